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
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING, Any, Literal

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
    UNCHANGED,
    Comparison,
    Conversion,
    RecordedOutput,
    conversions,
    input_conversions,
    log_distance,
    outputs_of,
    with_candidate_runs,
)
from hvdc_ident.text import figures, listed

if TYPE_CHECKING:
    from hvdc_ident.study.study import Study


GAIN_SHARE = 0.5
"""Prior odds of a model that is off by one factor in level and movement, against one that is off in both by chance."""
PLAIN = ("offset", "difference")
"""Suggestions where nothing more is known than that the levels differ."""
FALSE_ALARMS = 1e-3
"""Probability that noise alone makes one of a study's levels differ."""
SCALE = math.log(1.0 / FINEST)
"""The range of a mismatch: its logarithm, from FINEST to 1."""
ANYTHING = 4.0 * math.log(LARGEST)
"""The range of an input's level against the model's: its logarithm, up and down, with either sign."""
SMALLEST_FACTOR = math.sqrt(2.0)
"""The smallest factor between two ways of counting a quantity (peak and rms); a smaller one is another operating point."""
POSITIVE = math.log(3.0)
"""Log odds from which evidence is positive (Kass, Raftery 1995): enough for a question, which is all that is asked."""
TIMES = ((1e-3, "ms"), (1e-6, "us"), (60.0, "min"), (3600.0, "h"))
"""Units of time other than s that a recording may be in."""


@dataclass(frozen=True)
class QuiescentLevel:
    """One output of one experiment before the event, in the output's unit; None where it is not known.

    recorded: the mean of the recorded rows before the event; error: its standard error. model: the model's at its given
    values; low, high: what it can be with the candidates within their bounds. difference: recorded - model;
    noise_units: the same over the noise of a single row. slope: the recorded movement over the simulated.
    channel: what the suggestion is about: the output, two outputs ("P, Q"), "input NAME" or "time". factor: what the
    recording seems to be multiplied by; suggestion: what that is, in a few words; text: in a sentence, empty where there
    is nothing to say.
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

    @property
    def is_mistake(self) -> bool:
        """True where the recording seems wrong, not the model: a positive factor may as well be a gain of the model."""
        if self.suggestion is None or self.suggestion in PLAIN:
            return False
        return self.suggestion != "factor" or (self.factor or 0.0) < 0.0

    @classmethod
    def of(cls, record: RecordedOutput) -> QuiescentLevel:
        """Return the level as far as it is known without the model."""
        mean = float(record.values[record.before].mean()) if record.before.any() else None
        return cls(record.experiment, record.output, record.unit, recorded=mean)


@dataclass(frozen=True)
class QuiescentLevels:
    """The comparison of every recording with the model. remarks: what could not be compared, and why."""

    levels: tuple[QuiescentLevel, ...]
    remarks: tuple[str, ...] = ()
    failures: tuple[str, ...] = ()

    @property
    def lines(self) -> list[str]:
        """Sentences to be read before anything is fitted; what several experiments show alike is told once."""
        return [*self.failures, *(line for _, line in self._told())]

    @property
    def mistakes(self) -> list[str]:
        """Those of the lines that suspect a mistake of the recording: its sign, unit or time, or columns exchanged."""
        return [line for first, line in self._told() if first.is_mistake]

    def _told(self) -> Iterator[tuple[QuiescentLevel, str]]:
        """Yield a level of each group that is told alike, and the line."""
        groups: dict[tuple[str, str | None, str], list[QuiescentLevel]] = {}
        for level in self.levels:
            if level.text:
                suggestion = level.suggestion if level.suggestion not in PLAIN else ""
                groups.setdefault((level.channel, suggestion, f"{level.factor or 0:.2g}"), []).append(level)
        for group in groups.values():
            first = max(group, key=lambda level: abs(level.noise_units or 0.0))
            others = list(dict.fromkeys(level.experiment for level in group if level.experiment != first.experiment))
            shown = listed(others[:3]) if len(others) <= 3 else f"{len(others)} more experiments"
            yield first, f"{first.experiment}: {first.text}" + (f" (and so in {shown})" if others else "")

    def to_list(self) -> list[dict[str, Any]]:
        """Return one table an output and experiment, as the results keep them; failures are tables without an output."""
        failed = [{"experiment": None, "output": None, "text": t} for t in (*self.failures, *self.remarks)]
        return [*(asdict(level) for level in self.levels), *failed]


@dataclass(frozen=True)
class Cause:
    """One mistake that would explain several outputs of an experiment at once.

    channel: "input NAME", "time", or two outputs. suggestion: the mistake in a few words; text: in a sentence.
    """

    channel: str
    suggestion: str
    text: str


def quiescent_levels(study: Study) -> QuiescentLevels:
    """Return the comparison for a study at its given values."""
    return compare_levels(study.model, study.experiments, tuple(study.candidates.values()))


def compare_levels(
    model: AnyModel, experiments: Sequence[Experiment], candidates: Sequence[FitParameter] = ()
) -> QuiescentLevels:
    """Return the recorded levels and movements of every experiment against the model's, at the model's own values.

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
        levels |= {(e.name, r.output): QuiescentLevel.of(r) for r in records}
        if not records[0].before.any():
            when = "its event is not known" if e.event is None else "no row stands before its event"
            remarks.append(f"{e.name}: {when}, so no recorded rest is compared with the model's")
        run = outputs_of(simulator, e)
        if isinstance(run, str):
            failures.append(f"{e.name}: not compared with the model's rest: {run}")
            failures += _input_after_failure(simulator, e)
            continue
        comparisons += [Comparison.of(r, run[r.output]) for r in records]
        failures += [f"{e.name}: {line}" for r in records if (line := _run_away(r, run[r.output]))]
    if comparisons:
        quantile = float(norm.isf(FALSE_ALARMS / 2.0 / len(comparisons)))
        by_name = {e.name: e for e in experiments}
        for level in _judged(simulator, by_name, candidates, comparisons, quantile):
            levels[level.experiment, level.output] = level
    return QuiescentLevels(tuple(levels.values()), tuple(remarks), tuple(failures))


