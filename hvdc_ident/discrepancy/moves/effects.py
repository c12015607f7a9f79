"""Effects as terms: what is looked for beside a hypothesis, from some values of its unknowns, in some sizes.

An expansion begins with the screen of every candidate beside the hypothesis as it stands. Each further move adds trials to it: the best
of the screen, the best from other values of the parameters and beside the best refits; `sizes` and `outside` add more.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from hvdc_ident.discrepancy.candidates import CandidateEffect, candidates
from hvdc_ident.discrepancy.expansion import (
    LEFT_BEHIND,
    REFITS_PER_EFFECT,
    Expansion,
    ExpansionModel,
    Race,
    Trial,
    by_cost,
    cost_of,
    first_of,
    gains_of,
)
from hvdc_ident.discrepancy.hypothesis import Refit, scaled_sizes, slot_signals, with_given_gains
from hvdc_ident.discrepancy.movable import in_proportion
from hvdc_ident.discrepancy.moves.sizes import with_closer_sizes, with_levels, with_periods
from hvdc_ident.discrepancy.options import BEAM, FIELD, SearchContext
from hvdc_ident.discrepancy.residual_checks import tones
from hvdc_ident.discrepancy.score import TIED
from hvdc_ident.discrepancy.screen import Score, Screen, Sketch
from hvdc_ident.discrepancy.search import Hypothesis, Move, Search, Term
from hvdc_ident.effects import effects

THOROUGH_FACTOR = 4
"""Times as many of a thorough search."""
MAX_FAMILIES = 6
"""Effects at several places in a field: each takes a compilation of its own."""
LEADING_SHARE = 0.9
"""Share of the best fall of chi2 from which a refit leads on."""


def looked_for(search: Search, h: Hypothesis) -> list[Hypothesis]:
    """Hypotheses with one effect more, as the screen beside this one ranks them."""
    h = search.ready(h)
    if h.refit.failure:
        return []
    number = len(search.expansions) + 1
    model, expansion = opened(search.context, h.refit, number, search.expansions.get(search.root.key))
    search.models[h.key] = model
    search.expansions[h.key] = expansion
    if not expansion.screen.scores:
        return []
    ruler, found = search.ruler, expansion.candidates
    best, noise = search.ranked()[0], search.is_noise(h)

    def worth(s: Score) -> bool:
        c = found[s.candidate]
        price = ruler.price * len(c.probes[s.probe].free) - 2.0 * math.log(expansion.prior(c.effect))
        return not noise or ruler.share * s.fall > price

    reached = h.refit.chi2 - best.refit.chi2 if search.is_noise(best) else 0.0
    return kept(search, h, raced(model, expansion, f"round {number}", reached, worth))


def again(
    look: Callable[[ExpansionModel, Expansion, str], Expansion], text: str
) -> Callable[[Search, Hypothesis], list[Hypothesis]]:
    """Return a move that looks for more in an expansion that is open."""

    def move(search: Search, h: Hypothesis) -> list[Hypothesis]:
        expansion = search.expansions.get(h.key)
        if expansion is None or not expansion.trials:
            return []
        return kept(search, h, look(search.models[h.key], expansion, text))

    return move


def kept(search: Search, h: Hypothesis, expansion: Expansion) -> list[Hypothesis]:
    """Keep an expansion with its trials, and return these as hypotheses."""
    search.expansions[h.key] = expansion
    return extended(h, expansion, expansion.trials)


def extended(h: Hypothesis, expansion: Expansion, trials: Sequence[Trial]) -> list[Hypothesis]:
    """Return the hypotheses that trials of an expansion make of a hypothesis; none of what was not refitted to its end."""
    children = []
    for t in trials:
        r = t.refit
        if r.failure or not r.rows or r.predicted is None:
            continue
        c = r.placed[-1].candidate
        term = Term(c.effect, c.at, c.source, expansion.prior(c.effect))
        children.append(Hypothesis(r, h.base, (*h.terms, term), expansion.before if r.placed[-1].movable else None))
    return children


def opened(
    search: SearchContext, here: Refit, number: int, known: Expansion | None = None
) -> tuple[ExpansionModel, Expansion]:
    """Return what candidates are compared on beside a hypothesis, and their screen. Raises SimulationError where it cannot be run.

    number: of the expansion, for its noise. Each candidate is run in two sizes at first, and in the others where these promise much.
    known: what was looked for beside the model without terms; what promises little by the answers that it had there is not run.
    """
    search.tell(0, 1, f"round {number}: the signals")
    signals = slot_signals(here)
    times = [e.time for e in here.problem.fitted_experiments]
    found = candidates(here.model, signals, times, search.effects, search.places, tones(here.nominal()))
    there = {(p.candidate.effect, p.candidate.at, p.candidate.source) for p in here.placed}
    found = tuple(c for c in found if (c.effect, c.at, c.source) not in there and c.probes)
    model = ExpansionModel.of(search, here, found, number)
    text = f"round {number}: {len(found)} candidates"
    screen = model.screen(found, text, None if known is None else _as_promising(model, known, found), few_sizes=True)
    if known is not None:
        screen = replace(screen, largest=np.maximum(screen.largest, known.screen.largest))
    if not search.spent:
        best = screen.best()
        # A size at which a candidate does not run, as a slow filter in a loop does not, says nothing of its others.
        which = [*first_of(list(best), found), *screen.failures]
        screen = Screen.of([screen, model.screen(found, text, which, known=screen)], found)
    return model, Expansion(here, signals, found, screen)


def _as_promising(model: ExpansionModel, known: Expansion, found: Sequence[CandidateEffect]) -> list[int] | None:
    """Return the candidates that promise most by the answers of the same ones in another expansion, and those that were not among them;
    None where it has other rows."""
    if any(answer.size != Sketch(model.setup.nominal.residual.size).size for answer in known.screen.answers.values()):
        return None
    order = model.promising(known.screen, known.candidates, model.setup.point)
    taken, there = {known.candidates[k].label for k in order}, {c.label for c in known.candidates}
    return [k for k, c in enumerate(found) if c.label in taken or c.label not in there]


def raced(
    model: ExpansionModel, opened: Expansion, text: str, reached: float, worth: Callable[[Score], bool]
) -> Expansion:
    """Return the expansion with refits of the candidates that promise most by its screen.

    reached: by how much chi2 fell with the best hypothesis so far. worth: whether a score is worth its price, where that is asked.
    """
    most = max(opened.screen.scores[0].fall, reached, 0.0) if opened.screen.scores else 0.0
    # Where none explains the records, all are hopeful.
    hopeful = [s for s in opened.screen.scores if s.fall >= Race().reach * most and worth(s)]
    return opened.with_trials(model.refitted(opened.candidates, field(model.search, opened.candidates, hopeful), text))


def field(search: SearchContext, found: Sequence[CandidateEffect], scores: Sequence[Score]) -> list[Score]:
    """Return the scores that are refitted: of each effect the best candidates."""
    count: Counter[str] = Counter()
    several, most = 0, REFITS_PER_EFFECT * (THOROUGH_FACTOR if search.options.thorough else 1)
    taken: dict[int, Score] = {}
    for s in scores:
        c = found[s.candidate]
        if s.candidate in taken or count[c.effect] >= most or (len(c.at) > 1 and several >= MAX_FAMILIES):
            continue
        count[c.effect] += 1
        several += len(c.at) > 1
        taken[s.candidate] = s
    return [*taken.values()]


def best_from_given(model: ExpansionModel, opened: Expansion, text: str) -> Expansion:
    """Return the expansion with the best of its refits begun from the given values too: beside an effect other values of the parameters may
    explain the records as well."""
    given = with_given_gains(opened.before)
    if given is None:
        return opened
    which = [t.score.candidate for t in by_cost(opened.trials)[:REFITS_PER_EFFECT]]
    scores = [*model.screen(opened.candidates, text, which, given).best().values()]
    return opened.with_trials(model.refitted(opened.candidates, scores, text, opened.trials))


def from_given(model: ExpansionModel, opened: Expansion, text: str) -> Expansion:
    """Return the expansion with refits of what promises most beside the given values of the parameters: refitted ones that make up for an
    effect may leave no trace of it. Bends are run in sizes closer to each other."""
    given = with_given_gains(opened.before)
    opened = replace(opened, candidates=tuple(map(_denser, opened.candidates)))
    point = opened.before.theta if given is None else given
    which = model.promising(opened.screen, opened.candidates, point)
    known = opened.screen if given is None else None
    scores = model.screen(opened.candidates, text, which, given, known=known).scores
    taken = field(model.search, opened.candidates, scores)
    return opened.with_trials(model.refitted(opened.candidates, _promising(opened, taken), text, opened.trials))


def beside_leaders(model: ExpansionModel, opened: Expansion, text: str) -> Expansion:
    """Return the expansion with what is found from the parameters and beside the sizes of the best refits; as it is where these led
    already."""
    led = dict(opened.led)
    leaders = [t for t in leaders_of(opened) if cost_of(t) < led.get(t.score.candidate, math.inf) - TIED]
    led |= {t.score.candidate: cost_of(t) for t in leaders}
    for t in leaders:
        if model.search.spent:
            break
        opened, scores = _neighbours(model, opened, t, text)
        more = model.refitted(opened.candidates, _promising(opened, scores), text, opened.trials)
        opened = opened.with_trials(more)
    return replace(with_closer_sizes(model, opened, text), led=led)


def _promising(opened: Expansion, scores: Sequence[Score]) -> list[Score]:
    """Return the scores that promise more than their candidates' refits have come to."""
    came_to: dict[int, float] = {}
    for t in opened.trials:
        if t.refit.failure in ("", LEFT_BEHIND):
            came_to[t.score.candidate] = min(t.refit.chi2, came_to.get(t.score.candidate, math.inf))
    return [s for s in scores if opened.before.chi2 - s.fall < came_to.get(s.candidate, math.inf) - TIED]


