"""Uncertainty of an optimum from the curvature of the cost.

Covariance, its inflation by autocorrelated residuals, directions that are not determined, and the estimates with their
intervals.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import solve_banded
from scipy.special import chdtri, stdtrit

from hvdc_ident.data import Array
from hvdc_ident.fit.fit_parameter import FitParameter
from hvdc_ident.fit.noise import MISFIT
from hvdc_ident.fit.problem import Problem, stacked
from hvdc_ident.fit.residual import ResidualBlock
from hvdc_ident.fit.result import Estimate
from hvdc_ident.fit.simulator import unit_of, unknown_of
from hvdc_ident.fit.whitening import independent_samples
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.sensitivity import null_directions
from hvdc_ident.text import figures

if TYPE_CHECKING:
    from hvdc_ident.fit.nonsmooth import Trend

TWO_SIDED = 0.5 * float(chdtri(1.0, 0.05))
"""Rise of the negative log-likelihood at the ends of a 95 % interval: half the quantile of chi-square, 1 degree; 1.92."""
ONE_SIDED = 0.5 * float(chdtri(1.0, 0.10))
"""Rise at the one limit of a parameter whose optimum lies on a bound: half the 90 % quantile; 1.353."""
MOVED = 0.02
"""Share of the given value from which on a fitted value is said to differ from it."""
NO_INTERVAL = "no interval: the model lacks something"
"""Remark on an estimate where the residual is more than noise."""
WIDER = 2.0
"""From this ratio of an interval to that of independent residuals on, the difference is said in words."""
SINGULAR = 1e-7
"""Singular values of the normalised columns below this share of the largest are the sensitivities' own error."""
UNSEEN = 1e-9
"""A parameter whose whole range moves the residual by less than this has no effect."""


def narrow(value: float, interval: tuple[float | None, float | None]) -> bool:
    """Return whether an interval is narrower, either way, than a change that is told (`MOVED`)."""
    low, high = interval
    return low is not None and high is not None and max(high - value, value - low) <= MOVED * abs(value)


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Covariance of p unknowns from the curvature of the cost, each in its unit.

    raw: (p, p) inverse of J'J, as if the residuals were independent; corrected: the same for AR(1) residuals.
    Rows of unknowns in `reasons` mean nothing. singular: whether only combinations of some are determined.
    rho: AR(1) coefficient by output (0 where not significant). effective: the number of independent samples by output.
    dof: degrees of freedom of Student's t for the intervals; infinite where the noise is known and white.
    dof_independent: the same if the residuals were independent. rows: all compared ones. excess: what `corrected` was
    multiplied by, for the misfit is larger than the noise.
    """

    names: tuple[str, ...]
    raw: Array
    corrected: Array
    reasons: FrozenMap[str]
    singular: bool
    rho: FrozenMap[float]
    effective: FrozenMap[float]
    dof: float
    dof_independent: float = np.inf
    rows: int = 0
    excess: float = 1.0

    def std(self, name: str, *, raw: bool = False) -> float | None:
        """Return the standard deviation in the unknown's unit; None where there is a reason against it."""
        if name in self.reasons:
            return None
        i = self.names.index(name)
        return float(np.sqrt((self.raw if raw else self.corrected)[i, i]))

    def widened(self, factor: float) -> Uncertainty:
        """Return the uncertainty with the corrected variances multiplied; the noise is then known from the residuals alone."""
        if factor == 1.0:
            return self
        dof = max(1.0, sum(self.effective.values()) - len(self.names))
        alone = min(self.dof_independent, float(max(1, self.rows - len(self.names))))
        corrected = self.corrected * factor
        return replace(self, corrected=corrected, dof=min(self.dof, dof), dof_independent=alone, excess=factor)

    def on_trend(self, trend: Trend | None, names: Sequence[str]) -> Uncertainty:
        """Return the uncertainty with the roughness of the cost added. trend: None where there is none; names: of its unknowns."""
        if trend is None:
            return self
        places = [list(names).index(n) for n in self.names]
        return replace(self, raw=trend.widened(self.raw, places), corrected=trend.widened(self.corrected, places))

    def correlation(self) -> dict[str, dict[str, float]]:
        """Return the correlation of the estimates between those that have a standard deviation."""
        known = [i for i, n in enumerate(self.names) if n not in self.reasons]
        d = np.sqrt(np.diag(self.corrected))
        return {self.names[i]: {self.names[j]: float(self.corrected[i, j] / d[i] / d[j]) for j in known} for i in known}


