"""Profile likelihood: how far a parameter can be moved, all others re-fitted, before the cost has risen too much.

Raue et al. 2009, doi 10.1093/bioinformatics/btp358. All sides are followed at once (`profile_path`), a step of each in a
round: a step is a piece of work of its own, wherever it is done, and an executor that keeps its work keeps every step.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from hvdc_ident.budget import BudgetSpent, Known
from hvdc_ident.codec import NOT_STORED
from hvdc_ident.data import Array
from hvdc_ident.errors import SimulationError
from hvdc_ident.executor import Executor, Progress, mapped
from hvdc_ident.fit.descent import DescentResult, Residuals, descend
from hvdc_ident.fit.fit_parameter import FitParameter
from hvdc_ident.fit.nonsmooth import Trend
from hvdc_ident.fit.profile_path import (
    BetterFoundError,
    DescentStep,
    Physical,
    ProfileOptions,
    ProfilePath,
    Side,
)
from hvdc_ident.fit.uncertainty import ONE_SIDED, TWO_SIDED
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.text import listed

Asked = tuple[str, float]
"""A side: the unknown and the direction, -1.0 or 1.0."""


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
    threshold: float
    one_sided: bool = False
    thetas: Array = field(default_factory=lambda: np.zeros((0, 0)), metadata=NOT_STORED)

    @property
    def ci95(self) -> tuple[float | None, float | None]:
        """95 % interval; an end that was not found is None."""
        return self.lower.limit, self.upper.limit

    @property
    def closed(self) -> bool:
        """True where both ends are known."""
        return self.lower.status == "closed" and self.upper.status == "closed"

    @property
    def evaluations(self) -> int:
        """Evaluations of the objective for both sides."""
        return self.lower.evaluations + self.upper.evaluations

    def within_bounds(self) -> Profile:
        """Return the profile with the ends that it has if the bounds of the search hold for the other unknowns."""
        lower, upper = (
            s if s.leaning is None else replace(s, status="closed", limit=s.leaning, reason="")
            for s in (self.lower, self.upper)
        )
        return replace(self, lower=lower, upper=upper)


@dataclass(frozen=True, eq=False)
class Profiles:
    """Profiles around an optimum. restarts: each better optimum found on the way, in words."""

    theta: Array
    cost: float
    by_name: FrozenMap[Profile]
    restarts: tuple[str, ...] = ()


@dataclass(frozen=True)
class ProfilesSoFar(Known):
    """Profiles whose budget has ended them. ends: by name the lower and the upper side, None where it has not come to its end."""

    ends: Mapping[str, tuple[Side | None, Side | None]] = field(default_factory=dict)

    @classmethod
    def of(cls, sides: Mapping[Asked, Side], asked: Collection[Asked]) -> ProfilesSoFar:
        """Return the profiles by the sides that have come to their ends, of those that were asked for."""
        names = tuple(dict.fromkeys(n for n, _ in asked))
        ends = {n: (sides.get((n, -1.0)), sides.get((n, 1.0))) for n in names}
        walking = [n for n, both in ends.items() if None in both]
        done = tuple(f"profile of {n} walked" for n in names if n not in walking)
        return cls(done, (f"the rest of the profile{'s' if len(walking) > 1 else ''} of {listed(walking)}",), ends=ends)


def profiles(
    objective: Residuals,
    theta: Array,
    names: Sequence[str] | None = None,
    *,
    threshold: float | Mapping[str, float] = TWO_SIDED,
    physical: Physical | None = None,
    options: ProfileOptions | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Profiles:
    """Return the profile of each named unknown (all) around the optimum theta, (p,), which is refined first.

    threshold: rise of the cost at the ends of a two-sided interval; at a bound 1.353/1.92 of it, one-sided.
    Where a profile falls below the optimum, everything begins again from there (up to three times), and `restarts`
    says so. executor: a step is a piece of work, and which one comes next does not depend on where the last was done.
    Raises SimulationError where the objective cannot be evaluated at theta.
    """
    options = options or ProfileOptions()
    wanted = list(names) if names is not None else [u.name for u in objective.unknowns]
    rises = {n: threshold[n] if isinstance(threshold, Mapping) else threshold for n in wanted}
    start = DescentStep(
        np.asarray(theta, dtype=float),
        np.zeros(len(objective.unknowns), dtype=bool),
        0.1 * options.tolerance * min(rises.values(), default=TWO_SIDED),
    )
    restarts: list[str] = []
    while True:
        [best] = _take(objective, executor, [start])
        if isinstance(best, Failed):
            raise SimulationError(best.what)
        paths = {
            (name, direction): ProfilePath(
                objective.unknowns, best, rises[name], physical or {}, options, name, direction, last=len(restarts) == 3
            )
            for name in wanted
            for direction in (-1.0, 1.0)
        }
        try:
            sides = _follow(paths, partial(_take, objective, executor), progress)
        except BetterFoundError as better:
            restarts.append(f"on the profile of {better.name} the cost fell by {better.fall:.3g} below the optimum")
            start = replace(start, theta=better.theta)
            continue
        named = {n: _profile([(paths[n, d], sides[n, d]) for d in (-1.0, 1.0)]) for n in wanted}
        return Profiles(best.theta, best.at.cost, FrozenMap(named), tuple(restarts))


def trend_profiles(
    optimum: Trend,
    unknowns: Sequence[FitParameter],
    names: Sequence[str],
    covariance: Array,
    gradient: Array,
    threshold: Mapping[str, float],
    physical: Physical,
) -> FrozenMap[Profile]:
    """Return the profile of each named unknown from the curvature of a nonsmooth cost's trend.

    No path along such a cost finds the crossing of the trend.

    covariance: (p, p) of the estimates, before what correlated samples add, which is in the thresholds; of one on a bound
    the inverse of its curvature. gradient: (p,) of the cost, which pushes one that lies on a bound.
    """
    by_name = {}
    for name in names:
        i = [u.name for u in unknowns].index(name)
        unknown, value = unknowns[i], float(optimum.theta[i])
        on_bound = unknown.on_bound(value)
        rise = threshold[name] * (ONE_SIDED / TWO_SIDED if on_bound else 1.0)
        push = abs(float(gradient[i])) if on_bound else 0.0
        half = covariance[i, i] * (math.sqrt(push**2 + 2.0 * rise / covariance[i, i]) - push)
        set_by_physics = physical.get(name, (False, False))
        lower, upper = (_trend_side(unknown, value, sign * half, set_by_physics) for sign in (-1.0, 1.0))
        low, high = max(value - half, unknown.min), min(value + half, unknown.max)
        values = np.unique(np.append(np.linspace(low, high, 9), value))
        distance = values - value
        thetas = np.tile(optimum.theta, (values.size, 1)) + np.outer(distance, covariance[:, i] / covariance[i, i])
        rises = push * np.abs(distance) + 0.5 * distance**2 / covariance[i, i]
        by_name[name] = Profile(name, value, lower, upper, values, rises, rise, on_bound, thetas)
    return FrozenMap(by_name)


def _trend_side(u: FitParameter, optimum: float, distance: float, physical: tuple[bool, bool]) -> Side:
    """Return one end of the profile of a trend: at a signed distance from the optimum, or the bound before it."""
    bound = u.max if distance > 0 else u.min
    if optimum == bound:
        return Side("open-at-bound", None, "the optimum lies on this bound")
    if abs(distance) < abs(bound - optimum):
        return Side("closed", optimum + distance)
    if physical[int(distance > 0)]:
        return Side("closed", bound, f"ended by the physical bound {bound:.4g}")
    return Side("open-at-bound", None, f"the trend of the cost has not risen enough at the bound {bound:.4g}")


@dataclass(frozen=True)
class Failed:
    """A descent that has no end, for the simulation fails where it begins."""

    what: str


def _descend(objective: Residuals, step: DescentStep) -> DescentResult | Failed:
    try:
        return descend(objective, step.theta, step.fixed, enough=step.enough)
    except SimulationError as error:
        return Failed(error.what)


def _take(
    objective: Residuals, executor: Executor | None, steps: Sequence[DescentStep]
) -> Iterator[DescentResult | Failed]:
    """Return the end of each step, in order, as it is asked for."""
    return mapped(executor, partial(_descend, objective), steps)


def _follow(
    paths: Mapping[Asked, ProfilePath],
    take: Callable[[Sequence[DescentStep]], Iterator[DescentResult | Failed]],
    progress: Progress | None,
) -> dict[Asked, Side]:
    """Return the end of each side. Raises BetterFoundError for the first side, in their order, below the optimum."""
    steps = {asked: path.steps() for asked, path in paths.items()}
    sides: dict[Asked, Side] = {}
    waiting: dict[Asked, DescentStep] = {}

    def advance(asked: Asked, end: DescentResult | Failed | None) -> None:
        """Advance a path to its next question, or to its end. end: that of its last step; None: it has not begun."""
        path = steps[asked]
        try:
            if isinstance(end, Failed):
                waiting[asked] = path.throw(SimulationError(end.what))
            else:
                waiting[asked] = next(path) if end is None else path.send(end)
        except StopIteration as ended:
            sides[asked] = ended.value

    for asked in steps:
        advance(asked, None)
    count = 0
    try:
        while waiting:
            asked_steps, waiting = waiting, {}
            ends = take(list(asked_steps.values()))
            for asked in asked_steps:
                if progress:
                    count += 1
                    progress(len(sides), len(steps), f"profile of {asked[0]}, step {count} of all profiles together")
                advance(asked, next(ends))
    except BudgetSpent as end:
        end.known.append(ProfilesSoFar.of(sides, paths))
        raise
    return sides


def _profile(sides: Sequence[tuple[ProfilePath, Side]]) -> Profile:
    """Return the profile of two sides and the optimum between them."""
    (path, lower), (_, upper) = sides
    best = path.best
    points = [(float(path.x0[path.i]), best), *(point for side, _ in sides for point in side.points)]
    order = np.argsort([x for x, _ in points], kind="stable")
    thetas = np.array([end.theta for _, end in points])[order]
    rises = np.array([end.at.cost for _, end in points])[order] - best.at.cost
    value = float(best.theta[path.i])
    return Profile(path.name, value, lower, upper, thetas[:, path.i], rises, path.rise, path.on_bound, thetas)


@dataclass(frozen=True, eq=False)
class PairProfile:
    """The rise of the cost over a grid. first: (m,), second: (n,) values in their units; rises: (m, n), nan: failed."""

    names: tuple[str, str]
    first: Array
    second: Array
    rises: Array


def profile_pair(
    objective: Residuals, theta: Array, names: tuple[str, str], first: Array, second: Array, *, enough: float = 1e-3
) -> PairProfile:
    """Return the rise of the cost above the optimum theta at each pair of values, the other unknowns re-fitted from the nearest point.

    A value outside the bounds of the search is evaluated all the same; a point that cannot be simulated is nan.
    """
    known = [u.name for u in objective.unknowns]
    rows = [known.index(n) for n in names]
    fixed = np.isin(np.arange(len(known)), rows)
    best = descend(objective, theta, enough=enough)
    rises = np.full((first.size, second.size), np.nan)
    ends: dict[tuple[int, int], DescentResult] = {}
    centre = (int(np.abs(first - best.theta[rows[0]]).argmin()), int(np.abs(second - best.theta[rows[1]]).argmin()))
    order = sorted(np.ndindex(rises.shape), key=lambda k: (max(abs(k[0] - centre[0]), abs(k[1] - centre[1])), k))
    for k in order:
        near = min(ends, key=lambda d: (d[0] - k[0]) ** 2 + (d[1] - k[1]) ** 2, default=None)
        start = (ends[near].theta if near is not None else best.theta).copy()
        start[rows] = first[k[0]], second[k[1]]
        try:
            ends[k] = descend(objective, start, fixed, enough=enough)
        except SimulationError:
            continue
        rises[k] = ends[k].at.cost - best.at.cost
    return PairProfile(names, first, second, rises)