def _run_away(record: RecordedOutput, simulated: Array) -> str:
    """Return in words that the model grows without bound where the recording does not; empty where it stays near it.

    No two units of one quantity that are confused lie further apart than LARGEST.
    """
    recorded = record.values[np.isfinite(record.values)]
    bound = float(np.abs(recorded).max(initial=0.0))
    largest = float(np.abs(simulated).max(initial=0.0))
    if not bound or largest <= LARGEST * bound:
        return ""
    unit = f" {record.unit}" if record.unit else ""
    return (
        f"{record.output} of the model runs away to {largest:.3g}{unit} where the recording stays within {bound:.3g}{unit}: "
        "is a sign in the model, or a value, wrong?"
    )


def _judged(
    simulator: ModelSimulator,
    experiments: Mapping[str, Experiment],
    candidates: Sequence[FitParameter],
    comparisons: Sequence[Comparison],
    quantile: float,
) -> Iterator[QuiescentLevel]:
    """Yield every level with what it suggests. quantile: standard errors from which a difference is no chance."""
    ranged: list[Comparison] = []
    for name, group in _by("experiment", comparisons).items():
        doubted = any(c.differs(quantile) or c.moves_otherwise(quantile) for c in group)
        ranged += with_candidate_runs(simulator, experiments[name], candidates, group) if doubted else group
    model = simulator.model
    likely: dict[Comparison, tuple[Conversion, float]] = {}
    for output, group in _by("output", ranged).items():
        likely |= _likely_conversions(group, conversions(model.outputs[output].unit, model.parameters))
    for name, group in _by("experiment", ranged).items():
        odds = {c: likely[c][1] for c in group if c in likely}
        exchanged = _exchanged(group, odds, quantile)
        total = sum((odds | {c: gain for c, (_, gain) in exchanged.items()}).values())
        differs = any(c in likely or c.differs(quantile) for c in group)
        cause = _common_cause(simulator, experiments[name], candidates, group, total, differs)
        for c in group:
            conversion = likely[c][0] if c in likely else None
            yield _level(c, conversion, cause or (exchanged[c][0] if c in exchanged else None), quantile)


def _by(key: Literal["experiment", "output"], comparisons: Iterable[Comparison]) -> dict[str, list[Comparison]]:
    groups: dict[str, list[Comparison]] = {}
    for c in comparisons:
        groups.setdefault(getattr(c.record, key), []).append(c)
    return groups


