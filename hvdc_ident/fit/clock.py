"""The search over clock offsets that a descent cannot make.

An output that jumps with an input makes the cost jump in the offset of the clock, each time a row passes the jump:
between two rows the cost is smooth, and a descent never leaves the stretch it begins in. So the stretches are tried.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hvdc_ident.data import Array, Experiment
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit.nuisance import TIME_SHIFT, unknown_of
from hvdc_ident.fit.optimiser import Optimiser
from hvdc_ident.fit.problem import Problem
from hvdc_ident.fit.starts import LocalMinimum

MOST = 80
"""Stretches that are tried in an experiment; of more, every so many."""
ROUNDS = 6
"""How often the other unknowns are found again between two searches."""


def has_clocks(problem: Problem) -> bool:
    """Whether any experiment has a clock of unknown offset."""
    return any(TIME_SHIFT in e.nuisance for e in problem.fitted_experiments)


def searched(problem: Problem, best: LocalMinimum, method: Optimiser) -> LocalMinimum:
    """The best optimum over the stretches of all clocks: search, fit again, until no other stretch is better."""
    for _ in range(ROUNDS):
        theta = best.theta.copy()
        for e in problem.fitted_experiments:
            if TIME_SHIFT in e.nuisance:
                theta[problem.names.index(unknown_of(e.name, TIME_SHIFT))] = _best_offset(problem, e, theta)
        if np.array_equal(theta, best.theta):
            return best
        run = method.run(problem, theta)
        if run.status == "failed" or run.cost is None or not run.cost < best.cost:
            return best
        best = LocalMinimum(run.theta, run.cost)
    return best


def _best_offset(problem: Problem, e: Experiment, theta: Array) -> float:
    """The offset of one clock at which its experiment's cost is least, the other unknowns as they are; s."""
    alone = replace(problem, experiments=(e,), priors=problem.priors.without(*problem.priors))
    at = np.array([theta[problem.names.index(n)] for n in alone.names])
    place = alone.names.index(unknown_of(e.name, TIME_SHIFT))
    own, unknown = float(at[place]), alone.unknowns[place]
    offsets = _stretches(e, unknown.min, unknown.max)
    costs = []
    for tau in (own, *offsets):
        at[place] = tau
        try:
            costs.append(alone.cost(at))
        except SimulationError:
            costs.append(np.inf)  # only compared: an offset that cannot be simulated is not chosen
    return float((own, *offsets)[int(np.argmin(costs))])


def _stretches(e: Experiment, low: float, high: float) -> list[float]:
    """The middles of the stretches of offsets within which no row passes a break of an input, s."""
    breaks = np.unique([b for signal in e.inputs.values() for b in signal.breaks.tolist()])
    passing = np.unique(np.subtract.outer(e.time, breaks))
    inner = passing[(passing > low) & (passing < high)]
    ends = np.concatenate([[low], inner, [high]])
    middles = 0.5 * (ends[1:] + ends[:-1])
    return [float(m) for m in middles[:: max(1, -(-middles.size // MOST))]]
