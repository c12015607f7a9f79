"""Stated values as terms: every number of the card may be another one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.expansion import refits_of
from hvdc_ident.discrepancy.hypothesis import Refit, joint_refit_job
from hvdc_ident.discrepancy.result import VALUE
from hvdc_ident.discrepancy.score import P_VALUE
from hvdc_ident.discrepancy.search import Hypothesis, Move, Search, Term
from hvdc_ident.discrepancy.stated import differences, with_free
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit import FitParameter

VALUES = 8
"""Values that are refitted at a time, those that promise most."""
ELSEWHERE = (0.2, 0.35, 0.6, 1.6, 3.0)
"""Shares of a stated value without a trace at which it is run."""
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
    worth, starts = worth_of(here, open_to, [-2.0 * math.log(priors[f.name]) for f in open_to])
    chosen = [k for k in np.argsort(-worth, kind="stable")[:VALUES] if worth[k] > 0.0]
    wider = [with_free(h.base, open_to[k]) for k in chosen]
    jobs = []
    for k, w in zip(chosen, wider, strict=True):
        job = joint_refit_job(w, here, here.placed, {})
        (begin,) = job.begins
        begin[job.problem.names.index(open_to[k].name)] = starts[k]
        jobs.append(replace(job, begins=(begin,)))
    refits = refits_of(context, jobs, [f"with {open_to[k].name} free" for k in chosen])
    return [
        Hypothesis(r, w, (*h.terms, Term(VALUE, (open_to[k].name,), prior=priors[open_to[k].name])))
        for k, r, w in zip(chosen, refits, wider, strict=True)
        if not r.failure and not open_to[k].on_bound(r.values[open_to[k].name])
    ]


def worth_of(here: Refit, values: Sequence[FitParameter], prices: Sequence[float]) -> tuple[Array, list[float]]:
    """Return (m,) by how much chi2 falls with each held value set free, to first order and less its price, and where its refit begins.

    Of a value without a trace, such as a level that no signal reaches, the best of a few others is taken. prices: of the values' priors.
    """
    at = [here.values.get(f.name, f.given) for f in values]
    if not values:
        return np.zeros(0), at
    nominal = here.nominal()
    whole = differences(here.problem, here.theta, {f.name: v for f, v in zip(values, at, strict=True)})
    columns = nominal.projected(whole)
    power = np.sum(columns**2, axis=0)
    shown = power > LEAST_INDEPENDENT_POWER * np.sum(whole**2, axis=0)
    falls = np.where(shown, (columns.T @ nominal.residual) ** 2 / np.where(shown, power, 1.0), 0.0)
    for k in np.flatnonzero(~whole.any(axis=0)).tolist():
        for value in (v for share in ELSEWHERE if values[k].min < (v := share * at[k]) < values[k].max):
            with suppress(SimulationError):  # it does not run there
                moved = here.problem.residuals(here.problem.misfits(here.theta, {values[k].name: value})[:, None])
                left = nominal.projected(moved)[:, 0]
                fall = float(nominal.residual @ nominal.residual - left @ left)
                if fall > falls[k]:
                    falls[k], at[k] = fall, value
    # In chi2 of the noise: of a misfit its own size is no measure of what may be left.
    return np.asarray(falls - math.log(here.rows) - np.array(prices)), at


MOVE = Move("values", 0, freed, in_stead=True)
