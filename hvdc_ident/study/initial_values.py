"""Initial-value mismatch: recorded level before the event and movement after it against the model's, told before anything is fitted.

Both are known within what the noise of the recording leaves and within what the candidates can do inside their bounds: the model is
run at either end of each candidate's range too, and at the corners that raise and lower a level most. What a conversion of an
output explains (`suggest_conversion`) is compared with what one mistake in an input, an exchange of columns, another set-point or
another unit of time explains in all outputs of an experiment: such a mistake is undone and the model is run again.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import ndtri

from hvdc_ident.data import Array, Experiment, InputSignal, before_event, noise_floor, without_line
from hvdc_ident.errors import ComputationError, HvdcIdentError
from hvdc_ident.fit.fit_parameter import FitParameter
from hvdc_ident.fit.noise import MISFIT, source_of
from hvdc_ident.fit.simulator import observe, unknowns
from hvdc_ident.fit.whitening import autocorrelation
from hvdc_ident.linearize import find_operating_point, linearize
from hvdc_ident.model import AnyModel, is_white_box
from hvdc_ident.simulate import ModelSimulator
from hvdc_ident.study.conversions import (
    FINEST,
    LARGEST_FACTOR,
    POSITIVE,
    SIGN,
    STRONG,
    UNCHANGED,
    Conversion,
    Evidence,
    conversions,
    suggest_conversion,
)
from hvdc_ident.summary.levels import PLAIN, InitialValue
from hvdc_ident.text import figures, listed

if TYPE_CHECKING:
    from hvdc_ident.study.study import Study

FALSE_ALARMS = 1e-3
"""Probability that noise alone makes one of a study's levels differ."""
SMALLEST_FACTOR = math.sqrt(2.0)
"""The smallest factor between two ways of counting a quantity (peak and rms); a smaller one is another operating point."""
NEWTON = 6
"""Evaluations with a difference that find another set-point."""
TIMES = ((1e-3, "ms"), (1e-6, "us"), (60.0, "min"), (3600.0, "h"))
"""Units of time other than s that a recording may be in."""


@dataclass(frozen=True)
class InitialValues:
    """The comparison of every recording with the model. remarks: what could not be compared, and why."""

    values: tuple[InitialValue, ...]
    remarks: tuple[str, ...] = ()
    failures: tuple[str, ...] = ()

    @property
    def lines(self) -> list[str]:
        """Sentences to be read before anything is fitted; what several experiments show alike is said once."""
        return [*self.failures, *(line for _, line in self._grouped())]

    @property
    def mistakes(self) -> list[str]:
        """Those of the lines that suspect a mistake of the recording: its sign, unit or time, a set-point, or columns exchanged."""
        return [line for first, line in self._grouped() if first.is_mistake]

    def without(self, experiments: Iterable[str]) -> InitialValues:
        """Return the comparison without some experiments: those in which a mistake is known, from which the rest follows."""
        known = set(experiments)
        remarks, failures = (
            tuple(t for t in texts if t.split(":")[0] not in known) for texts in (self.remarks, self.failures)
        )
        return InitialValues(tuple(v for v in self.values if v.experiment not in known), remarks, failures)

    def _grouped(self) -> Iterator[tuple[InitialValue, str]]:
        """Yield a value of each group that is said alike, and the line."""
        groups: dict[tuple[str, str | None, str], list[InitialValue]] = {}
        for value in self.values:
            if value.text:
                suggestion = value.suggestion if value.suggestion not in PLAIN else ""
                groups.setdefault((value.channel, suggestion, f"{value.factor or 0:.2g}"), []).append(value)
        for group in groups.values():
            first = max(group, key=lambda value: abs(value.noise_units or 0.0))
            others = list(dict.fromkeys(value.experiment for value in group if value.experiment != first.experiment))
            shown = listed(others[:3]) if len(others) <= 3 else f"{len(others)} more experiments"
            yield first, f"{first.experiment}: {first.text}" + (f" (and so in {shown})" if others else "")

    @property
    def all(self) -> tuple[InitialValue, ...]:
        """The values as the results keep them; failures and remarks are values without an output."""
        return (*self.values, *(InitialValue("", "", text=text) for text in (*self.failures, *self.remarks)))


