"""Mistakes that show in all outputs of an experiment at once: an input in another unit or of the other sign, the time in
another unit."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hvdc_ident.errors import SteadyStateError
from hvdc_ident.experiment import Experiment, InputSignal
from hvdc_ident.fit.unknown import Free
from hvdc_ident.model.definition import Model
from hvdc_ident.model.external import AnyModel
from hvdc_ident.simulate import engine
from hvdc_ident.simulate.model_simulator import ModelSimulator
from hvdc_ident.study.conversions import LARGEST, Conversion, input_conversions
from hvdc_ident.study.rest_comparison import FINEST, NONE, Comparison, apart, freed, run_of
from hvdc_ident.trajectory import Array

SCALE = math.log(1.0 / FINEST)
"""The range of a mismatch: its logarithm, from FINEST to 1."""
ANYTHING = 4.0 * math.log(LARGEST)
"""The range of an input's level against the model's: its logarithm, up and down, with either sign."""
POSITIVE = math.log(3.0)
"""Log odds from which evidence is positive (Kass, Raftery 1995): enough for a question, which is all that is asked."""


@dataclass(frozen=True)
class Cause:
    """What would explain all outputs of an experiment at once. channel: "input NAME" or "time"; suggestion: in a few words;
    text: in a sentence."""

    channel: str
    suggestion: str
    text: str


def common_cause(
    simulator: ModelSimulator,
    e: Experiment,
    candidates: Sequence[Free],
    own: Sequence[Comparison],
    odds: float,
    doubted: bool,
) -> Cause | None:
    """A recorded input in another unit, or the time in another, where that explains more than what the outputs suggest.

    doubted: whether an output differs at all; else only the time is asked, which moves no level. It is asked where none
    of the model's modes can show in the record; such a model is no model of it, so the prior odds are even, and the
    misfit of the movement decides.
    """
    best: tuple[float, Cause | None] = (max(odds, POSITIVE), None)
    for name, signal, c, prior in _input_mistakes(simulator.model, e) if doubted else ():
        run = run_of(simulator, e.with_(inputs=e.inputs | {name: _scaled(signal, c)}))
        if not isinstance(run, str):
            total = prior + _gain(own, run)
            if total > best[0]:
                best = total, _input_cause(simulator.model, name, signal, c)
    mistakes = _time_mistakes(simulator.model, e)
    before = _misfits(freed(simulator, e, candidates, own)) if mistakes else {}
    for factor, unit in mistakes:
        slower = _slower(e, factor)
        run = run_of(simulator, slower)
        if not isinstance(run, str):
            scaled = freed(simulator, slower, candidates, [Comparison.of(c.record, run[c.record.output]) for c in own])
            after = _misfits(scaled)
            total = sum(math.log(before[o] / after[o]) for o in before if o in after) - math.log(len(mistakes))
            if total > best[0]:
                text = f"none of the model's modes lies between a row and the record's length: is the time in {unit}?"
                best = total, Cause("time", f"in {unit}", text)
    return best[1]


def _misfits(comparisons: Sequence[Comparison]) -> dict[str, float]:
    """The smallest misfit of the movement by output, over the runs; of those that move."""
    return {c.record.output: min(m.misfit for m in c.movements) or FINEST for c in comparisons if c.movements}


def _gain(own: Sequence[Comparison], run: Mapping[str, Array]) -> float:
    """The log odds of another run of the model against the given one, over all outputs of an experiment."""
    total = 0.0
    for c in own:
        other = Comparison.of(c.record, run[c.record.output])
        total += math.log(c.level_mismatch(NONE) / other.level_mismatch(NONE))
        total += math.log(c.movement_mismatch(NONE) / other.movement_mismatch(NONE))
    return total


def _input_mistakes(model: AnyModel, e: Experiment) -> Iterable[tuple[str, InputSignal, Conversion, float]]:
    """The recorded inputs with what may have been done to them, and the log of its prior odds.

    A level that comes nearer to the model's own once a large factor is undone speaks for that as a level of an output
    does; that an input's sign differs from the model's speaks for nothing.
    """
    recorded = [n for n in e.inputs if n in model.inputs and n not in e.drive]
    for name in recorded:
        signal, own = e.inputs[name], model.inputs[name].value
        level = float(signal.values[0])
        for c in input_conversions(model.inputs[name].unit):
            prior = math.log(c.prior / len(recorded))
            if c.factor > 0.0 and own and level:
                zero = FINEST * abs(own)
                distance = max(apart(c.undone(level), own, zero), FINEST)
                if distance >= apart(level, own, zero):
                    continue
                prior += math.log(ANYTHING / (2.0 * SCALE * distance))
            yield name, signal, c, prior


def input_after_failure(simulator: ModelSimulator, e: Experiment) -> list[str]:
    """A line for the input whose level, as recorded, leaves the model without a run, where undoing a unit gives one."""
    found = []
    for name, signal, c, prior in _input_mistakes(simulator.model, e):
        if prior > 0.0 and not isinstance(
            run_of(simulator, e.with_(inputs=e.inputs | {name: _scaled(signal, c)})), str
        ):
            found.append((prior, f"{e.name}: {_input_cause(simulator.model, name, signal, c).text}"))
    return [max(found)[1]] if found else []


def _input_cause(model: AnyModel, name: str, signal: InputSignal, c: Conversion) -> Cause:
    level, own = float(signal.values[0]), model.inputs[name].value
    text = f"input {name} reads {level:.4g} before the event, the model's value is {own:.4g}: {c.name}?"
    if c.factor == -1.0:
        text = (
            f"with the other sign of the recorded input {name} the model comes to the recorded outputs: sign of {name}?"
        )
    return Cause(f"input {name}", c.name, text)


def _scaled(signal: InputSignal, c: Conversion) -> InputSignal:
    return InputSignal(signal.times, (signal.values - c.shift) / c.factor, signal.breaks)


TIMES = ((1e-3, "ms"), (1e-6, "us"), (60.0, "min"), (3600.0, "h"))


def _time_mistakes(model: AnyModel, e: Experiment) -> list[tuple[float, str]]:
    """Units of time other than s in which a mode of the model would lie between a row and the record's length; none where
    one does as it is. An FMU does not tell its modes."""
    steps = np.diff(np.unique(e.time))
    constants = _time_constants(model, e)
    if not steps.size or not constants.size:
        return []
    shortest, longest = float(np.median(steps)), float(np.ptp(e.time))

    def seen(factor: float) -> bool:
        return bool(((constants > factor * shortest) & (constants < factor * longest)).any())

    return [] if seen(1.0) else [(f, unit) for f, unit in TIMES if seen(f)]


def _time_constants(model: AnyModel, e: Experiment) -> Array:
    """(k,) 1/|eigenvalue| of the model at its rest before the event, s; those of integrators are left out."""
    if not isinstance(model, Model) or not model.states or e.drive:
        return np.empty(0)
    code = engine(model, (), e.outputs)
    given = {n: e.values.get(n, i.value) for n, i in model.inputs.items()}
    u = np.array([float(e.inputs[n].values[0]) if n in e.inputs else v for n, v in given.items()])
    p = np.array([q.value for q in model.parameters.values()])
    try:
        y, w = code.start(p, u, float(e.time[0]))
    except SteadyStateError:
        return np.empty(0)
    jac, nx = code.jacobian(p, y, w), len(model.states)
    a = jac[:nx, :nx]
    if jac.shape[0] > nx:
        a = a - jac[:nx, nx:] @ np.linalg.lstsq(jac[nx:, nx:], jac[nx:, :nx], rcond=None)[0]
    rates = np.abs(np.linalg.eigvals(a))
    return np.asarray(1.0 / rates[rates > 1e-9 * rates.max(initial=0.0)])


def _slower(e: Experiment, factor: float) -> Experiment:
    """The experiment with its time in another unit."""
    inputs = {n: InputSignal(factor * s.times, s.values, factor * s.breaks) for n, s in e.inputs.items()}
    window = None if e.window is None else (factor * e.window[0], factor * e.window[1])
    measured = None if e.measured is None else replace(e.measured, time=factor * e.time)
    event = None if e.event is None else factor * e.event
    return e.with_(time=factor * e.time, inputs=inputs, window=window, measured=measured, event=event)
