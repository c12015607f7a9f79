"""Profile likelihood: how far a parameter can be moved, all others re-fitted, before the cost has risen too much.

Raue et al. 2009, doi 10.1093/bioinformatics/btp358. All sides are followed at once (`profile_path`), a step of each in a
round: a step is a piece of work of its own, wherever it is done, and an executor that keeps its work keeps every step.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.errors import SimulationError
from hvdc_ident.executor import Executor, Progress, mapped
from hvdc_ident.fit.fit_parameter import FitParameter
from hvdc_ident.fit.nonsmooth import Trend
from hvdc_ident.fit.objective import DescentResult, Objective, descend
from hvdc_ident.fit.profile_path import (
    BetterFoundError,
    DescentStep,
    Physical,
    ProfileOptions,
    ProfilePath,
    Side,
    Steps,
)
from hvdc_ident.fit.uncertainty import ONE_SIDED, TWO_SIDED
from hvdc_ident.immutable import FrozenMap

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


def profiles(
    objective: Objective,
    theta: Array,
    names: Sequence[str] | None = None,
    *,
    threshold: float | Mapping[str, float] = TWO_SIDED,
    physical: Physical | None = None,
    options: ProfileOptions | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Profiles:
    """The profile of each named unknown (all) around the optimum theta, (p,), which is refined first.

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
    take = _Taken(objective, executor)
    restarts: list[str] = []
    while True:
        best = _certain(next(take([start])))
        walkers = {
            (name, direction): ProfilePath(
                objective.unknowns, best, rises[name], physical or {}, options, name, direction, last=len(restarts) == 3
            )
            for name in wanted
            for direction in (-1.0, 1.0)
        }
        try:
            sides = _walked(walkers, take, progress)
        except _BetterAtError as found:
            restarts.append(f"on the profile of {found.name} the cost fell by {found.fall:.3g} below the optimum")
            start = replace(start, theta=found.theta)
            continue
        named = {n: _profile([(walkers[n, d], sides[n, d]) for d in (-1.0, 1.0)]) for n in wanted}
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
    """The profile of each named unknown as the curvature of a rough cost's trend has it, for no walk finds its crossing.

    covariance: (p, p) of the estimates, before what correlated samples add, which is in the thresholds; of one on a bound
    the inverse of its curvature. gradient: (p,) of the cost, which pushes one that lies on a bound.
    """
    found = {}
    for name in names:
        i = [u.name for u in unknowns].index(name)
        u, at = unknowns[i], float(optimum.theta[i])
        bound = u.on_bound(at)
        rise = threshold[name] * (ONE_SIDED / TWO_SIDED if bound else 1.0)
        push = abs(float(gradient[i])) if bound else 0.0
        half = covariance[i, i] * (math.sqrt(push**2 + 2.0 * rise / covariance[i, i]) - push)
        ends = [_trend_side(u, at, side * half, physical.get(name, (False, False))) for side in (-1.0, 1.0)]
        low, high = max(at - half, u.min), min(at + half, u.max)
        values = np.unique(np.append(np.linspace(low, high, 9), at))
        off = values - at
        thetas = np.tile(optimum.theta, (values.size, 1)) + np.outer(off, covariance[:, i] / covariance[i, i])
        rises = push * np.abs(off) + 0.5 * off**2 / covariance[i, i]
        found[name] = Profile(name, at, ends[0], ends[1], values, rises, thetas, rise, bound)
    return FrozenMap(found)


def _trend_side(u: FitParameter, at: float, off: float, physical: tuple[bool, bool]) -> Side:
    """One end of the profile of a trend: off from the optimum, or the bound before it."""
    end = u.max if off > 0 else u.min
    if at == end:
        return Side("open-at-bound", None, "the optimum lies on this bound")
    if abs(off) < abs(end - at):
        return Side("closed", at + off)
    if physical[int(off > 0)]:
        return Side("closed", end, f"ended by the physical bound {end:.4g}")
    return Side("open-at-bound", None, f"the trend of the cost has not risen enough at the bound {end:.4g}")


@dataclass(frozen=True)
class Failed:
    """A descent that has no end, for the simulation fails where it begins."""

    what: str


@dataclass(frozen=True, eq=False)
class _Descend:
    """Takes one step."""

    objective: Objective

    def __call__(self, step: DescentStep) -> DescentResult | Failed:
        try:
            return descend(self.objective, step.theta, step.fixed, enough=step.enough)
        except SimulationError as error:
            return Failed(error.what)


@dataclass(frozen=True, eq=False)
class _Taken:
    """Takes steps in the executor, or here: what became of each, in order, as it is asked for."""

    objective: Objective
    executor: Executor | None

    def __call__(self, steps: list[DescentStep]) -> Iterator[DescentResult | Failed]:
        return mapped(self.executor, _Descend(self.objective), steps)


