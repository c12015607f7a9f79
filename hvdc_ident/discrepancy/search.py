"""The search: one effect after the other, each looked for again beside the others, or done without.

A round screens everything on the model as it stands, refits the best, and judges the winner. From the gains of the best refits
the candidates at their places, and their effects at all places, are screened again, until nothing comes nearer. The gains that
the misfit has moved, and the given ones, are where a round begins.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from hvdc_ident.discrepancy.candidates import CandidateEffect, candidates, leaks
from hvdc_ident.discrepancy.evidence import (
    CandidateFit,
    Pick,
    Ruler,
    all_far_from_noise,
    at_edge,
    best_each,
    by_cost,
    cost_of,
    deficits,
    evidence_between,
    exceeds_noise,
    fall_beyond_loud_noise,
    is_clear,
    is_far_from_noise,
    is_noise,
    left_by,
    objections,
    resembles_noise,
    with_gain,
)
from hvdc_ident.discrepancy.forms import best_form, refitted_forms
from hvdc_ident.discrepancy.hypothesis import (
    FAILURES,
    Placed,
    Refit,
    RefitJob,
    built_in,
    gains_moved_far,
    joint_refit_job,
    judged,
    refit_again,
    scaled_sizes,
    slot_signals,
    with_given_gains,
)
from hvdc_ident.discrepancy.implied import TIED, implied, nearest, off_given
from hvdc_ident.discrepancy.movable import in_proportion
from hvdc_ident.discrepancy.moves import clocks, held_again, on_their_clocks, released
from hvdc_ident.discrepancy.options import BEAM, FIELD, SHORTLIST, TOLERANCE, SearchContext
from hvdc_ident.discrepancy.remainder import is_small
from hvdc_ident.discrepancy.residual_checks import tones
from hvdc_ident.discrepancy.rounds import LEFT_BEHIND, REFITS_PER_EFFECT, Race, Round, RoundModel, gains_of, refits_of
from hvdc_ident.discrepancy.screen import Score, ranked
from hvdc_ident.discrepancy.size_search import with_closer_sizes, with_searched_sizes
from hvdc_ident.effects import effects
from hvdc_ident.model import AnyModel

THOROUGH_FACTOR = 4
"""Times as many of a thorough search."""
MAX_FAMILIES = 6
"""Effects at several places in a field: each takes a compilation of its own."""
MAX_FOLLOWED = 3
"""Times that a round goes on from the gains of its best refits."""
LEADING_SHARE = 0.9
"""Share of the best fall of chi2 from which a refit leads on."""
NEARLY_SIGNIFICANT = 0.1
"""Chance under noise of the best fall below which a closer look is taken before nothing is said to be there."""
ONLY_A_FORM = "none of it leaves noise, and what is found from the data alone does"


def one_round(search: SearchContext, before: Refit, number: int, *, little: bool = False) -> Round:
    """Return a round on the model as it stands. Raises SimulationError where that model cannot be run.

    little: whether so little is left that only an effect that explains it is worth adding: a few refits show whether one may.
    """
    nominal = before.nominal()
    search.tell(0, 1, f"round {number}: the signals")
    signals = slot_signals(before)
    times = [e.time for e in before.problem.fitted_experiments]
    found = candidates(before.model, signals, times, search.effects, search.places, tones(nominal))
    there = {(p.candidate.effect, p.candidate.at, p.candidate.source) for p in before.placed}
    found = tuple(c for c in found if (c.effect, c.at, c.source) not in there and c.probes)
    round_model = RoundModel.of(search, before, found, number)
    text = f"round {number}: {len(found)} candidates"
    screen = round_model.screen(found, text)
    opened = Round(before, signals, found, screen)
    if not screen.scores:
        return replace(opened, why="no candidate leaves a trace in these data")
    p = screen.p(max(screen.scores[0].fall, 0.0))
    nothing = f"the best of all is what noise gives (p = {p:.2g})"
    loud = exceeds_noise(before) and not resembles_noise(before)
    if p > NEARLY_SIGNIFICANT and not loud:
        return replace(opened, why=nothing)
    if little or (p > search.options.significance and not loud):
        first = round_model.refitted(found, _field(search, found, screen.scores)[:SHORTLIST], f"round {number}")
        gains = [Ruler.of(t.refit).between(before, t.refit) for t in first if not t.refit.failure]
        named = max(gains, default=0.0) > search.options.named_bic
        if not (named and _significant(search, opened, first)) or (little and all_far_from_noise(before, first)):
            return replace(opened, failed=tuple(t for t in first if t.refit.failure), why=nothing)
    opened, trials = _explored(search, round_model, opened, number)
    if not _significant(search, opened, trials):
        return replace(opened, failed=tuple(t for t in trials if t.refit.failure), why=nothing)
    return judged_round(search, replace(opened, significant=True), trials, number)


def _significant(search: SearchContext, opened: Round, trials: Sequence[CandidateFit]) -> bool:
    """Return True where a refit makes chi2 fall by more than noise gives anywhere."""
    falls = [opened.before.chi2 - t.refit.chi2 for t in trials if not t.refit.failure]
    return opened.screen.p(max(falls, default=0.0)) <= search.options.significance


def _explored(
    search: SearchContext, round_model: RoundModel, opened: Round, number: int
) -> tuple[Round, list[CandidateFit]]:
    """Return the round with its refits."""
    found, text = opened.candidates, f"round {number}"
    most = opened.screen.scores[0].fall
    hopeful = [
        s for s in opened.screen.scores if s.fall >= Race().reach * most
    ]  # where none explains the records, all are
    opened, trials = _with_neighbours_of_leaders(
        round_model, opened, round_model.refitted(found, _field(search, found, hopeful), text), number
    )
    given = with_given_gains(opened.before)
    far = not search.spent and all_far_from_noise(opened.before, trials, near=TOLERANCE)
    if far:
        # Bends are missed between two sizes.
        opened = replace(opened, candidates=tuple(map(_denser, opened.candidates)))
        # A form shows by a few refits whether the catalogue lacks something, before all of it is looked at more closely.
        opened, trials = _outside(search, round_model, opened, trials, number)
        if opened.form is not None:
            return opened, trials
    if far and not search.spent:
        found = opened.candidates
        # Gains that make up for an effect may leave no trace of it.
        for point in (None,) if given is None else (None, given):
            if point is None:
                where = f"{text}: once more"
                denser = round_model.screen(found, where, known=opened.screen)
                every = ranked((*opened.screen.scores, *denser.scores), found)
            else:
                where = f"{text}: from the given values"
                which = round_model.promising(opened.screen, found, point)
                every = round_model.screen(found, where, which, point).scores
            scores = _field(search, found, every)
            trials = best_each([*trials, *round_model.refitted(found, scores, where, trials)])
        opened, trials = _with_neighbours_of_leaders(round_model, opened, trials, number)
    elif given is not None and not search.spent:
        # Beside an effect the records may be explained by other values of the parameters too.
        where, which = f"{text}: from the given values", [t.pick.candidate for t in by_cost(trials)[:REFITS_PER_EFFECT]]
        scores = [*round_model.screen(opened.candidates, where, which, given).best().values()]
        more = round_model.refitted(opened.candidates, scores, where, trials)
        opened, trials = _with_neighbours_of_leaders(round_model, opened, best_each([*trials, *more]), number)
    if not search.spent:
        opened, trials = with_searched_sizes(
            round_model, opened, trials, number, far=all_far_from_noise(opened.before, trials)
        )
    return _outside(search, round_model, opened, trials, number)


def _field(search: SearchContext, found: Sequence[CandidateEffect], scores: Sequence[Score]) -> list[Score]:
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


def _with_neighbours_of_leaders(
    round_model: RoundModel, opened: Round, trials: Sequence[CandidateFit], number: int
) -> tuple[Round, list[CandidateFit]]:
    """Return the trials with what is found from the gains and beside the sizes of the best, again while something comes nearer."""
    trials, led = best_each(trials), dict(opened.led)
    for _ in range(MAX_FOLLOWED):
        leaders = [t for t in _leaders(opened, trials) if cost_of(t) < led.get(t.pick.candidate, math.inf) - TIED]
        if not leaders or round_model.search.spent:
            break
        led |= {t.pick.candidate: cost_of(t) for t in leaders}
        least = cost_of(by_cost(trials)[0])
        more: list[CandidateFit] = []
        for t in leaders:
            opened, scores = _neighbours(round_model, opened, t, number)
            scores = _promising(opened.before, scores, [*trials, *more])
            more += round_model.refitted(opened.candidates, scores, f"round {number}: neighbours", [*trials, *more])
        opened, trials = with_closer_sizes(round_model, opened, best_each([*trials, *more]), number)
        if cost_of(by_cost(trials)[0]) > least - TIED:
            break
    return replace(opened, led=led), trials


def _promising(before: Refit, scores: Sequence[Score], trials: Sequence[CandidateFit]) -> list[Score]:
    """Return the scores that promise more than their candidates' refits have come to."""
    came_to: dict[int, float] = {}
    for t in trials:
        if t.refit.failure in ("", LEFT_BEHIND):
            came_to[t.pick.candidate] = min(t.refit.chi2, came_to.get(t.pick.candidate, math.inf))
    return [s for s in scores if before.chi2 - s.fall < came_to.get(s.candidate, math.inf) - TIED]


