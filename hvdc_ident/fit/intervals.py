"""Estimates with their intervals, from an optimum and the curvature there."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.special import stdtrit

from hvdc_ident.fit.nuisance import unit_of, unknown_of
from hvdc_ident.fit.problem import Problem, stacked
from hvdc_ident.fit.residual import Block
from hvdc_ident.fit.result import Estimate
from hvdc_ident.fit.uncertainty import Uncertainty
from hvdc_ident.fit.unknown import Free
from hvdc_ident.trajectory import Array

ONE_SIDED = 1.353
"""Half the 90 % quantile of chi-square with one degree of freedom: the 95 % limit of a parameter on its bound."""


def estimates_of(
    problem: Problem, theta: Array, blocks: Sequence[Block], inner: Uncertainty, everything: Uncertainty
) -> dict[str, Estimate]:
    """The estimate of every unknown by name.

    inner: about the unknowns inside their bounds, the others held there; everything: about all of them.
    An unknown inside gets value, std and the t interval; the only one on a bound gets its one-sided limit; several on
    bounds get none, for their limits are not independent.
    """
    r, jacobian = stacked(blocks)
    gradient = jacobian.T @ problem.loss.psi(r)
    prior, rows = problem.prior(theta)
    gradient += rows.T @ prior
    bound = [u.name for u, v in zip(problem.unknowns, theta, strict=True) if not u.min < v < u.max]
    parameters = problem.simulator.parameters
    nuisances = {unknown_of(e.name, n): n for e in problem.fitted_experiments for n in e.nuisance}
    found = {}
    for unknown, value, slope in zip(problem.unknowns, theta, gradient, strict=True):
        name = unknown.name
        if name not in bound:
            estimate = _inside(unknown, float(value), inner)
        else:
            estimate = _on_bound(unknown, float(value), float(slope), everything, alone=len(bound) == 1)
        unit = unit_of(problem.simulator, nuisances[name]) if name in nuisances else parameters[name].unit
        found[name] = _with(estimate, unit, problem.conditional_on.get(name, ()))
    return found


def _with(e: Estimate, unit: str, conditional_on: tuple[str, ...]) -> Estimate:
    return Estimate(e.value, e.std, e.ci95, e.method, tuple(conditional_on), e.std_raw, unit, e.reason)


def _inside(unknown: Free, value: float, known: Uncertainty) -> Estimate:
    """Value, std and t interval; a reason where the interval is wider than the bounds."""
    std = known.std(unknown.name)
    if std is None:
        return Estimate(value, reason=known.reasons[unknown.name])
    half = float(stdtrit(known.dof, 0.975)) * std
    width = unknown.max - unknown.min
    reason = "the interval is wider than the bounds" if math.isfinite(width) and 2.0 * half > width else ""
    raw = known.std(unknown.name, raw=True)
    return Estimate(value, std, (value - half, value + half), "covariance", std_raw=raw, reason=reason)


def _on_bound(unknown: Free, value: float, slope: float, known: Uncertainty, *, alone: bool) -> Estimate:
    """The bound with its one-sided 95 % limit, where the profile's cost, to second order, has risen by 1.353."""
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
