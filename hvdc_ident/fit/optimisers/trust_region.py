"""Bounded Levenberg-Marquardt on exact sensitivities; a simulation that fails shrinks the step.

The step minimises |r + J p|^2 + lambda |D p|^2 in scaled coordinates with D the largest column norms so far
(Moré 1978), with bounds met by an active set; lambda follows the ratio of actual to predicted reduction as in
Nielsen (1999), "Damping parameter in Marquardt's method". A step is no longer than the coordinate, or 1, at first, and twice
as long after each that kept half its promise: without bounds a full first step may land where no output answers any more.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit.fit_parameter import Coordinates
from hvdc_ident.fit.nonsmooth import RUNS, roughness
from hvdc_ident.fit.objective import active_set
from hvdc_ident.fit.optimiser import OptimiserResult, OptimiserStatus
from hvdc_ident.fit.problem import Problem
from hvdc_ident.fit.simulator import approximate

NAME = "trust-region"
SUMMARY = "bounded Levenberg-Marquardt with exact sensitivities"


PROBES = (-3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0)
"""Tiny steps, in units of `probe`, from which the scatter of the cost is estimated."""
AS_PROMISED = 0.1
"""A reduction within this share of the promised one shows no error of the simulation."""
SMALLEST = 1e-10
"""A scaled coordinate below this counts as this large where its step is judged: an optimum may lie at 0."""
LUCK = 3.0
"""A promised reduction within so many standard deviations of the cost's scatter cannot be told from it: the point stood on
is the lowest of some twenty (1.9 below the mean, the expected minimum), and the next has to be lower still."""


@dataclass(frozen=True)
class TrustRegion:
    """Options of the method; all tolerances are relative and without unit.

    max_evaluations: simulations of the whole set a run may take. gradient: largest cosine between the residual and a
    free column at which a point counts as stationary. reduction: smallest relative reduction of the cost worth a step; where
    the cost still falls just as promised, so that no error of the simulation is in sight, a thousandth of it is.
    step: smallest step, as a share of each scaled coordinate. damping: first lambda. probe: length, in scaled coordinates, of the steps
    that show how far the cost scatters by the simulation's own error.
    """

    max_evaluations: int = 200
    gradient: float = 1e-10
    reduction: float = 1e-13
    step: float = 1e-11
    damping: float = 1e-3
    probe: float = 1e-9

    def run(self, problem: Problem, start: Array) -> OptimiserResult:
        """Return the end of the run from `start`: converged, max-evaluations, stalled, flat, or failed with the reason."""
        run = _Run(problem, self)
        status, message = run.go(start)
        return OptimiserResult(run.theta, run.cost, status, message, run.evaluations)


OPTIMISER = TrustRegion


@dataclass
class _Run:
    """One run: its current point with the residual and its derivatives there."""

    problem: Problem
    options: TrustRegion
    evaluations: int = 0
    cost: float | None = None
    failure: str = ""
    theta: Array = field(init=False)
    x: Array = field(init=False)
    r: Array = field(init=False)
    jacobian: Array = field(init=False)

    def go(self, start: Array) -> tuple[OptimiserStatus, str]:
        """Return the status and the reason for which the run ended."""
        space = self.problem.coordinates
        low, high = space.bounds
        self.theta = np.asarray(start, dtype=float)
        if not self._move(np.clip(space.scaled(self.theta), low, high), space):
            return "failed", f"the start cannot be simulated: {self.failure}"
        size = _norms(self.jacobian)
        damping, growth, reach = self.options.damping, 2.0, 1.0
        while self.evaluations < self.options.max_evaluations:
            assert self.cost is not None
            if not self.jacobian.any():
                return "flat", "no compared output answers to any of the unknowns there"
            if self._stationary(low, high):
                return "converged", "the gradient is zero"
            size = np.maximum(size, _norms(self.jacobian))
            with np.errstate(over="ignore"):  # beyond the largest number a step has no limit
                far = reach * np.maximum(np.abs(self.x), 1.0)
            p = _step(
                self.jacobian, self.r, damping, size, np.maximum(low - self.x, -far), np.minimum(high - self.x, far)
            )
            predicted = self._predicted(p)
            small = bool((np.abs(p) <= self.options.step * np.maximum(np.abs(self.x), SMALLEST)).all())
            if predicted > 0 and not small:
                before = self.cost
                if self._move(self.x + p, space, better_than=before):
                    ratio = (before - self.cost) / predicted
                    damping, growth = damping * max(1 / 3, 1 - (2 * ratio - 1) ** 3), 2.0
                    damping = max(damping, 1e-14)
                    reach *= 2.0 if ratio > 0.5 else 1.0
                    smallest = self.options.reduction * (1e-3 if abs(ratio - 1.0) < AS_PROMISED else 1.0)
                    if max(before - self.cost, predicted) <= smallest * before:
                        return "converged", "the cost does not fall any more"
                    continue
                if not self.failure and predicted <= self.options.reduction * before:
                    return "converged", "the cost does not fall any more"
            elif small:
                return self._standstill(size, low, high)
            damping, growth = damping * growth, min(2.0 * growth, 1e6)
        return "max-evaluations", f"no optimum within {self.options.max_evaluations} evaluations"

    def _move(self, x: Array, space: Coordinates, better_than: float = np.inf) -> bool:
        """Return whether the simulation at x succeeds and is better; only then x becomes the current point."""
        theta = space.unscaled(x)
        self.evaluations += 1
        try:
            r, jacobian = self.problem.residual(theta)
        except SimulationError as error:
            self.failure = str(error)
            return False
        self.failure = ""
        cost = 0.5 * float(r @ r)
        if not cost < better_than:
            return False
        self.x, self.theta, self.r, self.cost = space.scaled(theta), theta, r, cost
        self.jacobian = jacobian * space.slope(theta)
        return True

    def _stationary(self, low: Array, high: Array) -> bool:
        g = self.jacobian.T @ self.r
        g[((self.x <= low) & (g > 0)) | ((self.x >= high) & (g < 0))] = 0.0
        scale = _norms(self.jacobian) * np.linalg.norm(self.r)
        return bool((np.abs(g) <= self.options.gradient * scale).all())

    def _standstill(self, size: Array, low: Array, high: Array) -> tuple[OptimiserStatus, str]:
        """Return the outcome where steps are too small to count: an optimum, a failing region or a gradient that does not fit."""
        if self.failure:
            return "failed", f"every step down leads to where the simulation fails: {self.failure}"
        p = _step(self.jacobian, self.r, 1e-10, size, low - self.x, high - self.x)
        assert self.cost is not None
        promise = self._predicted(p)
        if promise <= 1e-4 * self.cost + 1e-12 * self.r.size:
            return "converged", "no smaller step lowers the cost"
        error = self._scatter(p, low, high)
        if promise > LUCK * error and approximate(
            self.problem.simulator
        ):  # smooth near a local minimum, and nonsmooth beyond it
            self.evaluations += RUNS
            error = max(error, roughness(self.problem, self.theta))
        if promise <= LUCK * error:
            return "converged", f"no step lowers the cost by more than its own scatter there ({error:.2g})"
        return "stalled", "the sensitivities promise a lower cost that no step reaches (a jump, or their error)"

    def _predicted(self, p: Array) -> float:
        """Return the reduction of the cost that the linearised residuals promise for the step p."""
        assert self.cost is not None
        return self.cost - 0.5 * float(np.sum((self.r + self.jacobian @ p) ** 2))

    def _scatter(self, p: Array, low: Array, high: Array) -> float:
        """Return the standard deviation of the cost's noise over tiny even steps along p; 0 where one of them fails.

        Third differences remove a smooth cost. Adaptive steps of an integrator make it jump from one parameter
        value to the next, however close they are (Moré and Wild 2011, "Estimating computational noise",
        doi 10.1137/100786125).
        """
        space = self.problem.coordinates
        unit = self.options.probe * p / np.abs(p).max()
        room = np.where(unit > 0, high - self.x, np.where(unit < 0, self.x - low, np.inf))
        if not (room > -PROBES[0] * np.abs(unit)).all():
            unit = np.where(room > -PROBES[0] * np.abs(unit), unit, 0.0)
        costs = []
        for k in PROBES:
            self.evaluations += 1
            try:
                r, _ = self.problem.residual(space.unscaled(self.x + k * unit))
            except SimulationError:
                return 0.0
            costs.append(0.5 * float(r @ r))
        differences = np.diff(costs, 3)
        return float(np.sqrt(np.mean(differences**2) / 20.0))  # 20 = 1 + 9 + 9 + 1, of white noise of 1


def _norms(jacobian: Array) -> Array:
    """Return the columns' norms, (p,), 1 for a column of zeros."""
    norms = np.linalg.norm(jacobian, axis=0)
    return np.where(norms > 0, norms, 1.0)


def _step(jacobian: Array, r: Array, damping: float, size: Array, low: Array, high: Array) -> Array:
    """Return the p in [low, high] that minimises |r + J p|^2 + damping |size p|^2, (p,)."""
    n = size.size
    q, triangle = np.linalg.qr(jacobian)
    matrix = np.vstack([triangle, np.sqrt(damping) * np.diag(size)])
    target = np.concatenate([-(q.T @ r), np.zeros(n)])
    g = jacobian.T @ r

    def solve(free: NDArray[np.bool_], p: Array) -> Array:
        return np.asarray(np.linalg.lstsq(matrix[:, free], target - matrix[:, ~free] @ p[~free], rcond=None)[0])

    return active_set(solve, ~(((low >= 0) & (g > 0)) | ((high <= 0) & (g < 0))), low, high)