@dataclass(frozen=True, eq=False)
class Record:
    """One recorded output. before, after: (n,) rows of the level and of the movement. noise: std of a single row;
    deterministic: whether that is not known, so that the misfit stands in for it."""

    experiment: str
    output: str
    unit: str
    values: Array
    before: NDArray[np.bool_]
    after: NDArray[np.bool_]
    noise: float
    deterministic: bool

    @classmethod
    def of(cls, e: Experiment, output: str, unit: str, experiments: Sequence[Experiment]) -> Record:
        assert e.measured is not None
        values = e.measured[output]
        finite = np.isfinite(values)
        before = before_event(e.time, values, e.event)
        after = finite & e.compared & ~before
        noise = max(e.noise.get(output) or 0.0, noise_floor(values[finite]))
        deterministic = source_of([e], output) == MISFIT
        return cls(e.name, output, unit, values, before, after if after.any() else finite, noise, deterministic)

    @property
    def level(self) -> float | None:
        """The mean before the event; None where no row stands there."""
        return float(self.values[self.before].mean()) if self.before.any() else None


@dataclass(frozen=True, eq=False)
class Comparison:
    """A record against runs of the model. simulated: (n,) at the given values; noise: of a row, the misfit where it is not known;
    misfits: of the movement, by run; evidence: levels and slopes of all runs."""

    record: Record
    simulated: Array
    noise: float
    misfits: tuple[float, ...]
    evidence: Evidence

    @classmethod
    def of(cls, record: Record, simulated: Array) -> Comparison:
        slope, error, misfit, size = _movement(record, simulated) or (0.0, 0.0, 0.0, 0.0)
        noise = max(record.noise, misfit) if record.deterministic else record.noise
        moved = ((slope, error),) if size else ()
        levels: tuple[float, ...] = ()
        uncertain = 0.0
        if record.before.any():
            levels = (float(simulated[record.before].mean()),)
            uncertain = _error_of_mean((record.values - simulated)[record.before], noise, record.deterministic)
        evidence = Evidence(record.level, levels, uncertain, moved, size)
        return cls(record, simulated, noise, (misfit,) if size else (), evidence)

    @property
    def model(self) -> float | None:
        """The model's level at the given values; None where there is none."""
        return self.evidence.levels[0] if self.evidence.levels else None

    def with_run(self, simulated: Array) -> Comparison:
        """Return the comparison with one more run of the model."""
        other, own = Comparison.of(self.record, simulated), self.evidence
        levels, slopes = (*own.levels, *other.evidence.levels), (*own.slopes, *other.evidence.slopes)
        return replace(
            self, misfits=(*self.misfits, *other.misfits), evidence=replace(own, levels=levels, slopes=slopes)
        )

    def differs(self, quantile: float) -> bool:
        """Return whether the recorded level lies outside what the model can be, by more than noise and than a row shows."""
        own = self.evidence
        if own.recorded is None:
            return False
        gap = max(min(own.levels) - own.recorded, own.recorded - max(own.levels), 0.0)
        return gap > max(quantile * own.error, self.noise, FINEST * own.size)

    def moves_otherwise(self, quantile: float) -> bool:
        """Return whether no run of the model moves in the direction and within the size of the record."""
        slopes = self.evidence.slopes
        return bool(slopes) and all(abs(slope - 1.0) > quantile * error for slope, error in slopes)

    def gain_by(self, simulated: Array) -> float | None:
        """Return the gain (`Evidence.gain`) by another run, or by another output's.

        Its movement counts as no larger than this one: beside a run that wanders off every level would look near.
        """
        other = Comparison.of(self.record, simulated).evidence
        other = replace(other, size=min(self.evidence.size, other.size))
        return self.evidence.gain(other.level_mismatch(), other.slope_mismatch())


@dataclass(frozen=True)
class Cause:
    """One mistake that would explain several outputs of an experiment at once.

    channel: "input NAME", "time", or two outputs. suggestion: the mistake in a few words; text: in a sentence. gain: logarithm of
    the odds by which it explains them.
    """

    channel: str
    suggestion: str
    text: str
    gain: float = 0.0


