"""Ends of the parameters' intervals by the rise of the cost, and other optima that explain the records as well.

The rise at the ends of a 95 % interval is half a quantile of chi-square, widened by correlated samples and by misfit
(`spreads`); of several parameters on bounds together it is bootstrapped (`joint_limits`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from scipy.special import stdtrit

from hvdc_ident.codec import stored_as
from hvdc_ident.data import Array
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit import FitParameter, Problem
from hvdc_ident.fit.descent import DescentResult, bounded_step, descend
from hvdc_ident.fit.profile import PairProfile, Profile, profile_pair
from hvdc_ident.fit.search import same_place
from hvdc_ident.fit.uncertainty import ONE_SIDED, TWO_SIDED
from hvdc_ident.identifiability.pilot_fit import LocalAnalysis
from hvdc_ident.identifiability.verdicts import Verdict
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.sensitivity import normalised, rise_over_range

DRAWS = 999
SCATTER = 0.1
"""The 95 % quantile of so many draws scatters by 0.08 of itself (sqrt(p (1 - p)/n) over the density): less is no difference."""
TRIED = 6
"""At most so many exchanged points are begun from: about a third of what the profiles of as many parameters cost."""
EVALUATIONS = 25
"""A descent that has not come near by then is given up."""
NEAR = 10.0
"""Ends of the multistart whose cost is more than so many thresholds above the best are optima of their own, but no rivals."""


@dataclass(frozen=True)
class Spread:
    """Uncertainty of one parameter. std: in its unit. threshold: rise of the cost at the ends of its interval."""

    std: float
    threshold: float


def thresholds(optimum: LocalAnalysis) -> dict[str, float]:
    """The rise of the cost at the ends of each parameter's 95 % interval: see `spreads`."""
    return {n: s.threshold for n, s in spreads(optimum).items()}


def spreads(optimum: LocalAnalysis) -> dict[str, Spread]:
    """The standard deviation of each parameter, and the rise of the cost at the ends of its 95 % interval.

    The rise is 1.92; with estimated noise half the square of Student's t. Times what correlated samples and model error
    add to the variance in the parameter's direction (vertical scaling of an independence likelihood: Chandler and Bate
    2007, doi 10.1093/biomet/asm015): the AR(1) sandwich times the excess misfit.
    """
    u = optimum.uncertainty
    quantile = 0.5 * float(stdtrit(u.dof, 0.975)) ** 2 if np.isfinite(u.dof) else TWO_SIDED
    raw = np.diag(u.raw)
    safe = np.where(raw > 0, raw, 1.0)
    factor = np.maximum(np.where(raw > 0, np.diag(u.corrected) / safe, 1.0) * optimum.excess, 1.0)
    rows = zip(optimum.names, np.sqrt(raw * factor), quantile * factor, strict=False)
    return {n: Spread(float(std), float(rise)) for n, std, rise in rows}


def range_of(free: FitParameter, value: float, reach: float) -> tuple[float, float]:
    """The range that a verdict speaks of: the bounds; where there is none, as far from the value as profiles are walked.

    reach: in typical sizes, or times the value, as in `ProfileOptions`.
    """
    low = free.min if math.isfinite(free.min) else value - reach * free.size
    high = free.max if math.isfinite(free.max) else value * reach if free.log else value + reach * free.size
    return low, high


def rise_at_ends(optimum: LocalAnalysis, i: int, ends: tuple[float, float]) -> float | None:
    """Rise of the cost at the worse end of the range, the others re-fitted; None where an end cannot be run."""
    fixed = np.arange(optimum.theta.size) == i
    rises = []
    for end in ends:
        theta = optimum.theta.copy()
        theta[i] = end
        try:
            rises.append(descend(optimum.problem, theta, fixed, enough=1e-3).at.cost - optimum.cost)
        except SimulationError:
            return None
    return max(*rises, 0.0)


def physical_bounds(problem: Problem) -> dict[str, tuple[bool, bool]]:
    """Return two flags for each parameter: its lower, and its upper bound is the model's own."""
    parameters = problem.simulator.parameters
    return {f.name: (f.min == parameters[f.name].min, f.max == parameters[f.name].max) for f in problem.free}


