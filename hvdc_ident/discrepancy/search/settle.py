"""Several effects beside each other: each looked for again, over the whole catalogue, and tried without."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

from hvdc_ident.discrepancy.refits.begin import Placed
from hvdc_ident.discrepancy.refits.refit import Refit, RefitJob, run
from hvdc_ident.discrepancy.search.rounds import closed, one_round
from hvdc_ident.discrepancy.signatures.candidates import CandidateEffect
from hvdc_ident.discrepancy.trials.context import Round, SearchContext
from hvdc_ident.discrepancy.trials.race import done
from hvdc_ident.discrepancy.trials.refit_jobs import job_of
from hvdc_ident.discrepancy.trials.refitted import is_far
from hvdc_ident.discrepancy.trials.select import CandidateFit, Pick, at_edge, clear
from hvdc_ident.errors import HvdcIdentError, SimulationError

OTHERS = 6
"""Rivals of each effect in its own round that are tried again once the other effects are in."""


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
        without = _again(first, here, others)
        if without.failure:
            k += 1
            continue
        ruler = kept[k].ruler
        assert ruler is not None
        gain = ruler.gain(without.chi2, here.chi2, here.count - without.count)
        # What was clearly there before the others came may be nothing beside them.
        if gain <= search.options.named_bic or at_edge(here, k) or not clear(here, k):
            here = without
            del kept[k]
            continue
        if _beside_these(kept[k], others, last=k == len(kept) - 1):
            kept[k] = kept[k].light()
        elif near:
            try:
                again, winner = _looked_again(search, first, here, kept[k], k, without, number + k + 1)
                kept[k] = again.light()
                here = _in_place(winner.refit, k)
            except SimulationError as error:  # refitted it runs, as far as a refit needs it to
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
    for trial in found.trials[: OTHERS + 1]:
        placed = trial.refit.placed[-1]
        among = tuple(placed if j == k else p for j, p in enumerate(here.placed))
        with suppress(HvdcIdentError):  # it cannot sit there beside the others: no rival
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
    """The size of a candidate that the scores like best, or its first."""
    score, _, column = found.score_p(candidate)
    return Pick(candidate, found.scores.columns[column].probe if column >= 0 else 0, 1.0, score)


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


def _again(first: Refit, here: Refit, placed: Sequence[Placed]) -> Refit:
    """The nominal model with these effects, refitted from where they stand."""
    try:
        return run(job_of(first, here, placed, {}))
    except HvdcIdentError as error:
        return replace(here, failure=str(error))
