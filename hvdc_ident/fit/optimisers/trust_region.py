"""Bounded Levenberg-Marquardt on exact sensitivities, with a verdict on where it ended.

A run that stands still although the sensitivities promise a fall has met the simulation's own error, or a jump: the scatter of
the cost over tiny steps tells which.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.fit.descent import LEAST_DAMPING, Descent, DescentOptions
from hvdc_ident.fit.nonsmooth import LUCK, RUNS, roughness, scatter_along
from hvdc_ident.fit.optimiser import OptimiserResult, OptimiserStatus
from hvdc_ident.fit.problem import Problem
from hvdc_ident.fit.simulator import approximate

NAME = "trust-region"
SUMMARY = "bounded Levenberg-Marquardt with exact sensitivities"

PROBE = 1e-9
"""Length in scaled coordinates of the tiny step along which the scatter of the cost is estimated."""


@dataclass(frozen=True)
class TrustRegion(DescentOptions):
    """Options of the method, those of a descent."""

    def run(self, problem: Problem, start: Array) -> OptimiserResult:
        """Return the end of the run from `start`: converged, max-evaluations, stalled, flat, or failed with the reason."""
        down = Descent(problem, self)
        end = down.go(start)
        verdicts: dict[str, tuple[OptimiserStatus, str]] = {
            "inadmissible": ("failed", f"the start cannot be simulated: {down.failure}"),
            "flat": ("flat", "no compared output answers to any of the unknowns there"),
            "stationary": ("converged", "the gradient is zero"),
            "settled": ("converged", "the cost does not fall any more"),
            "enough": ("converged", "no fall of the cost worth a step is left"),
            "spent": ("max-evaluations", f"no optimum within {self.max_evaluations} evaluations"),
        }
        status, message = verdicts[end] if end in verdicts else _standstill(down, problem)
        if down.at is None:
            return OptimiserResult(np.asarray(start, dtype=float), None, status, message, down.evaluations)
        return OptimiserResult(down.at.theta, down.at.cost, status, message, down.evaluations)


OPTIMISER = TrustRegion


def _standstill(down: Descent, problem: Problem) -> tuple[OptimiserStatus, str]:
    """Return the outcome where steps are too small to count: an optimum, a failing region or a gradient that does not fit."""
    if down.failure:
        return "failed", f"every step down leads to where the simulation fails: {down.failure}"
    here = down.at
    assert here is not None
    low, high = down.room()
    p = here.step(LEAST_DAMPING, here.norms, low, high)
    promise = here.predicted(p)
    if promise <= 1e-4 * here.cost + 1e-12 * here.r.size:
        return "converged", "no smaller step lowers the cost"
    # Adaptive steps of an integrator make the cost jump from one parameter value to the next, however close they are.
    error = scatter_along(problem, here.theta, here.r, PROBE * p / np.abs(p).max())
    down.evaluations += RUNS
    if promise > LUCK * error and approximate(
        problem.simulator
    ):  # smooth near a local minimum, and nonsmooth beyond it
        error = max(error, roughness(problem, here.theta))
        down.evaluations += RUNS
    if promise <= LUCK * error:
        return "converged", f"no step lowers the cost by more than its own scatter there ({error:.2g})"
    return "stalled", "the sensitivities promise a lower cost that no step reaches (a jump, or their error)"
