"""The next experiment to make: designs of steps, ramps and multisines, ranked by how far they would narrow the widest interval.

The design with the largest determinant of the information matrix (D-optimal) is named beside the best. A design is advised only
where it narrows an interval by more than the width of that interval is uncertain, and further than the recordings made so far
would if they were made once more.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import ClassVar, Literal

import numpy as np

from hvdc_ident.codec import INLINE, NOT_STORED, Coded, stored_as
from hvdc_ident.data import Array, Experiment, InputSignal
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit.frequency_data import in_time
from hvdc_ident.fit.uncertainty import TWO_SIDED, narrow
from hvdc_ident.identifiability.pilot_fit import LocalAnalysis
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.parameters import Input
from hvdc_ident.sensitivity import independent, standard_deviations
from hvdc_ident.text import figures, listed, percentage

Shape = Literal["step", "ramp", "multisine"]
FACTORS = (1.0, -1.0, 2.0)
"""Levels of a step, in multiples of the largest move of that input so far."""
UNMOVED = 0.05
"""An input that was never moved is moved by this share of its value, or of what inputs of its unit usually are."""
HARMONICS = (1, 2, 4, 8, 16)
PER_PERIOD = 20
"""Points of the fastest sine in a period."""
HOPELESS = 1e3
"""A half-width of more than so many units of the scaled coordinate is no knowledge."""
NAMED = 3
EFFORT = 0.9**-2.0
"""Factor of the information that narrows an interval by a tenth: from it on another signal to record, or a second step, is worth it."""
BEGUN_WITH = 3
"""So many of the best single steps are tried with a second step of every other input."""
LISTED = 8


@dataclass(frozen=True)
class Move(Coded):
    """Move of one input. before, after: in its unit (of a multisine the middle and the highest value); at: s;
    seconds: duration of a ramp, or a multisine's slowest period."""

    input: str
    shape: Shape
    before: float = field(metadata=stored_as("from"))
    after: float = field(metadata=stored_as("to"))
    at: float
    seconds: float = 0.0
    stored_properties: ClassVar[tuple[str, ...]] = ("frequencies_hz",)

    @property
    def frequencies_hz(self) -> tuple[float, ...]:
        """Frequencies of a multisine, Hz; empty for the others."""
        return tuple(k / self.seconds for k in HARMONICS) if self.shape == "multisine" else ()

    def signal(self, end: float) -> InputSignal:
        """The input up to `end`, s."""
        if self.shape == "step":
            return InputSignal.step(self.at, self.before, self.after)
        if self.shape == "ramp":
            return InputSignal.ramp(self.at, self.before, self.at + self.seconds, self.after)
        time = np.arange(self.at, end, self.seconds / (HARMONICS[-1] * PER_PERIOD))
        values = self.before + (self.after - self.before) * _multisine((time - self.at) / self.seconds)
        return InputSignal(np.r_[self.at, time], np.r_[self.before, values], time)

    def text(self, units: Mapping[str, str]) -> str:
        """The move in words, to begin a sentence with."""
        unit = f" {units[self.input]}" if units.get(self.input) else ""
        if self.shape == "multisine":
            hertz = ", ".join(f"{f:.3g}" for f in self.frequencies_hz)
            size = abs(self.after - self.before)
            return f"superimpose on {self.input} ({self.before:g}{unit}) sines of {hertz} Hz together, peak {size:.4g}{unit}"
        span = f"{self.input} from {self.before:g} to {self.after:g}{unit}"
        return f"step {span}" if self.shape == "step" else f"ramp {span} in {self.seconds:.3g} s"


def _multisine(phase: Array) -> Array:
    """Sines of equal size with Schroeder's phases (doi 10.1109/TIT.1970.1054411), largest value 1, over so many periods."""
    count = len(HARMONICS)
    parts = [np.sin(2 * np.pi * k * phase - np.pi * i * (i + 1) / count) for i, k in enumerate(HARMONICS)]
    whole = np.sum(parts, axis=0)
    return np.asarray(whole / np.abs(whole).max())