Undone = tuple[Experiment, float, Cause]
"""An experiment in which a mistake is undone, the logarithm of the odds of that before it is run, and the mistake."""


def initial_values(study: Study) -> InitialValues:
    """Return the comparison for a study at its given values."""
    return compare_initial_values(study.model, study.experiments, tuple(study.candidates.values()))


def compare_initial_values(
    model: AnyModel, experiments: Sequence[Experiment], candidates: Sequence[FitParameter] = ()
) -> InitialValues:
    """Return the recorded levels and movements of every experiment against the model's, at the model's own values.

    candidates: what may be estimated; what they can move within their bounds is no evidence against a recording. Runs
    every experiment once, and where a recording differs some more times.
    """
    simulator = ModelSimulator(model)
    values: dict[tuple[str, str], InitialValue] = {}
    remarks: list[str] = []
    failures: list[str] = []
    comparisons: list[Comparison] = []
    for e in (e for e in experiments if e.outputs):
        records = [Record.of(e, o, model.outputs[o].unit, experiments) for o in e.outputs]
        values |= {(e.name, r.output): InitialValue(e.name, r.output, r.unit, r.level) for r in records}
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
        quantile = -float(ndtri(FALSE_ALARMS / 2.0 / len(comparisons)))
        by_name = {e.name: e for e in experiments}
        for value in _judged(simulator, by_name, candidates, comparisons, quantile):
            values[value.experiment, value.output] = value
    return InitialValues(tuple(values.values()), tuple(remarks), tuple(failures))


def _run_away(record: Record, simulated: Array) -> str:
    """Return in words that the model grows without bound where the recording does not; empty where it stays near it.

    No two units of one quantity that are confused lie further apart than LARGEST_FACTOR.
    """
    recorded = record.values[np.isfinite(record.values)]
    bound = float(np.abs(recorded).max(initial=0.0))
    largest = float(np.abs(simulated).max(initial=0.0))
    if not bound or largest <= LARGEST_FACTOR * bound:
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
) -> Iterator[InitialValue]:
    """Yield every value with what it suggests. quantile: standard errors from which a difference is no chance."""
    ranged: list[Comparison] = []
    for name, group in _by("experiment", comparisons).items():
        doubted = any(c.differs(quantile) or c.moves_otherwise(quantile) for c in group)
        ranged += _with_candidate_runs(simulator, experiments[name], candidates, group) if doubted else group
    model = simulator.model
    likely: dict[Evidence, tuple[Conversion, float]] = {}
    for output, group in _by("output", ranged).items():
        rest = [c.evidence for c in group]
        while (
            rest and (suggestion := suggest_conversion(rest, model.outputs[output].unit, model.parameters)) is not None
        ):
            likely |= dict.fromkeys(
                suggestion.explained, (suggestion.conversion, suggestion.gain / len(suggestion.explained))
            )
            rest = [e for e in rest if e not in likely]
    for name, group in _by("experiment", ranged).items():
        own = {c: likely[c.evidence][1] for c in group if c.evidence in likely}
        exchanged = _exchanged(group, own, quantile)
        total = sum((own | {c: cause.gain / 2.0 for c, cause in exchanged.items()}).values())
        differs = any(c.evidence in likely or c.differs(quantile) for c in group)
        cause = _common_cause(simulator, experiments[name], group, total, quantile, differs)
        for c in group:
            conversion = likely[c.evidence][0] if c.evidence in likely else None
            yield _value(c, conversion, cause or exchanged.get(c), quantile)


def _by(key: Literal["experiment", "output"], comparisons: Iterable[Comparison]) -> dict[str, list[Comparison]]:
    groups: dict[str, list[Comparison]] = {}
    for c in comparisons:
        groups.setdefault(getattr(c.record, key), []).append(c)
    return groups