def _likely_conversions(
    comparisons: Sequence[Comparison], known: Sequence[Conversion]
) -> dict[Comparison, tuple[Conversion, float]]:
    """Return the conversion of each comparison of one output, where one is more likely than not, with its log odds.

    One mistake may have been made in all experiments, in some or in one: each that takes part has to gain by it more than
    the choice costs, ln 2.
    """
    found: dict[Comparison, tuple[Conversion, float]] = {}
    rest = list(comparisons)
    while rest:
        tried = []
        for conversion in (*known, *(f for c in rest if (f := _free_factor(c)) is not None)):
            gains = {c: c.log_odds(conversion) - math.log(2.0) for c in rest if c.is_matched(conversion)}
            members = {c: gain for c, gain in gains.items() if gain > 0.0}
            tried.append((math.log(conversion.prior) + sum(members.values()), conversion, members))
        # A unit is suspected only where that is clearly more likely than a gain of the model.
        total, best, members = max(tried, key=lambda line: line[0] + (POSITIVE if line[1].gain else 0.0))
        if total <= POSITIVE:
            break
        found |= {c: (best, total / len(members)) for c in members}
        rest = [c for c in rest if c not in found]
    return found


def _free_factor(c: Comparison) -> Conversion | None:
    """Return the factor between the levels, where that is no known conversion; None where there is none.

    A gain of the model that is wrong makes level and movement wrong alike. It explains nothing of the level it is taken
    from, so that level's gain is taken off its prior, and what is left for it is the movement, and the other experiments.
    """
    if c.recorded is None or not c.movements or c.model is None or abs(c.model) <= 3.0 * c.error or not c.recorded:
        return None
    factor = Conversion("", c.recorded / c.model)
    prior = GAIN_SHARE * min(1.0, c.level_mismatch(factor) / c.level_mismatch(UNCHANGED))
    cause = "a gain of the model, or another base or unit"
    cause = f"the sign, and {cause}" if factor.factor < 0.0 else cause
    name = f"a factor of {factor.factor:.3g} in level and movement: {cause}"
    return replace(factor, name=name, prior=prior, gain=True)


def _level(c: Comparison, conversion: Conversion | None, cause: Cause | None, quantile: float) -> QuiescentLevel:
    """Return the level with what is said of it: the conversion, the common cause, or the plain difference."""
    first = c.movements[0] if c.movements else None
    level = replace(QuiescentLevel.of(c.record), slope=first.slope if first else None, channel=c.record.output)
    if c.recorded is not None and c.model is not None:
        difference = c.recorded - c.model
        level = replace(
            level, error=c.error, model=c.model, low=min(c.levels), high=max(c.levels), difference=difference,
            noise_units=difference / c.noise if c.noise else None,
        )  # fmt: skip
    if cause is not None:
        return replace(level, channel=cause.channel, suggestion=cause.suggestion, text=cause.text)
    if conversion is not None:
        text = f"{_reading(c, conversion)}: {conversion.name}?"
        suggestion = "factor" if conversion.gain else conversion.name
        return replace(level, factor=conversion.factor, suggestion=suggestion, text=text)
    if not c.differs(quantile):
        return level
    assert level.difference is not None
    text = f"{_reading(c, UNCHANGED)}: a difference of {_signed(level.difference, c.record.unit)}"
    if level.noise_units is not None and not c.record.deterministic:
        text += f", {figures(abs(level.noise_units), 3)} times the noise"
    if len(c.levels) > 1:
        text += ", more than the candidates can make good within their bounds"
    follows = first is not None and first.error < 0.5 and abs(first.slope - 1.0) < max(2.0 * first.error, FINEST)
    if follows:
        return replace(level, suggestion=PLAIN[0], text=f"{text}; it moves as the model does: an offset?")
    return replace(level, suggestion=PLAIN[1], text=f"{text}: another operating point, or part of the model?")


def _reading(c: Comparison, conversion: Conversion) -> str:
    """Return the two levels in words, or the two movements where the levels do not tell."""
    output = c.record.output
    if (
        c.recorded is None
        or c.model is None
        or not (conversion is UNCHANGED or abs(c.model) > 3.0 * c.error / abs(conversion.factor))
    ):
        return f"{output} moves {figures(c.movements[0].slope, 3)} times as far as the model does"
    difference = c.recorded - c.model
    ratio = abs(c.recorded / difference) if difference else 1.0
    digits = max(4, 2 + math.ceil(math.log10(max(ratio, 1.0))))  # that show the difference in two digits
    recorded, model = _signed(c.recorded, "", digits), _signed(c.model, c.record.unit, digits)
    return f"before the event {output} reads {recorded}, the model rests at {model}"


