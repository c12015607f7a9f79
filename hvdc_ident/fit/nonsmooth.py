"""Optima of a nonsmooth cost: that of its trend over the width of the interval, not the lowest of many local minima.

Events that pass rows, and adaptive steps of a solver, make the residuals jump from one parameter value to the next. The cost
is then a sawtooth on a parabola: its lowest minimum lies anywhere within sqrt(2 roughness) standard deviations. The roughness
is estimated by fourth differences (More and Wild, SIAM J. Sci. Comput. 33 (2011) 1292) over steps as wide as the interval.
Where it is not small against the threshold, the optimum is that of the trend of the residuals, regressed over that width.
A simulator of fixed steps may not answer at all over more than that: then the optimum is the middle of what is all the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from hvdc_ident.data import Array
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit.problem import Problem, stacked
from hvdc_ident.fit.simulator import approximate
from hvdc_ident.fit.uncertainty import SINGULAR, TWO_SIDED
from hvdc_ident.immutable import FrozenMap

FINE = 0.05
"""Share of its half-width by which an end may be off: 1.96 times 0.95 to 1.05 standard deviations cover 94 to 96 of 100."""
SLIGHT = 2.0 * FINE
"""Roughness, as a share of the threshold, that moves an end by less than that: the rise goes with the distance squared."""
UNEVEN = -np.cos(np.pi * np.arange(9) / 8)
"""Places from -1 to 1 along a coordinate: a constant, a slope and a bend leave 6 of 9 to estimate the scatter by."""
REACH = 2.0
"""First reach of the places, in standard deviations: the interval."""
LUCK = 3.0
"""So many times the roughness may lie between the costs of the lowest of some twenty local minima and of the next."""
RUNS = UNEVEN.size
"""Evaluations that an estimate of the roughness takes."""
ROUNDS = 8
"""Times that the places are moved or spread before the last trend is taken."""
SPREAD = 8.0
"""At most so many times as far the places reach in the next round: the scatter in one is only roughly known."""


@dataclass(frozen=True, eq=False)
class Trend:
    """The optimum of the trend of a rough cost.

    theta: (p,), each unknown in its unit. gain: (p, p), multiplies the covariance from the single run's derivatives from
    both sides, for these are off. scatter: (p, p) covariance of theta by the roughness alone.
    curvature: (p, p) of the cost. roughness: random change of the cost, half of chi-square, between values
    within the interval. settled: whether the optimum lies among the places that the trend was regressed on. unchanged: ends of
    the values between which runs are the same, by unknown.
    """

    theta: Array
    gain: Array
    scatter: Array
    curvature: Array
    roughness: float
    settled: bool = True
    unchanged: FrozenMap[tuple[float, float]] = field(default_factory=FrozenMap)

    def holds(self, theta: Array, threshold: float) -> bool:
        """Return whether theta, (p,), may be a local minimum that a search found within the interval of this optimum."""
        distance = theta - self.theta
        return bool(0.5 * distance @ self.curvature @ distance <= threshold + LUCK * self.roughness)

    def widened(self, covariance: Array, places: Sequence[int] | None = None) -> Array:
        """Return the covariance of the estimates, (k, k), with the derivatives' error and the roughness in it.

        places: of those k among all p unknowns; None: all.
        """
        among = np.ix_(places, places) if places is not None else ...
        gain = self.gain[among]
        return np.asarray(gain @ covariance @ gain.T + self.scatter[among])

    @property
    def text(self) -> str:
        """Sentence on the roughness, for the reader of a report."""
        if self.unchanged:
            listed = ", ".join(f"for {n} from {low:.6g} to {high:.6g}" for n, (low, high) in self.unchanged.items())
            return (
                f"Runs of this simulator answer in jumps and are the same {listed}: estimates are in the middle, and intervals "
                "hold all of it"
            )
        return (
            f"Runs of this simulator jump from one parameter value to the next, so that chi-square changes by about "
            f"{2.0 * self.roughness:.2g} at random within the intervals (their ends lie where it has risen by 3.84): "
            "estimates and intervals are those of its trend over the intervals, not of its lowest point"
        )


def residual_at(problem: Problem, theta: Array) -> Array:
    """Return the residuals, (N,), at theta, (p,), without their derivatives. Raises SimulationError."""
    r, _ = problem.loss.applied(*stacked(problem.blocks(theta, derivatives=False)))
    return np.concatenate([r, problem.prior(theta)[0]]) if problem.priors else r


def roughness(problem: Problem, theta: Array) -> float:
    """Return the random change of the cost between values of theta, (p,), within its interval.

    0 where sensitivities are exact, for such runs are smooth, and where a run fails beside theta, so that it is not known.
    """
    if not approximate(problem.simulator):
        return 0.0
    space = problem.coordinates
    low, high = space.bounds
    x = space.scaled(theta)
    r, jacobian = problem.residual(theta)
    length = np.linalg.norm(jacobian * space.slope(theta), axis=0)
    room = np.maximum(high - x, x - low)
    # All together they go through the interval of each unknown to one side.
    step = np.minimum(np.where(length > 0, REACH / np.where(length > 0, length, 1.0), 0.0), room)
    return scatter_along(problem, theta, r, np.where(high - x >= x - low, step, -step))


def scatter_along(problem: Problem, theta: Array, r: Array, step: Array) -> float:
    """Return the random change of the cost between theta, (p,), and a step from there, (p,) in scaled coordinates.

    r: (N,) the residuals at theta. 0 where a run fails, so that it is not known. Residuals that jump by n change the cost by
    sum r n + sum n^2/2, the first of mean 0 for noise in r. n is the remainder of polynomials of degree 4 through eight more
    runs, as fourth differences give, but at uneven steps: jumps at even distances would look smooth at even ones.
    """
    space = problem.coordinates
    x = space.scaled(theta)
    try:
        runs = np.array([r, *(residual_at(problem, space.unscaled(x + s * step)) for s in 0.5 + 0.5 * UNEVEN[1:])])
    except SimulationError:
        return 0.0
    smooth = np.linalg.qr(np.polynomial.chebyshev.chebvander(UNEVEN, 4))[0]
    remainder = runs - smooth @ (smooth.T @ runs)
    squares = np.sum(remainder**2, axis=0) / (UNEVEN.size - smooth.shape[1])
    return float(np.sqrt(np.sum(r**2 * squares)) + 0.5 * np.sum(squares))


def threshold_of(problem: Problem, r: Array) -> float:
    """Return the rise of the cost at the ends of an interval, which a misfit larger than the noise makes as much larger."""
    return TWO_SIDED * max(1.0, float(r @ r) / max(r.size - len(problem.names), 1))


def trend_of(problem: Problem, theta: Array, known_roughness: float | None = None) -> Trend | None:
    """Return the optimum of the trend near theta, (p,); None where the cost is smooth enough, or a run fails.

    known_roughness: the `roughness` at theta, where it is known.

    At places about the optimum, along each unknown, the Gauss-Newton step is taken with one and the same matrix of
    derivatives J. Its end, q, is regressed on the place: the intercept is the optimum, and the slope B is the error of J
    beside the trend's own derivatives, for with these q would be the same from everywhere. J has errors that do not
    depend on the residuals, so it serves as an instrument: the covariance is G (J'J)^-1 G' with G = (1 - B)^-1.
    The places are spread until B is known to `FINE`, and moved until the optimum lies among them.
    """
    rough = roughness(problem, theta) if known_roughness is None else known_roughness
    if rough == 0.0 or rough <= SLIGHT * threshold_of(problem, residual_at(problem, theta)):
        return _plateau(problem, theta) if approximate(problem.simulator) else None
    space = problem.coordinates
    low, high = space.bounds
    x = space.scaled(theta)
    inside = np.flatnonzero((x > low) & (x < high))
    reach = np.full(inside.size, REACH)
    trend: Trend | None = None
    for n in range(ROUNDS):
        try:
            centre = space.unscaled(x)
            local = _StandardCoordinates.of(problem, x, inside, problem.residual(centre)[1] * space.slope(centre))
            if local is None:
                return trend
            regression = _regressed(local, reach)
        except SimulationError:
            return trend
        rough = max(rough, regression.rough) if n == 0 else rough
        error = float(regression.error.max())
        gain = np.linalg.pinv(np.eye(inside.size) - regression.slope)
        ahead = gain @ regression.intercept
        x = np.clip(local.place(np.clip(ahead, -reach, reach)), low, high)
        settled = bool((np.abs(ahead) <= reach).all())
        trend = local.trend(x, gain * np.sqrt(1.0 + error**2), gain @ regression.scatter @ gain.T, rough, settled)
        if error > FINE:
            reach = reach * min(max(error / FINE, 2.0), SPREAD)
        elif settled:
            return trend
    return trend


def _plateau(problem: Problem, theta: Array) -> Trend | None:
    """Return the middle of the values about theta, (p,), at which runs are the same over more than a standard deviation.

    None where every unknown changes them. The interval of the estimate is the linear one and all that is the same.
    """
    space = problem.coordinates
    low, high = space.bounds
    x = space.scaled(theta)
    r, jacobian = problem.residual(theta)
    length = np.linalg.norm(jacobian * space.slope(theta), axis=0)
    ends = np.zeros((2, x.size))
    for k in np.flatnonzero((length > 0) & (x > low) & (x < high)):
        for side, room in enumerate((low[k] - x[k], high[k] - x[k])):
            step = np.sign(room) * min(1.0 / length[k], abs(room))
            ends[side, k] = _unchanged_to(problem, x, r, int(k), step, room)
    if not ends.any():
        return None
    middle = space.unscaled(x + ends.mean(axis=0))
    if threshold_of(problem, r) < 0.5 * float(np.sum(residual_at(problem, middle) ** 2) - r @ r):
        ends, middle = (
            np.abs(ends).max(axis=0) * np.array([[-1.0], [1.0]]),
            theta,
        )  # the middle of each is not that of all
    half = 0.5 * np.ptp(ends, axis=0) * space.slope(middle)
    scatter = np.diag(half**2) / (2.0 * TWO_SIDED)  # 1.96 standard deviations are half of it
    unchanged = {
        n: (m - h, m + h) for n, m, h in zip(problem.names, middle.tolist(), half.tolist(), strict=True) if h > 0.0
    }
    return Trend(middle, np.eye(x.size), scatter, jacobian.T @ jacobian, 0.0, unchanged=FrozenMap(unchanged))


def _unchanged_to(problem: Problem, x: Array, r: Array, k: int, step: float, room: float) -> float:
    """Return how far the k-th scaled coordinate can move to one side with the same residuals r, (N,), 0 where not by a step."""

    def same(distance: float) -> bool:
        moved = x.copy()
        moved[k] += distance
        try:
            change = residual_at(problem, problem.coordinates.unscaled(moved)) - r
        except SimulationError:
            return False
        return bool(change @ change <= FINE**2)  # a standard deviation changes them by 1

    if not same(step):
        return 0.0
    while abs(step) < abs(room) and same(further := np.sign(room) * min(2.0 * abs(step), abs(room))):
        step = further
    inner, outer = step, np.sign(room) * min(2.0 * abs(step), abs(room))
    while abs(outer - inner) > FINE * abs(inner):
        middle = 0.5 * (inner + outer)
        inner, outer = (middle, outer) if same(middle) else (inner, middle)
    return float(outer)


@dataclass(frozen=True, eq=False)
class _StandardCoordinates:
    """Coordinates about x in which the estimates have the covariance 1 by the derivatives there.

    inside: the k unknowns that move. axes: (k, k) a step in scaled coordinates for each.
    basis: (N, k) orthonormal, of the residuals' tangent space.
    """

    problem: Problem
    x: Array
    inside: NDArray[np.intp]
    axes: Array
    basis: Array

    @classmethod
    def of(cls, problem: Problem, x: Array, inside: NDArray[np.intp], columns: Array) -> _StandardCoordinates | None:
        """Return the coordinates by (N, p) derivatives; None where they leave a direction undetermined."""
        length = np.linalg.norm(columns[:, inside], axis=0)
        if not inside.size or not (length > 0).all():
            return None
        u, s, vt = np.linalg.svd(columns[:, inside] / length, full_matrices=False)
        if s[-1] <= SINGULAR * s[0]:
            return None
        return cls(problem, x, inside, vt.T / s / length[:, None], u)

    def place(self, z: Array) -> Array:
        """Return the scaled coordinates, (p,), of z, (k,)."""
        moved = self.x.copy()
        moved[self.inside] += self.axes @ z
        return moved

    def step_end(self, z: Array) -> Array:
        """Return the end of a Gauss-Newton step from z with the derivatives of the centre, and the cost: (k + 1,)."""
        r = residual_at(self.problem, self.problem.coordinates.unscaled(self.place(z)))
        return np.append(z - self.basis.T @ r, 0.5 * float(r @ r))

    def room(self, j: int) -> tuple[float, float]:
        """Return the distances to the bounds along the j-th coordinate, down and up."""
        low, high = (b[self.inside] - self.x[self.inside] for b in self.problem.coordinates.bounds)
        axis = self.axes[:, j]
        with np.errstate(divide="ignore"):
            ends = np.sort([low / axis, high / axis], axis=0)
        return float(-ends[0].max()), float(ends[1].min())

    def trend(self, x: Array, gain: Array, scatter: Array, rough: float, settled: bool) -> Trend:
        """Return the trend whose optimum is at x, (p,), with gain and scatter, (k, k), in units of the unknowns."""
        space = self.problem.coordinates
        theta = space.unscaled(x)
        axes = self.axes * space.slope(theta)[self.inside][:, None]
        back = np.linalg.inv(axes)
        whole, spread, curved = np.eye(x.size), np.zeros((x.size, x.size)), np.zeros((x.size, x.size))
        among = np.ix_(self.inside, self.inside)
        whole[among] = axes @ gain @ back
        spread[among] = axes @ scatter @ axes.T
        curved[among] = back.T @ back
        return Trend(theta, whole, spread, curved, rough, settled)


@dataclass(frozen=True, eq=False)
class _StepRegression:
    """Regression of the ends of steps on their starts.

    intercept: (k,). slope: (k, k); error: its standard error. scatter: covariance of the intercept, so large that 1.96
    standard deviations cover the interval by Student's t of the remaining places. rough: the cost's remainder of a parabola.
    """

    intercept: Array
    slope: Array
    error: Array
    scatter: Array
    rough: float


def _regressed(at: _StandardCoordinates, reach: Array) -> _StepRegression:
    """Return the regression from places along each coordinate as far as its reach, (k,)."""
    k = reach.size
    rows, ends = [np.zeros(2 * k)], [at.step_end(np.zeros(k))]
    for j in range(k):
        for t in _nodes(*at.room(j), float(reach[j])):
            z, row = np.zeros(k), np.zeros(2 * k)
            z[j] = t
            row[2 * j : 2 * j + 2] = t / reach[j], (t / reach[j]) ** 2
            rows.append(row)
            ends.append(at.step_end(z))
    design, q = np.column_stack([np.ones(len(rows)), np.array(rows)]), np.array(ends)
    coefficients, *_ = np.linalg.lstsq(design, q, rcond=None)
    remainder = q - design @ coefficients
    dof = len(rows) - 2 * k - 1
    known = np.linalg.pinv(design.T @ design)
    *_, rough = np.sqrt(np.sum(remainder**2, axis=0) / dof)
    coefficients, remainder = coefficients[:, :k], remainder[:, :k]
    noise = remainder.T @ remainder / dof
    return _StepRegression(
        coefficients[0],
        coefficients[1::2].T / reach,
        np.sqrt(np.outer(np.diag(noise), np.diag(known)[1::2])) / reach,
        noise * known[0, 0] * float(stdtrit(dof, 0.975) / stdtrit(np.inf, 0.975)) ** 2,
        float(rough),
    )


def _nodes(below: float, above: float, reach: float) -> list[float]:
    """Return places, but for 0, from -reach to reach; where the bounds are nearer than that, more of them on the side with room."""
    near, far = min(below, above, reach), min(max(below, above), max(reach, 2.0 * reach - min(below, above)))
    places = 0.5 * (far - near + (far + near) * UNEVEN) * (1.0 if above >= below else -1.0)
    middle = int(np.argmin(np.abs(places)))  # 0, but for the rounding, where both sides have room
    return [float(t) for n, t in enumerate(places) if n != middle]
