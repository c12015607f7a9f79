"""Estimates with their intervals, from an optimum and the curvature there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import stdtrit

from hvdc_ident.data import Array
from hvdc_ident.fit.nuisance import unit_of, unknown_of
from hvdc_ident.fit.problem import Problem, stacked
from hvdc_ident.fit.residual import ResidualBlock
from hvdc_ident.fit.result import Estimate
from hvdc_ident.fit.uncertainty import Uncertainty
from hvdc_ident.fit.unknown import FitParameter

ONE_SIDED = 1.353
"""Half the 90 % quantile of chi-square with one degree of freedom: the 95 % limit of a parameter on its bound."""


def estimates_of(
    problem: Problem, theta: Array, blocks: Sequence[ResidualBlock], inner: Uncertainty, everything: Uncertainty
) -> dict[str, Estimate]:
    """The estimate of every unknown by name.

    inner: about the unknowns inside their bounds, the others held there; everything: about all of them.
    An unknown inside gets value, std and the t interval, as far as the parameter may go by its nature; the only one on a
    bound gets its one-sided limit; several on bounds get none, for their limits are not independent.
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
            own = parameters.get(name)
            limits = (own.min, own.max) if own is not None else (-math.inf, math.inf)
            estimate = _inside(unknown, float(value), inner, limits)
        else:
            estimate = _on_bound(unknown, float(value), float(slope), everything, alone=len(bound) == 1)
        unit = unit_of(problem.simulator, nuisances[name]) if name in nuisances else parameters[name].unit
        found[name] = _with(estimate, unit, problem.conditional_on.get(name, ()))
    return found


def _with(e: Estimate, unit: str, conditional_on: tuple[str, ...]) -> Estimate:
    return replace(e, unit=unit, conditional_on=tuple(conditional_on))


WIDER = 2.0
"""From this ratio of an interval to that of independent residuals on, the difference is told in words."""


def _inside(unknown: FitParameter, value: float, known: Uncertainty, limits: tuple[float, float]) -> Estimate:
    """Value, std and t interval, which ends where the parameter does; a reason where it is wider than the bounds.

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
        reasons.append(
            f"the residuals are correlated, so that {known.rows} rows are worth no more than "
            f"{_counted(sum(known.effective.values()))} and the interval is {half / plain:.2g} times as wide as if they were independent"
        )
    independent = within(plain) if any(known.rho.values()) else None
    return Estimate(
        value, std, within(half), "covariance", std_raw=raw, reason="; ".join(reasons), ci95_independent=independent
    )


def _counted(samples: float) -> str:
    """So many independent rows, in words."""
    number = f"{samples:.3g}"
    return f"{number} independent {'row' if number == '1' else 'rows'}"


def _on_bound(unknown: FitParameter, value: float, slope: float, known: Uncertainty, *, alone: bool) -> Estimate:
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
