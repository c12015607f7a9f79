"""Bounded Levenberg-Marquardt on exact sensitivities: the descent that fits, profiles and refits share.

A step minimises |r + J p|^2 + lambda |D p|^2 in scaled coordinates with D the largest column norms so far (Moré 1978), with
bounds met by an active set; lambda follows the ratio of actual to predicted reduction as in Nielsen (1999), "Damping parameter
in Marquardt's method". A step is no longer than 1 in a logarithm and than another coordinate itself, or 1, at first, and twice as
long after each that kept half its promise: a full first step may land where no output answers any more. A simulation that fails
shrinks the step; one that changes no residual, as of a simulator of fixed steps that answers in jumps, is made longer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit.fit_parameter import Coordinates, FitParameter
from hvdc_ident.sensitivity import normalised

LEAST_DAMPING = 1e-14
"""Damping of a Gauss-Newton step: its root is the share of a column that is the sensitivities' own error, so that directions
without information do not move a step."""
FIRST_DAMPING = 1e-3
"""Damping with which a run from afar begins, and another after its first Gauss-Newton step that was none."""
AS_PROMISED = 0.1
"""A reduction within this share of the promised one shows no error of the simulation."""
SMALLEST = 1e-10
"""A scaled coordinate below this counts as this large where its step is judged: an optimum may lie at 0."""
UNCHANGED = 1e-9
"""Change of the residuals, as a share of the largest, that is none: rounding."""
WORTH = 1e-6
"""Share of the cost that a step has to promise to be made longer where nothing changes."""
OPENING = 10
"""Evaluations after which a descent's rate counts: its reach, doubled with each good step, is by then longer than any range, and one
that began near its optimum has ended."""
LONGEST = 10.0
"""Longest first step of a descent that begins near a minimum, and along a tangent: no parabola holds over four decades of a logarithm."""


class Residuals(Protocol):
    """A sum of squares to be minimised; a fit's `Problem` is one."""

    @property
    def unknowns(self) -> tuple[FitParameter, ...]:
        """Unknowns with their bounds."""

    def residual(self, theta: Array) -> tuple[Array, Array]:
        """Return r, (n,), and dr/dtheta, (n, p), at theta, (p,). Raises SimulationError where theta is inadmissible."""


@dataclass(frozen=True, eq=False)
class Evaluated:
    """Half a sum of squares with its (p,) gradient and its (p, p) Gauss-Newton curvature, per unit of the unknowns."""

    cost: float
    gradient: Array
    curvature: Array


@dataclass(frozen=True, eq=False)
class LinearResiduals:
    """The residuals at a point, linear about it. theta: (p,), each unknown in its unit; x: the same in scaled coordinates.

    r: (n,). triangle, target: R, (k, p), and Q'r, (k,), of the jacobian QR per scaled coordinate; slope: (p,) dtheta/dx.
    """

    theta: Array
    x: Array
    r: Array
    triangle: Array
    target: Array
    slope: Array

    @classmethod
    def at(cls, objective: Residuals, space: Coordinates, x: Array) -> LinearResiduals:
        """Return the residuals at scaled coordinates x, (p,). Raises SimulationError where they are inadmissible."""
        theta = space.unscaled(x)
        r, jacobian = objective.residual(theta)
        slope, p = space.slope(theta), theta.size
        # Of the residuals as a last column the triangle holds Q'r; Q itself, as long as the records, is not formed.
        factor = np.asarray(np.linalg.qr(np.column_stack([jacobian, r]), mode="r"))
        return cls(theta, space.scaled(theta), r, factor[:p, :p] * slope, factor[:p, p], slope)

    @cached_property
    def cost(self) -> float:
        """Half the sum of squares."""
        return 0.5 * float(self.r @ self.r)

    @cached_property
    def norms(self) -> Array:
        """Length of each column of the jacobian, (p,), 1 for a column of zeros."""
        norms = np.linalg.norm(self.triangle, axis=0)
        return np.where(norms > 0, norms, 1.0)

    @cached_property
    def gradient(self) -> Array:
        """Gradient of the cost by scaled coordinates, (p,)."""
        return np.asarray(self.triangle.T @ self.target)

    def step(self, damping: float, size: Array, low: Array, high: Array) -> Array:
        """Return the p in [low, high] that minimises |r + J p|^2 + damping |size p|^2, (p,)."""
        matrix = np.vstack([self.triangle, np.sqrt(damping) * np.diag(size)])
        right = np.concatenate([-self.target, np.zeros(size.size)])

        def solve(free: NDArray[np.bool_], p: Array) -> Array:
            return np.asarray(np.linalg.lstsq(matrix[:, free], right - matrix[:, ~free] @ p[~free], rcond=None)[0])

        return active_set(solve, ~_blocked(self.gradient, low, high), low, high)

    def predicted(self, p: Array) -> float:
        """Return the reduction of the cost that the linear residuals promise for the step p, (p,)."""
        along = self.triangle @ p
        return -float(self.gradient @ p + 0.5 * along @ along)

    def evaluated(self) -> Evaluated:
        """Return cost, gradient and curvature per unit of the unknowns."""
        triangle = self.triangle / self.slope
        return Evaluated(self.cost, self.gradient / self.slope, triangle.T @ triangle)


