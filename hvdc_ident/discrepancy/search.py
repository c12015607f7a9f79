"""Forward addition of effects, pairs where one masks the other, and each looked for again beside the others."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from hvdc_ident.discrepancy.candidates import CandidateEffect
from hvdc_ident.discrepancy.clocks import clocks, on_their_clocks
from hvdc_ident.discrepancy.context import Round, SearchContext
from hvdc_ident.discrepancy.evidence import CandidateFit, Pick, Ruler, at_edge, clear, evidence_between, gained
from hvdc_ident.discrepancy.options import BEAM, SHORTLIST, TOLERANCE
from hvdc_ident.discrepancy.placed import Placed
from hvdc_ident.discrepancy.race import done
from hvdc_ident.discrepancy.refit import FAILURES, Refit, RefitJob, judged
from hvdc_ident.discrepancy.refit_jobs import as_given, job_of, moved_far, refit_again
from hvdc_ident.discrepancy.refitted import is_far, is_noise, left_by
from hvdc_ident.discrepancy.released import held_again, released
from hvdc_ident.discrepancy.remainder import is_small
from hvdc_ident.discrepancy.rounds import against, closed, one_round


@dataclass(frozen=True, eq=False)
class SearchOutcome:
    """Where the search ended.

    rounds: all of them; kept: by effect of the final model, the round that judges its rivals; notes: what could not be done.
    """

    refit: Refit
    rounds: tuple[Round, ...]
    kept: tuple[Round, ...]
    notes: tuple[str, ...] = ()


def from_either_side(search: SearchContext, first: Refit) -> SearchOutcome:
    """The search from the refitted gains; where that leaves more than anybody asks about, from the given ones if it then ends nearer.

    Gains that have moved far to make up for what is missing may leave no room for it: beside them a lag of its true size is
    unstable, and no score tells of it. first: the nominal model, refitted.
    """
    outcome = forward(search, first)
    theta = as_given(first)
    last = outcome.refit
    if (
        theta is None
        or not moved_far(first)
        or not is_far(first, last)
        or is_small(search, first, last)
        or search.spent
    ):
        return outcome
    search.tell(0, 1, "once more, from the given values")
    try:
        again = forward(search, judged(replace(first, theta=theta)))
    except FAILURES as error:
        return replace(outcome, notes=(*outcome.notes, f"from the given values nothing was looked for: {error}"))
    ruler = Ruler.of(min(last, again.refit, key=lambda r: r.chi2))
    more = len(again.refit.problem.free) - len(last.problem.free)
    nearer = bool(again.kept) and ruler.gain(last.chi2, again.refit.chi2, more) > search.options.named_bic
    return again if nearer else outcome


def forward(search: SearchContext, first: Refit) -> SearchOutcome:
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
        return _onwards(search, first, first, [found] if found else [])
    # Parameters may stand for a missing effect: then the effect has as much evidence, and they are asked again beside it.
    # Where it has no more, a candidate that was held is the likelier cause, and a stated value the less likely one.
    moved = set(here.problem.names) - set(first.problem.names)
    level = search.options.set_bic if moved & {f.name for f in search.stated} else -search.options.set_bic
    found = found or one_round(search, first, 1)
    if found.winner is not None and _behind(search, found.winner.refit, here) <= level:
        return _onwards(search, first, first, [found])
    with_parameters = _onwards(search, base, here, [])
    # A parameter may stand for one of several effects: that is seen when the others are there too.
    if found.winner is None or not with_parameters.kept or search.spent:
        return with_parameters
    with_effects = _onwards(search, first, first, [found])
    more = len(with_effects.kept) > len(with_parameters.kept)
    behind = _behind(search, with_effects.refit, with_parameters.refit)
    return with_effects if behind <= (-search.options.named_bic if more else level) else with_parameters


def _behind(search: SearchContext, one: Refit, other: Refit) -> float:
    """By how much evidence, in BIC, the first hypothesis is behind the other."""
    ruler = Ruler.of(min(one, other, key=lambda r: r.chi2))
    few, many = (len(r.problem.free) + len(clocks(search, r)) for r in (one, other))
    return evidence_between(one, other, ruler, many - few)


def _onwards(search: SearchContext, base: Refit, here: Refit, rounds: list[Round]) -> SearchOutcome:
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
            both = _masked(search, here, found, len(rounds) + 1) if hopeful else None
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
        if little and is_far(here, found.winner.refit):
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
            here, kept, more = settled(search, base, here, kept, len(rounds))
            notes, asked_again = notes + more, here
            if is_noise(here, search.seed):
                break
    # Where a parameter was set free beside an effect, its rivals were refitted without that.
    if kept and not search.spent and asked_again is not here and (len(kept) > 1 or _closed_to(base, kept[0])):
        here, kept, more = settled(search, base, here, kept, len(rounds))
        notes += more
    return SearchOutcome(here, tuple(rounds), tuple(kept), notes)


def _closed_to(base: Refit, found: Round) -> bool:
    """Return True where a round held a parameter that has since been set free, or had the records on other clocks."""
    freed = {f.name for f in base.problem.free} - set(found.before.problem.names)
    return bool(freed) or base.problem.experiments[0].time is not found.before.problem.experiments[0].time


def _masked(search: SearchContext, before: Refit, found: Round, number: int) -> tuple[Round, Round] | None:
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
        whole = gained(further.winner, before, further.ruler)
        if not against(search, before, whole, further, first=True):
            passed.append((replace(found, winner=trial, why=""), further))
    return max(passed, key=lambda pair: -pair[1].winner.refit.chi2 if pair[1].winner else -np.inf, default=None)


def _different(found: Round) -> list[CandidateFit]:
    """The best refit of each effect, the best first."""
    each: dict[str, CandidateFit] = {}
    for t in found.trials:
        each.setdefault(found.candidates[t.pick.candidate].effect, t)
    return list(each.values())


def settled(
    search: SearchContext, first: Refit, here: Refit, kept: Sequence[Round], number: int
) -> tuple[Refit, list[Round], tuple[str, ...]]:
    """The refit, by effect the round that judges its rivals, and what could not be done, after looking for each again and
    doing without it.

    here: the refit of the model `first` with several effects; kept: the rounds that brought them; number: rounds so far.
    Where all of them together are far from noise none is what is missing, and none is looked for again.
    """
    kept, notes = list(kept), []
    near = not is_far(first, here)
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
        if gain <= search.options.named_bic or at_edge(here, k) or not clear(here, k):
            here = without
            del kept[k]
            continue
        searched = _beside_these(kept[k], others, last=k == len(kept) - 1) and not _closed_to(first, kept[k])
        if near and not searched:
            try:
                again, winner = _looked_again(
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


def _looked_again(
    search: SearchContext, first: Refit, here: Refit, found: Round, k: int, without: Refit, number: int
) -> tuple[Round, CandidateFit]:
    """The round that looks for the effect in place k beside the others, and its winner: one that was not best alone may be.

    Those that came near it in its own round are tried too. The effect itself stays where nothing better may be named.
    """
    again = one_round(search, without, number)
    own = here.placed[k].candidate
    again, mine = _with(again, own)
    sound = [t for t in again.trials if t.pick.candidate != mine]
    tried = {own.label, *(again.candidates[t.pick.candidate].label for t in sound)}
    refits: list[tuple[Pick, RefitJob]] = []
    for trial in found.trials[: SHORTLIST + 1]:
        placed = trial.refit.placed[-1]
        among = tuple(placed if j == k else p for j, p in enumerate(here.placed))
        with suppress(*FAILURES):  # it cannot sit there beside the others: no rival
            job = job_of(first, here, among, {k: trial.refit.sizes(placed)})
            candidate = job.placed[k].candidate
            # Places behind an effect that is left out are one place without it.
            if candidate.label not in tried:
                tried.add(candidate.label)
                again, number_of = _with(again, candidate)
                refits.append((Pick(number_of, 0, 1.0, 0.0), job))
    texts = [f"again with the others: {again.candidates[p.candidate].label}" for p, _ in refits]
    ended = done(search, [j for _, j in refits], texts)
    sound += [CandidateFit(p, _last(r, k), 0.0) for (p, _), r in zip(refits, ended, strict=True) if not r.failure]
    mine_again = [t for t in again.trials if t.pick.candidate == mine and t.refit.chi2 < here.chi2]
    sound.append(mine_again[0] if mine_again else CandidateFit(_pick(again, mine), _last(here, k), 0.0))
    ranked = closed(search, again, [*sound, *again.failed], number)
    winner = ranked.winner or next(t for t in ranked.trials if t.pick.candidate == mine)
    return replace(ranked, winner=winner), winner


def _with(found: Round, candidate: CandidateEffect) -> tuple[Round, int]:
    """The round with the candidate among its own, and where it stands there."""
    for k, c in enumerate(found.candidates):
        if c.label == candidate.label:
            return found, k
    return replace(found, candidates=(*found.candidates, candidate)), len(found.candidates)


def _pick(found: Round, candidate: int) -> Pick:
    """The size of a candidate that the screen likes best, or its first."""
    shot = found.screen.best().get(candidate)
    return Pick(candidate, 0, 1.0, 0.0) if shot is None else Pick(candidate, shot.probe, shot.factor, shot.fall)


def _last(refit: Refit, k: int) -> Refit:
    """The refit with the effect in place k told last, as that of a round is."""
    return _ordered(refit, [*(j for j in range(len(refit.placed)) if j != k), k])


def _in_place(refit: Refit, k: int) -> Refit:
    """The refit with the effect that is told last back in place k."""
    order = list(range(len(refit.placed) - 1))
    order.insert(k, len(refit.placed) - 1)
    return _ordered(refit, order)


def _ordered(refit: Refit, order: Sequence[int]) -> Refit:
    return replace(refit, placed=tuple(refit.placed[j] for j in order), apart=tuple(refit.apart[j] for j in order))