@dataclass(frozen=True)
class ExperimentDesign:
    """One experiment that could be made; of two moves the second comes when the first has had half of the time."""

    moves: tuple[Move, ...]
    stored_properties: ClassVar[tuple[str, ...]] = ("kind",)

    @property
    def kind(self) -> str:
        """Step, ramp or multisine; "step + step" where a second input follows."""
        return " + ".join(m.shape for m in self.moves)

    @property
    def inputs(self) -> tuple[str, ...]:
        """The inputs that move."""
        return tuple(m.input for m in self.moves)

    def experiment(self, template: Experiment) -> Experiment:
        """The experiment over the template's instants; nothing is recorded, so every output is given."""
        end = float(template.time[-1])
        signals = FrozenMap({m.input: m.signal(end) for m in self.moves})
        return Experiment(template.time, self.kind, inputs=signals, event=self.moves[0].at)

    def text(self, units: Mapping[str, str]) -> str:
        """The design in words, without a full stop."""
        words = self.moves[0].text(units)
        if len(self.moves) > 1:
            words += f" and, {self.moves[1].at - self.moves[0].at:.3g} s later, {self.moves[1].text(units)}"
        return words[:1].upper() + words[1:]


def single_input_designs(
    experiments: Sequence[Experiment], inputs: Mapping[str, float], units: Mapping[str, str], template: Experiment
) -> Iterator[ExperimentDesign]:
    """Every input alone: three steps, a ramp and a multisine. inputs: start values; units: of the inputs."""
    at, duration = _begin(template)
    for name, value in inputs.items():
        move = _move_size(name, experiments, inputs, units)
        for factor in FACTORS:
            yield ExperimentDesign((Move(name, "step", value, _rounded(value + factor * move), at),))
        yield ExperimentDesign((Move(name, "ramp", value, _rounded(value + move), at, duration / 4.0),))
        yield ExperimentDesign((Move(name, "multisine", value, _rounded(value + abs(move)), at, duration / 2.0),))


def two_step_designs(
    first: Sequence[ExperimentDesign], singles: Sequence[ExperimentDesign], template: Experiment
) -> Iterator[ExperimentDesign]:
    """Each of the given steps, followed half-way through the record by a step of another input at its first level."""
    at, duration = _begin(template)
    seconds: dict[str, Move] = {}
    for design in singles:
        if design.kind == "step":
            seconds.setdefault(design.inputs[0], design.moves[0])
    for design in first:
        move = design.moves[0]
        for name, other in seconds.items():
            if name != move.input:
                yield ExperimentDesign((move, Move(name, "step", other.before, other.after, at + duration / 2.0)))


def _begin(template: Experiment) -> tuple[float, float]:
    """Return when the design begins and how long it then lasts, s."""
    time = template.time
    at = template.event if template.event is not None else float(time[0] + 0.1 * np.ptp(time))
    return at, max(float(time[-1]) - at, 1e-3 * float(np.ptp(time)))


def _move_size(
    name: str, experiments: Sequence[Experiment], inputs: Mapping[str, float], units: Mapping[str, str]
) -> float:
    """Return the largest move of the input made so far, with its sign; a usual one where it never moved."""
    signals = [e.inputs[name] for e in experiments if name in e.inputs and name not in e.drive]
    moves = [s.values - s.values[0] for s in signals]
    largest = max((float(m[np.argmax(np.abs(m))]) for m in moves), key=abs, default=0.0)
    if largest:
        return largest
    same_unit = [abs(v) for n, v in inputs.items() if v and units.get(n, "") == units.get(name, "")]
    return UNMOVED * (abs(inputs[name]) or (float(np.median(same_unit)) if same_unit else 1.0))


def _rounded(value: float) -> float:
    return float(f"{value:.12g}")


@dataclass(frozen=True)
class OptimalityCriteria:
    """Criteria of an information matrix: how many directions are seen, the smallest of their eigenvalues (E-optimality),
    and the logarithm of the product of their eigenvalues (D-optimality)."""

    directions: int
    smallest_eigenvalue: float
    log_determinant: float


def optimality(matrix: Array, error: float) -> OptimalityCriteria:
    """Return the criteria of a (p, p) matrix whose columns are known to a relative error."""
    values = np.linalg.eigvalsh(matrix)
    seen = values[values > error**2 * max(values[-1], 1e-300)]
    if not seen.size:
        return OptimalityCriteria(0, 0.0, -np.inf)
    return OptimalityCriteria(int(seen.size), float(seen[0]), float(np.log(seen).sum()))