def _value(c: Comparison, conversion: Conversion | None, cause: Cause | None, quantile: float) -> InitialValue:
    """Return the value with what is said of it: the conversion, the common cause, or the plain difference."""
    slope, slope_error = c.evidence.slopes[0] if c.evidence.slopes else (None, math.inf)
    record, recorded = c.record, c.evidence.recorded
    value = InitialValue(record.experiment, record.output, record.unit, recorded, slope=slope, channel=record.output)
    if recorded is not None and c.model is not None:
        difference, levels = recorded - c.model, c.evidence.levels
        value = replace(
            value, error=c.evidence.error, model=c.model, low=min(levels), high=max(levels), difference=difference,
            noise_units=difference / c.noise if c.noise else None,
        )  # fmt: skip
    if cause is not None:
        return replace(value, channel=cause.channel, suggestion=cause.suggestion, text=cause.text)
    if conversion is not None:
        text = f"{_reading(c, conversion)}: {conversion.name}?"
        suggestion = "factor" if conversion.gain else conversion.name
        return replace(value, factor=conversion.factor, suggestion=suggestion, text=text)
    if not c.differs(quantile):
        return value
    assert value.difference is not None
    text = f"{_reading(c, UNCHANGED)}: a difference of {_signed(value.difference, record.unit)}"
    if value.noise_units is not None and not record.deterministic:
        text += f", {figures(abs(value.noise_units), 3)} times the noise"
    if len(c.evidence.levels) > 1:
        text += ", more than the candidates can make good within their bounds"
    if slope is not None and slope_error < 0.5 and abs(slope - 1.0) < max(2.0 * slope_error, FINEST):
        return replace(value, suggestion=PLAIN[0], text=f"{text}; it moves as the model does: an offset?")
    return replace(value, suggestion=PLAIN[1], text=f"{text}: another operating point, or part of the model?")


def _reading(c: Comparison, conversion: Conversion) -> str:
    """Return the two levels in words, or the two movements where the levels do not tell."""
    output, recorded, model = c.record.output, c.evidence.recorded, c.model
    tells = (
        conversion is UNCHANGED
        or conversion.shift
        or abs(model or 0.0) > 3.0 * c.evidence.error / abs(conversion.factor)
    )
    if recorded is None or model is None or not tells:
        return f"{output} moves {figures(c.evidence.slopes[0][0], 3)} times as far as the model does"
    return f"before the event {output} {_two_levels(recorded, model, c.record.unit)}"


def _two_levels(recorded: float, model: float, unit: str) -> str:
    """Return the two levels in the digits that show their difference in two."""
    ratio = abs(recorded / (recorded - model)) if recorded != model else 1.0
    digits = max(4, 2 + math.ceil(math.log10(max(ratio, 1.0))))
    return f"reads {_signed(recorded, '', digits)}, the model rests at {_signed(model, unit, digits)}"


def _signed(value: float, unit: str, digits: int = 4) -> str:
    return f"{value:+.{digits}g} {'' if unit in ('', '1', '-') else unit}".rstrip()


# --- mistakes that several outputs show at once ---


def _common_cause(
    simulator: ModelSimulator,
    e: Experiment,
    comparisons: Sequence[Comparison],
    gain: float,
    quantile: float,
    differs: bool,
) -> Cause | None:
    """Return a mistake in an input, a set-point or the time that explains more than what the outputs suggest, gain; None without one.

    differs: whether an output differs at all; else only the time is asked, which moves no level.
    """
    best, most = None, max(gain, math.log(POSITIVE))
    off = [c for c in comparisons if c.differs(quantile)]
    mistakes = [*_input_mistakes(simulator.model, e)] if differs else []
    mistakes += _other_set_points(simulator, e, comparisons) if len(off) > 1 else []
    for undone, odds, cause in (*mistakes, *_time_mistakes(simulator.model, e)):
        run = outputs_of(simulator, undone)
        if isinstance(run, str):
            continue
        if cause.channel == "time":  # the misfit of the movement decides
            after = [Comparison.of(c.record, run[c.record.output]).misfits for c in comparisons]
            gains = [
                math.log(min(c.misfits) / m[0])
                for c, m in zip(comparisons, after, strict=True)
                if m and m[0] and c.misfits
            ]
        else:
            gains = [g for c in comparisons if (g := c.gain_by(run[c.record.output])) is not None]
        if gains and odds + sum(gains) > most:
            best, most = cause, odds + sum(gains)
    return best


