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
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from hvdc_ident.errors import HvdcIdentError, SteadyStateError
from hvdc_ident.experiment import Experiment, InputSignal
from hvdc_ident.fit.noise import MISFIT, source_of
from hvdc_ident.fit.nuisance import observe, unknowns
from hvdc_ident.fit.unknown import Free
from hvdc_ident.model.definition import Model
from hvdc_ident.model.external import AnyModel
from hvdc_ident.simulate import engine
from hvdc_ident.simulate.model_simulator import ModelSimulator
from hvdc_ident.study.conversions import LARGEST, Conversion, conversions, input_conversions
from hvdc_ident.trajectory import Array
from hvdc_ident.waveform import noise_floor, pre_event_ar
from hvdc_ident.words import listed

if TYPE_CHECKING:
    from hvdc_ident.study.study import Study

FINEST = 1e-3
"""No model's level or movement is expected nearer to the plant's than this share, so a nearer match proves no more."""
SCALE = math.log(1.0 / FINEST)
ANYTHING = 4.0 * math.log(LARGEST)
"""The range of an input's level against the model's: its logarithm, up and down, with either sign."""
GAIN_SHARE = 0.5
"""Prior odds of a model that is off by one factor in level and movement, against one that is off in both by chance."""
POSITIVE = math.log(3.0)
"""Log odds from which evidence is positive (Kass, Raftery 1995): enough for a question, which is all that is asked."""
STRONG = 10.0
"""Odds from which evidence is strong (Jeffreys 1961): what a match has to gain by itself."""
FALSE_ALARMS = 1e-3
"""Probability that noise alone makes one of a study's levels differ."""