def half_widths(matrix: Array, per_std: Array, names: Sequence[str], error: float) -> FrozenMap[float | None]:
    """Half the first-order 95 % interval by parameter; None where it is not determined.

    Where only combinations are seen, as few as possible are taken as known, and those have None. per_std: (p,) half-width
    of a scaled coordinate whose standard deviation is 1, in the parameter's unit.
    """
    kept = independent(matrix, error)
    halves: dict[str, float | None] = dict.fromkeys(names)
    if kept:
        std = standard_deviations(matrix[np.ix_(kept, kept)])
        for i, s in zip(kept, std.tolist(), strict=True):
            if s <= HOPELESS:
                halves[names[i]] = s * float(per_std[i])
    return FrozenMap(halves)


@dataclass(frozen=True, eq=False)
class RankedDesign:
    """A design with the signals to record, and what would be known of the candidates with it added.

    criteria: of the information with it added. gain: (p, p) the information it adds, in scaled coordinates. half_width: of the
    interval that the advice is on, None where it stays open.
    """

    design: ExperimentDesign = field(metadata=INLINE)
    record: tuple[str, ...]
    new: tuple[str, ...] = field(metadata=stored_as("new_signals"))
    criteria: OptimalityCriteria
    gain: Array = field(default_factory=lambda: np.zeros((0, 0)), metadata=NOT_STORED)
    half_width: float | None = None

    @property
    def order(self) -> tuple[float, ...]:
        """The less, the better: directions seen, the interval to two digits, what it takes, and the determinant."""
        half = float(f"{math.inf if self.half_width is None else self.half_width:.2g}")
        return (-self.criteria.directions, half, len(self.new), len(self.design.moves), -self.criteria.log_determinant)


@dataclass(frozen=True, eq=False)
class Recommendation(Coded):
    """The experiment that narrows the widest interval most, of those tried.

    best: the experiment. aim: the parameter whose interval it narrows, the widest that any narrows. by_determinant: the
    experiment that raises the determinant most (D-optimal). now: the criteria of the information without either.
    half_widths_now: of the 95 % intervals by parameter, in its unit, as the verdicts have them, else to first order;
    half_widths: the same, made narrower as the information predicts, only as good as the noise assumed; None where it stays
    open. values: the parameters' values there. others: the best of each other kind and input, best first. tried: how many. failed: those
    that cannot be simulated, with the reason. text: the advice in words. misfit: whether the model leaves more than a known noise:
    the half-widths then hold only if nothing else is missing, and no interval of 95 % is predicted.
    """

    best: RankedDesign = field(metadata=INLINE)
    aim: str
    by_determinant: RankedDesign = field(metadata=stored_as("d_optimal"))
    now: OptimalityCriteria
    half_widths_now: FrozenMap[float | None] = field(metadata=stored_as("half_width_now"))
    half_widths: FrozenMap[float | None] = field(metadata=stored_as("predicted_half_width"))
    values: FrozenMap[float]
    others: tuple[RankedDesign, ...]
    tried: int
    failed: tuple[str, ...]
    text: str
    misfit: bool = False
    stored_properties: ClassVar[tuple[str, ...]] = ("input", "predicted_ci95")

    @property
    def input(self) -> str:
        """The input that moves first."""
        return self.best.design.moves[0].input

    @property
    def predicted_ci95(self) -> dict[str, tuple[float, float] | None]:
        """The 95 % intervals with the experiment added; None where one stays open, or the model leaves more than noise."""
        return {
            n: None if half is None or self.misfit else (self.values[n] - half, self.values[n] + half)
            for n, half in self.half_widths.items()
        }

    def determinant_gain(self, r: RankedDesign) -> float | None:
        """Return by how much an experiment raises the logarithm of the determinant; None where it shows more directions."""
        return (
            r.criteria.log_determinant - self.now.log_determinant
            if r.criteria.directions == self.now.directions
            else None
        )


