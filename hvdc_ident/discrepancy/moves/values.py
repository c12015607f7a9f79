"""Stated values as terms: every number of the card may be another one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.expansion import refits_of
from hvdc_ident.discrepancy.hypothesis import Refit, RefitJob, joint_refit_job
from hvdc_ident.discrepancy.result import VALUE
from hvdc_ident.discrepancy.score import P_VALUE
from hvdc_ident.discrepancy.search import Hypothesis, Move, Search, Term
from hvdc_ident.discrepancy.stated import differences, with_free
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit import FitParameter

VALUES = 8
"""Values that are refitted at a time, those that promise most."""
ELSEWHERE = (0.2, 0.35, 0.6, 1.6, 3.0)
"""Shares of a stated value without a trace at which it is run; of one that is 0, shares of its bounds."""
LEAST_INDEPENDENT_POWER = 1e-6
"""Share of a squared derivative that the free parameters have to leave for a value to be determined."""


def freed(search: Search, h: Hypothesis) -> list[Hypothesis]:
    """Hypotheses with one stated value more set free: those with which chi2 falls most, to first order, or at another value where none
    shows at the stated one."""
    context, h = search.context, search.ready(h)
    if h.refit.failure:
        return []
    here, share = h.refit, P_VALUE / max(len(context.stated), 1)
    priors = {f.name: P_VALUE for f in context.held} | {f.name: share for f in context.stated}
    known = h.base.model.parameters.keys() - here.problem.names
    open_to = [f for f in (*context.held, *context.stated) if f.name in known]
    free = promising(here, open_to, [-2.0 * math.log(priors[f.name]) for f in open_to])
    wider = [with_free(h.base, f) for f in free]
    jobs = [_from(here, w, f) for w, f in zip(wider, free, strict=True)]
    refits = refits_of(context, jobs, [f"with {f.name} free" for f in free])
    return [
        Hypothesis(r, w, (*h.terms, Term(VALUE, (f.name,), prior=priors[f.name])))
        for f, r, w in zip(free, refits, wider, strict=True)
        if not r.failure and not f.on_bound(r.values[f.name])
    ]


def _from(here: Refit, wider: Refit, free: FitParameter) -> RefitJob:
    """Return the refit with one value more free, from where another one came to."""
    job = joint_refit_job(wider, here, here.placed, {})
    (begin,) = job.begins
    begin[job.problem.names.index(free.name)] = free.start
    return job


def promising(here: Refit, values: Sequence[FitParameter], prices: Sequence[float]) -> list[FitParameter]:
    """Return the held values that promise most when set free, started where their refits begin. prices: of the values' priors."""
    left, starts = left_with(here, values)
    # In chi2 of the noise: of a misfit its own size is no measure of what may be left.
    worth = here.chi2 - left - math.log(here.rows) - np.array(prices)
    chosen = [k for k in np.argsort(-worth, kind="stable")[:VALUES] if worth[k] > 0.0]
    return [replace(values[k], start=float(np.clip(starts[k], values[k].min, values[k].max))) for k in chosen]


def left_with(here: Refit, values: Sequence[FitParameter]) -> tuple[Array, list[float]]:
    """Return (m,) chi2 with each held value free beside the unknowns, to first order from where these are, and where its refit begins.

    Of a value without a trace, such as a level that no signal reaches, the best of a few others is taken.
    """
    at = [here.values.get(f.name, f.given) for f in values]
    if not values:
        return np.zeros(0), at
    nominal = here.nominal()
    whole = differences(here.problem, here.theta, values, at)
    columns, residual = nominal.projected(whole), nominal.projected(nominal.residual)
    power = np.sum(columns**2, axis=0)
    shown = power > LEAST_INDEPENDENT_POWER * np.sum(whole**2, axis=0)
    left = residual @ residual - np.where(shown, (columns.T @ residual) ** 2 / np.where(shown, power, 1.0), 0.0)
    # At 0 a part is switched off, and a first step from there may tell nothing of what it does.
    for k in np.flatnonzero(~whole.any(axis=0) | (np.array(at) == 0.0)).tolist():
        for value in _elsewhere(values[k], at[k]):
            with suppress(SimulationError):  # it does not run there
                moved = here.problem.residuals(here.problem.misfits(here.theta, {values[k].name: value})[:, None])
                there = nominal.projected(moved)[:, 0]
                if there @ there < left[k]:
                    left[k], at[k] = float(there @ there), value
    return np.asarray(left), at


def _elsewhere(value: FitParameter, at: float) -> list[float]:
    """Return other values at which a stated one is run."""
    ends = (at,) if at else tuple(end for end in (value.min, value.max) if math.isfinite(end))
    return [v for share in ELSEWHERE for end in ends if value.min < (v := share * end) < value.max]


MOVE = Move("values", 0, freed, in_stead=True)