@dataclass(frozen=True)
class RestLevel:
    """One output of one experiment before the event, in the output's unit; None where it is not known.

    recorded: the mean of the recorded rows before the event; error: its standard error. model: the model's at its given
    values; low, high: what it can be with the candidates within their bounds. difference: recorded - model;
    noise_units: the same over the noise of a single row. slope: the recorded movement over the simulated.
    channel: what the suggestion is about: the output, "input NAME" or "time". factor: what the recording seems to be
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
class RestLevels:
    """The comparison of every recording with the model. remarks: what could not be compared, and why."""

    levels: tuple[RestLevel, ...]
    remarks: tuple[str, ...] = ()
    failures: tuple[str, ...] = ()

    @property
    def lines(self) -> list[str]:
        """What a user has to know before anything is fitted; what several experiments show alike is told once."""
        groups: dict[tuple[str, str | None, str], list[RestLevel]] = {}
        for level in self.levels:
            if level.text:
                groups.setdefault((level.channel, level.suggestion, f"{level.factor or 0:.2g}"), []).append(level)
        return [*self.failures, *map(_line, groups.values())]

    def to_list(self) -> list[dict[str, Any]]:
        """One table an output and experiment, as the results keep them; failures are tables without an output."""
        failed = [{"experiment": None, "output": None, "text": t} for t in (*self.failures, *self.remarks)]
        return [*(asdict(level) for level in self.levels), *failed]


def _line(alike: Sequence[RestLevel]) -> str:
    first = max(alike, key=lambda level: abs(level.noise_units or 0.0))
    others = list(dict.fromkeys(level.experiment for level in alike if level.experiment != first.experiment))
    shown = listed(others[:3]) if len(others) <= 3 else f"{len(others)} more experiments"
    return f"{first.experiment}: {first.text}" + (f" (and so in {shown})" if others else "")


def rest_levels(study: Study) -> RestLevels:
    """The comparison for a study at its given values."""
    return compare_rest(study.model, study.experiments, tuple(study.candidates.values()))


def compare_rest(model: AnyModel, experiments: Sequence[Experiment], candidates: Sequence[Free] = ()) -> RestLevels:
    """The recorded levels and movements of every experiment against the model's, at the model's own values.

    candidates: what may be estimated; what they can move within their bounds is no evidence against a recording. Runs
    every experiment once, and where a recording differs some more times.
    """
    simulator = ModelSimulator(model)
    levels: dict[tuple[str, str], RestLevel] = {}
    remarks: list[str] = []
    failures: list[str] = []
    comparisons: list[_Comparison] = []
    for e in (e for e in experiments if e.measured is not None):
        records = [_Record.of(e, o, model.outputs[o].unit, experiments) for o in e.outputs]
        levels |= {(e.name, r.output): r.level for r in records}
        if not records[0].before.any():
            when = "its event is not known" if e.event is None else "no row stands before its event"
            remarks.append(f"{e.name}: {when}, so no recorded rest is compared with the model's")
        run = _run(simulator, e)
        if isinstance(run, str):
            failures.append(f"{e.name}: not compared with the model's rest: {run}")
            failures += _input_after_failure(simulator, e)
            continue
        comparisons += [_Comparison.of(r, run[r.output]) for r in records]
    if not comparisons:
        return RestLevels(tuple(levels.values()), tuple(remarks), tuple(failures))
    sure = float(norm.isf(FALSE_ALARMS / 2.0 / len(comparisons)))
    by_experiment = {e.name: e for e in experiments}
    doubted = {c.record.experiment for c in comparisons if c.differs(sure) or c.is_moved_otherwise(sure)}
    freed: list[_Comparison] = []
    for name in dict.fromkeys(c.record.experiment for c in comparisons):
        own = [c for c in comparisons if c.record.experiment == name]
        freed += _freed(simulator, by_experiment[name], candidates, own) if name in doubted else own
    for level in _judged(simulator, by_experiment, candidates, freed, sure):
        levels[level.experiment, level.output] = level
    return RestLevels(tuple(levels.values()), tuple(remarks), tuple(failures))


# --- what is recorded, and what the model does ---


@dataclass(frozen=True, eq=False)
class _Record:
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
    def of(cls, e: Experiment, output: str, unit: str, experiments: Sequence[Experiment]) -> _Record:
        assert e.measured is not None
        values = e.measured[output]
        there = np.isfinite(values)
        before = there & (e.time < e.event - 1e-12) if e.event is not None else np.zeros(values.size, dtype=bool)
        after = there & e.compared & ~before
        noise = max(e.noise.get(output) or 0.0, noise_floor(values[there]))
        deterministic = source_of([e], output) == MISFIT
        return cls(e.name, output, unit, values, before, after if after.any() else there, noise, deterministic)

    @property
    def level(self) -> RestLevel:
        """What is known without the model."""
        mean = float(self.values[self.before].mean()) if self.before.any() else None
        return RestLevel(self.experiment, self.output, self.unit, recorded=mean)


@dataclass(frozen=True)
class _Movement:
    """The recorded movement as slope times the simulated. error: of the slope, if all that is left of the recorded
    movement beside noise were the model's fault and lay along it."""

    slope: float
    error: float
    misfit: float
    size: float


