"""Optimisers: options that run from one start, and a problem's cost as optimisation libraries want it.

A point where the simulation fails has no cost. Libraries need a number there all the same: they get one worse than any
that was seen, which only ranks the point last; it is never a result. The best admissible point is kept here, whatever
the library returns, and so is the budget.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit.problem import Problem

OptimiserStatus = Literal["converged", "max-evaluations", "stopped", "stalled", "flat", "failed"]


@dataclass(frozen=True, eq=False)
class OptimiserResult:
    """End of a run.

    theta: (p,) the best admissible point seen, each unknown in its unit; the start where nothing else was admissible.
    status: converged, at an optimum by the method's own criterion; max-evaluations; stopped, by another rule of the
    method; stalled, no step lowers the cost although its derivatives promise one; flat, the start lies where no output
    answers to any unknown, so that the run could not move; failed.
    cost: half the sum of squares there; None where not even the start could be simulated. message: why the run ended.
    evaluations: simulations of the whole set of experiments, failed ones included.
    """

    theta: Array
    cost: float | None
    status: OptimiserStatus
    message: str
    evaluations: int


@dataclass(frozen=True, eq=False)
class LocalMinimum:
    """A local minimum of the cost: (p,) theta and its cost."""

    theta: Array
    cost: float


class Optimiser(Protocol):
    """An options object that can run. Raises nothing for a simulation that fails: that is a status."""

    def run(self, problem: Problem, start: Array) -> OptimiserResult:
        """Return the end of the run from `start`, (p,) inside the bounds."""


class BudgetSpentError(Exception):
    """The run has used the evaluations it may take."""


@dataclass
class OptimiserRun:
    """One run of a library's method. limit: evaluations it may take, of the whole set of experiments."""

    problem: Problem
    start: Array
    limit: int
    evaluations: int = 0
    failures: int = 0
    best: Array = field(init=False)
    cost: float | None = None
    failure: str = ""
    _worst: float = 0.0
    _last: tuple[bytes, Array, Array] | None = None

    def __post_init__(self) -> None:
        self.start = np.asarray(self.start, dtype=float)
        self.best = self.start.copy()

    @property
    def x0(self) -> Array:
        """Start in scaled coordinates, (p,), inside the bounds."""
        low, high = self.problem.coordinates.bounds
        return np.clip(self.problem.coordinates.scaled(self.start), low, high)

    def residual(self, x: Array) -> Array:
        """Return the residual at scaled coordinates, (N,); infinite where the simulation fails."""
        evaluated = self._evaluated(x)
        return np.full(self._rows, np.inf) if evaluated is None else evaluated[0]

    def jacobian(self, x: Array) -> Array:
        """Return the residual's derivatives by scaled coordinates, (N, p)."""
        evaluated = self._evaluated(x)
        assert evaluated is not None
        return evaluated[1]

    def value_and_gradient(self, x: Array) -> tuple[float, Array]:
        """Return the cost at scaled coordinates and its gradient, (p,); where the simulation fails a worse cost and 0."""
        evaluated = self._evaluated(x)
        if evaluated is None:
            return 2.0 * self._worst + 1.0, np.zeros_like(x)
        r, jacobian = evaluated
        return 0.5 * float(r @ r), jacobian.T @ r

    def _evaluated(self, x: Array) -> tuple[Array, Array] | None:
        """Return residual and derivatives, computed once for a point however often it is asked for."""
        key = np.asarray(x, dtype=float).tobytes()
        if self._last is not None and self._last[0] == key:
            return self._last[1], self._last[2]
        self._count()
        theta = self.problem.coordinates.unscaled(np.asarray(x, dtype=float))
        try:
            r, jacobian = self.problem.residual(theta)
        except SimulationError as error:
            self.failures += 1
            self.failure = str(error)
            return None
        self._rows = r.size
        scaled = jacobian * self.problem.coordinates.slope(theta)
        self._last = (key, r, scaled)
        self._seen(theta, 0.5 * float(r @ r))
        return r, scaled

    def _count(self) -> None:
        if self.evaluations >= self.limit:
            raise BudgetSpentError
        self.evaluations += 1

    def _seen(self, theta: Array, cost: float) -> None:
        self._worst = max(self._worst, cost)
        if self.cost is None or cost < self.cost:
            self.cost, self.best = cost, np.asarray(theta, dtype=float).copy()

    def result(self, minimise: Callable[[OptimiserRun], tuple[bool, str]]) -> OptimiserResult:
        """Return the best point that a method sees. Without any admissible point the run failed.

        minimise: runs the method from `x0` and returns whether it says that it converged, and its message.
        """
        try:
            self.value_and_gradient(self.x0)
            converged, message = (False, "") if self.cost is None else minimise(self)
            status: OptimiserStatus = "converged" if converged else "stopped"
        except BudgetSpentError:
            status, message = "max-evaluations", f"no optimum within {self.limit} evaluations"
        if self.cost is None:
            why = f"no point could be simulated: {self.failure}"
            return OptimiserResult(self.start, None, "failed", why, self.evaluations)
        more = f"; {self.failures} of {self.evaluations} points could not be simulated" if self.failures else ""
        return OptimiserResult(self.best, self.cost, status, message + more, self.evaluations)