def _leaders(opened: Round, trials: Sequence[CandidateFit]) -> list[CandidateFit]:
    """Return the best refit of each of the best effects."""
    sound = by_cost(trials)
    if not sound:
        return []
    least = LEADING_SHARE * (opened.before.chi2 - sound[0].refit.chi2)
    each: dict[str, CandidateFit] = {}
    for t in sound:
        if opened.before.chi2 - t.refit.chi2 >= least:
            each.setdefault(opened.candidates[t.pick.candidate].effect, t)
    return list(each.values())[:BEAM]


def _neighbours(round_model: RoundModel, opened: Round, lead: CandidateFit, number: int) -> tuple[Round, list[Score]]:
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
    promising = [k for k in round_model.order(opened.screen, found, theta)[:FIELD] if k not in opened.promised]
    which = list(dict.fromkeys((*here, *like[: 2 * REFITS_PER_EFFECT], *parts, *around, *promising)))
    late = effects()[own.effect].delay_with(sizes)
    for k in promising:  # bends are missed between two sizes
        found[k] = _denser(found[k])
    for k in which:
        if found[k].effect == own.effect:
            found[k] = found[k].with_sizes([sizes])
        elif late:
            found[k] = found[k].with_sizes(_delaying(found[k], late))
    screen = round_model.screen(found, f"round {number}: beside {own.label}", which, theta)
    best = opened.before.chi2 - lead.refit.chi2
    near = [
        s
        for s in screen.scores
        if s.candidate != lead.pick.candidate
        # Of an effect in proportion to its size the fall is exact in that, and at the leader's gains hardly moves with them.
        and s.fall >= (Race().near if in_proportion(found[s.candidate], s.probe) else Race().reach) * best
    ]
    opened = replace(opened, candidates=tuple(found), promised=opened.promised | frozenset(promising))
    return opened, _field(round_model.search, found, near)


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


