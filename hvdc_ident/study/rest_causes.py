"""Mistakes that show in several outputs of an experiment at once: two columns exchanged, an input in another unit or of
the other sign, the time in another unit."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from hvdc_ident.data import Array, Experiment, InputSignal
from hvdc_ident.errors import SteadyStateError
from hvdc_ident.fit.unknown import Free
from hvdc_ident.model import AnyModel, Model
from hvdc_ident.simulate.engine import engine
from hvdc_ident.simulate.model_simulator import ModelSimulator
from hvdc_ident.study.conversions import EXCHANGE_SHARE, LARGEST, Conversion, input_conversions
from hvdc_ident.study.rest_comparison import FINEST, Comparison, apart, freed, run_of

SCALE = math.log(1.0 / FINEST)
"""The range of a mismatch: its logarithm, from FINEST to 1."""
ANYTHING = 4.0 * math.log(LARGEST)
"""The range of an input's level against the model's: its logarithm, up and down, with either sign."""
SMALLEST_FACTOR = math.sqrt(2.0)
"""The smallest factor between two ways of counting a quantity (peak and rms); a smaller one is another operating point."""
POSITIVE = math.log(3.0)
"""Log odds from which evidence is positive (Kass, Raftery 1995): enough for a question, which is all that is asked."""


@dataclass(frozen=True)
class Cause:
    """What would explain several outputs of an experiment at once. channel: "input NAME", "time", or two outputs;
    suggestion: in a few words; text: in a sentence."""

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
    for inputs, prior, cause in _input_mistakes(simulator.model, e) if doubted else ():
        run = run_of(simulator, e.with_(inputs=e.inputs | inputs))
        if not isinstance(run, str):
            total = prior + sum(c.log_odds_by(Comparison.of(c.record, run[c.record.output])) for c in own)
            if total > best[0]:
                best = total, cause
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
                text = f"no time constant of the model lies between the sampling step and the record's length: is the time in {unit}?"
                best = total, Cause("time", f"in {unit}", text)
    return best[1]


def _misfits(comparisons: Sequence[Comparison]) -> dict[str, float]:
    """The smallest misfit of the movement by output, over the runs; of those that move."""
    return {c.record.output: min(m.misfit for m in c.movements) or FINEST for c in comparisons if c.movements}


def exchanged(own: Sequence[Comparison], named: Mapping[int, float], sure: float) -> dict[int, tuple[Cause, float]]:
    """By the id of a comparison: the two outputs of one experiment whose columns seem to be exchanged, with its log odds.

    own: of one experiment. named: log odds of what each suggests by itself, by id. Both outputs have to differ, and each
    has to gain by the exchange more than the choice costs, ln 2, as by a conversion.
    """
    off = [c for c in own if c.differs(sure) or c.is_moved_otherwise(sure)]
    tried = []
    for a, b in combinations(off, 2):
        one, other = Comparison.of(a.record, b.simulated), Comparison.of(b.record, a.simulated)
        if a.is_matched_by(one) and b.is_matched_by(other):
            gain = a.log_odds_by(one) + b.log_odds_by(other) - 2.0 * math.log(2.0)
            total = gain + math.log(EXCHANGE_SHARE / math.comb(len(own), 2))
            if total > max(POSITIVE, named.get(id(a), 0.0) + named.get(id(b), 0.0)):
                tried.append((total, a, b))
    found: dict[int, tuple[Cause, float]] = {}
    for total, a, b in sorted(tried, key=lambda line: -line[0]):
        if id(a) not in found and id(b) not in found:
            cause = _exchange_cause(a, b)
            found |= {id(c): (cause, total / 2.0) for c in (a, b)}
    return found


def _exchange_cause(a: Comparison, b: Comparison) -> Cause:
    one, other = a.record.output, b.record.output
    text = f"{one} moves as the model's {other} does and {other} as its {one}"
    if None not in (a.recorded, b.recorded, a.model, b.model):
        text = (
            f"before the event {one} reads {a.recorded:+.4g} and {other} {b.recorded:+.4g}, "
            f"the model rests at {a.model:+.4g} and {b.model:+.4g}"
        )
    return Cause(f"{one}, {other}", "columns exchanged", f"{text}: are the columns of {one} and {other} exchanged?")


def _input_mistakes(model: AnyModel, e: Experiment) -> Iterable[tuple[Mapping[str, InputSignal], float, Cause]]:
    """The recorded inputs with what may have been done to them undone, the log of its prior odds, and what it is called.

    A level that comes nearer to the model's own once a large factor, or an exchange of two columns, is undone speaks for
    that as a level of an output does; that an input's sign differs from the model's speaks for nothing. A factor that is
    no known conversion is tried too, so large that it brings the level to the model's own: of that the level tells nothing.
    """
    recorded = [n for n in e.inputs if n in model.inputs and n not in e.drive]
    for name in recorded:
        signal, own = e.inputs[name], model.inputs[name].value
        level = float(signal.values[0])
        known = input_conversions(model.inputs[name].unit)
        for c in known:
            prior = math.log(c.prior / len(recorded))
            if c.factor > 0.0 and own and level:
                speaks = _nearer_level(level, c.undone(level), own)
                if speaks is None:
                    continue
                prior += speaks
            yield {name: _scaled(signal, c)}, prior, _input_cause(model, name, signal, c)
        if own * level > 0.0 and abs(math.log(level / own)) > math.log(SMALLEST_FACTOR):
            c = Conversion("per unit, or on another base", level / own)
            prior = math.log(known[-1].prior / len(recorded))
            yield {name: _scaled(signal, c)}, prior, _input_cause(model, name, signal, c)
    for a, b in combinations(recorded, 2):
        one, other = e.inputs[a], e.inputs[b]
        levels, owns = (float(one.values[0]), float(other.values[0])), (model.inputs[a].value, model.inputs[b].value)
        speak = [_nearer_level(levels[0], levels[1], owns[0]), _nearer_level(levels[1], levels[0], owns[1])]
        prior = math.log(EXCHANGE_SHARE / math.comb(len(recorded), 2))
        prior += sum(s for s in speak if s is not None) if None not in speak else 0.0
        yield {a: other, b: one}, prior, _input_exchange(a, b, levels, owns)


def _nearer_level(level: float, undone: float, own: float) -> float | None:
    """The log odds by which an input's level speaks for what was undone; None where that comes no nearer to the model's."""
    zero = FINEST * abs(own)
    if not zero:
        return None
    distance = max(apart(undone, own, zero), FINEST)
    return math.log(ANYTHING / (2.0 * SCALE * distance)) if distance < apart(level, own, zero) else None


def input_after_failure(simulator: ModelSimulator, e: Experiment) -> list[str]:
    """A line for the input whose level, as recorded, leaves the model without a run, where undoing a unit gives one."""
    found = []
    for inputs, prior, cause in _input_mistakes(simulator.model, e):
        if prior > 0.0 and not isinstance(run_of(simulator, e.with_(inputs=e.inputs | inputs)), str):
            found.append((prior, f"{e.name}: {cause.text}"))
    return [max(found)[1]] if found else []


def _input_exchange(a: str, b: str, levels: tuple[float, float], owns: tuple[float, float]) -> Cause:
    text = (
        f"before the event input {a} reads {levels[0]:.4g} and {b} {levels[1]:.4g}, the model's values are {owns[0]:.4g} and "
        f"{owns[1]:.4g}: are the columns of {a} and {b} exchanged?"
    )
    return Cause(f"input {a}", f"columns of {a} and {b} exchanged", text)


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
