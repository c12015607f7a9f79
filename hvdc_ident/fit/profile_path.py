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

from hvdc_ident.data import Array
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit.fit_parameter import Coordinates, FitParameter
from hvdc_ident.fit.objective import LONGEST, DescentResult
from hvdc_ident.fit.uncertainty import ONE_SIDED, TWO_SIDED

BEYOND = 10.0
"""Without bounds a walk goes on to so many times where a parabola would cross: the typical size is often a guess."""

SideStatus = Literal["closed", "open-at-bound", "not-found"]
Physical = Mapping[str, tuple[bool, bool]]
"""By unknown whether its lower and its upper bound are set by physics; else they only limit the search."""


@dataclass(frozen=True)
class Side:
    """One end of a profile.

    status: closed (limit is the crossing, or a bound set by physics that was reached); open-at-bound (the bound was
    reached first: limit is None); not-found. reason: why it is not closed, or which bound ended it.
    """

    status: SideStatus
    limit: float | None
    reason: str = ""
    evaluations: int = 0

    @property
    def crossing(self) -> float | None:
        """The value at which the cost has risen enough; None where it never does, also at a bound set by physics."""
        return self.limit if self.status == "closed" and not self.reason else None


@dataclass(frozen=True)
class ProfileOptions:
    """How profiles are walked.

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
    """A step to take: down from theta, (p,), with some unknowns fixed, (p,), to where less than `enough` is to be had."""

    theta: Array
    fixed: NDArray[np.bool_]
    enough: float


T = TypeVar("T")
Steps = Generator[DescentStep, DescentResult, T]
"""Asks for descents, is sent where each ended, and comes to a T."""


class BetterFoundError(Exception):
    """A point on a profile lies below the optimum. theta: (p,); fall: by how much."""

    def __init__(self, theta: Array, fall: float) -> None:
        super().__init__(fall)
        self.theta, self.fall = theta, fall


@dataclass
class ProfilePath:
    """The walk of one side of one unknown's profile from one optimum. direction: -1.0 or 1.0."""

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
        """How the side ended, once every descent asked for was answered; `points` is then what was walked, in order.

        A SimulationError is to be thrown in where a descent failed. Raises BetterFoundError.
        """
        direction, points = self.direction, self.points
        end = self.high[self.i] if direction > 0 else self.low[self.i]
        x, at, z = float(self.x0[self.i]), self.best, 0.0
        if x == end:
            return Side("open-at-bound", None, "the optimum lies on this bound")
        step, failures = self._first_step(), 0
        goal = np.sqrt(2.0 * self.rise)
        while len(points) < self.options.points and abs(x - self.x0[self.i]) < self.reach:
            ahead = x + direction * min(step, self._largest())
            ahead = float(np.clip(ahead, self.low[self.i], self.high[self.i]))
            try:
                there = yield from self._point(at, ahead)
            except SimulationError as error:
                failures += 1
                step = abs(ahead - x) / 4.0
                if failures > 6:
                    return self._ended("not-found", f"beyond {self._value(x):.4g} the simulation fails: {error.what}")
                continue
            points.append((ahead, there))
            rise = there.at.cost - self.best.at.cost
            if rise >= self.rise:
                crossing = yield from self._refine(x, at, ahead, there)
                points.append(crossing)
                return self._crossed(crossing[1])
            if ahead == end:
                return self._at_end(end)
            root = np.sqrt(2.0 * max(rise, 0.0))
            if root < z - 0.1 * goal:
                yield from self._look_for_another(there)
            per_step = (root - z) / abs(ahead - x)
            wish = 1.02 * (goal - root) / per_step if per_step > 0 else np.inf
            growth = 4.0 if root < 0.1 * goal else 1.0 if root < z else 2.0  # downhill again: there may be a well
            step = float(np.clip(wish, 0.3 * step, growth * step))
            x, at, z = ahead, there, root
        return self._ended("not-found", f"no crossing found up to {self._value(x):.4g}")

    def _first_step(self) -> float:
        """Half the way to where a parabola would cross, in scaled coordinates."""
        return float(min(0.5 * self._parabola, self._largest(), 10.0))

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
        """The minimum over the others with this one at `value` (scaled), begun on the tangent from a point nearby."""
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
        enough = 0.1 * self.options.tolerance * self.rise
        try:
            found = yield DescentStep(self.space.unscaled(ahead), self.fixed, enough)
        except SimulationError:
            x[self.i] = value
            found = yield DescentStep(self.space.unscaled(x), self.fixed, enough)
        self.evaluations += found.evaluations
        fall = self.best.at.cost - found.at.cost
        if fall > max(0.02, self.options.tolerance) * self.rise and not self.last:
            raise BetterFoundError(found.theta, fall)
        return found

    def _look_for_another(self, point: DescentResult) -> Steps[None]:
        """Where the profile falls away from the optimum there is another basin: its own optimum may be the better."""
        if self.last:
            return
        end = yield DescentStep(point.theta, np.zeros_like(self.fixed), 0.1 * self.options.tolerance * self.rise)
        self.evaluations += end.evaluations
        fall = self.best.at.cost - end.at.cost
        if fall > max(0.02, self.options.tolerance) * self.rise:
            raise BetterFoundError(end.theta, fall)

    def _refine(
        self, x: float, at: DescentResult, ahead: float, there: DescentResult
    ) -> Steps[tuple[float, DescentResult]]:
        """The crossing between a point below the threshold and one above, by false position (Illinois)."""
        goal = np.sqrt(2.0 * self.rise)
        kept = [self._root(at) - goal, self._root(there) - goal]
        for _ in range(60):
            lowest = min((x, at), (ahead, there), key=lambda p: abs(self._rise_off(p[1])))
            if abs(self._rise_off(lowest[1])) <= self.options.tolerance * self.rise or abs(ahead - x) <= 1e-14 * (
                1 + abs(x)
            ):
                return lowest
            share = kept[0] / (kept[0] - kept[1])
            middle = x + float(np.clip(share, 0.02, 0.98)) * (ahead - x)
            try:
                found = yield from self._point(at if share < 0.5 else there, middle)
            except SimulationError:
                return ahead, there
            value = self._root(found) - goal
            if value < 0:
                x, at, kept = middle, found, [value, 0.5 * kept[1]]
            else:
                ahead, there, kept = middle, found, [0.5 * kept[0], value]
        return ahead, there

    def _root(self, point: DescentResult) -> float:
        return float(np.sqrt(2.0 * max(point.at.cost - self.best.at.cost, 0.0)))

    def _rise_off(self, point: DescentResult) -> float:
        return point.at.cost - self.best.at.cost - self.rise

    def _crossed(self, point: DescentResult) -> Side:
        """Closed; or not found, where the crossing leans on another unknown's search bound."""
        leaning = []
        x = self.space.scaled(point.theta)
        for k, u in enumerate(self.unknowns):
            below, above = self.physical.get(u.name, (False, False))
            low = x[k] <= self.low[k] < self.x0[k] and not below
            high = x[k] >= self.high[k] > self.x0[k] and not above
            if k != self.i and (low or high):
                leaning.append(u.name)
        if leaning:
            names = ", ".join(leaning)
            return self._ended(
                "not-found", f"the cost rises only because {names} cannot leave the bounds of the search"
            )
        return self._ended("closed", "", float(point.theta[self.i]))

    def _at_end(self, end: float) -> Side:
        own = self.physical.get(self.name, (False, False))[int(self.direction > 0)]
        value = self._value(end)
        if own:
            return self._ended("closed", f"ended by the physical bound {value:.4g}", value)
        return self._ended("open-at-bound", f"the cost has not risen enough at the bound {value:.4g}")

    def _value(self, x: float) -> float:
        full = self.x0.copy()
        full[self.i] = x
        return float(self.space.unscaled(full)[self.i])

    def _ended(self, status: SideStatus, reason: str, limit: float | None = None) -> Side:
        return Side(status, limit, reason, self.evaluations)
