"""One side of a profile likelihood, step by step.

A side is followed in steps that adapt to the rise, each begun on the tangent of the last; the crossing is refined in the
signed root of the rise, which is nearly a straight line. The path asks for each descent and is sent where it ended, so
that descents can be run anywhere, and kept one by one.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.codec import NOT_STORED
from hvdc_ident.data import Array
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit.descent import LONGEST, DescentResult
from hvdc_ident.fit.fit_parameter import Coordinates, FitParameter
from hvdc_ident.fit.uncertainty import ONE_SIDED, TWO_SIDED

BEYOND = 10.0
"""Without bounds a path goes on to so many times where a parabola would cross: the typical size is often a guess."""

SideStatus = Literal["closed", "open-at-bound", "not-found"]
Physical = Mapping[str, tuple[bool, bool]]
"""Two flags for each unknown: its lower, and its upper bound is set by physics; else it only limits the search."""


@dataclass(frozen=True)
class Side:
    """One end of a profile.

    status: closed (limit is the crossing, or a bound set by physics that was reached); open-at-bound (the bound was
    reached first: limit is None); not-found. reason: why it is not closed, or which bound ended it.
    leaning: where the cost rises only because others cannot leave the bounds of the search, the value at which it does.
    """

    status: SideStatus
    limit: float | None
    reason: str = ""
    evaluations: int = 0
    leaning: float | None = field(default=None, metadata=NOT_STORED)

    @property
    def crossing(self) -> float | None:
        """The value at which the cost has risen enough; None where it never does, also at a bound set by physics."""
        return self.limit if self.status == "closed" and not self.reason else None


@dataclass(frozen=True)
class ProfileOptions:
    """Options of profiles.

    tolerance: of the rise at a crossing, as a share of the threshold. points: at most so many a side. steps: of the
    range between the bounds a step takes at most 1/steps. reach: without bounds, at most so many typical sizes (of a
    logarithm: so many times the value).
    """

    tolerance: float = 1e-3
    points: int = 40
    steps: int = 4
    reach: float = 1e6


@dataclass(frozen=True, eq=False)
class DescentStep:
    """A descent to make: from theta, (p,), with some unknowns fixed, (p,), until a predicted fall below `enough`."""

    theta: Array
    fixed: NDArray[np.bool_]
    enough: float


T = TypeVar("T")
Steps = Generator[DescentStep, DescentResult, T]
"""Asks for descents, is sent the end of each, and returns a T."""


class BetterFoundError(Exception):
    """A point on the profile of `name` lies below the optimum. theta: (p,); fall: of the cost below the optimum's."""

    def __init__(self, name: str, theta: Array, fall: float) -> None:
        super().__init__(name)
        self.name, self.theta, self.fall = name, theta, fall