def recommend(
    whole: LocalAnalysis,
    inputs: Mapping[str, Input],
    units: Mapping[str, str],
    *,
    thresholds: Mapping[str, float],
    told: Mapping[str, float] = MappingProxyType({}),
    misfit: bool = False,
) -> Recommendation | str:
    """Return the best of the experiments that a person could make, or in a sentence why none is advised; "" where nothing is left to know.

    Tried are, for every input that can be set, steps at three levels, a ramp and a multisine; and the best steps followed by a
    step of every other such input; each with the signals recorded so far, and with one more. whole: all candidates free, at
    the values of the optimum. inputs: the model's. units: of the parameters. thresholds: the rise of the cost at the ends of
    a parameter's interval. told: half-widths of the intervals by parameter, where the verdicts have some. misfit: whether the
    model leaves more than a known noise.
    """
    recordings = in_time(whole.problem.fitted_experiments)
    if not recordings:
        return "No experiment is advised: nothing was recorded in time."
    if not any(i.settable for i in inputs.values()):
        none = f"none of {listed(tuple(inputs))} can be set by a person" if inputs else "the model has no input"
        return f"No experiment is advised: {none}."
    template = max(recordings, key=lambda e: float(np.ptp(e.time)))
    values = {n: i.value for n, i in inputs.items() if i.settable}
    of_inputs = {n: i.unit for n, i in inputs.items()}
    tried = _Ranking(whole, template)
    singles = list(single_input_designs(recordings, values, of_inputs, template))
    ranked = list(tried.ranked(singles))
    steps: dict[str, ExperimentDesign] = {}  # the best single steps, each of another input
    for r in sorted(ranked, key=_order, reverse=True):
        if r.design.kind == "step":
            steps.setdefault(r.design.inputs[0], r.design)
    ranked += tried.ranked(two_step_designs([*steps.values()][:BEGUN_WITH], singles, template))
    if not ranked:
        return f"No experiment is advised: none of those tried can be simulated ({tried.failed[0]})."
    count = len({r.design for r in ranked})
    widths = _Widths.of(whole, thresholds, told)
    aimed = widths.aim(ranked)
    if aimed is None:
        return widths.why_none(count)
    aim, ranked = aimed
    best = ranked[0]
    by_determinant = max(
        ranked, key=lambda r: (r.criteria.directions, r.criteria.log_determinant, -len(r.design.moves))
    )
    at, then = FrozenMap({n: whole.value(n) for n in whole.names}), widths.with_gain(best.gain)
    text = _text(best, aim, by_determinant, widths, then, {**units, **of_inputs}, misfit=misfit)
    if whole.deterministic:
        text += " The misfit stands for the noise in these intervals."
    others = tuple(_others(ranked, best))
    return Recommendation(
        best, aim, by_determinant, tried.now, widths.now, then, at, others, count, tuple(tried.failed), text, misfit
    )