DescentEnd = Literal["inadmissible", "flat", "stationary", "settled", "enough", "standstill", "spent", "crawling"]


@dataclass(frozen=True)
class DescentOptions:
    """Options of a descent; tolerances are relative and without unit, but for `enough`.

    max_evaluations: simulations of the whole set a descent may take. gradient: largest cosine between the residual and a free
    column at which a point counts as stationary. reduction: smallest relative reduction of the cost worth a step; where the cost
    still falls just as promised, so that no error of the simulation is in sight, a thousandth of it is. step: smallest step, as a
    share of each scaled coordinate. damping: first lambda. enough: a predicted fall of the cost not worth a step. reach: longest
    first step, in logarithms and in shares of the other scaled coordinates.
    """

    max_evaluations: int = 200
    gradient: float = 1e-10
    reduction: float = 1e-13
    step: float = 1e-11
    damping: float = FIRST_DAMPING
    enough: float = 0.0
    reach: float = 1.0


@dataclass
class Descent:
    """A descent: the best point so far (None before the first), the evaluations used, and the last one with its error if it failed.

    fixed: (p,) unknowns that stay where they begin. noise_cost: the cost that noise alone leaves; where it is given, a descent that
    will not come near it ends early, as `crawling`.
    """

    objective: Residuals
    options: DescentOptions
    fixed: NDArray[np.bool_] | None = None
    noise_cost: float | None = None
    evaluations: int = 0
    failure: SimulationError | None = None
    at: LinearResiduals | None = None
    tried: LinearResiduals | None = field(init=False, default=None)
    space: Coordinates = field(init=False)

    def __post_init__(self) -> None:
        self.space = Coordinates(self.objective.unknowns)
        held = np.zeros(len(self.objective.unknowns), dtype=bool) if self.fixed is None else self.fixed
        low, high = self.space.bounds
        self._held, self._low, self._high = held, low, high

    def room(self) -> tuple[Array, Array]:
        """Return how far the unknowns may move from the best point, down and up, in scaled coordinates, (p,) each."""
        assert self.at is not None
        x = self.at.x
        return np.where(self._held, 0.0, self._low - x), np.where(self._held, 0.0, self._high - x)

    def go(self, start: Array) -> DescentEnd:
        """Go down from start, (p,), and return why it ended.

        inadmissible: the start cannot be simulated; flat: no output answers to any unknown there; stationary: the gradient is
        zero; settled: the cost does not fall any more; enough: no fall worth a step is left; standstill: no step lowers the
        cost although one should; spent: the evaluations are used up; crawling: at the rate so far they would be, far from the
        noise.
        """
        theta = np.asarray(start, dtype=float)
        x = self.space.scaled(theta)
        if not self._moved(np.where(self._held, x, np.clip(x, self._low, self._high)), np.inf):
            return "inadmissible"
        assert self.at is not None
        size, damping, growth, reach = self.at.norms, self.options.damping, 2.0, self.options.reach
        first = self.at.cost
        while self.evaluations < self.options.max_evaluations:
            here = self.at
            if not here.triangle[:, ~self._held].any():
                return "flat"
            low, high = self.room()
            if self._stationary(here, low, high):
                return "stationary"
            if self._crawls(here.cost, first):
                return "crawling"
            size = np.maximum(size, here.norms)
            with np.errstate(over="ignore"):  # beyond the largest number a step has no limit
                far = reach * np.where(self.space.log, 1.0, np.maximum(np.abs(here.x), 1.0))
            p = here.step(damping, size, np.maximum(low, -far), np.minimum(high, far))
            predicted = here.predicted(p)
            enough = self.options.enough
            # A short step promises little where the whole one promises much.
            if predicted <= enough and here.predicted(here.step(damping, size, low, high)) <= enough > 0.0:
                return "enough"
            small = bool((np.abs(p) <= self.options.step * np.maximum(np.abs(here.x), SMALLEST)).all())
            if small:
                return "standstill"
            if predicted > 0:
                if self._moved(here.x + p, here.cost):
                    fall = here.cost - self.at.cost
                    ratio = fall / predicted
                    damping, growth = max(damping * max(1 / 3, 1 - (2 * ratio - 1) ** 3), LEAST_DAMPING), 2.0
                    reach *= 2.0 if ratio > 0.5 else 1.0
                    least = self.options.reduction * (1e-3 if abs(ratio - 1.0) < AS_PROMISED else 1.0)
                    if max(fall, predicted) <= least * here.cost:
                        return "settled"
                    continue
                if not self.failure and predicted <= self.options.reduction * here.cost:
                    return "standstill"
                if predicted > WORTH * here.cost and self._passes_plateau(here, p, low, high):
                    damping, growth = self.options.damping, 2.0
                    continue
            damping = FIRST_DAMPING if damping <= LEAST_DAMPING else damping * growth
            growth = min(2.0 * growth, 1e6)
        return "spent"

    def _moved(self, x: Array, below: float) -> bool:
        """Return whether the simulation at x succeeds at a cost below the given one; only then x becomes the best point."""
        self.evaluations += 1
        self.tried = None
        try:
            self.tried = LinearResiduals.at(self.objective, self.space, x)
        except SimulationError as error:
            self.failure = error
            return False
        self.failure = None
        if not self.tried.cost < below:
            return False
        self.at = self.tried
        return True

    def _crawls(self, cost: float, first: float) -> bool:
        """Return whether the evaluations left do not lead to the noise at the rate at which the cost has fallen since the first."""
        if self.noise_cost is None or self.evaluations < OPENING or cost <= self.noise_cost:
            return False
        rate = np.log(first / cost) / (self.evaluations - 1)
        return bool(rate * (self.options.max_evaluations - self.evaluations) < np.log(cost / self.noise_cost))

    def _passes_plateau(self, here: LinearResiduals, p: Array, low: Array, high: Array) -> bool:
        """Return whether p changed no residual and a step twice, four times, ... as long leads to a lower cost, the best point then."""
        while self.tried is not None and np.abs(self.tried.r - here.r).max() <= UNCHANGED * np.abs(here.r).max():
            longer = np.clip(2.0 * p, low, high)
            if np.array_equal(longer, p) or self.evaluations >= self.options.max_evaluations:
                return False
            p = longer
            if self._moved(here.x + p, here.cost):
                return True
        return False

    def _stationary(self, here: LinearResiduals, low: Array, high: Array) -> bool:
        g = np.where(_blocked(here.gradient, low, high), 0.0, here.gradient)
        return bool((np.abs(g) <= self.options.gradient * here.norms * np.sqrt(2.0 * here.cost)).all())


