"""SciPy's differential evolution: a population that needs no derivatives and searches the whole range.

Storn and Price 1997, doi 10.1023/A:1008202821328.
"""

from __future__ import annotations

from dataclasses import dataclass

from hvdc_ident.data import Array
from hvdc_ident.fit.optimiser import BudgetSpentError, OptimiserResult, OptimiserRun, generator
from hvdc_ident.fit.problem import Problem

NAME = "differential-evolution"
SUMMARY = "a population of differences over the whole range (SciPy), without derivatives"
GLOBAL = True


@dataclass(frozen=True)
class DifferentialEvolution:
    """Options. population: members a parameter. cost, spread: absolute and relative spread of costs at the end."""

    max_evaluations: int = 20000
    population: int = 10
    cost: float = 1e-10
    spread: float = 1e-8
    seed: int = 0

    def run(self, problem: Problem, start: Array) -> OptimiserResult:
        """Return the end of the run; the start is one member of the first population."""
        from scipy.optimize import differential_evolution

        run = OptimiserRun(problem, start, self.max_evaluations)
        try:
            end = differential_evolution(
                run.at_cube,
                [(0.0, 1.0)] * run.start.size,
                x0=run.cube,
                popsize=self.population,
                atol=self.cost,
                tol=self.spread,
                maxiter=self.max_evaluations,
                polish=False,
                rng=generator(self.seed, run.start),
            )
        except BudgetSpentError:
            return run.spent()
        return run.ended(bool(end.success), f"the population has collapsed after {end.nit} generations")


OPTIMISER = DifferentialEvolution