@dataclass(frozen=True, eq=False)
class _Widths:
    """Half-widths of the intervals as they are, and as information that is added would make them.

    now: by parameter, in its unit, None where it is open. linear: the same to first order. scale: what a width is compared with,
    by parameter. uncertain: share of a width that its own 95 % uncertainty is. per_std: as of `half_widths`.
    """

    whole: LocalAnalysis
    per_std: Array
    now: FrozenMap[float | None]
    linear: FrozenMap[float | None]
    scale: Mapping[str, float]
    uncertain: float

    @classmethod
    def of(cls, whole: LocalAnalysis, thresholds: Mapping[str, float], told: Mapping[str, float]) -> _Widths:
        """Return the widths at a point. thresholds, told: as of `recommend`."""
        names = whole.names
        usual = float(np.median(list(thresholds.values()))) if thresholds else TWO_SIDED
        slope = whole.slope[: len(names)]
        per_std = slope * np.sqrt([2.0 * thresholds.get(n, usual) for n in names])
        linear = half_widths(whole.information.matrix, per_std, names, whole.error)
        now = FrozenMap({n: told.get(n, half) if half is not None else None for n, half in linear.items()})
        # A standard deviation from so many independent samples is itself known to 1/sqrt(2 samples).
        samples = max(sum(whole.uncertainty.effective.values()) - len(whole.problem.names), 1.0)
        uncertain = math.sqrt(2.0 * TWO_SIDED) / math.sqrt(2.0 * samples)
        return cls(whole, per_std, now, linear, dict(zip(names, slope.tolist(), strict=True)), uncertain)

    def with_gain(self, gain: Array) -> FrozenMap[float | None]:
        """Return the widths with information added, (p, p) in scaled coordinates: those of now, narrower by what it is to first order."""
        matrix = self.whole.information.matrix + gain
        linear = half_widths(matrix, self.per_std, self.whole.names, self.whole.error)

        def narrowed(name: str) -> float | None:
            then, was, now = linear[name], self.linear[name], self.now[name]
            return then if then is None or was is None or now is None else now * then / was if was else now

        return FrozenMap({n: narrowed(n) for n in self.whole.names})

    @cached_property
    def again(self) -> FrozenMap[float]:
        """The least width by parameter that any of the experiments would give if it were made once more."""
        each = [self.with_gain(gain) for gain in self.whole.information.by_experiment.values()]
        halves = {n: [half for w in each if (half := w[n]) is not None] for n in self.now}
        return FrozenMap({n: min(widths, default=math.inf) for n, widths in halves.items()})

    def narrows(self, name: str, then: float | None) -> bool:
        """Return whether a width is less than what repetition gives, by more than it is uncertain; any width is less than none."""
        return then is not None and (self.now[name] is None or then < (1.0 - self.uncertain) * self.again[name])

    def aim(self, ranked: Sequence[RankedDesign]) -> tuple[str, list[RankedDesign]] | None:
        """Return the widest of the open intervals that a design narrows, and the designs, the best for it first; None where none does."""
        after = [self.with_gain(r.gain) for r in ranked]
        for name in self.open:
            designs = [replace(r, half_width=w[name]) for r, w in zip(ranked, after, strict=True)]
            designs.sort(key=lambda r: r.order)
            if self.narrows(name, designs[0].half_width):
                return name, designs
        return None

    @property
    def open(self) -> list[str]:
        """The parameters whose interval is wider than a change that is told, the widest first beside its scale."""

        def wide(name: str) -> bool:
            half, value = self.now[name], self.whole.value(name)
            return half is None or not narrow(value, (value - half, value + half))

        def width(name: str) -> float:
            half = self.now[name]
            return math.inf if half is None else half / self.scale[name]

        return sorted(filter(wide, self.now), key=width, reverse=True)

    def why_none(self, count: int) -> str:
        """Return why none of so many experiments is advised, in a sentence; "" where no interval is open."""
        if not self.open:
            return ""
        if self.uncertain >= 1.0:
            return (
                "No experiment is advised: what the model leaves is no noise, and a width that rests on it is too uncertain to "
                "promise a narrower one. Diagnose first."
            )
        return (
            f"No experiment is advised: of {count} tried (steps, ramps, multisines and pairs of steps) none narrows the interval of "
            f"{listed(self.open)} further than the same recordings made once more, by more than the {percentage(self.uncertain)} by "
            "which a width is uncertain."
        )


class _Ranking:
    """Designs run and weighed, each with the signals recorded so far and with one more. template: the record they are made of."""

    def __init__(self, whole: LocalAnalysis, template: Experiment) -> None:
        self.whole, self.template = whole, template
        self.base = whole.information.matrix
        self.recorded = whole.problem.outputs_in_time
        self.now = optimality(self.base, whole.error)
        self.failed: list[str] = []

    def ranked(self, designs: Iterable[ExperimentDesign]) -> Iterator[RankedDesign]:
        """Yield every way to record each design that can be run."""
        for design in designs:
            try:
                gains = self._gains(design)
            except SimulationError as error:
                self.failed.append(f"{design.text({})}: {error.what}")
                continue
            plain = sum((gains[o] for o in self.recorded if o in gains), np.zeros_like(self.base))
            first = optimality(self.base + plain, self.whole.error)
            yield RankedDesign(design, self.recorded, (), first, plain)
            for signal in gains:
                if signal in self.recorded:
                    continue
                gain = plain + gains[signal]
                more = optimality(self.base + gain, self.whole.error)
                if (more.directions, more.smallest_eigenvalue) > (
                    first.directions,
                    first.smallest_eigenvalue * EFFORT,
                ):
                    yield RankedDesign(design, (*self.recorded, signal), (signal,), more, gain)

    def _gains(self, design: ExperimentDesign) -> dict[str, Array]:
        """Return the information of each output of the run, in scaled coordinates."""
        problem, names = self.whole.problem, self.whole.names
        run = problem.simulator.simulate(design.experiment(self.template), problem.values(self.whole.theta), names)
        information = {}
        for output in run.trajectory.names:
            gradient = run.gradient(output) * self.whole.slope[: len(names)]
            if not np.isfinite(gradient).all():
                raise SimulationError(f"the sensitivity of '{output}' is not finite")
            gradient = gradient / self._sigma(output, run.trajectory[output], run.trajectory.unit(output))
            information[output] = gradient.T @ gradient
        return information

    def _sigma(self, output: str, values: Array, unit: str) -> float:
        """The noise expected on an output, in its unit: as recorded so far; of a new one, as on others of its unit, or
        the same share of its largest value."""
        problem = self.whole.problem
        by_output = {o: s for table in problem.sigma.values() for o, s in table.items()}
        if output in by_output:
            return by_output[output]
        typical = float(np.median(list(by_output.values())))
        measured = [(e.measured, o) for e in problem.fitted_experiments for o in e.outputs if e.measured is not None]
        if any(m.unit(o) == unit for m, o in measured):
            return typical
        size = float(np.median([np.nanmax(np.abs(m[o])) for m, o in measured]))
        share = typical / size if size > 0 else 0.0
        return share * float(np.abs(values).max()) or typical


