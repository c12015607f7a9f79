"""Many refits as a race: all run a little, and those that cannot catch up with the best are left where they are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hvdc_ident.discrepancy.refit import Found, Job, Refit, find
from hvdc_ident.fit.executor import mapped

if TYPE_CHECKING:
    from hvdc_ident.discrepancy.state import Search


@dataclass(frozen=True)
class Race:
    """How a race is run.

    sprint: evaluations of every refit at first; more are for those within reach of the best. reach: share of the best
    refit's fall of chi2 from which another that has not ended is within its reach.
    """

    sprint: int = 15
    reach: float = 0.7

    def run(
        self, search: Search, before: float, jobs: Sequence[Job], texts: Sequence[str], best: float = np.inf
    ) -> list[Refit]:
        """The jobs' refits: some evaluations each, and then those to their ends that are within reach of the best.

        before: chi2 of the model without what they add. best: the least chi2 of refits done before.
        """
        first = done(search, [replace(j, evaluations=self.sprint) for j in jobs], texts)
        gained = [0.0 if r.failure else before - r.chi2 for r in first]
        leader = max([before - best, *gained])
        # Where none is better than nothing, all are still on their way.
        goal = self.reach * leader if leader > 0.0 else -np.inf
        on = [k for k, r in enumerate(first) if not (r.failure or r.ended) and gained[k] >= goal]
        further = [
            replace(jobs[k], begins=(first[k].theta,), evaluations=jobs[k].evaluations - self.sprint) for k in on
        ]
        for k, refit in zip(on, done(search, further, [f"{texts[k]}, to the end" for k in on]), strict=True):
            if not refit.failure:
                first[k] = refit
        return first


def done(search: Search, jobs: Sequence[Job], texts: Sequence[str], how: Callable[[Job], Found] = find) -> list[Refit]:
    """The jobs' refits, in their order, wherever they are done."""
    if jobs:
        search.tell(0, len(jobs), texts[0])
    outcomes = mapped(search.executor, how, jobs)
    refits = []
    for k, (job, outcome) in enumerate(zip(jobs, outcomes, strict=True)):
        search.tell(k + 1, len(jobs), texts[k])
        refits.append(outcome.refit(job))
    return refits