def _outside(
    search: SearchContext, round_model: RoundModel, opened: Round, trials: list[CandidateFit], number: int
) -> tuple[Round, list[CandidateFit]]:
    """Return the round with the refits of forms outside the catalogue, and the form that comes nearer than any effect, if one does.

    A form with many values finds the place and the gains where an effect, beside biased gains, did not: a filter whose poles and zeros
    meet is a gain. So every effect is tried there, begun with the gains that the form came to. Where one of them comes near the
    noise too, the catalogue lacks nothing. Forms are looked for in the first round, where the best refit takes away some of the misfit
    and leaves more than noise.
    """
    best = next(iter(by_cost(trials)), None)
    if number > 1 or not search.options.fallback or search.spent or best is None or not _explains_some(opened, trials):
        return opened, trials
    if is_noise(best.refit, search.seed):
        return opened, trials
    if opened.forms is None:
        opened = replace(opened, forms=refitted_forms(search, opened))
    form = best_form(search, opened, opened.forms or (), best.refit)
    if form is None or search.spent:
        return opened, trials
    at = form.refit.placed[-1].candidate.at
    which = [k for k, c in enumerate(opened.candidates) if c.at == at and not c.still]
    text = "round 1: in the stead of a form"
    screen = round_model.screen(opened.candidates, text, which, gains_of(opened.before, form.refit))
    scores = list(screen.best().values())[:FIELD]
    trials = best_each([*trials, *round_model.refitted(opened.candidates, scores, text, trials)])
    return replace(opened, form=form if all_far_from_noise(opened.before, trials) else None), trials