def undetermined(optimum: LocalAnalysis, p: Profile, ends: tuple[float, float]) -> bool:
    """Return True where a profile has no crossing on a side and, at the optimum, no curvature: only a far limit is known.

    A level that no record reaches is one. By its curvature the whole range between the ends would then change nothing (the
    rule for insensitive parameters), so every value up to the bound is as good, and which one a search ended at is chance.
    """
    if p.one_sided or None not in (p.lower.crossing, p.upper.crossing):
        return False
    i = optimum.names.index(p.name)
    curvature = optimum.information.matrix[i, i] / optimum.slope[i] ** 2
    return rise_over_range(curvature, ends[1] - ends[0]) < p.threshold


def bounded(p: Profile) -> bool:
    """Return True where the interval is known: both ends, or the one that a parameter on its bound has."""
    return p.closed or (p.one_sided and "closed" in (p.lower.status, p.upper.status))


def partner(optimum: LocalAnalysis, i: int) -> str:
    """The parameter whose column is most like the i-th."""
    cosines = np.abs(normalised(optimum.information.matrix)[0][i])  # a parameter without information is like no other
    cosines[i] = -1.0
    return optimum.names[int(np.argmax(cosines))] if len(optimum.names) > 1 else ""


def joint_limits(
    optimum: LocalAnalysis,
    walked: Mapping[str, Profile],
    limits: Mapping[str, float],
    again: Callable[[Mapping[str, float]], Mapping[str, Profile]],
    *,
    seed: int = 0,
) -> FrozenMap[Profile]:
    """The profiles, with the limits of parameters on bounds found anew where several are on bounds together.

    Then 1.353 is not the right rise, for the others on bounds do not scatter freely: a parametric bootstrap of the problem
    linearised at the limit gives the rise that 95 % of the samples stay below. again: walks the profiles of some unknowns
    to other thresholds.
    """
    on_bound = [n for n, p in walked.items() if p.one_sided]
    if len(on_bound) < 2:
        return FrozenMap(walked)
    other: dict[str, float] = {}
    for n in on_bound:
        crossing = next((c for c in (walked[n].lower.crossing, walked[n].upper.crossing) if c is not None), None)
        if crossing is None:
            continue
        near = walked[n].thetas[int(np.argmin(np.abs(walked[n].values - crossing)))]
        rise = bootstrap_rise(optimum, n, crossing, seed, near)
        if rise > 0 and abs(rise - ONE_SIDED) > SCATTER * ONE_SIDED:
            other[n] = limits[n] * rise / ONE_SIDED
    return FrozenMap({**walked, **again(other)} if other else walked)


def bootstrap_rise(optimum: LocalAnalysis, name: str, value: float, seed: int = 0, near: Array | None = None) -> float:
    """The 95 % quantile of the rise at the true value of `name`, where estimates stop at their bounds; 0 without information.

    Noise is drawn for the problem linearised, in scaled coordinates, at the point of the profile where `name` has the
    value: at the optimum a parameter on its bound may have no derivative left. near: (p,) where the search for it starts.
    Raises SimulationError.
    """
    problem, space = optimum.problem, optimum.problem.coordinates
    i = problem.names.index(name)
    begin = (optimum.theta if near is None else near).copy()
    begin[i] = value
    truth = descend(problem, begin, np.arange(begin.size) == i, enough=1e-3).theta
    columns = problem.residual(truth)[1] * space.slope(truth)
    matrix = columns.T @ columns
    low, high = (side - space.scaled(truth) for side in space.bounds)
    above = value > optimum.theta[i]
    low_fixed, high_fixed = low.copy(), high.copy()
    low_fixed[i] = high_fixed[i] = 0.0
    values, vectors = np.linalg.eigh(matrix)
    root = vectors * np.sqrt(np.clip(values, 0.0, None))
    rises = []
    for z in np.random.default_rng(seed).standard_normal((DRAWS, truth.size)):
        g = root @ z
        best = bounded_step(g, matrix, low, high)
        at = bounded_step(g, matrix, low_fixed, high_fixed)
        outside = best[i] < 0 if above else best[i] > 0
        rises.append(_cost(g, matrix, at) - _cost(g, matrix, best) if outside else 0.0)
    return float(np.quantile(rises, 0.95))


def _cost(g: Array, h: Array, p: Array) -> float:
    return float(g @ p + 0.5 * p @ h @ p)


