"""SciPy's Nelder-Mead: a simplex that needs no derivatives.

Nelder and Mead 1965, doi 10.1093/comjnl/7.4.308; parameters adapted to the dimension after Gao and Han 2012.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.fit.optimiser import BudgetSpentError, OptimiserResult, OptimiserRun
from hvdc_ident.fit.problem import Problem

NAME = "nelder-mead"
SUMMARY = "the simplex of Nelder and Mead (SciPy), without derivatives"


@dataclass(frozen=True)
class NelderMead:
    """Options. size: of the first simplex, as a share of the range; cost, step: absolute tolerances at the end.

    Begun again from its end (up to `restarts` times) with a fresh simplex, for a simplex may collapse off an optimum.
    """

    max_evaluations: int = 5000
    size: float = 0.1
    cost: float = 1e-10
    step: float = 1e-10
    restarts: int = 5

    def run(self, problem: Problem, start: Array) -> OptimiserResult:
        """Return the end of the run from `start`."""
        run = OptimiserRun(problem, start, self.max_evaluations)
        try:
            run.value(run.start)
            if run.cost is None:
                return run.ended(False, "")
            x = run.cube
            for k in range(1 + self.restarts):
                before = run.cost
                x = self._descent(run, x, self.size * 0.5**k)
                assert run.cost is not None
                if k and before - run.cost <= 1e-9 * before + self.cost:
                    return run.ended(True, f"the simplex collapsed, and so did a fresh one ({k + 1} in all)")
        except BudgetSpentError:
            return run.spent()
        return run.ended(False, f"fresh simplexes still improve after {self.restarts} restarts")

    def _descent(self, run: OptimiserRun, x: Array, size: float) -> Array:
        """Return where a simplex from x ends, in the unit cube."""
        from scipy.optimize import minimize

        steps = np.where(x + size <= 1.0, size, -size)
        simplex = np.vstack([x, x + np.diag(steps)])
        end = minimize(
            run.at_cube,
            x,
            method="Nelder-Mead",
            bounds=[(0.0, 1.0)] * x.size,
            options={
                "initial_simplex": simplex,
                "fatol": self.cost,
                "xatol": self.step,
                "maxfev": 10 * self.max_evaluations,
                "maxiter": 10 * self.max_evaluations,
                "adaptive": x.size > 2,
            },
        )
        return np.asarray(end.x)


OPTIMISER = NelderMead
