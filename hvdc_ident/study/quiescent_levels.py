"""Recorded rest against model rest: a flipped sign, a wrong unit or base, an offset, told before anything is fitted.

Each recording is compared with the model at its given values in two respects: the level before the event, and the
movement after it (the slope of the recorded against the simulated movement). Both are known within what the noise of
the recording leaves and within what the candidates can do inside their bounds: the model is run at either end of each
candidate's range too, and at the corners that raise and lower a level most.

A conversion (`conversions`) is weighed against "the model is off here" as hypotheses are: after it is undone, a level or
a movement is left with a mismatch m on a logarithmic scale. How good the model is is not known, so the mismatch has no
scale of its own: its density is 1/(m ln(1/FINEST)) from FINEST to 1, and the odds gain m(as recorded)/m(undone), by the
level and by the movement, times the conversion's prior. A factor that is no known conversion is weighed too: a wrong
gain of the model shows in level and movement alike. Whatever is named has to match the
level by itself, or else the movement without contradicting the level. An input in another unit is undone by running the
model with it undone.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import norm

from hvdc_ident.data import Array, Experiment, InputSignal
from hvdc_ident.errors import SteadyStateError
from hvdc_ident.fit.fit_parameter import FitParameter
from hvdc_ident.model import AnyModel, Model
from hvdc_ident.simulate import ModelSimulator, engine_of
from hvdc_ident.study.level_comparison import (
    EXCHANGE_SHARE,
    FINEST,
    LARGEST,
    NONE,
    Comparison,
    Conversion,
    RecordedOutput,
    apart,
    conversions,
    freed,
    input_conversions,
    run_of,
)
from hvdc_ident.text import listed

if TYPE_CHECKING:
    from hvdc_ident.study.study import Study


GAIN_SHARE = 0.5
"""Prior odds of a model that is off by one factor in level and movement, against one that is off in both by chance."""
PLAIN = ("offset", "difference")
"""Suggestions where nothing more is known than that the levels differ."""
FALSE_ALARMS = 1e-3
"""Probability that noise alone makes one of a study's levels differ."""


@dataclass(frozen=True)
class QuiescentLevel:
    """One output of one experiment before the event, in the output's unit; None where it is not known.

    recorded: the mean of the recorded rows before the event; error: its standard error. model: the model's at its given
    values; low, high: what it can be with the candidates within their bounds. difference: recorded - model;
    noise_units: the same over the noise of a single row. slope: the recorded movement over the simulated.
    channel: what the suggestion is about: the output, two outputs ("P, Q"), "input NAME" or "time". factor: what the recording seems to be
    multiplied by; suggestion: what that is, in a few words; text: in a sentence, empty where there is nothing to say.
    """

    experiment: str
    output: str
    unit: str = ""
    recorded: float | None = None
    error: float | None = None
    model: float | None = None
    low: float | None = None
    high: float | None = None
    difference: float | None = None
    noise_units: float | None = None
    slope: float | None = None
    channel: str = ""
    factor: float | None = None
    suggestion: str | None = None
    text: str = ""


@dataclass(frozen=True)
class QuiescentLevels:
    """The comparison of every recording with the model. remarks: what could not be compared, and why."""

    levels: tuple[QuiescentLevel, ...]
    remarks: tuple[str, ...] = ()
    failures: tuple[str, ...] = ()

    @property
    def lines(self) -> list[str]:
        """Sentences to be read before anything is fitted; what several experiments show alike is told once."""
        groups: dict[tuple[str, str | None, str], list[QuiescentLevel]] = {}
        for level in self.levels:
            if level.text:
                named = level.suggestion if level.suggestion not in PLAIN else ""
                groups.setdefault((level.channel, named, f"{level.factor or 0:.2g}"), []).append(level)
        return [*self.failures, *map(_line, groups.values())]

    def to_list(self) -> list[dict[str, Any]]:
        """One table an output and experiment, as the results keep them; failures are tables without an output."""
        failed = [{"experiment": None, "output": None, "text": t} for t in (*self.failures, *self.remarks)]
        return [*(asdict(level) for level in self.levels), *failed]


def _line(alike: Sequence[QuiescentLevel]) -> str:
    first = max(alike, key=lambda level: abs(level.noise_units or 0.0))
    others = list(dict.fromkeys(level.experiment for level in alike if level.experiment != first.experiment))
    shown = listed(others[:3]) if len(others) <= 3 else f"{len(others)} more experiments"
    return f"{first.experiment}: {first.text}" + (f" (and so in {shown})" if others else "")


