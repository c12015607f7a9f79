"""Objectives, costs with gradient and curvature that can be minimised and profiled, and a bounded descent on them.

The descent stands beside `optimisers.trust_region` because their tasks differ: it takes any objective, holds some unknowns
and begins near a minimum, as each of a profile's or bootstrap's hundreds of descents does, and stops where less than a given
fall is left. The other begins anywhere, works on the residuals' own QR factors for full precision, and tells a minimum from
the scatter of the simulation. They share the active set of the bounds.
"""

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
from hvdc_ident.sensitivity import normalised

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
        """Unknowns with their bounds."""

    def evaluate(self, theta: Array) -> Evaluated:
        """Return cost, gradient and curvature at theta, (p,). Raises SimulationError where theta is inadmissible."""


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """Half a sum of squares. residual: theta to r, (n,), and dr/dtheta, (n, p)."""

    unknowns: tuple[FitParameter, ...]
    residual: Callable[[Array], tuple[Array, Array]]

    def evaluate(self, theta: Array) -> Evaluated:
        """Return half of r'r with the Gauss-Newton curvature J'J."""
        r, jacobian = self.residual(theta)
        return Evaluated(0.5 * float(r @ r), jacobian.T @ r, jacobian.T @ jacobian)

    @classmethod
    def of(cls, problem: Problem) -> LeastSquares:
        """Return the cost of a fit."""
        return cls(problem.unknowns, problem.residual)


@dataclass(frozen=True, eq=False)
class DescentResult:
    """End of a descent: theta, (p,), the objective evaluated there, and the number of evaluations used."""

    theta: Array
    at: Evaluated
    evaluations: int


def descend(
    objective: Objective, theta: Array, fixed: NDArray[np.bool_], *, enough: float, max_evaluations: int = 80
) -> DescentResult:
    """Return the minimum over the unknowns that are not fixed, within their bounds, by damped Gauss-Newton steps.

    enough: a predicted fall of the cost not worth a step. Raises SimulationError where theta is inadmissible.
    """
    space = Coordinates(objective.unknowns)
    low, high = space.bounds
    longest = np.where(space.log, LONGEST, np.inf)
    x = np.clip(space.scaled(np.asarray(theta, dtype=float)), low, high)
    x[fixed] = space.scaled(np.asarray(theta, dtype=float))[fixed]
    theta = space.unscaled(x)
    current = objective.evaluate(theta)
    used, damping, rejected = 1, 0.0, 0
    while used < max_evaluations and rejected < 12:
        slope = space.slope(theta)
        g, h = current.gradient * slope, current.curvature * np.outer(slope, slope)
        down, up = np.maximum(low - x, -longest), np.minimum(high - x, longest)
        p = bounded_step(g, h, damping, np.where(fixed, 0.0, down), np.where(fixed, 0.0, up))
        predicted = -float(g @ p + 0.5 * p @ h @ p)
        if predicted <= enough:
            break
        used += 1
        trial = space.unscaled(x + p)
        try:
            proposal = objective.evaluate(trial)
        except SimulationError:
            proposal = None
        if proposal is None or not proposal.cost < current.cost:
            rejected += 1
            damping = max(10.0 * damping, 1e-3)
            continue
        ratio = (current.cost - proposal.cost) / predicted
        damping = 0.0 if ratio > 0.75 and damping < 1e-4 else damping * (0.2 if ratio > 0.25 else 4.0)
        rejected = 0
        theta, current = trial, proposal
        x = space.scaled(theta)
    return DescentResult(theta, current, used)


def predicted_reduction(problem: Problem, theta: Array) -> float:
    """Return the fall of the cost that a Gauss-Newton step within the bounds promises. Raises SimulationError."""
    space = problem.coordinates
    r, jacobian = problem.residual(theta)
    columns = jacobian * space.slope(theta)
    low, high = space.bounds
    x = space.scaled(theta)
    g, h = columns.T @ r, columns.T @ columns
    p = bounded_step(g, h, 0.0, low - x, high - x)
    return -float(g @ p + 0.5 * p @ h @ p)


def bounded_step(g: Array, h: Array, damping: float, low: Array, high: Array) -> Array:
    """Return the p in [low, high] that minimises g'p + p'(h + damping diag h)p/2, (p,); p is 0 where h is.

    Least squares at each stage: directions whose curvature is rounding do not move it.
    """
    matrix, scale = normalised(h)
    matrix += damping * np.eye(g.size)
    target = -g / scale

    def solve(free: NDArray[np.bool_], p: Array) -> Array:
        rhs = target[free] - matrix[np.ix_(free, ~free)] @ (p * scale)[~free]
        return np.asarray(np.linalg.lstsq(matrix[np.ix_(free, free)], rhs, rcond=1e-12)[0]) / scale[free]

    free = ~(((low >= 0) & (g > 0)) | ((high <= 0) & (g < 0)) | ((low >= 0) & (high <= 0))) & (np.diag(h) > 0)
    return active_set(solve, free, low, high)


def active_set(
    solve: Callable[[NDArray[np.bool_], Array], Array], free: NDArray[np.bool_], low: Array, high: Array
) -> Array:
    """Return the step p in [low, high], (p,), whose free entries solve a quadratic problem.

    solve: from the mask of the free entries and p, the minimum over the free ones with the others as they are in p.
    free: (p,) at first; the others stay at 0. Entries that would leave are put on their bound one after the other, the first
    to leave first.
    """
    p = np.zeros(low.size)
    while free.any():
        trial = p.copy()
        trial[free] = solve(free, p)
        outside = (trial < low) | (trial > high)
        if not outside.any():
            return trial
        limit = np.where(trial < low, low, high)
        share = np.where(outside, limit / np.where(outside, trial, 1.0), np.inf)
        first = int(np.argmin(share))
        p[first], free[first] = limit[first], False
    return p