@dataclass
class ProfilePath:
    """One side of one unknown's profile, from one optimum. direction: -1.0 or 1.0."""

    unknowns: tuple[FitParameter, ...]
    best: DescentResult
    threshold: float
    physical: Physical
    options: ProfileOptions
    name: str
    direction: float
    last: bool = False
    evaluations: int = field(default=0, init=False)
    points: list[tuple[float, DescentResult]] = field(default_factory=list, init=False)

    def __post_init__(self) -> None:
        self.space = Coordinates(self.unknowns)
        self.low, self.high = self.space.bounds
        self.i = [u.name for u in self.unknowns].index(self.name)
        self.fixed = np.arange(len(self.unknowns)) == self.i
        self.x0 = self.space.scaled(self.best.theta)
        self.on_bound = bool(self.x0[self.i] <= self.low[self.i] or self.x0[self.i] >= self.high[self.i])
        self.reach = math.log(self.options.reach) if self.unknowns[self.i].log else self.options.reach
        self.rise = self.threshold * (ONE_SIDED / TWO_SIDED if self.on_bound else 1.0)
        if not self.unknowns[self.i].log and math.isfinite(self._parabola):
            self.reach = max(self.reach, BEYOND * self._parabola)

    def steps(self) -> Steps[Side]:
        """Return the end of the side, once every descent asked for was answered; `points` then holds the path, in order.

        A SimulationError is to be thrown in where a descent failed. Raises BetterFoundError.
        """
        end = self.high[self.i] if self.direction > 0 else self.low[self.i]
        x, current, z = float(self.x0[self.i]), self.best, 0.0
        if x == end:
            return Side("open-at-bound", None, "the optimum lies on this bound")
        # Half the way to where a parabola would cross, in scaled coordinates.
        step, failures = float(min(0.5 * self._parabola, self._largest(), LONGEST)), 0
        goal = np.sqrt(2.0 * self.rise)
        while len(self.points) < self.options.points and abs(x - self.x0[self.i]) < self.reach:
            ahead = x + self.direction * min(step, self._largest())
            ahead = float(np.clip(ahead, self.low[self.i], self.high[self.i]))
            try:
                point = yield from self._point(current, ahead)
            except SimulationError as error:
                failures += 1
                step = abs(ahead - x) / 4.0
                if failures > 6:
                    return self._ended("not-found", f"beyond {self._value(x):.4g} the simulation fails: {error.what}")
                continue
            failures = 0
            self.points.append((ahead, point))
            rise = point.at.cost - self.best.at.cost
            if rise >= self.rise:
                crossing = yield from self._refine(x, current, ahead, point)
                self.points.append(crossing)
                return self._crossed(crossing[1])
            if ahead == end:
                value = self._value(end)
                if self.physical.get(self.name, (False, False))[int(self.direction > 0)]:
                    return self._ended("closed", f"ended by the physical bound {value:.4g}", value)
                return self._ended("open-at-bound", f"the cost has not risen enough at the bound {value:.4g}")
            root = np.sqrt(2.0 * max(rise, 0.0))
            if root < z - 0.1 * goal and not self.last:
                # The profile falls away from the optimum: this is another basin, whose own optimum may be the better.
                basin = yield DescentStep(point.theta, np.zeros_like(self.fixed), self._enough)
                self._accept(basin)
            per_step = (root - z) / abs(ahead - x)
            desired = 1.02 * (goal - root) / per_step if per_step > 0 else np.inf
            growth = 4.0 if root < 0.1 * goal else 1.0 if root < z else 2.0  # downhill again: there may be a well
            step = float(np.clip(desired, 0.3 * step, growth * step))
            x, current, z = ahead, point, root
        return self._ended("not-found", f"no crossing found up to {self._value(x):.4g}")

    @property
    def _enough(self) -> float:
        """Predicted fall of the cost at which a descent ends."""
        return 0.1 * self.options.tolerance * self.rise

    def _accept(self, end: DescentResult) -> None:
        """Count the evaluations of a descent. Raises BetterFoundError where it ended below the optimum."""
        self.evaluations += end.evaluations
        fall = self.best.at.cost - end.at.cost
        if fall > max(0.02, self.options.tolerance) * self.rise and not self.last:
            raise BetterFoundError(self.name, end.theta, fall)

    @cached_property
    def _parabola(self) -> float:
        """Return how far off a parabola would cross, in scaled coordinates; infinite where it does not rise."""
        slope = self.space.slope(self.best.theta)
        h = self.best.at.curvature * np.outer(slope, slope)
        others = ~self.fixed
        part = h[np.ix_(others, others)]
        bent = h[self.i, self.i] - h[self.i, others] @ np.linalg.lstsq(part, h[others, self.i], rcond=1e-12)[0]
        return float(np.sqrt(2.0 * self.rise / bent)) if bent > 1e-14 * max(h[self.i, self.i], 1e-300) else math.inf

    def _largest(self) -> float:
        width = self.high[self.i] - self.low[self.i]
        return float(width / self.options.steps) if np.isfinite(width) else self.reach

    def _point(self, near: DescentResult, value: float) -> Steps[DescentResult]:
        """Return the minimum over the others with this one at `value` (scaled), begun on the tangent from a point nearby."""
        x = self.space.scaled(near.theta)
        slope = self.space.slope(near.theta)
        h = near.at.curvature * np.outer(slope, slope)
        others = ~self.fixed & (x > self.low) & (x < self.high)
        ahead = x.copy()
        ahead[self.i] = value
        if others.any():
            bend = np.linalg.lstsq(h[np.ix_(others, others)], h[others, self.i], rcond=1e-10)[0]
            longest = np.where(self.space.log[others], LONGEST, np.inf)
            moved = np.clip(-bend * (value - x[self.i]), -longest, longest)
            ahead[others] = np.clip(x[others] + moved, self.low[others], self.high[others])
        try:
            end = yield DescentStep(self.space.unscaled(ahead), self.fixed, self._enough)
        except SimulationError:
            x[self.i] = value
            end = yield DescentStep(self.space.unscaled(x), self.fixed, self._enough)
        self._accept(end)
        return end

    def _refine(
        self, x: float, below: DescentResult, ahead: float, above: DescentResult
    ) -> Steps[tuple[float, DescentResult]]:
        """Return the crossing between a point below the threshold and one above, by false position (Illinois)."""
        goal = np.sqrt(2.0 * self.rise)
        values = [self._root(below) - goal, self._root(above) - goal]
        for _ in range(60):
            nearest = min((x, below), (ahead, above), key=lambda point: self._off_threshold(point[1]))
            narrow = abs(ahead - x) <= 1e-14 * (1 + abs(x))
            if narrow or self._off_threshold(nearest[1]) <= self.options.tolerance * self.rise:
                return nearest
            share = values[0] / (values[0] - values[1])
            middle = x + float(np.clip(share, 0.02, 0.98)) * (ahead - x)
            try:
                point = yield from self._point(below if share < 0.5 else above, middle)
            except SimulationError:
                return ahead, above
            value = self._root(point) - goal
            if value < 0:
                x, below, values = middle, point, [value, 0.5 * values[1]]
            else:
                ahead, above, values = middle, point, [0.5 * values[0], value]
        return ahead, above

    def _root(self, point: DescentResult) -> float:
        return float(np.sqrt(2.0 * max(point.at.cost - self.best.at.cost, 0.0)))

    def _off_threshold(self, point: DescentResult) -> float:
        return abs(point.at.cost - self.best.at.cost - self.rise)

    def _crossed(self, point: DescentResult) -> Side:
        """Return the closed side; or not found, where the crossing leans on another unknown's search bound."""
        leaning = []
        x = self.space.scaled(point.theta)
        for k, u in enumerate(self.unknowns):
            below, above = self.physical.get(u.name, (False, False))
            low = x[k] <= self.low[k] < self.x0[k] and not below
            high = x[k] >= self.high[k] > self.x0[k] and not above
            if k != self.i and (low or high):
                leaning.append(u.name)
        value = float(point.theta[self.i])
        if leaning:
            why = f"the cost rises only because {', '.join(leaning)} cannot leave the bounds of the search"
            return Side("not-found", None, why, self.evaluations, leaning=value)
        return self._ended("closed", "", value)

    def _value(self, x: float) -> float:
        full = self.x0.copy()
        full[self.i] = x
        return float(self.space.unscaled(full)[self.i])

    def _ended(self, status: SideStatus, reason: str, limit: float | None = None) -> Side:
        return Side(status, limit, reason, self.evaluations)