def quiescent_levels(study: Study) -> QuiescentLevels:
    """The comparison for a study at its given values."""
    return compare_levels(study.model, study.experiments, tuple(study.candidates.values()))


def compare_levels(
    model: AnyModel, experiments: Sequence[Experiment], candidates: Sequence[FitParameter] = ()
) -> QuiescentLevels:
    """The recorded levels and movements of every experiment against the model's, at the model's own values.

    candidates: what may be estimated; what they can move within their bounds is no evidence against a recording. Runs
    every experiment once, and where a recording differs some more times.
    """
    simulator = ModelSimulator(model)
    levels: dict[tuple[str, str], QuiescentLevel] = {}
    remarks: list[str] = []
    failures: list[str] = []
    comparisons: list[Comparison] = []
    for e in (e for e in experiments if e.outputs):
        records = [RecordedOutput.of(e, o, model.outputs[o].unit, experiments) for o in e.outputs]
        levels |= {(e.name, r.output): _recorded(r) for r in records}
        if not records[0].before.any():
            when = "its event is not known" if e.event is None else "no row stands before its event"
            remarks.append(f"{e.name}: {when}, so no recorded rest is compared with the model's")
        run = run_of(simulator, e)
        if isinstance(run, str):
            failures.append(f"{e.name}: not compared with the model's rest: {run}")
            failures += input_after_failure(simulator, e)
            continue
        comparisons += [Comparison.of(r, run[r.output]) for r in records]
    if not comparisons:
        return QuiescentLevels(tuple(levels.values()), tuple(remarks), tuple(failures))
    sure = float(norm.isf(FALSE_ALARMS / 2.0 / len(comparisons)))
    by_experiment = {e.name: e for e in experiments}
    doubted = {c.record.experiment for c in comparisons if c.differs(sure) or c.is_moved_otherwise(sure)}
    judged: list[Comparison] = []
    for name in dict.fromkeys(c.record.experiment for c in comparisons):
        own = [c for c in comparisons if c.record.experiment == name]
        judged += freed(simulator, by_experiment[name], candidates, own) if name in doubted else own
    for level in _judged(simulator, by_experiment, candidates, judged, sure):
        levels[level.experiment, level.output] = level
    return QuiescentLevels(tuple(levels.values()), tuple(remarks), tuple(failures))


def _judged(
    simulator: ModelSimulator,
    experiments: Mapping[str, Experiment],
    candidates: Sequence[FitParameter],
    comparisons: Sequence[Comparison],
    sure: float,
) -> list[QuiescentLevel]:
    """Every level with what it suggests."""
    model = simulator.model
    named: dict[int, tuple[Conversion, float]] = {}
    for output in dict.fromkeys(c.record.output for c in comparisons):
        own = [c for c in comparisons if c.record.output == output]
        named |= _named(own, conversions(model.outputs[output].unit, model.parameters))
    found = []
    for name in dict.fromkeys(c.record.experiment for c in comparisons):
        own = [c for c in comparisons if c.record.experiment == name]
        alone = {id(c): named[id(c)][1] for c in own if id(c) in named}
        swapped = exchanged(own, alone, sure)
        odds = sum((alone | {k: gain for k, (_, gain) in swapped.items()}).values())
        doubted = any(id(c) in named or c.differs(sure) for c in own)
        cause = common_cause(simulator, experiments[name], candidates, own, odds, doubted)
        found += [
            _told(c, named.get(id(c), (None, 0.0))[0], cause or swapped.get(id(c), (None, 0.0))[0], sure) for c in own
        ]
    return found


def _named(own: Sequence[Comparison], known: Sequence[Conversion]) -> dict[int, tuple[Conversion, float]]:
    """The conversion of each comparison of one output, where one is more likely than not, with its log odds.

    One mistake may have been made in all experiments, in some or in one: each that takes part has to gain by it more than
    the choice costs, ln 2.
    """
    found: dict[int, tuple[Conversion, float]] = {}
    rest = list(own)
    while rest:
        tried = []
        for c in (*known, *(f for r in rest for f in _free_factor(r))):
            gains = [(r, r.log_odds(c) - math.log(2.0)) for r in rest if r.is_matched(c)]
            members = [(r, g) for r, g in gains if g > 0.0]
            tried.append((math.log(c.prior) + sum(g for _, g in members), c, members))
        # A unit is suspected only where that is clearly more likely than a gain of the model.
        total, best, members = max(tried, key=lambda line: line[0] + (POSITIVE if line[1].gain else 0.0))
        if total <= POSITIVE:
            break
        found |= {id(r): (best, total / len(members)) for r, _ in members}
        rest = [r for r in rest if id(r) not in found]
    return found


