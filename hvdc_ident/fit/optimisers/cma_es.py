"""CMA-ES: evolution strategy with an adapted covariance matrix, by Hansen's package `cma` (extra `optimisers`).

Hansen and Ostermeier 2001, doi 10.1162/106365601750190398.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.fit.optimiser import BudgetSpentError, OptimiserResult, OptimiserRun, generator, missing
from hvdc_ident.fit.problem import Problem

NAME = "cma-es"
SUMMARY = "evolution strategy with covariance adaptation (package cma, an extra), without derivatives"
GLOBAL = True
PACKAGE = "cma"
OPTIMA = ("tolfun", "tolx", "tolfunhist", "tolflatfitness", "ftarget")
"""Names the package gives an end that is an optimum; others (stagnation, a flat cost) are not."""


@dataclass(frozen=True)
class CmaEs:
    """Options. size: first standard deviation, as a share of the range. cost, step: absolute tolerances at the end."""

    max_evaluations: int = 20000
    size: float = 0.3
    cost: float = 1e-10
    step: float = 1e-9
    seed: int = 0

    def run(self, problem: Problem, start: Array) -> OptimiserResult:
        """Return the end of the run. Raises InputError where the package is not installed."""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of optional parts of the package that are not installed
                import cma
        except ImportError:
            raise missing(PACKAGE, NAME) from None
        run = OptimiserRun(problem, start, self.max_evaluations)
        random = generator(self.seed, run.start)
        p = run.start.size
        middle = np.append(run.cube, 0.5) if p == 1 else run.cube  # one dimension is not supported there
        options = {
            "bounds": [0.0, 1.0],
            "seed": np.nan,
            "randn": lambda *shape: random.standard_normal(shape),
            "verbose": -9,
            "tolfun": self.cost,
            "tolfunhist": self.cost,
            "tolx": self.step,
            "maxiter": self.max_evaluations,
            "maxfevals": 10 * self.max_evaluations,
        }
        try:
            run.value(run.start)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # a start on a bound is moved inside: that is what is wanted
                strategy = cma.CMAEvolutionStrategy(np.clip(middle, 1e-6, 1 - 1e-6), self.size, options)
                while not strategy.stop():
                    points = strategy.ask()
                    strategy.tell(points, [run.at_cube(np.asarray(x)[:p]) for x in points])
                reasons = strategy.stop()
        except BudgetSpentError:
            return run.spent()
        stopped_by = ", ".join(f"{k} {v}" for k, v in reasons.items())
        return run.ended(any(k in OPTIMA for k in reasons), f"ended by {stopped_by}")


OPTIMISER = CmaEs
