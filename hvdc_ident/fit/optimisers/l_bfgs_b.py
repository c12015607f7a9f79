"""SciPy's L-BFGS-B: a quasi-Newton method with bounds, on exact gradients.

Byrd, Lu, Nocedal, Zhu 1995, doi 10.1137/0916069.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.fit.optimiser import BudgetSpentError, OptimiserResult, OptimiserRun
from hvdc_ident.fit.problem import Problem

NAME = "l-bfgs-b"
SUMMARY = "quasi-Newton with bounds (SciPy), with exact gradients"
FLAT = 1e-7
"""Projected slope, of the cost at the start, below which an end that the line search could not better is an optimum."""


@dataclass(frozen=True)
class LBfgsB:
    """Options. cost: relative reduction not worth a step; gradient: largest projected slope, of the cost at the start."""

    max_evaluations: int = 2000
    cost: float = 1e-14
    gradient: float = 1e-12
    memory: int = 20

    def run(self, problem: Problem, start: Array) -> OptimiserResult:
        """Return the end of the run from `start`."""
        from scipy.optimize import minimize

        run = OptimiserRun(problem, start, self.max_evaluations)
        low, high = problem.coordinates.bounds
        try:
            first, _ = run.value_and_gradient(run.x0)
            if run.cost is None:
                return run.ended(False, "")
            scale = 1.0 / max(first, 1e-300)  # the method's tolerances are absolute ones

            def scaled(x: Array) -> tuple[float, Array]:
                value, gradient = run.value_and_gradient(x)
                return scale * value, scale * gradient

            end = minimize(
                scaled,
                run.x0,
                jac=True,
                method="L-BFGS-B",
                bounds=list(zip(low, high, strict=True)),
                options={
                    "ftol": self.cost,
                    "gtol": self.gradient,
                    "maxcor": self.memory,
                    "maxfun": 10 * self.max_evaluations,
                    "maxiter": 10 * self.max_evaluations,
                },
            )
        except BudgetSpentError:
            return run.spent()
        # A slope that is rounding inside the bounds: the line search then ends as abnormal, at an optimum.
        flat = np.abs(np.clip(end.x - end.jac, low, high) - end.x).max() < FLAT
        if not end.success and not flat:
            return run.refused(str(end.message))
        return run.ended(True, str(end.message))


OPTIMISER = LBfgsB