def _free_factor(c: Comparison) -> list[Conversion]:
    """The factor between the levels, where that is no known conversion.

    A gain of the model that is wrong makes level and movement wrong alike. It explains nothing of the level it is taken
    from, so that level's gain is taken off its prior, and what is left for it is the movement, and the other experiments.
    """
    if c.recorded is None or not c.movements or c.model is None or abs(c.model) <= 3.0 * c.error or not c.recorded:
        return []
    chosen = Conversion("", c.recorded / c.model)
    prior = GAIN_SHARE * min(1.0, c.level_mismatch(chosen) / c.level_mismatch(NONE))
    cause = "a gain of the model, or another base or unit"
    cause = f"the sign, and {cause}" if chosen.factor < 0.0 else cause
    name = f"a factor of {chosen.factor:.3g} in level and movement: {cause}"
    return [replace(chosen, name=name, prior=prior, gain=True)]


def _told(c: Comparison, conversion: Conversion | None, cause: Cause | None, sure: float) -> QuiescentLevel:
    """The level with what is said of it: the conversion, the common cause, or the plain difference."""
    first = c.movements[0] if c.movements else None
    level = replace(_recorded(c.record), slope=first.slope if first else None)
    if c.recorded is not None and c.model is not None:
        difference = c.recorded - c.model
        level = replace(
            level, error=c.error, model=c.model, low=min(c.levels), high=max(c.levels), difference=difference,
            noise_units=difference / c.noise if c.noise else None,
        )  # fmt: skip
    if cause is not None:
        return replace(level, channel=cause.channel, suggestion=cause.suggestion, text=cause.text)
    level = replace(level, channel=c.record.output)
    if conversion is not None:
        text = f"{_reading(c, conversion)}: {conversion.name}?"
        suggestion = "factor" if conversion.gain else conversion.name
        return replace(level, factor=conversion.factor, suggestion=suggestion, text=text)
    if not c.differs(sure):
        return level
    assert level.difference is not None
    text = f"{_reading(c, NONE)}: a difference of {_signed(level.difference, c.record.unit)}{_in_noise(c)}"
    if len(c.levels) > 1:
        text += ", more than the candidates can make good within their bounds"
    follows = first is not None and first.error < 0.5 and abs(first.slope - 1.0) < max(2.0 * first.error, FINEST)
    if follows:
        return replace(level, suggestion=PLAIN[0], text=f"{text}; it moves as the model does: an offset?")
    return replace(level, suggestion=PLAIN[1], text=f"{text}: another operating point, or part of the model?")


def _reading(c: Comparison, conversion: Conversion) -> str:
    """The two levels, or the two movements where the levels do not tell."""
    o, unit = c.record.output, c.record.unit
    if (
        c.recorded is not None
        and c.model is not None
        and (conversion is NONE or abs(c.model) > 3.0 * c.error / abs(conversion.factor))
    ):
        digits = _digits(c.recorded, c.recorded - c.model)
        recorded, model = _signed(c.recorded, "", digits), _signed(c.model, unit, digits)
        return f"before the event {o} reads {recorded}, the model rests at {model}"
    slope = c.movements[0].slope
    return f"{o} moves {slope:.3g} times as far as the model does"


def _recorded(record: RecordedOutput) -> QuiescentLevel:
    """Return the levels as far as they are known without the model."""
    mean = float(record.values[record.before].mean()) if record.before.any() else None
    return QuiescentLevel(record.experiment, record.output, record.unit, recorded=mean)


def _digits(value: float, difference: float) -> int:
    """As many as show a difference in two digits, four at least."""
    ratio = abs(value / difference) if difference else 1.0
    return max(4, 2 + math.ceil(math.log10(max(ratio, 1.0))))


def _signed(value: float, unit: str, digits: int = 4) -> str:
    return f"{value:+.{digits}g} {'' if unit in ('', '1', '-') else unit}".rstrip()


def _in_noise(c: Comparison) -> str:
    if c.record.deterministic or not c.noise or c.recorded is None or c.model is None:
        return ""
    return f", {abs(c.recorded - c.model) / c.noise:.3g} times the noise"


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
    candidates: Sequence[FitParameter],
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
    code = engine_of(model, (), e.outputs)
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
