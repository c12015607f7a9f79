"""How far the data's word reaches: thresholds of profiles, refits at the ends of a range, limits at several bounds."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtrit

from hvdc_ident.data import Array
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit import FitParameter, Problem
from hvdc_ident.fit.bootstrap import FEWEST, cluster_sandwich
from hvdc_ident.fit.objective import LeastSquares, bounded_step, descend
from hvdc_ident.fit.profile import PairProfile, Profile, profile_pair
from hvdc_ident.fit.uncertainty import ONE_SIDED, TWO_SIDED
from hvdc_ident.identifiability.pilot import Optimum
from hvdc_ident.identifiability.verdicts import Verdict
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.sensitivity import independent, pivoted_order, rise_over_range

DRAWS = 999
SCATTER = 0.1
"""The 95 % quantile of so many draws scatters by 0.08 of itself (sqrt(p (1 - p)/n) over the density): less is no difference."""


@dataclass(frozen=True)
class Spread:
    """How well one parameter is known. std: in its unit. threshold: rise of the cost at the ends of its interval."""

    std: float
    threshold: float


def thresholds(optimum: Optimum) -> dict[str, float]:
    """The rise of the cost at the ends of each parameter's 95 % interval: see `spreads`."""
    return {n: s.threshold for n, s in spreads(optimum).items()}


def spreads(optimum: Optimum) -> dict[str, Spread]:
    """The standard deviation of each parameter, and the rise of the cost at the ends of its 95 % interval.

    The rise is 1.92; with estimated noise half the square of Student's t. Times what correlated samples and model error
    add to the variance in the parameter's direction (vertical scaling of an independence likelihood: Chandler and Bate
    2007, doi 10.1093/biomet/asm015): the wider of the AR(1) sandwich times the excess misfit and, where the misfit
    shows model error, the sandwich over experiments with t(n - 1).
    """
    u = optimum.uncertainty
    quantile = 0.5 * float(stdtrit(u.dof, 0.975)) ** 2 if np.isfinite(u.dof) else TWO_SIDED
    raw = np.diag(u.raw)
    safe = np.where(raw > 0, raw, 1.0)
    factor = np.maximum(np.where(raw > 0, np.diag(u.corrected) / safe, 1.0) * optimum.excess, 1.0)
    limits = quantile * factor
    if optimum.excess > 1.0 and len({b.experiment for b in optimum.blocks}) >= FEWEST and not u.singular:
        covariance, dof = cluster_sandwich(optimum.blocks)
        scatter = np.where(raw > 0, np.diag(covariance) / safe, 0.0)
        wider = 0.5 * float(stdtrit(dof, 0.975)) ** 2 * scatter
        factor = np.where(wider > limits, scatter, factor)
        limits = np.maximum(limits, wider)
    stds = np.sqrt(raw * factor)
    return {n: Spread(float(s), float(v)) for n, s, v in zip(optimum.names, stds, limits, strict=False)}


def told_by_noise(whole: Optimum, kept: Sequence[str], others: Sequence[str]) -> dict[str, float]:
    """By parameter of `others` the half-width, in its unit, of the 95 % interval that the noise alone would leave it.

    whole: all candidates free. kept: those fitted anyway. Only those are in it that can be told beside them: the best
    determined first, as long as no direction is lost and every interval is narrower than its bounds. The misfit has no
    part in it, so this is what the records could tell of a model that explains them (Cramer and Rao's bound, at first order).
    """
    free = {f.name: f for f in whole.problem.free}
    names = [n for n in whole.names if n in kept or n in others]
    matrix = whole.information.select(names).matrix
    slope = dict(zip(whole.problem.names, whole.slope.tolist(), strict=True))
    order = [names[i] for i in pivoted_order(matrix)]
    chosen, found = [n for n in order if n in kept], dict[str, float]()
    for n in (n for n in order if n in others):
        trial = [*chosen, n]
        part = whole.information.select(trial).matrix
        if len(independent(part, whole.error)) < len(trial):
            continue
        lengths = np.sqrt(np.diag(part))
        inverse = np.linalg.inv(part / np.outer(lengths, lengths))
        halves = np.sqrt(2.0 * TWO_SIDED * np.diag(inverse)) / lengths
        if all(h * slope[m] < _room(free[m], whole.value(m)) for m, h in zip(trial, halves.tolist(), strict=True)):
            chosen = trial
            found[n] = float(halves[-1] * slope[n])
    return found


def _room(free: FitParameter, value: float) -> float:
    """Half of the range between the bounds as the unknown is scaled, in its unit at `value`; infinite without bounds."""
    return 0.5 * (value * math.log(free.max / free.min) if free.log else free.max - free.min)


def range_of(free: FitParameter, value: float, reach: float) -> tuple[float, float]:
    """The range that a verdict speaks of: the bounds; where there is none, as far from the value as profiles are walked.

    reach: in typical sizes, or times the value, as in `ProfileOptions`.
    """
    low = free.min if math.isfinite(free.min) else value - reach * free.size
    high = free.max if math.isfinite(free.max) else value * reach if free.log else value + reach * free.size
    return low, high