def leaders_of(opened: Expansion) -> list[Trial]:
    """Return the best refit of each of the best effects."""
    sound = by_cost(opened.trials)
    if not sound:
        return []
    least = LEADING_SHARE * (opened.before.chi2 - sound[0].refit.chi2)
    each: dict[str, Trial] = {}
    for t in sound:
        if opened.before.chi2 - t.refit.chi2 >= least:
            each.setdefault(opened.candidates[t.score.candidate].effect, t)
    return list(each.values())[:BEAM]


def _neighbours(model: ExpansionModel, opened: Expansion, lead: Trial, text: str) -> tuple[Expansion, list[Score]]:
    """Return the round and the scores of what is at the leader's places, is its effect, or promises most, from the gains that the leader
    came to.

    Its effect elsewhere, and at several places of which one is the leader's, is tried in the leader's size too, and another kind
    of delay there with a delay as long. What promises most there is ranked by the answers of the screen: beside gains that make up for
    what is missing, it was misjudged.
    """
    own = opened.candidates[lead.score.candidate]
    sizes = lead.refit.sizes(lead.refit.placed[-1])
    found = list(opened.candidates)
    same = [k for k in opened.screen.best() if found[k].effect == own.effect]
    like = [k for k in same if len(found[k].at) == len(own.at)]
    around = [k for k in same if set(found[k].at) > set(own.at)]
    parts = [k for k in same if len(found[k].at) == 1 and any(found[k].at[0] in found[f].at for f in around)]
    here = [k for k, c in enumerate(found) if set(c.at) <= set(own.at) and not c.still]
    theta = gains_of(opened.before, lead.refit)
    promising = [k for k in model.order(opened.screen, found, theta)[:FIELD] if k not in opened.promised]
    which = list(dict.fromkeys((*here, *like[: 2 * REFITS_PER_EFFECT], *parts, *around, *promising)))
    late = effects()[own.effect].delay_with(sizes)
    for k in promising:  # bends are missed between two sizes
        found[k] = _denser(found[k])
    for k in which:
        if found[k].effect == own.effect:
            found[k] = found[k].with_sizes([sizes])
        elif late:
            found[k] = found[k].with_sizes(_delaying(found[k], late))
    screen = model.screen(found, f"{text} {own.label}", which, theta)
    best = opened.before.chi2 - lead.refit.chi2
    near = [
        s
        for s in screen.scores
        if s.candidate != lead.score.candidate
        # Of an effect in proportion to its size the fall is exact in that, and at the leader's gains hardly moves with them.
        and s.fall >= (Race().near if in_proportion(found[s.candidate], s.probe) else Race().reach) * best
    ]
    opened = replace(opened, candidates=tuple(found), promised=opened.promised | frozenset(promising))
    return opened, field(model.search, found, near)