def _exchanged(
    comparisons: Sequence[Comparison], own: Mapping[Comparison, float], quantile: float
) -> dict[Comparison, Cause]:
    """Return the two outputs of one experiment whose columns seem to be exchanged, by comparison.

    own: gain of what each suggests by itself. Both outputs have to differ, and each has to gain by the exchange.
    """
    off = [c for c in comparisons if c.differs(quantile) or c.moves_otherwise(quantile)]
    causes: dict[Comparison, Cause] = {}
    for a, b in combinations(off, 2):
        gains = a.gain_by(b.simulated), b.gain_by(a.simulated)
        if gains[0] is None or gains[1] is None or a in causes or b in causes:
            continue
        total = gains[0] + gains[1] - math.log(STRONG * math.comb(len(comparisons), 2))
        if total > max(math.log(POSITIVE), own.get(a, 0.0) + own.get(b, 0.0)):
            one, other = a.record.output, b.record.output
            text = f"{one} follows the model's {other} and {other} its {one}: are the columns of {one} and {other} exchanged?"
            causes |= dict.fromkeys((a, b), Cause(f"{one}, {other}", "columns exchanged", text, total))
    return causes


def _input_mistakes(model: AnyModel, e: Experiment) -> Iterator[Undone]:
    """Yield the experiment with what may have been done to a recorded input undone.

    A level that comes nearer to the model's own once a conversion, or an exchange of two columns, is undone speaks for
    that as a level of an output does; that an input's sign differs from the model's speaks for nothing. A factor that is
    no known conversion is tried too, so large that it brings the level to the model's own: of that the level tells nothing.
    """
    recorded = [n for n in e.inputs if n in model.inputs and n not in e.drive]
    levels = {n: float(e.inputs[n].values[0]) for n in recorded}
    for name, level in levels.items():
        signal, expected = e.inputs[name], model.inputs[name].value
        evidence = Evidence(level, (expected,))
        known = [c for c in conversions(model.inputs[name].unit, model.parameters) if c.factor > 0.0]
        tries = math.log(len(recorded) * (len(known) + 2))
        weighed = [(SIGN, -math.log(2.0 * len(recorded)))]
        weighed += [
            (c, gain - tries) for c in known if expected and level and (gain := evidence.gain_of(c)) is not None
        ]
        if expected * level > 0.0 and abs(math.log(level / expected)) > math.log(SMALLEST_FACTOR):
            weighed.append((Conversion("per unit, or on another base", level / expected), -tries))
        for c, odds in weighed:
            text = f"input {name} reads {level:.4g} before the event, the model's value is {expected:.4g}: {c.name}?"
            if c is SIGN:
                text = f"with the other sign of the recorded input {name} the model comes to the recorded outputs: sign of {name}?"
            undone = InputSignal(signal.times, (signal.values - c.shift) / c.factor, signal.breaks)
            yield e.with_(inputs=e.inputs | {name: undone}), odds, Cause(f"input {name}", c.name, text)
    for a, b in combinations(recorded, 2):
        one, other = model.inputs[a].value, model.inputs[b].value
        text = (
            f"before the event input {a} reads {levels[a]:.4g} and {b} {levels[b]:.4g}, the model's values are "
            f"{one:.4g} and {other:.4g}: are the columns of {a} and {b} exchanged?"
        )
        swapped = ((a, b, one), (b, a, other))
        gains = [Evidence(levels[n], (v,)).gain(Evidence(levels[m], (v,)).level_mismatch(), 1.0) for n, m, v in swapped]
        odds = sum(g or 0.0 for g in gains) * (None not in gains) - math.log(STRONG * math.comb(len(recorded), 2))
        exchanged = e.inputs | {a: e.inputs[b], b: e.inputs[a]}
        yield e.with_(inputs=exchanged), odds, Cause(f"input {a}", f"columns of {a} and {b} exchanged", text)