@dataclass(frozen=True, eq=False)
class _Comparison:
    """A record against the model. recorded, error: level and standard error, None where there is no level. model: at the
    given values. levels: of all runs; movements: of all runs in which both move."""

    record: _Record
    recorded: float | None
    error: float
    model: float | None
    noise: float
    levels: tuple[float, ...]
    movements: tuple[_Movement, ...]
    size: float
    conversions: tuple[Conversion, ...] = field(default=())

    @classmethod
    def of(cls, record: _Record, simulated: Array) -> _Comparison:
        movement = _movement(record, simulated)
        misfit = movement.misfit if movement else 0.0
        noise = max(record.noise, misfit) if record.deterministic else record.noise
        size = movement.size if movement else 0.0
        moved = (movement,) if movement else ()
        if not record.before.any():
            return cls(record, None, 0.0, None, noise, (), moved, size)
        gap = (record.values - simulated)[record.before]
        model = float(simulated[record.before].mean())
        error = _error_of_mean(gap, noise, record.deterministic)
        return cls(record, float(record.values[record.before].mean()), error, model, noise, (model,), moved, size)

    def with_run(self, simulated: Array) -> _Comparison:
        """The same with one more run of the model."""
        movement = _movement(self.record, simulated)
        level = (float(simulated[self.record.before].mean()),) if self.record.before.any() else ()
        return replace(
            self, levels=(*self.levels, *level), movements=(*self.movements, *((movement,) if movement else ()))
        )

    def differs(self, sure: float) -> bool:
        """Whether the recorded level lies outside what the model can be, by more than noise and than a row shows."""
        if self.recorded is None:
            return False
        gap = max(min(self.levels) - self.recorded, self.recorded - max(self.levels), 0.0)
        return gap > max(sure * self.error, self.noise, FINEST * self.size)

    def is_moved_otherwise(self, sure: float) -> bool:
        """Whether no run of the model moves in the direction and within the size of the record."""
        return bool(self.movements) and all(abs(m.slope - 1.0) > sure * m.error for m in self.movements)

    def level_mismatch(self, c: Conversion) -> float:
        """On a logarithmic scale, once the conversion is undone; not below what noise and the finest match leave."""
        if self.recorded is None:
            return 1.0
        undone, error = c.undone(self.recorded), self.error / abs(c.factor)
        near = min(max(undone, min(self.levels)), max(self.levels))
        zero = math.hypot(error, self.size) or FINEST * max(abs(undone), abs(near)) or 1.0
        return max(math.hypot(_apart(undone, near, zero), error / math.hypot(zero, near)), FINEST)

    def movement_mismatch(self, c: Conversion) -> float:
        """The same of the movement; 1 where nothing moves, whatever the conversion."""
        if not self.movements:
            return 1.0
        slopes = [m.slope / c.factor for m in self.movements]
        near = min(max(1.0, min(slopes)), max(slopes))
        if near == 1.0:  # between two runs: as well known as the run that follows best
            share = min(m.error / abs(m.slope) for m in self.movements if m.slope)
            return min(max(share, FINEST), 1.0)
        best = int(np.argmin([abs(s - near) for s in slopes]))
        error = max(self.movements[best].error / abs(c.factor), FINEST)
        return max(math.hypot(_apart(near, 1.0, error), error / math.hypot(1.0, error)), FINEST)

    def is_matched(self, c: Conversion) -> bool:
        """Whether the conversion, undone, brings the level far nearer; or the movement, and leaves the level within a share
        of the movement."""
        level = self.level_mismatch(c)
        if STRONG * level <= self.level_mismatch(NONE):
            return True
        follows = STRONG * self.movement_mismatch(c) <= self.movement_mismatch(NONE)
        return follows and (self.recorded is None or STRONG * level <= 1.0)

    def log_odds(self, c: Conversion) -> float:
        """Of the conversion against a model that is off, without priors."""
        level = math.log(self.level_mismatch(NONE) / self.level_mismatch(c))
        return level + math.log(self.movement_mismatch(NONE) / self.movement_mismatch(c))


NONE = Conversion("", 1.0)


def _apart(a: float, b: float, zero: float) -> float:
    """The distance of two values on a scale that is logarithmic above `zero` and passes through 0."""
    return abs(math.asinh(a / zero) - math.asinh(b / zero))


def _movement(record: _Record, simulated: Array) -> _Movement | None:
    """None where the record shows nothing but noise, or the model stands still."""
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
    left = v - slope * w
    misfit = math.sqrt(max(float(left @ left) / n - noise**2, noise**2 * math.sqrt(2.0 / n)))
    return _Movement(slope, math.hypot(misfit, record.noise / math.sqrt(n)) / size, misfit, size)


def _error_of_mean(gap: Array, noise: float, deterministic: bool) -> float:
    """The standard error of the mean of some rows: of coloured noise, with what a drift leaves open, as the larger of the
    noise told and seen; that of a deterministic record is its misfit, which no mean makes smaller."""
    n = gap.size
    rho = pre_event_ar(gap)
    std = max(noise, float(np.std(gap - gap.mean(), ddof=1)) if n > 2 else 0.0)
    drift = float(np.polyfit(np.arange(n), gap, 1)[0]) * n if n > 2 else 0.0
    independent = 1.0 if deterministic else max(n * (1.0 - rho) / (1.0 + rho), 1.0)
    return math.hypot(std / math.sqrt(independent), drift / math.sqrt(12.0))


def _run(
    simulator: ModelSimulator,
    e: Experiment,
    values: Mapping[str, float] | None = None,
    nuisance: Mapping[str, float] | None = None,
) -> Mapping[str, Array] | str:
    """The outputs at the experiment's rows, or why there are none."""
    try:
        return observe(simulator, e, values or {}, nuisance=nuisance, derivatives=False).values
    except HvdcIdentError as error:
        return str(error)


