"""What can be minimised and profiled: a cost with its gradient and curvature, and a bounded descent on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit.fit_parameter import Coordinates, FitParameter
from hvdc_ident.fit.problem import Problem

LONGEST = 10.0
"""A step changes a logarithm by at most this: no parabola holds over four decades, and on a plateau its minimum lies anywhere."""


@dataclass(frozen=True, eq=False)
class Evaluated:
    """A cost with its (p,) gradient and (p, p) curvature (exact or Gauss-Newton), per unit of the unknowns."""

    cost: float
    gradient: Array
    curvature: Array


class Objective(Protocol):
    """A cost of some unknowns; for a fit the negative log-likelihood up to a constant."""

    @property
    def unknowns(self) -> tuple[FitParameter, ...]:
        """The unknowns with their bounds."""

    def evaluate(self, theta: Array) -> Evaluated:
        """Cost, gradient and curvature at theta, (p,). Raises SimulationError where theta is inadmissible."""


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """Half a sum of squares. residual: theta to r, (n,), and dr/dtheta, (n, p)."""

    unknowns: tuple[FitParameter, ...]
    residual: Callable[[Array], tuple[Array, Array]]

    def evaluate(self, theta: Array) -> Evaluated:
        """Half of r'r with the Gauss-Newton curvature J'J."""
        r, jacobian = self.residual(theta)
        return Evaluated(0.5 * float(r @ r), jacobian.T @ r, jacobian.T @ jacobian)

    @classmethod
    def of(cls, problem: Problem) -> LeastSquares:
        """The cost of a fit."""
        return cls(problem.unknowns, problem.residual)


@dataclass(frozen=True, eq=False)
class Smooth:
    """Any smooth cost. cost: theta to the cost and its gradient; the curvature comes from differences of gradients."""

    unknowns: tuple[FitParameter, ...]
    cost: Callable[[Array], tuple[float, Array]]

    def evaluate(self, theta: Array) -> Evaluated:
        """The cost with a curvature made positive, from central differences of the gradient."""
        value, gradient = self.cost(theta)
        p = theta.size
        rows = np.zeros((p, p))
        for i, u in enumerate(self.unknowns):
            h = np.zeros(p)
            h[i] = 1e-5 * max(abs(theta[i]), 1e-3 * u.size)
            rows[i] = (self.cost(theta + h)[1] - self.cost(theta - h)[1]) / (2.0 * h[i])
        values, vectors = np.linalg.eigh(0.5 * (rows + rows.T))
        return Evaluated(float(value), np.asarray(gradient), (vectors * np.abs(values)) @ vectors.T)


@dataclass(frozen=True, eq=False)
class DescentResult:
    """Where a descent ended: theta, (p,), what the objective is there, and how many evaluations it took."""

    theta: Array
    at: Evaluated
    evaluations: int


def descend(
    objective: Objective, theta: Array, fixed: NDArray[np.bool_], *, enough: float, max_evaluations: int = 80
) -> DescentResult:
    """The minimum over the unknowns that are not fixed, within their bounds, by damped Gauss-Newton steps.

    enough: a predicted fall of the cost not worth a step. Raises SimulationError where theta is inadmissible.
    """
    space = Coordinates(objective.unknowns)
    low, high = space.bounds
    longest = np.where(space.log, LONGEST, np.inf)
    x = np.clip(space.scaled(np.asarray(theta, dtype=float)), low, high)
    x[fixed] = space.scaled(np.asarray(theta, dtype=float))[fixed]
    theta = space.unscaled(x)
    here = objective.evaluate(theta)
    used, damping, rejected = 1, 0.0, 0
    while used < max_evaluations and rejected < 12:
        slope = space.slope(theta)
        g, h = here.gradient * slope, here.curvature * np.outer(slope, slope)
        back, forth = np.maximum(low - x, -longest), np.minimum(high - x, longest)
        p = bounded_step(g, h, damping, np.where(fixed, 0.0, back), np.where(fixed, 0.0, forth))
        predicted = -float(g @ p + 0.5 * p @ h @ p)
        if predicted <= enough:
            break
        used += 1
        trial = space.unscaled(x + p)
        try:
            there = objective.evaluate(trial)
        except SimulationError:
            there = None
        if there is None or not there.cost < here.cost:
            rejected += 1
            damping = max(10.0 * damping, 1e-3)
            continue
        good = (here.cost - there.cost) / predicted
        damping = 0.0 if good > 0.75 and damping < 1e-4 else damping * (0.2 if good > 0.25 else 4.0)
        rejected = 0
        theta, here = trial, there
        x = space.scaled(theta)
    return DescentResult(theta, here, used)


def promised(problem: Problem, theta: Array) -> float:
    """How much lower the cost would be after a Gauss-Newton step within the bounds. Raises SimulationError."""
    space = problem.coordinates
    r, jacobian = problem.residual(theta)
    columns = jacobian * space.slope(theta)
    low, high = space.bounds
    x = space.scaled(theta)
    g, h = columns.T @ r, columns.T @ columns
    p = bounded_step(g, h, 0.0, low - x, high - x)
    return -float(g @ p + 0.5 * p @ h @ p)


def bounded_step(g: Array, h: Array, damping: float, low: Array, high: Array) -> Array:
    """The p in [low, high] that minimises g'p + p'(h + damping diag h)p/2, (p,); directions without curvature stay.

    Unknowns that would leave are put on their bound one after the other, the first to leave first.
    """
    d = np.diag(h)
    scale = np.sqrt(np.where(d > 0, d, 1.0))
    matrix = h / np.outer(scale, scale)
    matrix = matrix + damping * np.eye(g.size)
    target, p = -g / scale, np.zeros(g.size)
    free = ~(((low >= 0) & (g > 0)) | ((high <= 0) & (g < 0)) | ((low >= 0) & (high <= 0))) & (d > 0)
    while free.any():
        part = np.ix_(free, free)
        rhs = target[free] - matrix[np.ix_(free, ~free)] @ (p * scale)[~free]
        trial = p.copy()
        trial[free] = _solve(matrix[part], rhs) / scale[free]
        outside = (trial < low) | (trial > high)
        if not outside.any():
            return trial
        limit = np.where(trial < low, low, high)
        share = np.where(outside, limit / np.where(outside, trial, 1.0), np.inf)
        first = int(np.argmin(share))
        p[first], free[first] = limit[first], False
    return p


def _solve(matrix: Array, rhs: Array) -> Array:
    """The least solution, blind to directions whose curvature is rounding."""
    return np.asarray(np.linalg.lstsq(matrix, rhs, rcond=1e-12)[0])
