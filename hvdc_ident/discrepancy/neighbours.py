"""Neighbours of the best hypotheses, refitted from where these ended.

A neighbour differs in one thing: the place, the effect, or the parts of the effect. It begins at the size that does the same (a
delay as long, a level as high) and with the gains that the refit came to, for these are nearer to the truth than those which the
misfit has moved.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace

from hvdc_ident.discrepancy.context import Round, SearchContext
from hvdc_ident.discrepancy.evidence import CandidateFit, Pick
from hvdc_ident.discrepancy.options import BEAM, FIELD
from hvdc_ident.discrepancy.proposals import has_one_size, joined
from hvdc_ident.discrepancy.refit import Refit
from hvdc_ident.discrepancy.refitted import all_far, best_each, by_cost, refitted
from hvdc_ident.discrepancy.signatures.candidates import CandidateEffect
from hvdc_ident.discrepancy.signatures.finite import is_linear, kind_of
from hvdc_ident.discrepancy.size_profile import has_to_be_met, resized
from hvdc_ident.effects import Probe, effects

TURNS = 3
"""Times that the neighbours of what is then best are refitted."""
LEVEL = 0.9
"""Share of the best fall of chi2 from which a refit's neighbours are worth a refit, and of what could be explained at its place."""


def with_neighbours(
    search: SearchContext,
    opened: Round,
    trials: Sequence[CandidateFit],
    field: Sequence[Pick],
    number: int,
    asked: set[Hashable],
) -> tuple[Round, list[CandidateFit]]:
    """The trials with the neighbours of the best, again while one of these is better.

    asked: what the round has refitted as neighbours before, and from which gains; those asked for now are added.
    """
    trials = best_each(trials)
    if search.spent:
        return opened, trials
    turned: set[tuple[int, int]] = set()
    for _ in range(TURNS):
        leaders = _leaders(opened, trials)
        if not leaders:
            break
        opened, picks = _neighbours(opened, leaders, trials, field, turned, asked)
        if not picks:
            break
        before = by_cost(trials)[0]
        more = refitted(search, opened, picks, f"round {number}: neighbours", trials)
        trials = best_each([*trials, *more])
        if by_cost(trials)[0] is before:
            break
    return opened, trials


def _leaders(opened: Round, trials: Sequence[CandidateFit]) -> list[CandidateFit]:
    """The best refit of each of the best effects."""
    sound = by_cost(trials)
    if not sound:
        return []
    least = LEVEL * (opened.before.chi2 - sound[0].refit.chi2)
    each: dict[str, CandidateFit] = {}
    for t in sound:
        if opened.before.chi2 - t.refit.chi2 >= least:
            each.setdefault(opened.candidates[t.pick.candidate].effect, t)
    return list(each.values())[:BEAM]


_Asked = tuple[int, int, tuple[float, ...], int]
"""A leader, a neighbour of it, the leader's gains, and how many sizes were proposed for the neighbour."""


@dataclass(frozen=True)
class _Lead:
    """A hypothesis whose neighbours are asked for.

    number: of its candidate; probe: the one it began at. gains: the unknowns of the model before at its end. sizes: of its
    effect. late: by how long that delays a slow signal, s; None for what is no kind of delay.
    """

    number: int
    candidate: CandidateEffect
    probe: int
    gains: tuple[float, ...]
    sizes: Mapping[str, float]
    late: float | None

    @classmethod
    def of(cls, opened: Round, trial: CandidateFit) -> _Lead:
        refit, number = trial.refit, trial.pick.candidate
        sizes = refit.sizes(refit.placed[-1])
        return cls(number, opened.candidates[number], trial.pick.probe, gains_of(opened, refit), sizes, late_of(trial))

    def is_elsewhere(self, other: CandidateEffect) -> bool:
        """Return True for the same effect at another place."""
        return other.effect == self.candidate.effect and other.at != self.candidate.at

    def probe_of(self, other: CandidateEffect) -> Probe | None:
        """The probe of another candidate with the sizes that were found, to the last digit; None where it has sizes of other names.

        A limit and a saturation have a level each; a letter that two linear effects share, an offset and a loss, is chance.
        """
        if other.effect != self.candidate.effect and is_linear(kind_of(other, 0)):
            return None
        own = set(self.candidate.probes[self.probe].free)
        alike = [p for p in other.probes if set(p.free) <= set(self.sizes)]
        if not alike:
            return None
        found = next((p for p in alike if set(p.free) == own), alike[0])
        for name in found.free:
            found = resized(found, name, self.sizes[name])
        return found

    def is_in_stead(self, other: CandidateEffect) -> bool:
        """Return True for another effect at the same place that may be the true one with the gains that were found: one whose size
        no slope at 0 tells, or one that brings nothing in, of which a refit from other gains may have come to nothing."""
        if other.at != self.candidate.at or other.effect == self.candidate.effect:
            return False
        return not is_linear(kind_of(other, 0)) or not other.source

    def is_other_delay(self, other: CandidateEffect) -> bool:
        """Return True for another kind of delay at the same place."""
        delays = (self.late or 0.0) > 0 and effects()[other.effect].equivalent_delay is not None
        return delays and other.at == self.candidate.at and other.effect != self.candidate.effect


