"""SciPy's L-BFGS-B: a quasi-Newton method with bounds, on exact gradients.

Byrd, Lu, Nocedal, Zhu 1995, doi 10.1137/0916069.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.fit.optimiser import OptimiserResult, OptimiserRun
from hvdc_ident.fit.problem import Problem

NAME = "l-bfgs-b"
SUMMARY = "quasi-Newton with bounds (SciPy), with exact gradients"
FLAT = 1e-7
"""Projected slope, of the cost at the start, below which an end that the line search could not better is an optimum."""
RESOLVED = 1e-11
"""Share of a cost that runs within the engine's tolerance still tell from it. Smaller ones are rounding and the choice of steps, by
which a line search may go on for a dozen evaluations."""


@dataclass(frozen=True)
class LBfgsB:
    """Options. cost: relative reduction not worth a step; gradient: largest projected slope, of the cost at the start."""

    max_evaluations: int = 2000
    cost: float = 1e-14
    gradient: float = 1e-12
    memory: int = 20

    def run(self, problem: Problem, start: Array) -> OptimiserResult:
        """Return the end of the run from `start`."""
        return OptimiserRun(problem, start, self.max_evaluations).result(self._minimised)

    def _minimised(self, run: OptimiserRun) -> tuple[bool, str]:
        from scipy.optimize import minimize

        low, high = run.problem.coordinates.bounds
        first, _ = run.value_and_gradient(run.x0)
        scale = 1.0 / max(first, 1e-300)  # the method's tolerances are absolute ones

        def scaled(x: Array) -> tuple[float, Array]:
            value, gradient = run.value_and_gradient(x)
            return scale * value, scale * gradient

        costs = [1.0]
        still = False

        def enough(*, intermediate_result: Any) -> None:
            nonlocal still
            costs.append(float(intermediate_result.fun))
            still = costs[-2] - costs[-1] <= RESOLVED * costs[-1]
            if still:
                raise StopIteration

        # The run counts its own evaluations, and ends the method where it has had enough.
        most = 10 * self.max_evaluations
        options = {"ftol": self.cost, "gtol": self.gradient, "maxcor": self.memory, "maxfun": most, "maxiter": most}
        bounds = list(zip(low, high, strict=True))
        end = minimize(scaled, run.x0, jac=True, method="L-BFGS-B", bounds=bounds, options=options, callback=enough)
        # A slope that is rounding inside the bounds: the line search then ends as abnormal, at an optimum.
        flat = np.abs(np.clip(end.x - end.jac, low, high) - end.x).max() < FLAT
        return bool(end.success or flat or still), str(end.message)


OPTIMISER = LBfgsB
