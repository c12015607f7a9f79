"""Many refits as a race: all run a little, and those that cannot catch up with the best are left where they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hvdc_ident.discrepancy.refit import Refit, RefitJob, RefitResult, find
from hvdc_ident.executor import mapped
from hvdc_ident.fit import Problem

if TYPE_CHECKING:
    from hvdc_ident.discrepancy.context import SearchContext

UNTRIED = "not tried: the budget ended"
"""Failure of a refit that was not begun."""
BATCH = 6
"""Refits in one piece of work, of one model where they share it: a model takes longer to send than some steps of a refit."""


@dataclass(frozen=True)
class Race:
    """Budget of the successive halving of refits.

    laps: evaluations of every refit that still runs, one lap after the other. reach, near: share of the best refit's fall of chi2
    that one has to come to for another lap, and to be run to its end. least: refits, the best, that run another lap anyway.
    """

    laps: tuple[int, ...] = (2, 5)
    reach: float = 0.4
    near: float = 0.7
    least: int = 12

    def run(
        self, search: SearchContext, before: Refit, jobs: Sequence[RefitJob], texts: Sequence[str], best: float = np.inf
    ) -> list[Refit]:
        """The jobs' refits: some evaluations each, and then those to their ends that are within reach of the best.

        before: the model without what they add. best: the least chi2 of refits done before. In the first lap an effect that may
        begin anywhere begins at rest.
        """
        first = [replace(j, evaluations=self.laps[0], judged=False, problem=_from_rest(j, before)) for j in jobs]
        refits = done(search, first, texts)
        left = [j.evaluations - self.laps[0] for j in jobs]
        for lap in self.laps[1:]:
            running = self._within(self.reach, before.chi2, best, refits, least=self.least)
            refits = _on(search, jobs, refits, running, [min(lap, n) for n in left], texts)
            left = [n - lap if k in running else n for k, n in enumerate(left)]
        near = self._within(self.near, before.chi2, best, refits, least=0)
        ends = [f"{t}, to the end" for t in texts]
        refits = _on(search, jobs, refits, near, [max(n, 1) for n in left], ends, judged=True)
        return [r if r.rows or r.failure else replace(r, failure=BEHIND) for r in refits]

    def _within(self, share: float, before: float, best: float, refits: Sequence[Refit], least: int) -> list[int]:
        """Those that come to this share of what the best gains, and the first `least` of all."""
        gained = [-np.inf if r.failure else before - r.chi2 for r in refits]
        leader = max([before - best, *gained], default=0.0)
        # Where none is better than nothing, all are still on their way.
        goal = share * leader if leader > 0.0 else -np.inf
        order = sorted((k for k, g in enumerate(gained) if g > -np.inf), key=lambda k: -gained[k])
        return [k for n, k in enumerate(order) if n < least or gained[k] >= goal]


def _from_rest(job: RefitJob, before: Refit) -> Problem:
    return replace(job.problem, free_initial_states=before.problem.free_initial_states)


BEHIND = "left behind: others explain far more"
"""Why a refit was not carried to its end."""


def _on(
    search: SearchContext,
    jobs: Sequence[RefitJob],
    refits: Sequence[Refit],
    which: Sequence[int],
    evaluations: Sequence[int],
    texts: Sequence[str],
    *,
    judged: bool = False,
) -> list[Refit]:
    """The refits, some of them run on from where they are; one that fails stays there, unless it is to be judged."""
    again = [
        replace(jobs[k], begins=(refits[k].theta,), spare=(), evaluations=evaluations[k], judged=judged)
        for k in which
        if judged or not refits[k].ended
    ]
    asked = [k for k in which if judged or not refits[k].ended]
    further = done(search, again, [texts[k] for k in asked])
    better = {k: r for k, r in zip(asked, further, strict=True) if judged or not r.failure}
    return [better.get(k, r) for k, r in enumerate(refits)]


def done(search: SearchContext, jobs: Sequence[RefitJob], texts: Sequence[str]) -> list[Refit]:
    """The jobs' refits, in their order, wherever they are done; once the budget is over none but the first are begun."""
    if jobs:
        search.tell(0, len(jobs), texts[0])
    batches: list[list[RefitJob]] = []
    for j in jobs:
        if batches and len(batches[-1]) < BATCH and batches[-1][-1].model is j.model:
            batches[-1].append(j)
        else:
            batches.append([j])
    outcomes = iter(mapped(search.executor, _all, batches))
    refits: list[Refit] = []
    for n, batch in enumerate(batches):
        if n and search.spent:
            rest = [j for b in batches[n:] for j in b]
            refits += [Refit(j.model, j.placed, j.problem, j.noise, j.begins[0], failure=UNTRIED) for j in rest]
            break
        refits += [found.refit(j) for found, j in zip(next(outcomes), batch, strict=True)]
        search.tell(len(refits), len(jobs), texts[len(refits) - 1])
    return refits


def _all(jobs: Sequence[RefitJob]) -> list[RefitResult]:
    return [find(j) for j in jobs]
