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
        """Where the run from `start` ended."""
        from scipy.optimize import minimize

        search = OptimiserRun(problem, start, self.max_evaluations)
        low, high = problem.coordinates.bounds
        try:
            first, _ = search.value_and_gradient(search.x0)
            if search.cost is None:
                return search.ended(False, "")
            scale = 1.0 / max(first, 1e-300)  # the method's tolerances are absolute ones

            def scaled(x: Array) -> tuple[float, Array]:
                value, gradient = search.value_and_gradient(x)
                return scale * value, scale * gradient

            end = minimize(
                scaled,
                search.x0,
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
            return search.spent()
        if not end.success and not _flat(end.x, end.jac, low, high):
            return search.refused(str(end.message))
        return search.ended(True, str(end.message))


def _flat(x: Array, gradient: Array, low: Array, high: Array) -> bool:
    """Whether no way down is left inside the bounds but what rounding makes of one: the line search then ends as abnormal."""
    return bool(np.abs(np.clip(x - gradient, low, high) - x).max() < FLAT)


OPTIMISER = LBfgsB