def _explains_some(opened: Round, trials: Sequence[CandidateFit]) -> bool:
    """Return True where a refit takes away a share of what is beyond noise: where none does, the noise is louder than stated."""
    least = opened.before.chi2 - fall_beyond_loud_noise(opened.before)
    return any(not t.refit.failure and t.refit.chi2 < least for t in trials)


def judged_round(search: SearchContext, opened: Round, trials: Sequence[CandidateFit], number: int) -> Round:
    """The round with its refits ranked and its winner, put into the model; or what speaks against the best.

    Ranked by what the fitted and the held-out data say together. Of those that are as good the likeliest wins: an effect's
    probability before any data is shared by all its places and sources, so an offset goes before one of many couplings. Of those
    that are as likely and imply other values of the parameters that one wins whose values are nearest to the given ones.
    """
    refitted = {t.pick.candidate for t in trials}
    trials = [*trials, *(t for t in opened.failed if t.pick.candidate not in refitted)]
    sound, failed = [t for t in trials if not t.refit.failure], tuple(t for t in trials if t.refit.failure)
    if not sound:
        return replace(opened, failed=failed, why="no candidate could be refitted")
    before, found = opened.before, opened.candidates
    ruler = Ruler.of(min(sound, key=lambda t: t.refit.chi2).refit)
    ranked = sorted((with_gain(t, before, ruler) for t in sound), key=lambda t: -t.total_gain)
    if opened.form is not None:
        return replace(opened, trials=tuple(ranked), failed=failed, ruler=ruler, why=ONLY_A_FORM)
    level = [t for t, behind in zip(ranked, deficits(ranked), strict=True) if behind <= search.options.set_bic]
    refused = {id(t): objection(search, before, t, opened, first=number == 1) for t in level}
    many = Counter(c.effect for c in found)
    unlikely = {id(t): 2.0 * np.log(many[found[t.pick.candidate].effect]) - t.total_gain for t in level}
    likeliest = sorted((t for t in level if not refused[id(t)]), key=lambda t: unlikely[id(t)])
    winner = next(iter(likeliest), None)
    if winner is not None:
        tied = [t for t in likeliest if unlikely[id(t)] <= unlikely[id(winner)] + TIED]
        winner = nearest(winner, tied, lambda t: implied(t.refit), lambda t: off_given(t.refit))
        winner = _well_named(before.model, found, winner, tied)
        placed = built_in(before, winner.refit)
        if placed.failure:
            return replace(
                opened,
                trials=tuple(ranked),
                failed=failed,
                ruler=ruler,
                why=f"{found[winner.pick.candidate].label}: {placed.failure}",
            )
        new = with_gain(replace(winner, refit=placed), before, ruler)
        ranked, winner = [new if t is winner else t for t in ranked], new
    why = "" if winner else f"{found[level[0].pick.candidate].label}: {refused[id(level[0])]}"
    return replace(opened, trials=tuple(ranked), failed=failed, winner=winner, why=why, ruler=ruler)


def _well_named(
    model: AnyModel, found: Sequence[CandidateEffect], winner: CandidateFit, tied: Sequence[CandidateFit]
) -> CandidateFit:
    """Return of those that explain as much as the winner, there and from there, one whose name suits these signals, where its own
    does not: reactive power that acts on a voltage is a droop, and no conductance."""
    own = found[winner.pick.candidate]
    if own.effect != "conductance" or all(leaks(model, own.at, s) for s in own.sources):
        return winner
    others = [t for t in tied if found[t.pick.candidate].effect in ("droop", "coupling")]
    there = [t for t in others if (found[t.pick.candidate].at, found[t.pick.candidate].source) == (own.at, own.source)]
    return next(iter(there), winner)


def objection(search: SearchContext, before: Refit, trial: CandidateFit, opened: Round, *, first: bool) -> str:
    """Objection to naming a trial's effect, in words; empty where there is none. opened: the round that knows what noise does."""
    p = opened.screen.p(before.chi2 - trial.refit.chi2)
    return objections(before, trial, p, search.options, search.tolerance, first=first)