def _other_set_points(simulator: ModelSimulator, e: Experiment, comparisons: Sequence[Comparison]) -> Iterator[Undone]:
    """Yield the experiment at another value of an input that is not recorded, that which brings the levels of the outputs nearest.

    The value is free, so that the level that gains most by it tells nothing for it.
    """
    inputs = simulator.model.inputs
    known = [c for c in comparisons if c.evidence.recorded is not None]
    recorded = np.array([c.record.level for c in known])
    error = np.array(
        [math.hypot(c.evidence.error, FINEST * math.hypot(c.evidence.size, c.evidence.recorded or 1.0)) for c in known]
    )

    def run_at(name: str, value: float) -> list[Comparison]:
        run = outputs_of(simulator, e.with_(values=e.values | {name: value}))
        if isinstance(run, str):
            raise ComputationError(run)
        return [Comparison.of(c.record, run[c.record.output]) for c in known]

    free = [n for n, i in inputs.items() if i.settable and n not in e.inputs and n not in e.drive]
    for name in free:
        value = e.values.get(name, inputs[name].value)
        try:
            solution = least_squares(
                lambda at, name=name: (recorded - [c.model for c in run_at(name, float(at[0]))]) / error,
                value, x_scale=abs(value) or 1.0, diff_step=FINEST, max_nfev=NEWTON,
            )  # fmt: skip
            uncertain = max(1.0 / (float(np.linalg.norm(solution.jac)) or 1e-300), FINEST * abs(value))
            shown = round(float(solution.x[0]), -math.floor(math.log10(uncertain)))
            after = run_at(name, shown)
        except (ComputationError, ValueError):
            continue
        levels = listed(
            [
                f"{c.record.output} {_two_levels(c.evidence.recorded or 0.0, c.model or 0.0, c.record.unit)}"
                for c in known[:3]
            ]
        )
        unit = f" {inputs[name].unit}" if inputs[name].unit else ""
        setting = f"values = {{{name} = {shown:g}}}"
        text = f"before the event {levels}; at {name} = {shown:g}{unit} and not {value:g} it rests there: {setting}?"
        by_level = [
            math.log(c.evidence.level_mismatch() / a.evidence.level_mismatch())
            for c, a in zip(known, after, strict=True)
        ]
        odds = -max(by_level) - math.log(len(free))
        yield e.with_(values=e.values | {name: shown}), odds, Cause(f"input {name}", setting, text)


def _input_after_failure(simulator: ModelSimulator, e: Experiment) -> list[str]:
    """Return a line for the input whose level, as recorded, leaves the model without a run, where undoing a unit gives one."""
    likely = []
    for undone, odds, cause in _input_mistakes(simulator.model, e):
        if odds > 0.0 and not isinstance(outputs_of(simulator, undone), str):
            likely.append((odds, f"{e.name}: {cause.text}"))
    return [max(likely)[1]] if likely else []


def _time_mistakes(model: AnyModel, e: Experiment) -> list[Undone]:
    """Return the experiment in the units of time other than s in which a mode of the model would lie between a row and the record's
    length: empty where one does as it is, for a model that cannot show in the record is no model of it. An FMU does not tell its modes."""
    if not is_white_box(model) or not model.states or e.drive:
        return []
    starts = {n: float(s.values[0]) for n, s in e.inputs.items()}
    try:
        rates = np.abs(linearize(model, find_operating_point(model, {**e.values, **starts}), side="below").poles())
    except HvdcIdentError:
        return []
    constants = 1.0 / rates[rates > 1e-9 * rates.max(initial=0.0)]
    shortest, longest = float(np.median(np.diff(np.unique(e.time)))), float(np.ptp(e.time))

    def seen(factor: float) -> bool:
        return bool(((constants > factor * shortest) & (constants < factor * longest)).any())

    units = [] if seen(1.0) else [(f, unit) for f, unit in TIMES if seen(f)]
    text = "no time constant of the model lies between the sampling step and the record's length: is the time in {}?"
    return [(_in_other_time(e, f), -math.log(len(units)), Cause("time", f"in {u}", text.format(u))) for f, u in units]


def _in_other_time(e: Experiment, factor: float) -> Experiment:
    """Return the experiment with its time multiplied by a factor."""
    inputs = {n: InputSignal(factor * s.times, s.values, factor * s.breaks) for n, s in e.inputs.items()}
    measured = None if e.measured is None else replace(e.measured, time=factor * e.time)
    event = None if e.event is None else factor * e.event
    return e.with_(time=factor * e.time, inputs=inputs, window=None, measured=measured, event=event)


# --- runs of the model against a record ---


