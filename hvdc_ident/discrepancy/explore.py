"""One step of the search: refit what promises most, then its neighbours, until nothing comes nearer."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace

from hvdc_ident.discrepancy.context import Round, SearchContext
from hvdc_ident.discrepancy.evidence import CandidateFit, Pick
from hvdc_ident.discrepancy.neighbours import gains_of, late_of, with_neighbours
from hvdc_ident.discrepancy.nominal import Nominal
from hvdc_ident.discrepancy.options import BEAM, FIELD, TOLERANCE
from hvdc_ident.discrepancy.outside.filtered import filtered, filters
from hvdc_ident.discrepancy.outside.law import law
from hvdc_ident.discrepancy.proposals import (
    View,
    by_absorbed,
    by_latent,
    by_score,
    by_score_elsewhere,
    views_of,
)
from hvdc_ident.discrepancy.refitted import (
    all_far,
    best_each,
    by_cost,
    is_noise,
    once_more,
    refitted,
    telling,
)
from hvdc_ident.discrepancy.remainder import is_small
from hvdc_ident.discrepancy.size_profile import has_to_be_met

OF_EFFECT = 8
"""Of one effect among these at most: places that cannot be told apart are neighbours, and come later."""
BATCHES = 1
"""Further times that so many are refitted where nothing comes near the noise, unless a thorough search is asked for."""


def explored(
    search: SearchContext, opened: Round, nominal: Nominal, number: int
) -> tuple[Round, tuple[CandidateFit, ...]]:
    """The round and its refits. A first round goes on until a refit comes near the noise or nothing is left to try."""
    views, scored = views_of(opened, nominal), opened
    opened, more = by_latent(search, opened, views, number, lambda c: not has_to_be_met(c))
    chance = opened.scores.threshold(0.5)
    field = sorted((p for p in [*by_score(opened), *more] if max(p.score, p.fall) > chance), key=lambda p: -p.fall)
    taken = _entrants(opened, field)
    trials = refitted(search, opened, taken, f"round {number}")
    asked: set[Hashable] = set()
    opened, trials = with_neighbours(search, opened, trials, field, number, asked)
    if (absorbed := by_absorbed(scored)) and not search.spent:
        text = f"round {number}: what the parameters may stand for"
        trials = best_each([*trials, *refitted(search, opened, absorbed, text, trials)])
    if not (_noise(search, trials) or search.spent):
        given = _entrants(scored, by_score_elsewhere(search, scored, views))
        if given:
            trials = [*trials, *refitted(search, opened, given, f"round {number}: from the given values", trials)]
            opened, trials = with_neighbours(search, opened, trials, [*field, *given], number, asked)
    opened, trials = _with_sizes_to_be_met(search, opened, trials, field, views, number, asked)
    if number == 1 and _tells(opened, trials):
        if search.options.fallback and not (_noise(search, trials) or search.spent):
            opened = _outside(search, opened, nominal, trials)
            opened, trials = _in_its_stead(search, opened, trials, field)
        opened, trials = _with_the_others(search, opened, trials, field, taken, asked)
    return opened, tuple(trials)


def _with_sizes_to_be_met(
    search: SearchContext,
    opened: Round,
    trials: list[CandidateFit],
    field: Sequence[Pick],
    views: Callable[[], Sequence[View]],
    number: int,
    asked: set[Hashable],
) -> tuple[Round, list[CandidateFit]]:
    """The trials with sizes that have to be met: where nothing explains the records, and where what does is a kind of delay."""
    far = all_far(opened.before, trials, near=TOLERANCE)
    late = {opened.candidates[t.pick.candidate].at for t in by_cost(trials)[:BEAM] if late_of(t) is not None}
    if search.spent or not (far or late):
        return opened, trials
    opened, more = by_latent(search, opened, views, number, lambda c: has_to_be_met(c) and (far or c.at in late))
    if not more:
        return opened, trials
    met = refitted(search, opened, _entrants(opened, more), f"round {number}: sizes to be met", trials)
    trials = once_more(search, opened, best_each([*trials, *met]), f"round {number}: sizes to be met")
    return with_neighbours(search, opened, trials, [*field, *more], number, asked)


def _with_the_others(
    search: SearchContext,
    opened: Round,
    trials: list[CandidateFit],
    field: Sequence[Pick],
    taken: Sequence[Pick],
    asked: set[Hashable],
) -> tuple[Round, list[CandidateFit]]:
    """The trials with proposals that promise less, so many at a time while nothing explains the gap.

    taken: those that were refitted. The round keeps the number of those that never were.
    """
    done = {id(p) for p in taken}
    batches = math.inf if search.options.thorough else BATCHES
    while _unexplained(search, opened, trials) and not opened.law:
        rest = [p for p in field if id(p) not in done]
        taken = _entrants(opened, rest)
        if not taken or not batches or search.spent:
            return replace(opened, untried=len(rest)), trials
        batches -= 1
        done |= {id(p) for p in taken}
        trials = best_each([*trials, *refitted(search, opened, taken, "round 1: the others", trials)])
        opened, trials = with_neighbours(search, opened, trials, field, 1, asked)
    return opened, trials


def _unexplained(search: SearchContext, opened: Round, trials: Sequence[CandidateFit]) -> bool:
    """Return True where no refit comes near the noise, and the best leaves more of the gap than a verdict passes over."""
    far = all_far(opened.before, trials)
    return far and not any(is_small(search, opened.before, t.refit) for t in by_cost(trials)[:BEAM])


def _noise(search: SearchContext, trials: Sequence[CandidateFit]) -> bool:
    best = next(iter(by_cost(trials)), None)
    return best is None or is_noise(best.refit, search.seed)


def _outside(search: SearchContext, opened: Round, nominal: Nominal, trials: Sequence[CandidateFit]) -> Round:
    """The round with a filter, or where nothing explains the gap a formula, from outside the catalogue, if one does."""
    best = by_cost(trials)[0].refit
    tried = filters(search, opened, nominal)
    opened = replace(opened, filters=tried)
    found = filtered(search, opened, tried, best)
    if found is None and _unexplained(search, opened, trials):
        found = law(search, opened, best)
        return replace(opened, laws=() if found is None else (found,))
    return opened if found is None else replace(opened, laws=(found,))


def _in_its_stead(
    search: SearchContext, opened: Round, trials: list[CandidateFit], field: Sequence[Pick]
) -> tuple[Round, list[CandidateFit]]:
    """The trials with every proposal at the place of a form from outside the catalogue, begun with the gains that it came to.

    A form with many parameters finds the place and the gains where a score, taken with biased gains, did not: a filter whose
    poles and zeros meet is a gain. Where an effect comes near the noise there too, the catalogue lacks nothing.
    """
    law = opened.law
    if law is None or search.spent:
        return opened, trials
    gains = gains_of(opened, law.refit)
    best: dict[int, Pick] = {}
    for p in field:
        if opened.candidates[p.candidate].at == law.refit.placed[-1].candidate.at:
            best.setdefault(p.candidate, replace(p, gains=gains))
    picks = sorted(best.values(), key=lambda p: -p.score)[:FIELD]
    trials = best_each([*trials, *refitted(search, opened, picks, "round 1: in the stead of a form", trials)])
    if all_far(opened.before, trials):
        return opened, trials
    return replace(opened, laws=(replace(law, near=False),)), trials


def _tells(opened: Round, trials: Sequence[CandidateFit]) -> bool:
    """Return True where a refit takes away a share of what is beyond noise: where none does, the noise is louder than stated."""
    least = opened.before.chi2 - telling(opened.before)
    return any(not t.refit.failure and t.refit.chi2 < least for t in trials)


def _entrants(opened: Round, field: Sequence[Pick]) -> list[Pick]:
    """The proposals that are refitted first: those that promise most, not all of them one effect."""
    effect_count: dict[str, int] = {}
    place_count: dict[tuple, int] = {}
    taken: list[Pick] = []
    for p in field:
        c = opened.candidates[p.candidate]
        place = c.effect, c.at, c.source
        if len(taken) == FIELD:
            break
        if effect_count.get(c.effect, 0) >= OF_EFFECT or place_count.get(place, 0) >= BEAM:
            continue
        effect_count[c.effect] = effect_count.get(c.effect, 0) + 1
        place_count[place] = place_count.get(place, 0) + 1
        taken.append(p)
    return taken