def _signed(value: float, unit: str, digits: int = 4) -> str:
    return f"{value:+.{digits}g} {'' if unit in ('', '1', '-') else unit}".rstrip()


def _common_cause(
    simulator: ModelSimulator,
    e: Experiment,
    candidates: Sequence[FitParameter],
    comparisons: Sequence[Comparison],
    odds: float,
    differs: bool,
) -> Cause | None:
    """Return a mistake in an input or in the time that explains more than what the outputs suggest, odds; None without one.

    differs: whether an output differs at all; else only the time is asked, which moves no level. It is asked where none
    of the model's modes can show in the record; such a model is no model of it, so the prior odds are even, and the
    misfit of the movement decides.
    """
    highest, best = max(odds, POSITIVE), None
    for inputs, prior, cause in _input_mistakes(simulator.model, e) if differs else ():
        run = outputs_of(simulator, e.with_(inputs=e.inputs | inputs))
        if not isinstance(run, str):
            total = prior + sum(c.log_odds_by(Comparison.of(c.record, run[c.record.output])) for c in comparisons)
            if total > highest:
                highest, best = total, cause
    mistakes = _time_mistakes(simulator.model, e)
    before = _misfits(with_candidate_runs(simulator, e, candidates, comparisons)) if mistakes else {}
    for factor, unit in mistakes:
        slower = _in_other_time(e, factor)
        run = outputs_of(simulator, slower)
        if isinstance(run, str):
            continue
        scaled = [Comparison.of(c.record, run[c.record.output]) for c in comparisons]
        after = _misfits(with_candidate_runs(simulator, slower, candidates, scaled))
        total = sum(math.log(before[o] / after[o]) for o in before if o in after) - math.log(len(mistakes))
        if total > highest:
            text = f"no time constant of the model lies between the sampling step and the record's length: is the time in {unit}?"
            highest, best = total, Cause("time", f"in {unit}", text)
    return best


def _misfits(comparisons: Sequence[Comparison]) -> dict[str, float]:
    """Return the smallest misfit of the movement by output, over the runs; of those that move."""
    return {c.record.output: min(m.misfit for m in c.movements) or FINEST for c in comparisons if c.movements}


def _exchanged(
    comparisons: Sequence[Comparison], odds: Mapping[Comparison, float], quantile: float
) -> dict[Comparison, tuple[Cause, float]]:
    """Return the two outputs of one experiment whose columns seem to be exchanged, by comparison, with the log odds.

    odds: log odds of what each suggests by itself. Both outputs have to differ, and each has to gain by the exchange more
    than the choice costs, ln 2, as by a conversion.
    """
    off = [c for c in comparisons if c.differs(quantile) or c.moves_otherwise(quantile)]
    tried = []
    for a, b in combinations(off, 2):
        one, other = Comparison.of(a.record, b.simulated), Comparison.of(b.record, a.simulated)
        if a.is_matched_by(one) and b.is_matched_by(other):
            gain = a.log_odds_by(one) + b.log_odds_by(other) - 2.0 * math.log(2.0)
            total = gain + math.log(EXCHANGE_SHARE / math.comb(len(comparisons), 2))
            if total > max(POSITIVE, odds.get(a, 0.0) + odds.get(b, 0.0)):
                tried.append((total, a, b))
    found: dict[Comparison, tuple[Cause, float]] = {}
    for total, a, b in sorted(tried, key=lambda line: -line[0]):
        if a in found or b in found:
            continue
        one_name, other_name = a.record.output, b.record.output
        text = f"{one_name} moves as the model's {other_name} does and {other_name} as its {one_name}"
        if None not in (a.recorded, b.recorded, a.model, b.model):
            text = (
                f"before the event {one_name} reads {a.recorded:+.4g} and {other_name} {b.recorded:+.4g}, "
                f"the model rests at {a.model:+.4g} and {b.model:+.4g}"
            )
        question = f"are the columns of {one_name} and {other_name} exchanged?"
        cause = Cause(f"{one_name}, {other_name}", "columns exchanged", f"{text}: {question}")
        found |= dict.fromkeys((a, b), (cause, total / 2.0))
    return found