def _freed(
    simulator: ModelSimulator, e: Experiment, candidates: Sequence[Free], own: Sequence[_Comparison]
) -> list[_Comparison]:
    """The comparisons with the runs at the ends of every candidate's range, and at the corners that move a level most."""
    found = list(own)
    ends: dict[str, dict[str, float]] = {}  # level of each output by candidate and end
    local = unknowns(simulator, e)
    for free in (*candidates, *local):
        for share in (0.0, 1.0):
            run = _run(simulator, e, *_at(e, {free.name: free.draw(share)}))
            if isinstance(run, str):
                continue
            found = [c.with_run(run[c.record.output]) for c in found]
            for c in found:
                if c.levels:
                    ends.setdefault(c.record.output, {})[f"{free.name} {share:g}"] = c.levels[-1]
    corners = []
    for at in ends.values():
        for pick in (min, max):
            corner = {}
            for free in (*candidates, *local):
                sides = {s: v for s in (0.0, 1.0) if (v := at.get(f"{free.name} {s:g}")) is not None}
                if len(sides) == 2 and sides[0.0] != sides[1.0]:
                    corner[free.name] = free.draw(pick(sides, key=lambda s: sides[s]))
            if len(corner) > 1 and corner not in corners:
                corners.append(corner)
    for corner in corners:
        run = _run(simulator, e, *_at(e, corner))
        if not isinstance(run, str):
            found = [c.with_run(run[c.record.output]) for c in found]
    return found


def _at(e: Experiment, values: Mapping[str, float]) -> tuple[dict[str, float], dict[str, float]]:
    """The parameters and the experiment's own nuisances among some unknowns of a fit."""
    local = f"{e.name}:"
    parameters = {n: v for n, v in values.items() if not n.startswith(local)}
    return parameters, {n.removeprefix(local): v for n, v in values.items() if n.startswith(local)}


# --- what it means ---


def _judged(
    simulator: ModelSimulator,
    experiments: Mapping[str, Experiment],
    candidates: Sequence[Free],
    comparisons: Sequence[_Comparison],
    sure: float,
) -> list[RestLevel]:
    """Every level with what it suggests."""
    model = simulator.model
    named: dict[int, tuple[Conversion, float]] = {}
    for output in dict.fromkeys(c.record.output for c in comparisons):
        own = [c for c in comparisons if c.record.output == output]
        named |= _named(own, conversions(model.outputs[output].unit, model.parameters))
    found = []
    for name in dict.fromkeys(c.record.experiment for c in comparisons):
        own = [c for c in comparisons if c.record.experiment == name]
        odds = sum(named[id(c)][1] for c in own if id(c) in named)
        doubted = any(id(c) in named or c.differs(sure) for c in own)
        cause = _common_cause(simulator, experiments[name], candidates, own, odds, doubted)
        found += [_told(c, named.get(id(c), (None, 0.0))[0], cause, sure) for c in own]
    return found


def _named(own: Sequence[_Comparison], known: Sequence[Conversion]) -> dict[int, tuple[Conversion, float]]:
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


def _free_factor(c: _Comparison) -> list[Conversion]:
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


@dataclass(frozen=True)
class _Cause:
    """What would explain all outputs of an experiment at once. channel: "input NAME" or "time"; suggestion: in a few words;
    text: in a sentence."""

    channel: str
    suggestion: str
    text: str


