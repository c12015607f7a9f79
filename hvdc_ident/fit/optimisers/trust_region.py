"""Bounded Levenberg-Marquardt on exact sensitivities, with a verdict on where it ended.

A run that stands still although the sensitivities promise a fall has met the simulation's own error, or a jump: the scatter of
the cost over tiny steps tells which.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit.descent import LEAST_DAMPING, Descent, DescentOptions
from hvdc_ident.fit.nonsmooth import LUCK, RUNS, roughness
from hvdc_ident.fit.optimiser import OptimiserResult, OptimiserStatus
from hvdc_ident.fit.problem import Problem
from hvdc_ident.fit.simulator import approximate

NAME = "trust-region"
SUMMARY = "bounded Levenberg-Marquardt with exact sensitivities"


PROBES = (-3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0)
"""Tiny steps, in units of PROBE, from which the scatter of the cost is estimated."""
PROBE = 1e-9
"""Length of these steps in scaled coordinates."""


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
    error = _scatter(down, p, low, high)
    if promise > LUCK * error and approximate(
        problem.simulator
    ):  # smooth near a local minimum, and nonsmooth beyond it
        down.evaluations += RUNS
        error = max(error, roughness(problem, here.theta))
    if promise <= LUCK * error:
        return "converged", f"no step lowers the cost by more than its own scatter there ({error:.2g})"
    return "stalled", "the sensitivities promise a lower cost that no step reaches (a jump, or their error)"


def _scatter(down: Descent, p: Array, low: Array, high: Array) -> float:
    """Return the standard deviation of the cost's noise over tiny even steps along p, (p,); 0 where one of them fails.

    Third differences remove a smooth cost. Adaptive steps of an integrator make it jump from one parameter
    value to the next, however close they are (Moré and Wild 2011, "Estimating computational noise",
    doi 10.1137/100786125).
    """
    assert down.at is not None
    unit = PROBE * p / np.abs(p).max()
    room = np.where(unit > 0, high, np.where(unit < 0, -low, np.inf))
    unit = np.where(room > -PROBES[0] * np.abs(unit), unit, 0.0)
    costs = []
    for k in PROBES:
        down.evaluations += 1
        try:
            r, _ = down.objective.residual(down.space.unscaled(down.at.x + k * unit))
        except SimulationError:
            return 0.0
        costs.append(0.5 * float(r @ r))
    differences = np.diff(costs, 3)
    return float(np.sqrt(np.mean(differences**2) / 20.0))  # 20 = 1 + 9 + 9 + 1, of white noise of 1