def _certain(end: DescentResult | Failed) -> DescentResult:
    if isinstance(end, Failed):
        raise SimulationError(end.what)
    return end


class _BetterAtError(Exception):
    """A point on the profile of that unknown lies below the optimum. theta: (p,); fall: by how much."""

    def __init__(self, name: str, found: BetterFoundError) -> None:
        super().__init__(name)
        self.name, self.theta, self.fall = name, found.theta, found.fall


def _walked(walkers: Mapping[Asked, ProfilePath], take: _Taken, progress: Progress | None) -> dict[Asked, Side]:
    """How each side ended. Raises _BetterAtError for the first side, in their order, that fell below the optimum."""
    walks = {asked: walker.steps() for asked, walker in walkers.items()}
    sides: dict[Asked, Side] = {}
    waiting: dict[Asked, DescentStep] = {}

    def go_on(asked: Asked, end: DescentResult | Failed | None) -> None:
        """The walk goes on to its next question, or to its end."""
        try:
            waiting[asked] = _next(walks[asked], end)
        except StopIteration as ended:
            sides[asked] = ended.value
        except BetterFoundError as better:
            raise _BetterAtError(asked[0], better) from None

    for asked in walks:
        go_on(asked, None)
    taken = 0
    while waiting:
        steps, waiting = waiting, {}
        ends = take(list(steps.values()))
        for asked in steps:
            if progress:
                taken += 1
                progress(len(sides), len(walks), f"profile of {asked[0]}, step {taken} of all profiles together")
            go_on(asked, next(ends))
    return sides


def _next(walk: Steps[Side], end: DescentResult | Failed | None) -> DescentStep:
    """What a walk asks for when it is told how the last step ended (None: it has not begun)."""
    if end is None:
        return next(walk)
    if isinstance(end, Failed):
        return walk.throw(SimulationError(end.what))
    return walk.send(end)


def _profile(sides: Sequence[tuple[ProfilePath, Side]]) -> Profile:
    """The profile put together from its two sides and the optimum between them."""
    (walker, below), (_, above) = sides
    best = walker.best
    points = [(float(walker.x0[walker.i]), best), *(point for side, _ in sides for point in side.points)]
    order = np.argsort([x for x, _ in points], kind="stable")
    thetas = np.array([reached.theta for _, reached in points])[order]
    costs = np.array([reached.at.cost for _, reached in points])[order]
    return Profile(
        walker.name,
        float(best.theta[walker.i]),
        below,
        above,
        thetas[:, walker.i],
        costs - best.at.cost,
        thetas,
        walker.rise,
        walker.on_bound,
    )


JOINT = 2.996
"""Rise of the cost on the border of a joint 95 % region of two parameters: half the chi-square quantile, 2 degrees."""


@dataclass(frozen=True, eq=False)
class PairProfile:
    """The rise of the cost over a grid. first: (m,), second: (n,) values in their units; rises: (m, n), nan: failed."""

    names: tuple[str, str]
    first: Array
    second: Array
    rises: Array


def profile_pair(
    objective: Objective, theta: Array, names: tuple[str, str], first: Array, second: Array, *, enough: float = 1e-3
) -> PairProfile:
    """The cost above the optimum theta at each pair of values, the other unknowns re-fitted from the nearest point.

    A value outside the bounds of the search is evaluated all the same; a point that cannot be simulated is nan.
    """
    known = [u.name for u in objective.unknowns]
    rows = [known.index(n) for n in names]
    fixed = np.isin(np.arange(len(known)), rows)
    best = descend(objective, theta, np.zeros(len(known), dtype=bool), enough=enough)
    rises = np.full((first.size, second.size), np.nan)
    done: dict[tuple[int, int], DescentResult] = {}
    centre = (int(np.abs(first - best.theta[rows[0]]).argmin()), int(np.abs(second - best.theta[rows[1]]).argmin()))
    order = sorted(np.ndindex(rises.shape), key=lambda k: (max(abs(k[0] - centre[0]), abs(k[1] - centre[1])), k))
    for k in order:
        near = min(done, key=lambda d: (d[0] - k[0]) ** 2 + (d[1] - k[1]) ** 2, default=None)
        begin = (done[near].theta if near is not None else best.theta).copy()
        begin[rows] = first[k[0]], second[k[1]]
        try:
            done[k] = descend(objective, begin, fixed, enough=enough)
        except SimulationError:
            continue
        rises[k] = done[k].at.cost - best.at.cost
    return PairProfile(names, first, second, rises)
