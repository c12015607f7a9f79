"""SciPy's dual annealing: generalised simulated annealing with local descents on exact gradients.

Xiang, Sun, Fan, Gong 1997, doi 10.1016/S0375-9601(97)00474-X.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.fit.objective import predicted_reduction
from hvdc_ident.fit.optimiser import BudgetSpentError, OptimiserResult, OptimiserRun, generator
from hvdc_ident.fit.problem import Problem

NAME = "dual-annealing"
SUMMARY = "simulated annealing with local descents over the whole range (SciPy)"
GLOBAL = True


@dataclass(frozen=True)
class DualAnnealing:
    """Options. iterations: of the annealing, which has no end of its own.

    stationary: the best point counts as an optimum where a Gauss-Newton step promises no larger share of the cost.
    """

    max_evaluations: int = 20000
    iterations: int = 100
    stationary: float = 1e-6
    seed: int = 0

    def run(self, problem: Problem, start: Array) -> OptimiserResult:
        """Return the end of the run."""
        from scipy.optimize import dual_annealing

        run = OptimiserRun(problem, start, self.max_evaluations)
        space = problem.coordinates
        ends = np.array([u.drawn for u in problem.unknowns])
        box = list(zip(space.scaled(ends[:, 0]), space.scaled(ends[:, 1]), strict=True))
        local: dict[str, Any] = {
            "method": "L-BFGS-B",
            "jac": lambda x: run.value_and_gradient(x)[1],
            "bounds": box,
            "options": {"ftol": 1e-14, "gtol": 1e-10},
        }
        try:
            dual_annealing(
                lambda x: run.value_and_gradient(x)[0],
                box,
                x0=np.clip(run.x0, [b[0] for b in box], [b[1] for b in box]),
                maxiter=self.iterations,
                maxfun=10 * self.max_evaluations,
                minimizer_kwargs=local,
                rng=generator(self.seed, run.start),
            )
        except BudgetSpentError:
            return run.spent()
        if run.cost is None:
            return run.ended(False, "")
        promise = predicted_reduction(problem, run.best)
        good = promise <= self.stationary * run.cost + 1e-9
        remark = (
            "the best point is an optimum" if good else f"the best point is no optimum: {promise:.3g} is still to gain"
        )
        return run.ended(good, f"{self.iterations} iterations done; {remark}")


OPTIMISER = DualAnnealing