@dataclass(frozen=True, eq=False)
class SearchOutcome:
    """Where the search ended.

    rounds: all of them; kept: by effect of the final model, the round that judges its rivals; notes: what could not be done.
    """

    refit: Refit
    rounds: tuple[Round, ...]
    kept: tuple[Round, ...]
    notes: tuple[str, ...] = ()


def two_start_search(search: SearchContext, first: Refit) -> SearchOutcome:
    """The search from the refitted gains; where that leaves more than anybody asks about, from the given ones if it then ends nearer.

    Gains that have moved far to make up for what is missing may leave no room for it: beside them a lag of its true size is
    unstable, and no score shows it. first: the nominal model, refitted.
    """
    outcome = forward_search(search, first)
    theta = with_given_gains(first)
    last = outcome.refit
    if (
        theta is None
        or not gains_moved_far(first)
        or not is_far_from_noise(first, last)
        or is_small(search, first, last)
        or search.spent
    ):
        return outcome
    search.tell(0, 1, "once more, from the given values")
    try:
        again = forward_search(search, judged(replace(first, theta=theta)))
    except FAILURES as error:
        return replace(outcome, notes=(*outcome.notes, f"from the given values nothing was looked for: {error}"))
    ruler = Ruler.of(min(last, again.refit, key=lambda r: r.chi2))
    nearer = bool(again.kept) and ruler.between(last, again.refit) > search.options.named_bic
    return again if nearer else outcome


def forward_search(search: SearchContext, first: Refit) -> SearchOutcome:
    """The effects that are added one after the other, each with all others refitted, until nothing is worth adding.

    Beside each of them, and beside none, parameters that were held are set free where the records speak against their values.
    """
    found = None
    if not search.held:  # a stated value has to bring more than an effect that leaves noise could leave it
        found = one_round(search, first, 1)
        if found.winner is not None and is_noise(found.winner.refit, search.seed):
            clocked = on_their_clocks(search, first, first)[1]
            if clocked is first or _behind(search, found.winner.refit, clocked) <= 0.0:
                return SearchOutcome(found.winner.refit, (found,), (found,))
    base, here = (first, first) if is_noise(first, search.seed) else released(search, first, first)
    if here is first:
        return _added_one_by_one(search, first, first, [found] if found else [])
    # Parameters may stand for a missing effect: then the effect has as much evidence, and they are asked again beside it.
    # Where it has no more, a candidate that was held is the likelier cause, and a stated value the less likely one.
    moved = set(here.problem.names) - set(first.problem.names)
    level = search.options.set_bic if moved & {f.name for f in search.stated} else -search.options.set_bic
    found = found or one_round(search, first, 1)
    if found.winner is not None and _behind(search, found.winner.refit, here) <= level:
        return _added_one_by_one(search, first, first, [found])
    with_parameters = _added_one_by_one(search, base, here, [])
    # A parameter may stand for one of several effects: that is seen when the others are there too.
    if found.winner is None or not with_parameters.kept or search.spent:
        return with_parameters
    with_effects = _added_one_by_one(search, first, first, [found])
    more = len(with_effects.kept) > len(with_parameters.kept)
    behind = _behind(search, with_effects.refit, with_parameters.refit)
    return with_effects if behind <= (-search.options.named_bic if more else level) else with_parameters


def _behind(search: SearchContext, one: Refit, other: Refit) -> float:
    """By how much evidence, in BIC, the first hypothesis is behind the other."""
    ruler = Ruler.of(min(one, other, key=lambda r: r.chi2))
    few, many = (len(r.problem.free) + len(clocks(search, r)) for r in (one, other))
    return evidence_between(one, other, ruler, many - few)


