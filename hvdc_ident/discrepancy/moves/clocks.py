"""Clocks as terms of a hypothesis: records moved to where their time stamps are right.

Two recorders of one rate cannot be aligned better than to half a row, and a late clock would be taken for an effect, as a sampler at the
set-points. A record that is moved is simulated from where it began: what the plant does from then on, as taking its samples, does not
move with the recorder's clock.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np

from hvdc_ident.data import Experiment, Trajectory
from hvdc_ident.discrepancy.hypothesis import FAILURES, Refit, RefitJob, refit_again, refitted
from hvdc_ident.discrepancy.nominal import of_held_out
from hvdc_ident.discrepancy.options import SearchContext
from hvdc_ident.discrepancy.score import P_CLOCKS, Ruler, evidence_between
from hvdc_ident.discrepancy.search import CLOCKS, Hypothesis, Move, Search, Term
from hvdc_ident.fit import Problem
from hvdc_ident.fit.simulator import TIME_SHIFT, unknown_of
from hvdc_ident.text import listed, quantity

MAX_CLOCK_ROWS = 0.5
"""Rows by which a record's time stamps are off at most, with recorders of one rate."""


def on_their_clocks(search: SearchContext, base: Refit, here: Refit) -> tuple[Refit, Refit]:
    """Return the nominal model and the hypothesis `here` on records that are moved to suit it, where that brings more evidence
    than it costs; else as they are.

    base: the nominal model that `here` adds effects to. A clock that would be off by more than half a row is no clock, and the
    records stay where they are; so they do where the study declares that clocks may be off.
    """
    if search.spent or not search.records or any(TIME_SHIFT in e.nuisance for e in here.problem.experiments):
        return base, here
    search.tell(0, 1, "with clocks that are off")
    now = clocks(search, here)
    late = {n: v + now.get(n, 0.0) for n, v in _late(here).items()}
    reach = {e.name: MAX_CLOCK_ROWS * float(np.median(np.diff(e.time))) for e in search.records}
    if not late or any(abs(v) >= reach[n] for n, v in late.items()):
        return base, here
    moved = _refitted(base, here, tuple(_moved(e, late[e.name]) if e.name in late else e for e in search.records))
    if moved is None:
        return base, here
    return moved if _gain(here, moved[1], len(late)) > search.options.named_bic else (base, here)


def _gain(still: Refit, moved: Refit, count: int) -> float:
    """Return the evidence, in BIC, for so many clocks being off."""
    # The row that leaves a record takes its share of the noise along.
    as_many = replace(still, chi2=still.chi2 * moved.rows / still.rows)
    return evidence_between(as_many, moved, Ruler.of(moved), count)


def clocks(search: SearchContext, here: Refit) -> dict[str, float]:
    """By how much each clock is late in the hypothesis `here`, s; empty where the records stand as they were given."""
    now = {e.name: e for e in here.problem.experiments}
    if all(now[e.name].time is e.time for e in search.records):
        return {}
    return {e.name: float(e.time[-1] - now[e.name].time[-1]) for e in search.records}


def clock_sentence(off: Mapping[str, float]) -> str:
    """The clocks as a sentence."""
    each = [f"that of {n} is {quantity(abs(v), 's')} {'late' if v > 0 else 'early'}" for n, v in off.items()]
    return f"The clocks of the records are off by less than half a row: {listed(each)}."


def _late(here: Refit) -> dict[str, float]:
    """By how much each clock is late, s, as it suits the hypothesis; empty where that is unknown.

    Of the fitted records together with all unknowns, of each of the others with these unknowns.
    """
    timed = _timed(here.problem)
    values = dict(zip(here.problem.names, here.theta, strict=True))
    begin = np.array([values.get(n, 0.0) for n in timed.names])
    try:
        end = refitted(RefitJob(here.model, here.placed, timed, (begin,), here.noise))
        if end.failure:
            return {}
        at = dict(zip(timed.names, end.theta, strict=True))
        found = {e.name: float(at[unknown_of(e.name, TIME_SHIFT)]) for e in timed.fitted_experiments}
        others = of_held_out(here.problem)
        return found | (
            {} if others is None else _late_alone(_timed(others), end.theta[: len(others.free)], timed.outputs)
        )
    except FAILURES:  # it does not run, or the record has one instant
        return {}


def _late_alone(others: Problem, known: np.ndarray, outputs: Collection[str]) -> dict[str, float]:
    """By how much the clock of each record is late, s, to first order, with all other unknowns known; from these outputs."""
    blocks = others.blocks(np.concatenate([known, np.zeros(len(others.experiments))]))
    found = {}
    for e in others.experiments:
        column = others.names.index(unknown_of(e.name, TIME_SHIFT))
        own = [b for b in blocks if b.experiment == e.name and b.output in outputs]
        slope, left = np.concatenate([b.jacobian[:, column] for b in own]), np.concatenate([b.residual for b in own])
        power = float(slope @ slope)
        found[e.name] = -float(slope @ left) / power if power > 0 else 0.0
    return found


def _timed(problem: Problem) -> Problem:
    """The problem with a late clock of each fitted record among its unknowns."""
    experiments = (
        e.with_(nuisance=(*e.nuisance, TIME_SHIFT)) if e.role == "fit" and e.outputs else e for e in problem.experiments
    )
    return replace(problem, experiments=tuple(experiments))


def _moved(experiment: Experiment, late: float) -> Experiment:
    """The experiment with its record earlier by so many s; it begins at the instant at which it began, with no value there."""
    assert experiment.measured is not None
    time = experiment.time - late
    after = time > experiment.time[0]
    grid = np.concatenate([experiment.time[:1], time[after]])
    values = np.vstack([np.full((1, len(experiment.measured.names)), np.nan), experiment.measured.values[after]])
    names, units = experiment.measured.names, experiment.measured.units
    return experiment.with_(time=grid, measured=Trajectory(grid, values, names, units))


def _refitted(base: Refit, here: Refit, records: tuple[Experiment, ...]) -> tuple[Refit, Refit] | None:
    """The nominal model, at its values, and the hypothesis refitted, on other records; None where it does not run on them."""
    other = replace(base, problem=replace(base.problem, experiments=records))
    same = replace(here, problem=replace(here.problem, experiments=records))
    found = refit_again(other, same, same.placed)
    return None if found.failure else (other, found)


def clocked(search: Search, h: Hypothesis) -> list[Hypothesis]:
    """The hypothesis on records whose clocks are off, where they are."""
    if any(t.kind == CLOCKS for t in h.terms) or search.is_noise(h):
        return []
    h = search.ready(h)
    if h.refit.failure:
        return []
    base, refit = on_their_clocks(search.context, h.base, h.refit)
    if refit is h.refit:
        return []
    return [Hypothesis(refit, base, (*h.terms, Term(CLOCKS, tuple(clocks(search.context, refit)), prior=P_CLOCKS)))]


MOVE = Move("clocks", 0, clocked, in_stead=True)
