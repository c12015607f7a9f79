"""Effects as moves of the search: what is looked for beside a hypothesis, from some values of its unknowns, in some sizes.

An expansion begins with the screen of every candidate beside the hypothesis as it stands. Each further move adds trials to it: the best
of the screen, the best from other values of the parameters, sizes to which no slope leads, forms outside the catalogue.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

from hvdc_ident.discrepancy.candidates import CandidateEffect, candidates
from hvdc_ident.discrepancy.expansion import (
    LEFT_BEHIND,
    REFITS_PER_EFFECT,
    Expansion,
    ExpansionModel,
    Race,
    first_of,
    gains_of,
)
from hvdc_ident.discrepancy.hypothesis import Refit, scaled_sizes, slot_signals, with_given_gains
from hvdc_ident.discrepancy.movable import in_proportion
from hvdc_ident.discrepancy.options import BEAM, FIELD, SearchContext
from hvdc_ident.discrepancy.outside import best_form, refitted_forms
from hvdc_ident.discrepancy.residual_checks import tones
from hvdc_ident.discrepancy.score import TIED, CandidateFit, best_each, by_cost, cost_of
from hvdc_ident.discrepancy.screen import Score
from hvdc_ident.discrepancy.sizes import with_closer_sizes, with_searched_sizes
from hvdc_ident.effects import effects

THOROUGH_FACTOR = 4
"""Times as many of a thorough search."""
MAX_FAMILIES = 6
"""Effects at several places in a field: each takes a compilation of its own."""
LEADING_SHARE = 0.9
"""Share of the best fall of chi2 from which a refit leads on."""


def opened(search: SearchContext, here: Refit, number: int) -> tuple[ExpansionModel, Expansion]:
    """Return what candidates are compared on beside a hypothesis, and their screen. Raises SimulationError where it cannot be run.

    number: of the expansion, for its noise. Each candidate is run in two sizes at first, and in the others where these promise much.
    """
    search.tell(0, 1, f"round {number}: the signals")
    signals = slot_signals(here)
    times = [e.time for e in here.problem.fitted_experiments]
    found = candidates(here.model, signals, times, search.effects, search.places, tones(here.nominal()))
    there = {(p.candidate.effect, p.candidate.at, p.candidate.source) for p in here.placed}
    found = tuple(c for c in found if (c.effect, c.at, c.source) not in there and c.probes)
    model = ExpansionModel.of(search, here, found, number)
    text = f"round {number}: {len(found)} candidates"
    screen = model.screen(found, text, few_sizes=True)
    if not search.spent:
        best = screen.best()
        # A size at which a candidate does not run, as a slow filter in a loop does not, says nothing of its others.
        which = [*first_of(list(best), found), *(k for k in range(len(found)) if k not in best)]
        screen = screen.with_(model.screen(found, text, which, known=screen), found)
    return model, Expansion(here, signals, found, screen)


def raced(
    model: ExpansionModel, opened: Expansion, text: str, reached: float, worth: Callable[[Score], bool]
) -> Expansion:
    """Return the expansion with refits of the candidates that promise most by its screen.

    reached: by how much chi2 fell with the best hypothesis so far. worth: whether a score is worth its price, where that is asked.
    """
    most = max(opened.screen.scores[0].fall, reached, 0.0) if opened.screen.scores else 0.0
    # Where none explains the records, all are hopeful.
    hopeful = [s for s in opened.screen.scores if s.fall >= Race().reach * most and worth(s)]
    return _with(opened, model.refitted(opened.candidates, field(model.search, opened.candidates, hopeful), text))


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
    which = [t.pick.candidate for t in by_cost(opened.trials)[:REFITS_PER_EFFECT]]
    scores = [*model.screen(opened.candidates, text, which, given).best().values()]
    return _with(opened, model.refitted(opened.candidates, scores, text, opened.trials))


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
    return _with(opened, model.refitted(opened.candidates, _promising(opened, taken), text, opened.trials))


def beside_leaders(model: ExpansionModel, opened: Expansion, text: str) -> Expansion:
    """Return the expansion with what is found from the parameters and beside the sizes of the best refits; as it is where these led
    already."""
    led = dict(opened.led)
    leaders = [t for t in _leaders(opened) if cost_of(t) < led.get(t.pick.candidate, math.inf) - TIED]
    led |= {t.pick.candidate: cost_of(t) for t in leaders}
    for t in leaders:
        if model.search.spent:
            break
        opened, scores = _neighbours(model, opened, t, text)
        more = model.refitted(opened.candidates, _promising(opened, scores), text, opened.trials)
        opened = _with(opened, more)
    opened, trials = with_closer_sizes(model, opened, list(opened.trials), text)
    return replace(opened, led=led, trials=tuple(trials))


def searched_sizes(model: ExpansionModel, opened: Expansion, text: str, *, far: bool) -> Expansion:
    """Return the expansion with effects whose size has to be met. far: whether nothing explains the records so far."""
    opened, trials = with_searched_sizes(model, opened, list(opened.trials), text, far=far)
    return replace(opened, trials=tuple(trials))


def outside(model: ExpansionModel, opened: Expansion, text: str) -> Expansion:
    """Return the expansion with refits of forms outside the catalogue, and of every effect at the place of the best form, from its gains.

    A form with many values finds the place and the gains where an effect, beside biased gains, did not: a filter whose poles and zeros
    meet is a gain.
    """
    if opened.forms is None:
        opened = replace(opened, forms=refitted_forms(model.search, opened))
    best = next(iter(by_cost(opened.trials)), None)
    form = best_form(model.search, opened, opened.forms or (), None if best is None else best.refit)
    if form is None or model.search.spent:
        return opened
    at = form.refit.placed[-1].candidate.at
    which = [k for k, c in enumerate(opened.candidates) if c.at == at and not c.still]
    screen = model.screen(opened.candidates, text, which, gains_of(opened.before, form.refit))
    scores = list(screen.best().values())[:FIELD]
    return _with(opened, model.refitted(opened.candidates, scores, text, opened.trials))


def _with(opened: Expansion, more: Sequence[CandidateFit]) -> Expansion:
    return replace(opened, trials=tuple(best_each([*opened.trials, *more])))


def _promising(opened: Expansion, scores: Sequence[Score]) -> list[Score]:
    """Return the scores that promise more than their candidates' refits have come to."""
    came_to: dict[int, float] = {}
    for t in opened.trials:
        if t.refit.failure in ("", LEFT_BEHIND):
            came_to[t.pick.candidate] = min(t.refit.chi2, came_to.get(t.pick.candidate, math.inf))
    return [s for s in scores if opened.before.chi2 - s.fall < came_to.get(s.candidate, math.inf) - TIED]


def _leaders(opened: Expansion) -> list[CandidateFit]:
    """Return the best refit of each of the best effects."""
    sound = by_cost(opened.trials)
    if not sound:
        return []
    least = LEADING_SHARE * (opened.before.chi2 - sound[0].refit.chi2)
    each: dict[str, CandidateFit] = {}
    for t in sound:
        if opened.before.chi2 - t.refit.chi2 >= least:
            each.setdefault(opened.candidates[t.pick.candidate].effect, t)
    return list(each.values())[:BEAM]


def _neighbours(
    model: ExpansionModel, opened: Expansion, lead: CandidateFit, text: str
) -> tuple[Expansion, list[Score]]:
    """Return the round and the scores of what is at the leader's places, is its effect, or promises most, from the gains that the leader
    came to.

    Its effect elsewhere, and at several places of which one is the leader's, is tried in the leader's size too, and another kind
    of delay there with a delay as long. What promises most there is ranked by the answers of the screen: beside gains that make up for
    what is missing, it was misjudged.
    """
    own = opened.candidates[lead.pick.candidate]
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
        if s.candidate != lead.pick.candidate
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
