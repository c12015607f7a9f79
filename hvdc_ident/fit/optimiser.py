"""What an optimiser is: options, and one run from one start."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

from hvdc_ident.data import Array
from hvdc_ident.fit.problem import Problem

OptimiserStatus = Literal["converged", "max-evaluations", "stopped", "stalled", "flat", "failed"]


@dataclass(frozen=True, eq=False)
class OptimiserResult:
    """Where a run ended.

    theta: (p,) the best admissible point seen, each unknown in its unit; the start where nothing else was admissible.
    status: converged, at an optimum by the method's own criterion; max-evaluations; stopped, by another rule of the
    method; stalled, no step lowers the cost although its derivatives promise one; flat, the start lies where no output
    answers to any unknown, so that the run could not move; failed.
    cost: half the sum of squares there; None where not even the start could be simulated. message: why the run ended.
    evaluations: simulations of the whole set of experiments, failed ones included.
    """

    theta: Array
    cost: float | None
    status: OptimiserStatus
    message: str
    evaluations: int


class Optimiser(Protocol):
    """An options object that can run. Raises nothing for a simulation that fails: that is a status."""

    def run(self, problem: Problem, start: Array) -> OptimiserResult:
        """Where the run from `start`, (p,) inside the bounds, ended."""
