"""Many refits as a race: all run a little, and those that cannot catch up with the best are left where they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from hvdc_ident.discrepancy.refit import Refit, RefitJob, find
from hvdc_ident.executor import mapped

if TYPE_CHECKING:
    from hvdc_ident.discrepancy.context import SearchContext
import numpy as np


@dataclass(frozen=True)
class Race:
    """Budget of the successive halving of refits.

    sprint: evaluations of every refit at first; more are for those within reach of the best. reach: share of the best
    refit's fall of chi2 from which another that has not ended is within its reach. second: refits, the best of the first
    sprint, that run another before that is asked.
    """

    sprint: int = 6
    reach: float = 0.4
    second: int = 12

    def run(
        self, search: SearchContext, before: float, jobs: Sequence[RefitJob], texts: Sequence[str], best: float = np.inf
    ) -> list[Refit]:
        """The jobs' refits: some evaluations each, and then those to their ends that are within reach of the best.

        before: chi2 of the model without what they add. best: the least chi2 of refits done before.
        """
        laps = [replace(j, evaluations=self.sprint) for j in jobs]
        refits = done(search, laps, texts)
        running = [k for k, r in enumerate(refits) if not (r.failure or r.ended)]
        slow = sorted(running, key=lambda k: refits[k].chi2)[: self.second]
        refits = _on(search, laps, refits, slow, texts)
        gained = [0.0 if r.failure else before - r.chi2 for r in refits]
        leader = max([before - best, *gained])
        # Where none is better than nothing, all are still on their way.
        goal = self.reach * leader if leader > 0.0 else -np.inf
        near = [k for k in running if not refits[k].ended and gained[k] >= goal]
        rest = [replace(j, evaluations=j.evaluations - self.sprint) for j in jobs]
        return _on(search, rest, refits, near, [f"{t}, to the end" for t in texts])


def _on(
    search: SearchContext, jobs: Sequence[RefitJob], refits: Sequence[Refit], which: Sequence[int], texts: Sequence[str]
) -> list[Refit]:
    """The refits, some of them run on from where they are; one that fails stays there."""
    further = done(search, [replace(jobs[k], begins=(refits[k].theta,)) for k in which], [texts[k] for k in which])
    better = {k: r for k, r in zip(which, further, strict=True) if not r.failure}
    return [better.get(k, r) for k, r in enumerate(refits)]


UNTRIED = "not tried: the budget ended"
"""Failure of a refit that was not begun."""


def done(search: SearchContext, jobs: Sequence[RefitJob], texts: Sequence[str]) -> list[Refit]:
    """The jobs' refits, in their order, wherever they are done; once the budget is over none but the first is begun."""
    if jobs:
        search.tell(0, len(jobs), texts[0])
    outcomes = iter(mapped(search.executor, find, jobs))
    refits: list[Refit] = []
    for k, job in enumerate(jobs):
        if k and search.spent:
            refits += [Refit(j.model, j.placed, j.problem, j.noise, j.begins[0], failure=UNTRIED) for j in jobs[k:]]
            break
        refits.append(next(outcomes).refit(job))
        search.tell(k + 1, len(jobs), texts[k])
    return refits