def uncertainty(
    blocks: Sequence[ResidualBlock],
    names: Sequence[str],
    spans: Array,
    source: Mapping[str, str],
    prior: Array | None = None,
    noise_dof: float = np.inf,
) -> Uncertainty:
    """Return the uncertainty of the unknowns whose columns the blocks have, with the priors' information.

    prior: (k, p) derivatives of the priors' residuals, which are independent and of standard deviation 1.
    noise_dof: independent samples behind a given noise that was estimated: the intervals are then Student's (one
    parameter's F quantile).
    spans: (p,) the range of each unknown. source: "given" or "misfit" by output: where sigma comes from.
    The correction is the sandwich (J'J)^-1 J'RJ (J'J)^-1 with R the AR(1) correlation within a record: (1+rho)/(1-rho)
    where the sensitivities are slow against the noise. It is never below the uncorrected variance.
    """
    _, jacobian = stacked(blocks)
    count, p = jacobian.shape
    if prior is not None and prior.size:
        jacobian = np.vstack([jacobian, prior])
    norms = np.linalg.norm(jacobian, axis=0)
    unseen = norms * spans <= UNSEEN
    norms = np.where(unseen, 1.0, norms)
    seen = np.where(unseen, 0.0, jacobian / norms)
    inverse, null = _inverse(seen), null_directions(seen, SINGULAR)
    rho, effective = samples_by_output(blocks, p)
    meat = sum(
        (score_covariance(b.jacobian[part] / norms, rho[b.output]) for b in blocks for part in b.stretches),
        np.zeros((p, p)),
    )
    if prior is not None and prior.size:
        meat = meat + (prior / norms).T @ (prior / norms)
    sandwich = inverse @ meat @ inverse
    from_misfit = any(source[b.output] == MISFIT for b in blocks)
    if from_misfit and count > p:
        sandwich = sandwich * ((count - p) / max(count - float(np.trace(inverse @ meat)), 0.05 * count))
    # Of a direction that is hardly determined rounding may leave a variance below 0.
    raw_std, std = np.sqrt(np.diag(inverse)), np.sqrt(np.maximum(np.diag(sandwich), 0.0))
    lift = np.where(std < raw_std, raw_std / np.where(std > 0, std, 1.0), 1.0)
    corrected = sandwich * np.outer(lift, lift)
    np.fill_diagonal(corrected, np.maximum(np.diag(corrected), raw_std**2))
    known = not from_misfit and not any(rho.values())
    dof = min(noise_dof, np.inf if known else max(1.0, sum(effective.values()) - p))
    return Uncertainty(
        tuple(names),
        inverse / np.outer(norms, norms),
        corrected / np.outer(norms, norms),
        _reasons(names, unseen, null, too_few=from_misfit and count <= p),
        bool(null.shape[0]),
        FrozenMap(rho),
        FrozenMap(effective),
        float(dof),
        float(min(noise_dof, max(1, count - p) if from_misfit else np.inf)),
        count,
    )


def _inverse(columns: Array) -> Array:
    """Return the inverse of J'J, (p, p), over the directions that are determined, from columns J of length 1 or 0."""
    root = np.linalg.pinv(np.linalg.qr(columns, mode="r"), rcond=SINGULAR)
    return np.asarray(root @ root.T)


def samples_by_output(blocks: Sequence[ResidualBlock], p: int) -> tuple[dict[str, float], dict[str, float]]:
    """Return by output the residuals' AR(1) coefficient, and the independent samples they are worth, after a fit of p unknowns."""
    total = sum(b.residual.size for b in blocks)
    rho, effective = {}, {}
    for output in dict.fromkeys(b.output for b in blocks):
        records = [b.score[part] for b in blocks if b.output == output for part in b.stretches]
        n = sum(r.size for r in records)
        rho[output], effective[output] = independent_samples(records, p * n / total)
    return rho, effective


def score_covariance(jacobian: Array, rho: float) -> Array:
    """Return J'RJ with R_ij = rho^|i-j|, (p, p)."""
    if rho == 0.0:
        return jacobian.T @ jacobian
    before = np.zeros_like(jacobian)
    before[1:] = rho * jacobian[:-1]
    past = solve_banded((1, 0), np.array([[1.0], [-rho]]).repeat(len(jacobian), axis=1), before, check_finite=False)
    cross = jacobian.T @ past
    return jacobian.T @ jacobian + cross + cross.T


def _reasons(names: Sequence[str], unseen: Array, null: Array, *, too_few: bool) -> FrozenMap[str]:
    """Return by name the reason why an unknown has no standard deviation."""
    if too_few:
        return FrozenMap(dict.fromkeys(names, "not more rows than unknowns: the misfit says nothing about the noise"))
    reasons = {n: "no compared output depends on it here" for n, u in zip(names, unseen, strict=True) if u}
    for direction in null:
        members = [n for n, v in zip(names, direction, strict=True) if abs(v) > 1e-3]
        for n in members:
            others = ", ".join(m for m in members if m != n)
            reasons.setdefault(n, f"only a combination with {others} is determined")
    return FrozenMap(reasons)