def _others(ranked: Sequence[RankedDesign], best: RankedDesign) -> Iterator[RankedDesign]:
    """Yield the best of each other kind and set of inputs, in their order; pairs only where the second step adds something."""
    shown = {(best.design.kind, frozenset(best.design.inputs))}
    alone: dict[tuple[tuple[Move, ...], tuple[str, ...]], RankedDesign] = {
        (r.design.moves, r.record): r for r in ranked if len(r.design.moves) == 1
    }
    for r in ranked:
        key = r.design.kind, frozenset(r.design.inputs)
        single = alone.get((r.design.moves[:1], r.record))
        if key in shown or (
            len(r.design.moves) > 1
            and single is not None
            and r.criteria.directions <= single.criteria.directions
            and r.criteria.log_determinant <= single.criteria.log_determinant + math.log(EFFORT)
        ):
            continue
        shown.add(key)
        yield r
        if len(shown) > LISTED:
            return


def _order(r: RankedDesign) -> tuple[int, float, float]:
    """Directions seen, smallest eigenvalue to a hundredth, determinant: larger is better."""
    return (
        r.criteria.directions,
        round(float(np.log(max(r.criteria.smallest_eigenvalue, 1e-300))), 2),
        r.criteria.log_determinant,
    )


def _text(
    best: RankedDesign,
    aim: str,
    by_determinant: RankedDesign,
    widths: _Widths,
    then: Mapping[str, float | None],
    units: Mapping[str, str],
    *,
    misfit: bool,
) -> str:
    """Return the advice, what it would give for the parameter it is for and those that gain most, and what stays as it is."""
    now = widths.now

    def share(name: str) -> float:  # of the interval's width then to now; 0 where it was open
        before, after = now[name], then[name]
        return 0.0 if before is None or after is None or not before else after / before

    def instruction(r: RankedDesign) -> str:
        record = f"{listed(r.new)} besides the signals so far" if r.new else "the same signals"
        return f"{r.design.text(units)}, recording {record}"

    def gain(name: str) -> str:
        before, after = ("none" if half is None else f"±{figures(half, 3)}" for half in (now[name], then[name]))
        would = "be known to" if misfit else "get a 95 % confidence interval of"
        return f"{name} would {would} {after} {units.get(name, '')}".rstrip() + f" (now {before})"

    others = sorted((n for n in then if n != aim and widths.narrows(n, then[n])), key=share)
    condition = "if nothing else is missing, " if misfit else ""
    text = f"{instruction(best)}: {condition}{', '.join(map(gain, [aim, *others][:NAMED]))}."
    if best.new:
        text += f" That takes the noise of {listed(best.new)} to be like that of the signals recorded."
    if wider := widths.open[: widths.open.index(aim)]:
        text += f" The wider interval of {listed(wider)} is narrowed by none of the experiments tried."
    still_open = [n for n, half in then.items() if half is None]
    if still_open:
        text += f" {listed(still_open)} would stay open: only together with others, or not at all, do they show."
    if by_determinant.design != best.design:
        text += f" For all parameters taken together most would come from another: {instruction(by_determinant)}."
    return text