def _movement(record: Record, simulated: Array) -> tuple[float, float, float, float] | None:
    """Return the recorded movement after the event as slope times the simulated: slope, its error, rms misfit and the rms of the
    simulated movement; None where the record shows nothing but noise, or the model stands still.

    error: if all that is left of the recorded movement beside noise were the model's fault and lay along the simulated one.
    """
    if not record.after.any():
        return None
    base = record.before if record.before.any() else record.after
    v = record.values[record.after] - record.values[base].mean()
    w = simulated[record.after] - simulated[base].mean()
    n, noise = v.size, 0.0 if record.deterministic else record.noise
    size = float(np.sqrt(w @ w / n))
    # The mean square of n rows of noise scatters by sqrt(2/n) about its mean; solvers leave 1e-8 of a value.
    moves = float(v @ v) / n > noise**2 * (1.0 + 5.0 * math.sqrt(2.0 / n)) and float(v @ v) > 0.0
    if not moves or size <= 1e-6 * float(np.abs(simulated).max()):
        return None
    slope = float(v @ w) / float(w @ w)
    residual = v - slope * w
    misfit = math.sqrt(max(float(residual @ residual) / n - noise**2, noise**2 * math.sqrt(2.0 / n)))
    return slope, math.hypot(misfit, record.noise / math.sqrt(n)) / size, misfit, size


def _error_of_mean(gap: Array, noise: float, deterministic: bool) -> float:
    """The standard error of the mean of some rows: of coloured noise, with what a drift leaves open, as the larger of the
    noise told and seen; that of a deterministic record is its misfit, which no mean makes smaller."""
    n = gap.size
    rho = autocorrelation([without_line(np.arange(float(n)), gap)[0]], 2)
    std = max(noise, float(np.std(gap - gap.mean(), ddof=1)) if n > 2 else 0.0)
    drift = float(np.polyfit(np.arange(n), gap, 1)[0]) * n if n > 2 else 0.0
    independent = 1.0 if deterministic else max(n * (1.0 - rho) / (1.0 + rho), 1.0)
    return math.hypot(std / math.sqrt(independent), drift / math.sqrt(12.0))


def outputs_of(
    simulator: ModelSimulator,
    e: Experiment,
    values: Mapping[str, float] | None = None,
    nuisance: Mapping[str, float] | None = None,
) -> Mapping[str, Array] | str:
    """Return the outputs at the experiment's rows, or why there are none."""
    try:
        return observe(simulator, e, values or {}, nuisance=nuisance, derivatives=False).values
    except HvdcIdentError as error:
        return str(error)


def _with_candidate_runs(
    simulator: ModelSimulator, e: Experiment, candidates: Sequence[FitParameter], comparisons: Sequence[Comparison]
) -> list[Comparison]:
    """Return the comparisons with the runs at the ends of every candidate's range, and at the corners that move a level most."""
    with_runs, local = list(comparisons), f"{e.name}:"
    free = (*candidates, *unknowns(simulator, e))
    ends: dict[tuple[str, str, float], float] = {}  # level by output, candidate and value

    def run_at(values: Mapping[str, float]) -> bool:
        parameters = {n: v for n, v in values.items() if not n.startswith(local)}
        nuisance = {n.removeprefix(local): v for n, v in values.items() if n.startswith(local)}
        run = outputs_of(simulator, e, parameters, nuisance)
        if not isinstance(run, str):
            with_runs[:] = [c.with_run(run[c.record.output]) for c in with_runs]
        return not isinstance(run, str)

    for f in free:
        for value in (f.draw(0.0), f.draw(1.0)):
            if run_at({f.name: value}):
                ends |= {
                    (c.record.output, f.name, value): c.evidence.levels[-1] for c in with_runs if c.evidence.levels
                }
    corners: dict[tuple[float, ...], dict[str, float]] = {}
    for output in dict.fromkeys(o for o, _, _ in ends):
        for pick in (min, max):
            sides = {
                f.name: {v: level for (o, n, v), level in ends.items() if (o, n) == (output, f.name)} for f in free
            }
            corner = {n: pick(at, key=lambda v: at[v]) for n, at in sides.items() if len(set(at.values())) == 2}
            corners[tuple(corner.values())] = corner
    for corner in corners.values():
        if len(corner) > 1:
            run_at(corner)
    return with_runs