def _added_one_by_one(search: SearchContext, base: Refit, here: Refit, rounds: list[Round]) -> SearchOutcome:
    """The search from the nominal model `here`; rounds: its first, where that is done."""
    nominal = here
    kept: list[Round] = []
    notes: tuple[str, ...] = ()
    asked_again, little = None, False
    while len(kept) < search.options.most:
        if kept and search.spent:
            notes += ("The budget ended: no further effect was looked for.",)
            break
        try:
            if kept or not rounds:
                rounds.append(one_round(search, here, len(rounds) + 1, little=little))
        except FAILURES as error:
            if not kept:
                raise
            notes += (f"nothing was looked for beside {here.placed[-1].candidate.label}: {error}",)
            break
        found = rounds[-1]
        if found.winner is None:
            hopeful = (
                found.significant
                and found.form is None
                and not little
                and len(kept) + 1 < search.options.most
                and not (search.spent or is_noise(here, search.seed))
            )
            both = _masked_pair(search, here, found, len(rounds) + 1) if hopeful else None
            if both is None:
                break
            rounds[-1] = both[0]
            rounds.append(both[1])
            kept += both
            assert both[1].winner is not None
            here = both[1].winner.refit
            if not is_noise(here, search.seed):
                base, here = released(search, base, here)
            break
        # Nobody asks about so little of the gap: an effect is added to it only if it explains that.
        if little and is_far_from_noise(here, found.winner.refit):
            break
        kept.append(found)
        base, here = held_again(search, base, found.winner.refit)
        if is_noise(here, search.seed):
            break
        base, here = released(search, base, here)
        if is_noise(here, search.seed):
            break
        little = left_by(here) <= TOLERANCE * left_by(nominal)
        # An effect that stands for another one may be why something is left.
        if 1 < len(kept) < search.options.most and not (little or search.spent):
            here, kept, more = backward_elimination(search, base, here, kept, len(rounds))
            notes, asked_again = notes + more, here
            if is_noise(here, search.seed):
                break
    # Where a parameter was set free beside an effect, its rivals were refitted without that.
    if kept and not search.spent and asked_again is not here and (len(kept) > 1 or _closed_to(base, kept[0])):
        here, kept, more = backward_elimination(search, base, here, kept, len(rounds))
        notes += more
    return SearchOutcome(here, tuple(rounds), tuple(kept), notes)


def _closed_to(base: Refit, found: Round) -> bool:
    """Return True where a round held a parameter that has since been set free, or had the records on other clocks."""
    freed = {f.name for f in base.problem.free} - set(found.before.problem.names)
    return bool(freed) or base.problem.experiments[0].time is not found.before.problem.experiments[0].time


def _masked_pair(search: SearchContext, before: Refit, found: Round, number: int) -> tuple[Round, Round] | None:
    """Two rounds whose effects pass together though the first does not alone, for one masks the other; None where none do.

    The best hypotheses, of different effects or places, are each searched one step further.
    """
    passed: list[tuple[Round, Round]] = []
    for trial in _different(found)[:BEAM]:
        try:
            further = one_round(search, trial.refit, number)
        except FAILURES:
            continue
        if further.winner is None or further.ruler is None:
            continue
        whole = with_gain(further.winner, before, further.ruler)
        if not objection(search, before, whole, further, first=True):
            passed.append((replace(found, winner=trial, why=""), further))
    return max(passed, key=lambda pair: -pair[1].winner.refit.chi2 if pair[1].winner else -np.inf, default=None)


def _different(found: Round) -> list[CandidateFit]:
    """The best refit of each effect, the best first."""
    each: dict[str, CandidateFit] = {}
    for t in found.trials:
        each.setdefault(found.candidates[t.pick.candidate].effect, t)
    return list(each.values())


def backward_elimination(
    search: SearchContext, first: Refit, here: Refit, kept: Sequence[Round], number: int
) -> tuple[Refit, list[Round], tuple[str, ...]]:
    """The refit, by effect the round that judges its rivals, and what could not be done, after looking for each again and
    doing without it.

    here: the refit of the model `first` with several effects; kept: the rounds that brought them; number: rounds so far.
    Where all of them together are far from noise none is what is missing, and none is looked for again.
    """
    kept, notes = list(kept), []
    near = not is_far_from_noise(first, here)
    k = 0
    while k < len(kept):
        search.tell(k, len(kept), f"again with the others: {here.placed[k].candidate.label}")
        others = tuple(p for j, p in enumerate(here.placed) if j != k)
        without = refit_again(first, here, others)
        if without.failure:
            k += 1
            continue
        ruler = kept[k].ruler
        assert ruler is not None
        gain = ruler.gain(without.chi2, here.chi2, here.count - without.count)
        # An effect that was clearly there before the others came may be nothing beside them.
        if gain <= search.options.named_bic or at_edge(here, k) or not is_clear(here, k):
            here = without
            del kept[k]
            continue
        searched = _beside_these(kept[k], others, last=k == len(kept) - 1) and not _closed_to(first, kept[k])
        if near and not searched:
            try:
                again, winner = _searched_again(
                    search, first, here, kept[k], k, without, number + k + 1 if len(kept) > 1 else 1
                )
                kept[k] = again
                here = _in_place(winner.refit, k)
            except FAILURES as error:  # refitted it runs, as far as a refit needs it to
                notes.append(f"{here.placed[k].candidate.label} was not looked for again beside the others: {error}")
        k += 1
    return here, kept, tuple(notes)


