"""SciPy's bounded least squares (trust region reflective) on exact sensitivities.

Branch, Coleman, Li 1999, doi 10.1137/S1064827595289108.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.fit.optimiser import OptimiserResult, OptimiserRun
from hvdc_ident.fit.problem import Problem

NAME = "least-squares"
SUMMARY = "SciPy's trust region reflective least squares, with exact sensitivities"


@dataclass(frozen=True)
class LeastSquaresTrf:
    """Options. cost, step, gradient: relative tolerances, without unit."""

    max_evaluations: int = 200
    cost: float = 1e-12
    step: float = 1e-10
    gradient: float = 1e-10

    def run(self, problem: Problem, start: Array) -> OptimiserResult:
        """Return the end of the run from `start`."""
        return OptimiserRun(problem, start, self.max_evaluations).result(self._minimised)

    def _minimised(self, run: OptimiserRun) -> tuple[bool, str]:
        from scipy.optimize import least_squares

        low, high = run.problem.coordinates.bounds
        inside = np.clip(run.x0, low + 1e-9 * (1.0 + np.abs(low)), high - 1e-9 * (1.0 + np.abs(high)))
        tolerances = {"ftol": self.cost, "xtol": self.step, "gtol": self.gradient}
        end = least_squares(
            run.residual, inside, run.jacobian, (low, high), method="trf", x_scale="jac", **tolerances
        )  # fmt: skip
        return end.status > 0, end.message.replace("`", "").rstrip(".")


OPTIMISER = LeastSquaresTrf
