"""Particle swarm optimisation, by the package `pyswarms` (extra `optimisers`); RaPId's default method.

Kennedy and Eberhart 1995, doi 10.1109/ICNN.1995.488968; constants after Clerc and Kennedy 2002.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.fit.optimiser import BudgetSpentError, OptimiserResult, OptimiserRun, generator, missing
from hvdc_ident.fit.problem import Problem

NAME = "particle-swarm"
SUMMARY = "a swarm of particles (package pyswarms, an extra), without derivatives"
GLOBAL = True
PACKAGE = "pyswarms"


@dataclass(frozen=True)
class ParticleSwarm:
    """Options. particles: in the swarm. inertia, own, common: w, c1 and c2 of the velocity.

    The swarm has converged where the best cost improved by less than `cost` (relative to 1 + cost) over `patience`
    iterations.
    """

    max_evaluations: int = 20000
    particles: int = 20
    inertia: float = 0.7298
    own: float = 1.49618
    common: float = 1.49618
    cost: float = 1e-10
    patience: int = 20
    seed: int = 0

    def run(self, problem: Problem, start: Array) -> OptimiserResult:
        """Return the end of the run; one particle begins at the start. Raises InputError where the package is missing."""
        run = OptimiserRun(problem, start, self.max_evaluations)
        p = run.start.size
        random = generator(self.seed, run.start)
        first = np.vstack([run.cube, random.random((self.particles - 1, p))])
        iterations = self.max_evaluations // self.particles
        with _isolated(int(random.integers(2**31))):
            try:
                import pyswarms
            except ImportError:
                raise missing(PACKAGE, NAME) from None
            swarm = pyswarms.single.GlobalBestPSO(
                self.particles,
                p,
                {"c1": self.own, "c2": self.common, "w": self.inertia},
                bounds=(np.zeros(p), np.ones(p)),
                bh_strategy="nearest",
                ftol=self.cost,
                ftol_iter=self.patience,
                init_pos=first,
            )
            try:
                swarm.optimize(lambda points: np.array([run.at_cube(x) for x in points]), iterations, verbose=False)
            except BudgetSpentError:
                return run.spent()
        done = len(swarm.cost_history)
        if done >= iterations:
            return run.spent()
        return run.ended(True, f"the best cost stood still over {self.patience} of {done} iterations")


@contextmanager
def _isolated(seed: int) -> Iterator[None]:
    """Keep the package to itself: it draws from NumPy's global generator and would write a log file where it stands."""
    state: Any = np.random.get_state()
    before = os.environ.get("LOG_CFG")
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "quiet.yaml")
        with open(path, "w", encoding="utf-8") as file:
            file.write("{version: 1, incremental: true}\n")
        os.environ["LOG_CFG"] = path
        np.random.seed(seed)
        try:
            yield
        finally:
            np.random.set_state(state)
            if before is None:
                del os.environ["LOG_CFG"]
            else:
                os.environ["LOG_CFG"] = before


OPTIMISER = ParticleSwarm