def _neighbours(
    opened: Round,
    leaders: Sequence[CandidateFit],
    trials: Sequence[CandidateFit],
    field: Sequence[Pick],
    turned: set[tuple[int, int]],
    asked: set[Hashable],
) -> tuple[Round, list[Pick]]:
    """The round with the sizes that the neighbours of the leaders begin at, and these.

    Left out are those that were asked for beside the same leader in these turns (`turned`), or from the same gains in this round.
    All that may stand in a leader's stead at its place, and have a size to begin at, are refitted however many score higher
    elsewhere, for they are its rivals; of those at other places as many as are refitted at a time, and the others may be asked for
    again.
    """
    found = opened.candidates
    far = all_far(opened.before, trials)
    own: dict[int, list[Pick]] = {}
    for p in field:
        own.setdefault(p.candidate, []).append(p)
    extra: dict[int, list[Probe]] = {}
    rivals: list[Pick] = []
    elsewhere: list[tuple[Pick, _Asked]] = []
    taken: set[_Asked] = set()
    for lead in (_Lead.of(opened, t) for t in leaders):
        for n, c in enumerate(found):
            away = lead.is_elsewhere(c)
            if not (away or lead.is_in_stead(c)) or (lead.number, n) in turned:
                continue
            again = lead.number, n, lead.gains, len(own.get(n, ()))
            if again in asked:
                continue
            if c.still or not opened.reaches(c) or opened.bound(c) < LEVEL * opened.bound(lead.candidate):
                continue
            picks: list[Pick] = []
            score = opened.score_p(n)[0]
            # The sizes that were found, though it was refitted there from others: those may lead astray.
            as_found = has_to_be_met(c) or lead.late is not None if away else not lead.is_other_delay(c)
            if as_found and (probe := lead.probe_of(c)) is not None:
                met = extra.setdefault(n, [])
                swept = far and not away and has_one_size(c) and not has_to_be_met(c)
                picks.append(Pick(n, len(c.probes) + len(met), 1.0, score, lead.gains, swept=swept))
                met.append(probe)
            elif lead.is_other_delay(c) and (start := _as_late(c, lead.late)) is not None:
                picks.append(Pick(n, *start, score, lead.gains))
            if lead.is_in_stead(c) and n in own:
                picks += [replace(p, gains=lead.gains) for p in own[n]]
            elif n in own:
                picks.append(own[n][0] if own[n][0].gains else replace(own[n][0], gains=lead.gains))
            elif score > opened.scores.threshold(0.5):
                picks.append(Pick(n, opened.scores.columns[opened.score_p(n)[2]].probe, 1.0, score, lead.gains))
            if away:
                elsewhere += [(p, again) for p in picks]
            else:
                rivals += picks
                taken.add(again)
        rivals += _other_forms(opened, lead.number, trials, asked)
    nearest = sorted(elsewhere, key=lambda e: -e[0].score)[:FIELD]
    taken |= {again for _, again in nearest}
    turned |= {again[:2] for again in taken}
    asked |= taken
    more = [replace(found[n], probes=tuple(probes)) for n, probes in extra.items()]
    picked = sorted([*rivals, *(p for p, _ in nearest)], key=lambda p: -p.score)
    return replace(opened, candidates=joined(found, more)), picked


def gains_of(opened: Round, refit: Refit) -> tuple[float, ...]:
    """Return the unknowns of the model before the round as a refit came to them."""
    k, whole = len(opened.before.problem.free), len(refit.problem.free)
    return (*refit.theta[:k].tolist(), *refit.theta[whole:].tolist())


def _as_late(candidate: CandidateEffect, late: float | None) -> tuple[int, float] | None:
    """The probe of a kind of delay, and the factor on its size, that delay as long as another; None where there is none."""
    entry = effects()[candidate.effect]
    if entry.equivalent_delay is None or late is None or not late > 0:
        return None
    delays = {k: entry.delay_with(p.values) or 0.0 for k, p in enumerate(candidate.probes)}
    near = min((k for k, d in delays.items() if d > 0), key=lambda k: abs(math.log(delays[k] / late)), default=None)
    return None if near is None else (near, late / delays[near])


def _other_forms(opened: Round, number: int, trials: Sequence[CandidateFit], asked: set[Hashable]) -> list[Pick]:
    """Return picks of this effect at this place with other optional parts, each at its best score."""
    c = opened.candidates[number]
    done = {frozenset(c.probes[t.pick.probe].free) for t in trials if t.pick.candidate == number}
    best: dict[frozenset[str], tuple[float, int]] = {}
    for column, score in zip(opened.scores.columns, opened.scores.t, strict=True):
        if column.candidate != number:
            continue
        form = frozenset(c.probes[column.probe].free)
        if form not in done and (number, form) not in asked and score > best.get(form, (0.0, 0))[0]:
            best[form] = (float(score), column.probe)
    asked |= {(number, form) for form in best}
    return [Pick(number, probe, 1.0, score) for score, probe in best.values()]


def late_of(trial: CandidateFit) -> float | None:
    """By how long the effect that a trial added delays a slow signal, s; None for what is no kind of delay."""
    placed = trial.refit.placed[-1]
    return effects()[placed.candidate.effect].delay_with(trial.refit.sizes(placed))