def pair_of(optimum: LocalAnalysis, verdicts: Mapping[str, Verdict], names: tuple[str, str]) -> PairProfile:
    """The common profile of two fitted parameters, over twice their intervals but within the bounds.

    Its rises are in units of the threshold for one parameter, so 95 % of both together lie within 2.996/1.92: half the quantiles
    of chi-square with two degrees of freedom and with one.
    """
    grids = []
    for n in names:
        u = optimum.problem.unknowns[optimum.problem.names.index(n)]
        v = verdicts[n]
        low, high = v.profile.ci95 if v.profile is not None else (None, None)
        half = 0.5 * (high - low) if low is not None and high is not None else 0.25 * u.span
        centre = optimum.value(n)
        grids.append(np.linspace(max(u.min, centre - 2 * half), min(u.max, centre + 2 * half), 13))
    limit = max(thresholds(optimum)[n] for n in names)
    pair = profile_pair(optimum.problem, optimum.theta, names, *grids, enough=1e-3 * limit)
    return replace(pair, rises=pair.rises / limit)


@dataclass(frozen=True)
class OtherOptimum:
    """An optimum as good as the best within the noise. values: by unknown, in its unit; rise: of the cost above the best."""

    values: FrozenMap[float]
    rise: float = field(metadata=stored_as("cost_rise"))


def other_optima(
    best: LocalAnalysis, limits: Mapping[str, float], ends: Sequence[tuple[Mapping[str, float], float]]
) -> tuple[OtherOptimum, ...]:
    """The optima whose cost is less than the largest of the limits above the best one's, or below it, the lowest first.

    limits: the rise of the cost at the ends of each parameter's interval. ends: where the starts of the multistart ended,
    with their costs. The search starts from those, and from the best with two parameters of one unit exchanged, the most
    alike in their effect first, or with a sign turned: that is where the usual second solutions lie.
    """
    limit = max(limits.values())

    def same_basin(theta: Array) -> bool:
        """Return True where a point is the best one but for the roughness of the cost."""
        return best.trend is not None and best.trend.holds(theta, limit)

    known, reached = [best.theta], [best.theta]
    starts: list[Array] = []
    for theta in (*_ended(best, ends, limit), *_exchanged(best)):
        if not any(same_place(best.problem, theta, k) for k in known) and not same_basin(theta):
            known.append(theta)
            starts.append(theta)
    rivals: list[DescentResult] = []
    for theta in starts:
        try:
            end = descend(best.problem, theta, enough=1e-4 * limit, max_evaluations=EVALUATIONS)
        except SimulationError:
            continue
        found_before = any(same_place(best.problem, end.theta, k) for k in reached)
        if end.at.cost - best.cost < limit and not found_before and not same_basin(end.theta):
            reached.append(end.theta)
            rivals.append(end)
    rivals.sort(key=lambda r: r.at.cost)
    names = best.problem.names
    return tuple(
        OtherOptimum(FrozenMap(zip(names, map(float, r.theta), strict=True)), r.at.cost - best.cost) for r in rivals
    )


def _ended(best: LocalAnalysis, ends: Sequence[tuple[Mapping[str, float], float]], limit: float) -> Iterator[Array]:
    for values, cost in ends:
        if cost - best.cost < NEAR * limit:
            theta = [values.get(n, best.value(n)) for n in best.problem.names]
            yield np.array(theta, dtype=float)


def _exchanged(best: LocalAnalysis) -> Iterator[Array]:
    """The best point with two values exchanged, or a sign turned, where the bounds admit it."""
    free, parameters = best.problem.free, best.problem.simulator.parameters
    alike = np.abs(normalised(best.information.matrix)[0])
    places: list[tuple[float, Array]] = []
    for i, j in combinations(range(len(free)), 2):
        a, b = best.theta[i], best.theta[j]
        fits = free[i].min <= b <= free[i].max and free[j].min <= a <= free[j].max
        if fits and parameters[free[i].name].unit == parameters[free[j].name].unit:
            theta = best.theta.copy()
            theta[i], theta[j] = b, a
            places.append((float(alike[i, j]), theta))
    for i, u in enumerate(free):
        if u.min <= -best.theta[i] <= u.max:
            theta = best.theta.copy()
            theta[i] = -theta[i]
            places.append((1.0, theta))
    places.sort(key=lambda p: -p[0])
    yield from (theta for _, theta in places[:TRIED])