def _beside_these(own: Round, others: Sequence[Placed], last: bool) -> bool:
    """Return True where the round that brought the last effect searched beside the others as they are, and refitted its rivals."""
    before = [p.candidate.label for p in own.before.placed]
    return last and len(own.trials) > 1 and before == [p.candidate.label for p in others]


def _searched_again(
    search: SearchContext, first: Refit, here: Refit, found: Round, k: int, without: Refit, number: int
) -> tuple[Round, CandidateFit]:
    """The round that looks for the effect in place k beside the others, and its winner: one that was not best alone may be.

    Those that came near it in its own round are tried too. The effect itself stays where nothing better may be named.
    """
    again = one_round(search, without, number)
    own = here.placed[k].candidate
    again, mine = _with_candidate(again, own)
    sound = [t for t in again.trials if t.pick.candidate != mine]
    tried = {own.label, *(again.candidates[t.pick.candidate].label for t in sound)}
    refits: list[tuple[Pick, RefitJob]] = []
    for trial in found.trials[: SHORTLIST + 1]:
        placed = trial.refit.placed[-1]
        among = tuple(placed if j == k else p for j, p in enumerate(here.placed))
        with suppress(*FAILURES):  # it cannot sit there beside the others: no rival
            job = joint_refit_job(first, here, among, {k: trial.refit.sizes(placed)})
            candidate = job.placed[k].candidate
            # Places behind an effect that is left out are one place without it.
            if candidate.label not in tried:
                tried.add(candidate.label)
                again, number_of = _with_candidate(again, candidate)
                refits.append((Pick(number_of, 0, 1.0, 0.0), job))
    texts = [f"again with the others: {again.candidates[p.candidate].label}" for p, _ in refits]
    ended = refits_of(search, [j for _, j in refits], texts)
    sound += [CandidateFit(p, _last(r, k), 0.0) for (p, _), r in zip(refits, ended, strict=True) if not r.failure]
    mine_again = [t for t in again.trials if t.pick.candidate == mine and t.refit.chi2 < here.chi2]
    sound.append(mine_again[0] if mine_again else CandidateFit(_pick(again, mine), _last(here, k), 0.0))
    ranked = judged_round(search, again, [*sound, *again.failed], number)
    winner = ranked.winner or next(t for t in ranked.trials if t.pick.candidate == mine)
    return replace(ranked, winner=winner), winner


def _with_candidate(found: Round, candidate: CandidateEffect) -> tuple[Round, int]:
    """The round with the candidate among its own, and where it stands there."""
    for k, c in enumerate(found.candidates):
        if c.label == candidate.label:
            return found, k
    return replace(found, candidates=(*found.candidates, candidate)), len(found.candidates)


def _pick(found: Round, candidate: int) -> Pick:
    """The size of a candidate that the screen likes best, or its first."""
    score = found.screen.best().get(candidate)
    return Pick(candidate, 0, 1.0, 0.0) if score is None else Pick(candidate, score.probe, score.factor, score.fall)


def _last(refit: Refit, k: int) -> Refit:
    """The refit with the effect in place k moved to the end, as that of a round is."""
    return _ordered(refit, [*(j for j in range(len(refit.placed)) if j != k), k])


def _in_place(refit: Refit, k: int) -> Refit:
    """The refit with the effect that is last back in place k."""
    order = list(range(len(refit.placed) - 1))
    order.insert(k, len(refit.placed) - 1)
    return _ordered(refit, order)


def _ordered(refit: Refit, order: Sequence[int]) -> Refit:
    return replace(refit, placed=tuple(refit.placed[j] for j in order), apart=tuple(refit.apart[j] for j in order))