def _input_mistakes(model: AnyModel, e: Experiment) -> Iterator[tuple[Mapping[str, InputSignal], float, Cause]]:
    """Yield the recorded inputs with what may have been done to them undone, its log prior odds, and its name.

    A level that comes nearer to the model's own once a large factor, or an exchange of two columns, is undone speaks for
    that as a level of an output does; that an input's sign differs from the model's speaks for nothing. A factor that is
    no known conversion is tried too, so large that it brings the level to the model's own: of that the level tells nothing.
    """
    recorded = [n for n in e.inputs if n in model.inputs and n not in e.drive]
    levels = {n: float(e.inputs[n].values[0]) for n in recorded}
    for name, level in levels.items():
        signal, expected = e.inputs[name], model.inputs[name].value
        known = input_conversions(model.inputs[name].unit)
        weighed = []
        for c in known:
            odds: float | None = 0.0
            if c.factor > 0.0 and expected and level:
                odds = _odds_of_level(level, c.undone(level), expected)
            if odds is not None:
                weighed.append((c, math.log(c.prior / len(recorded)) + odds))
        if expected * level > 0.0 and abs(math.log(level / expected)) > math.log(SMALLEST_FACTOR):
            c = Conversion("per unit, or on another base", level / expected)
            weighed.append((c, math.log(known[-1].prior / len(recorded))))
        for c, prior in weighed:
            text = f"input {name} reads {level:.4g} before the event, the model's value is {expected:.4g}: {c.name}?"
            if c.factor == -1.0:
                text = f"with the other sign of the recorded input {name} the model comes to the recorded outputs: sign of {name}?"
            undone = InputSignal(signal.times, (signal.values - c.shift) / c.factor, signal.breaks)
            yield {name: undone}, prior, Cause(f"input {name}", c.name, text)
    for a, b in combinations(recorded, 2):
        expected_a, expected_b = model.inputs[a].value, model.inputs[b].value
        gains = [_odds_of_level(levels[a], levels[b], expected_a), _odds_of_level(levels[b], levels[a], expected_b)]
        prior = math.log(EXCHANGE_SHARE / math.comb(len(recorded), 2))
        prior += sum(gain for gain in gains if gain is not None) if None not in gains else 0.0
        text = (
            f"before the event input {a} reads {levels[a]:.4g} and {b} {levels[b]:.4g}, the model's values are "
            f"{expected_a:.4g} and {expected_b:.4g}: are the columns of {a} and {b} exchanged?"
        )
        yield {a: e.inputs[b], b: e.inputs[a]}, prior, Cause(f"input {a}", f"columns of {a} and {b} exchanged", text)


def _odds_of_level(level: float, undone: float, expected: float) -> float | None:
    """Return the log odds by which an input's level speaks for what was undone; None where that comes no nearer to the model's."""
    zero = FINEST * abs(expected)
    if not zero:
        return None
    distance = max(log_distance(undone, expected, zero), FINEST)
    nearer = distance < log_distance(level, expected, zero)
    return math.log(ANYTHING / (2.0 * SCALE * distance)) if nearer else None


def _input_after_failure(simulator: ModelSimulator, e: Experiment) -> list[str]:
    """Return a line for the input whose level, as recorded, leaves the model without a run, where undoing a unit gives one."""
    found = []
    for inputs, prior, cause in _input_mistakes(simulator.model, e):
        if prior > 0.0 and not isinstance(outputs_of(simulator, e.with_(inputs=e.inputs | inputs)), str):
            found.append((prior, f"{e.name}: {cause.text}"))
    return [max(found)[1]] if found else []


def _time_mistakes(model: AnyModel, e: Experiment) -> list[tuple[float, str]]:
    """Return the units of time other than s in which a mode of the model would lie between a row and the record's length.

    Empty where one does as it is. An FMU does not tell its modes.
    """
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


def _in_other_time(e: Experiment, factor: float) -> Experiment:
    """Return the experiment with its time multiplied by a factor."""
    inputs = {n: InputSignal(factor * s.times, s.values, factor * s.breaks) for n, s in e.inputs.items()}
    window = None if e.window is None else (factor * e.window[0], factor * e.window[1])
    measured = None if e.measured is None else replace(e.measured, time=factor * e.time)
    event = None if e.event is None else factor * e.event
    return e.with_(time=factor * e.time, inputs=inputs, window=window, measured=measured, event=event)