def _common_cause(
    simulator: ModelSimulator,
    e: Experiment,
    candidates: Sequence[Free],
    own: Sequence[_Comparison],
    odds: float,
    doubted: bool,
) -> _Cause | None:
    """A recorded input in another unit, or the time in another, where that explains more than what the outputs suggest.

    doubted: whether an output differs at all; else only the time is asked, which moves no level. It is asked where none
    of the model's modes can show in the record; such a model is no model of it, so the prior odds are even, and the
    misfit of the movement decides.
    """
    best: tuple[float, _Cause | None] = (max(odds, POSITIVE), None)
    for name, signal, c, prior in _input_mistakes(simulator.model, e) if doubted else ():
        run = _run(simulator, e.with_(inputs=e.inputs | {name: _scaled(signal, c)}))
        if not isinstance(run, str):
            total = prior + _gain(own, run)
            if total > best[0]:
                best = total, _input_cause(simulator.model, name, signal, c)
    mistakes = _time_mistakes(simulator.model, e)
    before = _misfits(_freed(simulator, e, candidates, own)) if mistakes else {}
    for factor, unit in mistakes:
        slower = _slower(e, factor)
        run = _run(simulator, slower)
        if not isinstance(run, str):
            scaled = _freed(
                simulator, slower, candidates, [_Comparison.of(c.record, run[c.record.output]) for c in own]
            )
            after = _misfits(scaled)
            total = sum(math.log(before[o] / after[o]) for o in before if o in after) - math.log(len(mistakes))
            if total > best[0]:
                text = f"none of the model's modes lies between a row and the record's length: is the time in {unit}?"
                best = total, _Cause("time", f"in {unit}", text)
    return best[1]


def _misfits(comparisons: Sequence[_Comparison]) -> dict[str, float]:
    """The smallest misfit of the movement by output, over the runs; of those that move."""
    return {c.record.output: min(m.misfit for m in c.movements) or FINEST for c in comparisons if c.movements}


def _gain(own: Sequence[_Comparison], run: Mapping[str, Array]) -> float:
    """The log odds of another run of the model against the given one, over all outputs of an experiment."""
    total = 0.0
    for c in own:
        other = _Comparison.of(c.record, run[c.record.output])
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
                apart = max(_apart(c.undone(level), own, zero), FINEST)
                if apart >= _apart(level, own, zero):
                    continue
                prior += math.log(ANYTHING / (2.0 * SCALE * apart))
            yield name, signal, c, prior


def _input_after_failure(simulator: ModelSimulator, e: Experiment) -> list[str]:
    """A line for the input whose level, as recorded, leaves the model without a run, where undoing a unit gives one."""
    found = []
    for name, signal, c, prior in _input_mistakes(simulator.model, e):
        if prior > 0.0 and not isinstance(_run(simulator, e.with_(inputs=e.inputs | {name: _scaled(signal, c)})), str):
            found.append((prior, f"{e.name}: {_input_cause(simulator.model, name, signal, c).text}"))
    return [max(found)[1]] if found else []


def _input_cause(model: AnyModel, name: str, signal: InputSignal, c: Conversion) -> _Cause:
    level, own = float(signal.values[0]), model.inputs[name].value
    text = f"input {name} reads {level:.4g} before the event, the model's value is {own:.4g}: {c.name}?"
    if c.factor == -1.0:
        text = (
            f"with the other sign of the recorded input {name} the model comes to the recorded outputs: sign of {name}?"
        )
    return _Cause(f"input {name}", c.name, text)


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


def _told(c: _Comparison, conversion: Conversion | None, cause: _Cause | None, sure: float) -> RestLevel:
    """The level with what is said of it: the conversion, the common cause, or the plain difference."""
    first = c.movements[0] if c.movements else None
    level = replace(c.record.level, slope=first.slope if first else None)
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
        return replace(level, suggestion="offset", text=f"{text}; it moves as the model does: an offset?")
    return replace(level, suggestion="difference", text=f"{text}: another operating point, or part of the model?")


def _reading(c: _Comparison, conversion: Conversion) -> str:
    """The two levels, or the two movements where the levels do not tell."""
    o, unit = c.record.output, c.record.unit
    if (
        c.recorded is not None
        and c.model is not None
        and (conversion is NONE or abs(c.model) > 3.0 * c.error / abs(conversion.factor))
    ):
        return f"before the event {o} reads {_signed(c.recorded, '')}, the model rests at {_signed(c.model, unit)}"
    slope = c.movements[0].slope
    return f"{o} moves {slope:.3g} times as far as the model does"


def _signed(value: float, unit: str) -> str:
    return f"{value:+.4g} {'' if unit in ('', '1', '-') else unit}".rstrip()


def _in_noise(c: _Comparison) -> str:
    if c.record.deterministic or not c.noise or c.recorded is None or c.model is None:
        return ""
    return f", {abs(c.recorded - c.model) / c.noise:.3g} times the noise"