def estimates_of(
    problem: Problem,
    theta: Array,
    blocks: Sequence[ResidualBlock],
    inner: Uncertainty,
    everything: Uncertainty,
    *,
    systematic: bool = False,
) -> dict[str, Estimate]:
    """Return the estimate of every unknown by name. systematic: the residual is more than noise; no estimate has an interval then.

    inner: about the unknowns inside their bounds, the others held there; everything: about all of them.
    An unknown that neither knows gets its value alone.
    An unknown inside gets value, std and the t interval, as far as the parameter may go by its nature; the only one on a
    bound gets its one-sided limit; several on bounds get none, for their limits are not independent.
    """
    r, jacobian = stacked(blocks)
    gradient = jacobian.T @ problem.loss.psi(r)
    prior, rows = problem.prior(theta)
    gradient += rows.T @ prior
    bound = [u.name for u, v in zip(problem.unknowns, theta, strict=True) if u.on_bound(v)]
    parameters = problem.simulator.parameters
    nuisances = {unknown_of(e.name, n): n for e in problem.fitted_experiments for n in e.nuisance}
    estimates = {}
    for unknown, value, slope in zip(problem.unknowns, theta, gradient, strict=True):
        name = unknown.name
        if name not in bound and name not in inner.names:
            estimate = Estimate(float(value))
        elif name not in bound:
            parameter = parameters.get(name)
            limits = (-math.inf, math.inf) if parameter is None else (parameter.min, parameter.max)
            estimate = _inside(unknown, float(value), inner, limits)
        else:
            estimate = _at_bound(unknown, float(value), float(slope), everything, alone=len(bound) == 1)
        unit = unit_of(problem.simulator, nuisances[name]) if name in nuisances else parameters[name].unit
        if systematic:  # remarks on an interval are of no use without it
            kept = estimate if name in bound else replace(estimate, reason="")
            estimate = kept.without_interval(NO_INTERVAL)
        estimates[name] = replace(estimate, unit=unit, conditional_on=tuple(problem.conditional_on.get(name, ())))
    return estimates


def _inside(unknown: FitParameter, value: float, known: Uncertainty, limits: tuple[float, float]) -> Estimate:
    """Return value, std and t interval, which ends where the parameter does; a reason where it is wider than the bounds.

    limits: what the parameter may be by its nature, in its unit. A parameter whose bounds admit no negative value has none.
    """
    std, raw = known.std(unknown.name), known.std(unknown.name, raw=True)
    if std is None or raw is None:
        return Estimate(value, reason=known.reasons[unknown.name])
    low, high = max(limits[0], 0.0 if unknown.min >= 0 else -math.inf), limits[1]

    def within(half: float) -> tuple[float, float]:
        return max(value - half, min(low, value)), min(value + half, max(high, value))

    half = float(stdtrit(known.dof, 0.975)) * std
    plain = float(stdtrit(known.dof_independent, 0.975)) * raw * math.sqrt(known.excess)
    width = unknown.max - unknown.min
    reasons = ["the interval is wider than the bounds"] if math.isfinite(width) and 2.0 * half > width else []
    if half > WIDER * plain > 0:
        worth = figures(sum(known.effective.values()), 3)
        reasons.append(
            f"the residuals are correlated, so that {known.rows} rows are worth no more than "
            f"{worth} independent {'row' if worth == '1' else 'rows'} and the interval is {half / plain:.2g} times as wide "
            "as if they were independent"
        )
    independent = within(plain) if any(known.rho.values()) else None
    return Estimate(
        value, std, within(half), "covariance", std_raw=raw, reason="; ".join(reasons), ci95_independent=independent
    )


def _at_bound(unknown: FitParameter, value: float, slope: float, known: Uncertainty, *, alone: bool) -> Estimate:
    """Return the bound with its one-sided 95 % limit, where the profile's cost, to second order, has risen by 1.353."""
    if not alone:
        return Estimate(value, reason="on a bound together with others: their limits are not independent")
    std, raw = known.std(unknown.name), known.std(unknown.name, raw=True)
    if std is None or raw is None:
        return Estimate(value, reason=f"on a bound, and {known.reasons[unknown.name]}")
    inflation = (std / raw) ** 2
    curvature = 1.0 / raw**2
    push = abs(slope)
    reach = (-push + float(np.sqrt(push**2 + 2.0 * curvature * ONE_SIDED * inflation))) / curvature
    low = value <= unknown.min
    ci = (value, value + reach) if low else (value - reach, value)
    return Estimate(value, None, ci, "one-sided", reason=f"on its {'lower' if low else 'upper'} bound")