@dataclass(frozen=True, eq=False)
class DescentResult:
    """End of a descent: theta, (p,), the objective evaluated there, and the number of evaluations used."""

    theta: Array
    at: Evaluated
    evaluations: int


def descend(
    objective: Residuals,
    theta: Array,
    fixed: NDArray[np.bool_] | None = None,
    *,
    enough: float,
    max_evaluations: int = 80,
) -> DescentResult:
    """Return the minimum near theta, (p,), over the unknowns that are not fixed, within their bounds.

    For descents that begin near a minimum, as each of a profile's hundreds does: by Gauss-Newton steps until a
    predicted fall of the cost is less than `enough`. Raises SimulationError where theta is inadmissible.
    """
    down = Descent(
        objective, DescentOptions(max_evaluations, damping=LEAST_DAMPING, enough=enough, reach=LONGEST), fixed
    )
    down.go(theta)
    if down.at is None:
        assert down.failure is not None
        raise down.failure
    return DescentResult(down.at.theta, down.at.evaluated(), down.evaluations)


def predicted_reduction(objective: Residuals, theta: Array) -> float:
    """Return the fall of the cost that a Gauss-Newton step within the bounds promises. Raises SimulationError."""
    space = Coordinates(objective.unknowns)
    here = LinearResiduals.at(objective, space, space.scaled(theta))
    low, high = space.bounds
    return here.predicted(here.step(LEAST_DAMPING, here.norms, low - here.x, high - here.x))


def bounded_step(g: Array, h: Array, low: Array, high: Array) -> Array:
    """Return the p in [low, high] that minimises g'p + p'h p/2, (p,), for g, (p,), and h, (p, p); p is 0 where h is.

    Least squares at each stage: directions whose curvature is rounding do not move it.
    """
    matrix, scale = normalised(h)
    target = -g / scale

    def solve(free: NDArray[np.bool_], p: Array) -> Array:
        rhs = target[free] - matrix[np.ix_(free, ~free)] @ (p * scale)[~free]
        return np.asarray(np.linalg.lstsq(matrix[np.ix_(free, free)], rhs, rcond=1e-12)[0]) / scale[free]

    return active_set(solve, ~_blocked(g, low, high) & (np.diag(h) > 0), low, high)


def _blocked(gradient: Array, low: Array, high: Array) -> NDArray[np.bool_]:
    """Return the entries, (p,), that have no room where the gradient would have them go; low, high: how far they may move."""
    return ((low >= 0) & (gradient > 0)) | ((high <= 0) & (gradient < 0)) | ((low >= 0) & (high <= 0))


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
