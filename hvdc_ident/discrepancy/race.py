"""Many refits as a race: all run a little, and those that cannot catch up with the best are left where they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from hvdc_ident.discrepancy.refit import Job, Refit, find

if TYPE_CHECKING:
    from hvdc_ident.discrepancy.rounds import Search

SPRINT = 15
"""Evaluations of every refit at first; more are for those within reach of the best."""
REACH = 0.7
"""Share of the best refit's fall of chi2 from which another that has not ended is within its reach."""


def raced(
    search: Search, before: float, jobs: Sequence[Job], texts: Sequence[str], best: float = np.inf
) -> list[Refit]:
    """The jobs' refits: some evaluations each, and then those to their ends that are within reach of the best.

    before: chi2 of the model without what they add. best: the least chi2 of refits done before.
    """
    first = done(search, [replace(j, evaluations=SPRINT) for j in jobs], texts)
    gained = [0.0 if r.failure else before - r.chi2 for r in first]
    leader = max([before - best, *gained])
    goal = REACH * leader if leader > 0.0 else -np.inf  # where none is better than nothing, all are still on their way
    on = [k for k, r in enumerate(first) if not (r.failure or r.ended) and gained[k] >= goal]
    further = [replace(jobs[k], begins=(first[k].theta,), evaluations=jobs[k].evaluations - SPRINT) for k in on]
    for k, refit in zip(on, done(search, further, [f"{texts[k]}, to the end" for k in on]), strict=True):
        if not refit.failure:
            first[k] = refit
    return first


def done(search: Search, jobs: Sequence[Job], texts: Sequence[str]) -> list[Refit]:
    """The jobs' refits, in their order, wherever they are done."""
    if jobs:
        search.tell(0, len(jobs), texts[0])
    outcomes = search.executor.map(find, jobs) if search.executor is not None else map(find, jobs)
    refits = []
    for k, (job, outcome) in enumerate(zip(jobs, outcomes, strict=True)):
        search.tell(k + 1, len(jobs), texts[k])
        refits.append(outcome.refit(job))
    return refits
