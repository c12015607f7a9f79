"""Profile likelihood: how far a parameter can be moved, all others re-fitted, before the cost has risen too much.

Raue et al. 2009, doi 10.1093/bioinformatics/btp358. A side is walked in steps that adapt to the rise, each point
warm-started along the tangent of the last; the crossing is refined in the signed root of the rise, which is nearly
a straight line.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np

from hvdc_ident.errors import SimulationError
from hvdc_ident.fit.objective import Objective, Reached, descend
from hvdc_ident.fit.unknown import Coordinates
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.trajectory import Array

if TYPE_CHECKING:
    from hvdc_ident.fit.estimate import Executor

TWO_SIDED = 1.92
"""Rise of the negative log-likelihood at the ends of a 95 % interval: half the quantile of chi-square, 1 degree."""
ONE_SIDED = 1.353
"""The same for the one limit of a parameter whose optimum lies on a bound: half the 90 % quantile."""

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


@dataclass(frozen=True, eq=False)
class Profile:
    """The profile of one unknown.

    value: at the optimum. values: (m,) sorted, in its unit; rises: (m,) cost above the optimum; thetas: (m, p) all
    unknowns at each point. threshold: the rise at the ends. one_sided: whether the optimum lies on a bound.
    """

    name: str
    value: float
    lower: Side
    upper: Side
    values: Array
    rises: Array
    thetas: Array
    threshold: float
    one_sided: bool = False

    @property
    def ci95(self) -> tuple[float | None, float | None]:
        """The interval; an end that was not found is None."""
        return self.lower.limit, self.upper.limit

    @property
    def closed(self) -> bool:
        """Whether both ends are known."""
        return self.lower.status == "closed" and self.upper.status == "closed"

    @property
    def evaluations(self) -> int:
        """Evaluations of the objective that both sides took."""
        return self.lower.evaluations + self.upper.evaluations


@dataclass(frozen=True, eq=False)
class Profiles:
    """Profiles around an optimum. restarts: what each better optimum found on the way was, in words."""

    theta: Array
    cost: float
    by_name: FrozenMap[Profile]
    restarts: tuple[str, ...] = ()


@dataclass(frozen=True)
class Walk:
    """How profiles are walked.

    tolerance: of the rise at a crossing, as a share of the threshold. points: at most so many a side. steps: of the
    range between the bounds a step takes at most 1/steps. reach: without bounds, at most so many typical sizes.
    """

    tolerance: float = 1e-3
    points: int = 40
    steps: int = 4
    reach: float = 1e6


def profiles(
    objective: Objective,
    theta: Array,
    names: Sequence[str] | None = None,
    *,
    threshold: float | Mapping[str, float] = TWO_SIDED,
    physical: Physical | None = None,
    walk: Walk | None = None,
    executor: Executor | None = None,
    progress: Callable[[int, int, str], None] | None = None,
) -> Profiles:
    """The profile of each named unknown (all) around the optimum theta, (p,), which is refined first.

    threshold: rise of the cost at the ends of a two-sided interval; at a bound 1.353/1.92 of it, one-sided.
    Where a profile falls below the optimum, everything begins again from there (up to three times), and `restarts`
    says so. executor: a side is a piece of work, all from the same optimum, so the result does not depend on it.
    Raises SimulationError where the objective cannot be evaluated at theta.
    """
    walk = walk or Walk()
    wanted = list(names) if names is not None else [u.name for u in objective.unknowns]
    restarts: list[str] = []
    least = min(threshold.values(), default=TWO_SIDED) if isinstance(threshold, Mapping) else threshold
    enough = 0.1 * walk.tolerance * least
    none = np.zeros(len(objective.unknowns), dtype=bool)
    asked = [(name, direction) for name in wanted for direction in (-1.0, 1.0)]
    while True:
        best = descend(objective, theta, none, enough=enough)
        rises = {n: threshold[n] if isinstance(threshold, Mapping) else threshold for n in wanted}
        walkers = _Walkers(objective, best, rises, physical or {}, walk, last=len(restarts) == 3)
        found: dict[str, list[_Walked]] = {name: [] for name in wanted}
        ends = (executor.map if executor else map)(walkers, asked)
        better: _Better | None = None
        for done, name in enumerate(wanted):
            if progress:
                progress(done, len(wanted), f"profile of {name}")
            while better is None and len(found[name]) < 2:
                walked = next(ends)
                found[name].append(walked)
                better = walked.better
            if better is not None:
                theta = better.theta
                restarts.append(f"on the profile of {name} the cost fell by {better.fall:.3g} below the optimum")
                break
        else:
            named = {n: _profile(walkers.of(n), *sides) for n, sides in found.items()}
            return Profiles(best.theta, best.at.cost, FrozenMap(named), tuple(restarts))


@dataclass(frozen=True, eq=False)
class _Better:
    """A place that costs less than the optimum. theta: (p,); fall: by how much."""

    theta: Array
    fall: float


@dataclass(frozen=True, eq=False)
class _Walked:
    """One side as walked: how it ended; m points, their scaled places (m,), unknowns (m, p) and costs (m,).

    better: set where the walk was given up because it came below the optimum; `side` is then None.
    """

    side: Side | None
    scaled: Array
    thetas: Array
    costs: Array
    better: _Better | None = None


@dataclass(frozen=True, eq=False)
class _Walkers:
    """The walks from one optimum; called with the name of an unknown and a direction, it walks that side."""

    objective: Objective
    best: Reached
    rises: Mapping[str, float]
    physical: Physical
    walk: Walk
    last: bool

    def __call__(self, asked: tuple[str, float]) -> _Walked:
        name, direction = asked
        size = len(self.objective.unknowns)
        try:
            side, points = self.of(name).side(direction)
        except _BetterFoundError as found:
            return _Walked(None, np.zeros(0), np.zeros((0, size)), np.zeros(0), _Better(found.theta, found.fall))
        thetas = np.array([p.theta for _, p in points]).reshape(len(points), size)
        return _Walked(side, np.array([x for x, _ in points]), thetas, np.array([p.at.cost for _, p in points]))

    def of(self, name: str) -> _Walker:
        """The walker of one unknown."""
        return _Walker(self.objective, self.best, self.rises[name], self.physical, self.walk, name, self.last)


def _profile(walker: _Walker, below: _Walked, above: _Walked) -> Profile:
    """The profile put together from its sides and the optimum between them."""
    assert below.side is not None and above.side is not None
    best = walker.best
    scaled = np.concatenate([walker.x0[[walker.i]], below.scaled, above.scaled])
    thetas = np.vstack([best.theta, below.thetas, above.thetas])
    costs = np.concatenate([[best.at.cost], below.costs, above.costs])
    order = np.argsort(scaled, kind="stable")
    return Profile(
        walker.name,
        float(best.theta[walker.i]),
        below.side,
        above.side,
        thetas[order, walker.i],
        costs[order] - best.at.cost,
        thetas[order],
        walker.rise,
        walker.on_bound,
    )


class _BetterFoundError(Exception):
    """A point on a profile lies below the optimum."""

    def __init__(self, theta: Array, fall: float) -> None:
        super().__init__(fall)
        self.theta, self.fall = theta, fall


@dataclass
class _Walker:
    """The walk of one unknown's profile from one optimum."""

    objective: Objective
    best: Reached
    threshold: float
    physical: Physical
    walk: Walk
    name: str
    last: bool = False
    evaluations: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        self.space = Coordinates(self.objective.unknowns)
        self.low, self.high = self.space.bounds
        self.i = [u.name for u in self.objective.unknowns].index(self.name)
        self.fixed = np.arange(len(self.objective.unknowns)) == self.i
        self.x0 = self.space.scaled(self.best.theta)
        self.on_bound = bool(self.x0[self.i] <= self.low[self.i] or self.x0[self.i] >= self.high[self.i])
        self.rise = self.threshold * (ONE_SIDED / TWO_SIDED if self.on_bound else 1.0)

    def side(self, direction: float) -> tuple[Side, list[tuple[float, Reached]]]:
        """One side: how it ended, and its points in the order walked."""
        self.evaluations = 0
        end = self.high[self.i] if direction > 0 else self.low[self.i]
        points: list[tuple[float, Reached]] = []
        x, at, z = float(self.x0[self.i]), self.best, 0.0
        if x == end:
            return Side("open-at-bound", None, "the optimum lies on this bound"), points
        step, failures = self._first_step(), 0
        goal = np.sqrt(2.0 * self.rise)
        while len(points) < self.walk.points and abs(x - self.x0[self.i]) < self.walk.reach:
            ahead = x + direction * min(step, self._largest())
            ahead = float(np.clip(ahead, self.low[self.i], self.high[self.i]))
            try:
                there = self._point(at, ahead)
            except SimulationError as error:
                failures += 1
                step = abs(ahead - x) / 4.0
                if failures > 6:
                    return self._ended(
                        "not-found", f"beyond {self._value(x):.4g} the simulation fails: {error.what}"
                    ), points
                continue
            points.append((ahead, there))
            rise = there.at.cost - self.best.at.cost
            if rise >= self.rise:
                crossing = self._refine(x, at, ahead, there)
                points.append(crossing)
                return self._crossed(crossing[1], end), points
            if ahead == end:
                return self._at_end(direction, end), points
            root = np.sqrt(2.0 * max(rise, 0.0))
            if root < z - 0.1 * goal:
                self._look_for_another(there)
            per_step = (root - z) / abs(ahead - x)
            wish = 1.02 * (goal - root) / per_step if per_step > 0 else np.inf
            growth = 4.0 if root < 0.1 * goal else 1.0 if root < z else 2.0  # downhill again: there may be a well
            step = float(np.clip(wish, 0.3 * step, growth * step))
            x, at, z = ahead, there, root
        return self._ended("not-found", f"no crossing found up to {self._value(x):.4g}"), points

    def _first_step(self) -> float:
        """Half the way to where a parabola would cross, in scaled coordinates."""
        slope = self.space.slope(self.best.theta)
        h = self.best.at.curvature * np.outer(slope, slope)
        others = ~self.fixed
        part = h[np.ix_(others, others)]
        bent = h[self.i, self.i] - h[self.i, others] @ np.linalg.lstsq(part, h[others, self.i], rcond=1e-12)[0]
        parabola = np.sqrt(2.0 * self.rise / bent) if bent > 1e-14 * max(h[self.i, self.i], 1e-300) else np.inf
        return float(min(0.5 * parabola, self._largest(), 10.0))

    def _largest(self) -> float:
        width = self.high[self.i] - self.low[self.i]
        return float(width / self.walk.steps) if np.isfinite(width) else np.inf

    def _point(self, near: Reached, value: float) -> Reached:
        """The minimum over the others with this one at `value` (scaled), begun on the tangent from a point nearby."""
        x = self.space.scaled(near.theta)
        slope = self.space.slope(near.theta)
        h = near.at.curvature * np.outer(slope, slope)
        others = ~self.fixed & (x > self.low) & (x < self.high)
        ahead = x.copy()
        ahead[self.i] = value
        if others.any():
            bend = np.linalg.lstsq(h[np.ix_(others, others)], h[others, self.i], rcond=1e-10)[0]
            ahead[others] = np.clip(x[others] - bend * (value - x[self.i]), self.low[others], self.high[others])
        enough = 0.1 * self.walk.tolerance * self.rise
        try:
            found = descend(self.objective, self.space.unscaled(ahead), self.fixed, enough=enough)
        except SimulationError:
            x[self.i] = value
            found = descend(self.objective, self.space.unscaled(x), self.fixed, enough=enough)
        self.evaluations += found.evaluations
        fall = self.best.at.cost - found.at.cost
        if fall > 0.02 * self.rise and not self.last:
            raise _BetterFoundError(found.theta, fall)
        return found

    def _look_for_another(self, point: Reached) -> None:
        """Where the profile falls away from the optimum there is another basin: its own optimum may be the better."""
        if self.last:
            return
        end = descend(
            self.objective, point.theta, np.zeros_like(self.fixed), enough=0.1 * self.walk.tolerance * self.rise
        )
        self.evaluations += end.evaluations
        fall = self.best.at.cost - end.at.cost
        if fall > 0.02 * self.rise:
            raise _BetterFoundError(end.theta, fall)

    def _refine(self, x: float, at: Reached, ahead: float, there: Reached) -> tuple[float, Reached]:
        """The crossing between a point below the threshold and one above, by false position (Illinois)."""
        goal = np.sqrt(2.0 * self.rise)
        kept = [self._root(at) - goal, self._root(there) - goal]
        for _ in range(60):
            lowest = min((x, at), (ahead, there), key=lambda p: abs(self._rise_off(p[1])))
            if abs(self._rise_off(lowest[1])) <= self.walk.tolerance * self.rise or abs(ahead - x) <= 1e-14 * (
                1 + abs(x)
            ):
                return lowest
            share = kept[0] / (kept[0] - kept[1])
            middle = x + float(np.clip(share, 0.02, 0.98)) * (ahead - x)
            try:
                found = self._point(at if share < 0.5 else there, middle)
            except SimulationError:
                return ahead, there
            value = self._root(found) - goal
            if value < 0:
                x, at, kept = middle, found, [value, 0.5 * kept[1]]
            else:
                ahead, there, kept = middle, found, [0.5 * kept[0], value]
        return ahead, there

    def _root(self, point: Reached) -> float:
        return float(np.sqrt(2.0 * max(point.at.cost - self.best.at.cost, 0.0)))

    def _rise_off(self, point: Reached) -> float:
        return point.at.cost - self.best.at.cost - self.rise

    def _crossed(self, point: Reached, end: float) -> Side:
        """Closed; or not found, where the crossing leans on another unknown's search bound."""
        leaning = []
        x = self.space.scaled(point.theta)
        for k, u in enumerate(self.objective.unknowns):
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

    def _at_end(self, direction: float, end: float) -> Side:
        own = self.physical.get(self.name, (False, False))[int(direction > 0)]
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
