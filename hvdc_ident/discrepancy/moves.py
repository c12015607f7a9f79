"""Parameters and clocks as hypotheses: set free where the records, under a hypothesis, speak against their values.

The report of a model that lacks something holds parameters for the misfit that is being diagnosed, what a study states of the
others is known to a few per cent at best, and two recorders of one rate cannot be aligned better than to half a row. What is off
there would be taken for an effect (a late clock as a sampler at the set-points, say), so "these parameters are off their values" and
"the clocks are off" are compared with the effects, and asked again beside them. A record that is moved is simulated from where it
began: what the plant does from then on, as taking its samples, does not move with the recorder's clock.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from hvdc_ident.data import Array, Experiment, Trajectory
from hvdc_ident.discrepancy.evidence import Ruler, evidence_between, is_noise
from hvdc_ident.discrepancy.hypothesis import FAILURES, Refit, RefitJob, refit_again, refitted
from hvdc_ident.discrepancy.nominal import of_held_out
from hvdc_ident.discrepancy.options import SearchContext
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit import FitParameter, Problem
from hvdc_ident.fit.simulator import TIME_SHIFT, unknown_of
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel, is_white_box
from hvdc_ident.text import listed, quantity

STATED_ERROR = 0.02
"""Share by which the stated value of a parameter that is no candidate may be off: data sheets and tests are no better."""
LEAST_INDEPENDENT_POWER = 1e-6
"""Share of its squared derivative that the others must not make good, for a parameter to be determined at all."""
DIFFERENCE_STEP = 1e-3
"""Share of a value, or of its range where that is 0, by which it is moved for a derivative."""


def stated(model: AnyModel, candidates: Sequence[FitParameter]) -> tuple[FitParameter, ...]:
    """Return the parameters of a model that are no candidates, with bounds as near as they are known.

    None of a model that is closed inside: each derivative would be a run.
    """
    if not is_white_box(model):
        return ()
    others = {n: p.value for n, p in model.parameters.items() if p.value and n not in {f.name for f in candidates}}
    return tuple(FitParameter(n, v, v - STATED_ERROR * abs(v), v + STATED_ERROR * abs(v)) for n, v in others.items())


def released(search: SearchContext, base: Refit, here: Refit) -> tuple[Refit, Refit]:
    """Return the nominal model and the hypothesis `here`, with those held parameters free, and the clocks of the records as far
    off, as bring more evidence than they cost.

    base: the nominal model that `here` adds effects to, at its values. One is set free at a time, the one that gains most, and has
    to gain as much in BIC as an effect needs to be named, until noise is left; one that ends on its bound stays held. here: a
    hypothesis that leaves more than noise.
    """
    refused: set[str] = set()
    while not search.spent:
        held = [f for f in (*search.held, *search.stated) if f.name not in (*here.problem.names, *refused)]
        best = _most_wanted(search, here, held)
        if best is None:
            break
        search.tell(0, 1, f"with {best.name} free")
        wider = _with_free(base, best)
        freed = refit_again(wider, here, here.placed)
        if freed.failure or not evidence_between(here, freed, Ruler.of(freed), 1) > search.options.named_bic:
            break
        # What asks for more than a value may be off is something else; free, the value would hide it from every score.
        if best.on_bound(freed.values[best.name]):
            refused.add(best.name)
            continue
        base, here = wider, freed
        if is_noise(here, search.seed):
            return base, here
    clocked = on_their_clocks(search, base, here)
    return clocked if clocked[1] is here else _parameters_held_again(search, *clocked)


def held_again(search: SearchContext, base: Refit, here: Refit) -> tuple[Refit, Refit]:
    """Return the nominal model and the hypothesis `here`, with those parameters held, and the records on their clocks, again that
    bring no evidence any more.

    A parameter that was set free may have stood for an effect that has been added since. base: the nominal model that `here` adds
    effects to.
    """
    return as_recorded(search, *_parameters_held_again(search, base, here))


def _parameters_held_again(search: SearchContext, base: Refit, here: Refit) -> tuple[Refit, Refit]:
    """Return both with those parameters held again that bring no evidence any more."""
    for f in (*search.held, *search.stated):
        if f.name not in here.problem.names or search.spent:
            continue
        fewer = _with_held(base, f)
        without = refit_again(fewer, here, here.placed)
        if not without.failure and evidence_between(without, here, Ruler.of(here), 1) <= search.options.named_bic:
            base, here = fewer, without
    return base, here


def _with_held(refit: Refit, parameter: FitParameter) -> Refit:
    """Return the nominal model with one parameter less among the free ones, at its given value."""
    at = refit.problem.names.index(parameter.name)
    free = tuple(f for f in refit.problem.free if f.name != parameter.name)
    held = FrozenMap({**refit.problem.held, parameter.name: parameter.given})
    return replace(refit, problem=replace(refit.problem, free=free, held=held), theta=np.delete(refit.theta, at))


def _with_free(refit: Refit, parameter: FitParameter) -> Refit:
    """Return the nominal model with one parameter more among the free ones, at the value that it was held at."""
    count, value = len(refit.problem.free), _value(refit, parameter)
    held = {n: v for n, v in refit.problem.held.items() if n != parameter.name}
    free = replace(parameter, start=float(np.clip(value, parameter.min, parameter.max)))
    problem = replace(refit.problem, free=(*refit.problem.free, free), held=FrozenMap(held))
    return replace(refit, problem=problem, theta=np.insert(refit.theta, count, free.start))


def _value(refit: Refit, parameter: FitParameter) -> float:
    return refit.problem.held.get(parameter.name, parameter.given)


def _most_wanted(search: SearchContext, here: Refit, held: Sequence[FitParameter]) -> FitParameter | None:
    """Return the held parameter with which chi2 falls most, to first order; None where it falls with none."""
    if not held:
        return None
    nominal = here.nominal()
    whole = np.column_stack([derivative(here, f, nominal.residual) for f in held])
    columns = nominal.projected(whole)
    power = np.sum(columns**2, axis=0)
    determined = power > LEAST_INDEPENDENT_POWER * np.sum(whole**2, axis=0)
    falls = np.where(determined, (columns.T @ nominal.residual) ** 2 / np.where(determined, power, 1.0), 0.0)
    k = int(np.argmax(falls))
    # In chi2 of the noise: of a misfit its own size is no measure of what may be left.
    return held[k] if falls[k] > search.options.named_bic else None


def derivative(here: Refit, parameter: FitParameter, residual: Array) -> Array:
    """Return (N,) the change of the whitened residual with a held parameter, by differences; 0 where it does not run.

    residual: (N,) with the parameter as it is held.
    """
    value = _value(here, parameter)
    extent = parameter.max - parameter.min
    step = DIFFERENCE_STEP * (abs(value) or (extent if np.isfinite(extent) else 1.0))
    held = FrozenMap({**here.problem.held, parameter.name: value + step})
    try:
        moved = replace(here.problem, held=held).blocks(here.theta)
    except SimulationError:
        return np.zeros_like(residual)
    return (np.concatenate([b.residual for b in moved]) - residual) / step


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


def as_recorded(search: SearchContext, base: Refit, here: Refit) -> tuple[Refit, Refit]:
    """Return the nominal model and the hypothesis `here` on the records as they are, unless their clocks still bring evidence."""
    off = clocks(search, here)
    if not off or search.spent:
        return base, here
    back = _refitted(base, here, search.records)
    if back is None:
        return base, here
    return back if _gain(back[1], here, len(off)) <= search.options.named_bic else (base, here)


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