def _denser(candidate: CandidateEffect) -> CandidateEffect:
    """Return a candidate with three times as many sizes, where it has one size and bends what it acts on."""
    values = [p.values[n] for p in candidate.probes for n in p.free if len(p.free) == 1]
    if len(values) < max(2, len(candidate.probes)) or min(values) <= 0.0 or in_proportion(candidate, 0):
        return candidate
    (name,) = candidate.probes[0].free
    ends = sorted(values)
    between = [a * (b / a) ** share for a, b in pairwise(ends) for share in (1 / 3, 2 / 3)]
    return candidate.with_sizes([{**candidate.probes[0].values, name: v} for v in between])


def _delaying(candidate: CandidateEffect, late: float) -> list[dict[str, float]]:
    """Return the sizes at which a candidate delays so long, from its probe that delays most alike; none of what is no delay."""
    delays = [effects()[candidate.effect].delay_with(p.values) for p in candidate.probes]
    near = {n: abs(math.log(d / late)) for n, d in enumerate(delays) if d is not None and d * late > 0.0}
    if not near:
        return []
    n = min(near, key=lambda k: near[k])
    return [scaled_sizes(candidate, n, late / (delays[n] or late))]


MOVES = (
    Move("effects", 1, looked_for, in_stead=True),
    Move("the best from the given values", 1, again(best_from_given, "from the given values")),
    Move("from the given values", 2, again(from_given, "from the given values")),
    Move("beside the leaders", 2, again(beside_leaders, "beside")),
    Move("beside the new leaders", 3, again(beside_leaders, "beside")),
    Move("periods of samplers", 2, again(with_periods, "sizes to be met")),
    Move("levels of quantisers", 3, again(with_levels, "sizes to be met")),
)