def rise_at_ends(optimum: Optimum, i: int, ends: tuple[float, float]) -> float | None:
    """How much the cost rises at the worse end of the range, the others re-fitted; None where an end cannot be run."""
    fixed = np.arange(optimum.theta.size) == i
    rises = []
    for end in ends:
        theta = optimum.theta.copy()
        theta[i] = end
        try:
            rises.append(descend(LeastSquares.of(optimum.problem), theta, fixed, enough=1e-3).at.cost - optimum.cost)
        except SimulationError:
            return None
    return max(*rises, 0.0)


def physical_bounds(problem: Problem) -> dict[str, tuple[bool, bool]]:
    """By parameter whether its bounds are the model's own."""
    own = problem.simulator.parameters
    return {f.name: (f.min == own[f.name].min, f.max == own[f.name].max) for f in problem.free}


def undetermined(optimum: Optimum, p: Profile, ends: tuple[float, float]) -> bool:
    """Return whether a profile has no crossing on a side and, at the optimum, no curvature: only a far limit is known.

    A level that no record reaches is one. By its curvature the whole range between the ends would then change nothing (the
    rule for insensitive parameters), so every value up to the bound is as good, and which one a search ended at is chance.
    """
    if p.one_sided or None not in (p.lower.crossing, p.upper.crossing):
        return False
    i = optimum.names.index(p.name)
    curvature = optimum.information.matrix[i, i] / optimum.slope[i] ** 2
    return rise_over_range(curvature, ends[1] - ends[0]) < p.threshold


def bounded(p: Profile) -> bool:
    """Whether the interval is known: both ends, or the one that a parameter on its bound has."""
    return p.closed or (p.one_sided and "closed" in (p.lower.status, p.upper.status))


def partner(optimum: Optimum, i: int) -> str:
    """The parameter whose column is most like the i-th."""
    matrix = optimum.information.matrix
    size = np.sqrt(np.diag(matrix))
    size = np.where(size > 0, size, 1.0)  # a parameter without information is like no other
    cosines = np.abs(matrix[i]) / (size * size[i])
    cosines[i] = -1.0
    return optimum.names[int(np.argmax(cosines))] if len(optimum.names) > 1 else ""


def joint_limits(
    optimum: Optimum,
    found: Mapping[str, Profile],
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
    on_bound = [n for n, p in found.items() if p.one_sided]
    if len(on_bound) < 2:
        return FrozenMap(found)
    other: dict[str, float] = {}
    for n in on_bound:
        crossing = next((c for c in (found[n].lower.crossing, found[n].upper.crossing) if c is not None), None)
        if crossing is None:
            continue
        there = found[n].thetas[int(np.argmin(np.abs(found[n].values - crossing)))]
        rise = bootstrap_rise(optimum, n, crossing, seed, there)
        if rise > 0 and abs(rise - ONE_SIDED) > SCATTER * ONE_SIDED:
            other[n] = limits[n] * rise / ONE_SIDED
    return FrozenMap({**found, **again(other)} if other else found)


def bootstrap_rise(optimum: Optimum, name: str, value: float, seed: int = 0, near: Array | None = None) -> float:
    """The 95 % quantile of the rise at the true value of `name`, where estimates stop at their bounds; 0 where it says nothing.

    Noise is drawn for the problem linearised, in scaled coordinates, at the point of the profile where `name` has the
    value: at the optimum a parameter on its bound may have no derivative left. near: (p,) where the search for it begins.
    Raises SimulationError.
    """
    problem, space = optimum.problem, optimum.problem.coordinates
    i = problem.names.index(name)
    begin = (optimum.theta if near is None else near).copy()
    begin[i] = value
    truth = descend(LeastSquares.of(problem), begin, np.arange(begin.size) == i, enough=1e-3).theta
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
        best = bounded_step(g, matrix, 0.0, low, high)
        at = bounded_step(g, matrix, 0.0, low_fixed, high_fixed)
        outside = best[i] < 0 if above else best[i] > 0
        rises.append(_cost(g, matrix, at) - _cost(g, matrix, best) if outside else 0.0)
    return float(np.quantile(rises, 0.95))


def _cost(g: Array, h: Array, p: Array) -> float:
    return float(g @ p + 0.5 * p @ h @ p)


def pair_of(optimum: Optimum, found: Mapping[str, Verdict], names: tuple[str, str], points: int = 13) -> PairProfile:
    """The common profile of two fitted parameters, over twice their intervals but within the bounds.

    Its rises are in units of the threshold for one parameter, so 95 % of both together lie within JOINT/1.92.
    """
    grids = []
    for n in names:
        u = optimum.problem.unknowns[optimum.problem.names.index(n)]
        v = found[n]
        low, high = v.ci95 or (None, None)
        half = 0.5 * (high - low) if low is not None and high is not None else 0.25 * u.span
        centre = optimum.value(n)
        grids.append(np.linspace(max(u.min, centre - 2 * half), min(u.max, centre + 2 * half), points))
    limit = max(thresholds(optimum)[n] for n in names)
    pair = profile_pair(LeastSquares.of(optimum.problem), optimum.theta, names, *grids, enough=1e-3 * limit)
    return replace(pair, rises=pair.rises / limit)
