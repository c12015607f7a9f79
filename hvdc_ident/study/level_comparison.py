"""A recording against runs of the model: level before the event and movement after it, with what noise and candidates
leave open, and the mismatch that is left once a conversion of unit or sign is undone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from math import log, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import (
    PREFIXED,
    PREFIXES,
    UNITS,
    Array,
    Experiment,
    before_event,
    conversion,
    noise_floor,
    same_unit,
    without_line,
)
from hvdc_ident.errors import HvdcIdentError
from hvdc_ident.fit.fit_parameter import FitParameter
from hvdc_ident.fit.noise import MISFIT, source_of
from hvdc_ident.fit.simulator import observe, unknowns
from hvdc_ident.fit.whitening import autocorrelation
from hvdc_ident.parameters import Parameter
from hvdc_ident.simulate import ModelSimulator

SIGN_SHARE, OTHER_SHARE, BOTH_SHARE = 0.5, 0.4, 0.1
"""Prior probabilities, given that a channel is wrong: its sign (the commonest mistake), one of the other known
conversions (all alike), or both."""
EXCHANGE_SHARE = 0.1
"""Prior probability, given that channels are wrong, that two columns are exchanged: as rare as two mistakes in one channel."""

GRID = (50.0, 60.0)  # Hz
LARGEST = 1e6
AMPLITUDES, POWERS = ("V", "A"), ("W", "var", "VA")
ELECTRICAL = (*AMPLITUDES, *POWERS)
OF_AMPLITUDES = {
    "sqrt(2): peak for rms": sqrt(2.0),
    "1/sqrt(2): rms for peak": 1.0 / sqrt(2.0),
    "sqrt(3): line to line for phase": sqrt(3.0),
    "1/sqrt(3): phase for line to line": 1.0 / sqrt(3.0),
}
OF_POWERS = {
    "3/2: power of dq peak values": 1.5,
    "2/3: power of dq peak values": 2.0 / 3.0,
    "3: all phases for one": 3.0,
    "1/3: one phase for all": 1.0 / 3.0,
}
OF_POLES = {"2: both poles for one": 2.0, "1/2: one pole for both": 0.5}
NAMES = {"%": "per cent", "deg": "degrees", "rad": "radians", "rpm": "1/min"}


@dataclass(frozen=True)
class Conversion:
    """One mistake. name: what the recording then holds, for a message. prior: its probability, given a mistake.

    gain: whether it is a factor like that of a wrong gain of the model, and no conversion of units.
    """

    name: str
    factor: float
    shift: float = 0.0
    prior: float = 0.0
    gain: bool = False

    def undone(self, recorded: float) -> float:
        """A recorded value in the model's unit."""
        return (recorded - self.shift) / self.factor


SIGN = Conversion("sign", -1.0, prior=SIGN_SHARE)


def conversions(unit: str, parameters: Mapping[str, Parameter]) -> tuple[Conversion, ...]:
    """Return the conversions that a signal of this unit may have suffered, the sign first, each with its prior probability.

    unit: the model's. parameters: the model's; those in V, A, W, var or VA are bases that a per-unit signal may have been
    multiplied by. A conversion and its opposite sign are two.
    """
    known = [*_of_unit(unit), *_of_bases(unit, parameters)]
    known = [(n, a, b) for n, a, b in known if not (abs(abs(a) - 1.0) < 1e-9 and b == 0.0)]
    distinct: dict[tuple[str, float], tuple[str, float, float]] = {}
    for line in known:
        distinct.setdefault((f"{line[1]:.6g}", line[2]), line)
    count = max(len(distinct), 1)
    plain = [Conversion(n, a, b, OTHER_SHARE / count) for n, a, b in distinct.values()]
    both = [
        Conversion(f"{c.name}, with the other sign", -c.factor, 0.0, BOTH_SHARE / count) for c in plain if not c.shift
    ]
    return (SIGN, *plain, *both)


def input_conversions(unit: str) -> tuple[Conversion, ...]:
    """Return the conversions of an input: its sign and what changes it a lot, for its level may well be another than the model's."""
    large = [c for c in conversions(unit, {}) if c.factor > 0.0 and abs(log(abs(c.factor))) > log(30.0)]
    share = OTHER_SHARE / max(len(large) + 1, 1)
    return tuple(Conversion(c.name, c.factor, c.shift, share) for c in (SIGN, *large))


def _of_unit(unit: str) -> list[tuple[str, float, float]]:
    """Return (what is recorded, factor, shift) of the other units of the kind, and of what is confused with it beside them."""
    pu, found = same_unit(unit, "pu"), []
    for name in (*(u for u in UNITS if u != "‰"), *(prefix + base for base in PREFIXED for prefix in PREFIXES)):
        by = conversion(unit, name)
        if by is not None and 1.0 / LARGEST <= by[0] <= LARGEST:
            found.append((f"in {NAMES.get(name, name)}" if name != "pu" else "per unit", *by))
    if pu:
        found += [
            (f"a factor of {n}", a, 0.0) for n, a in (("100", 100.0), ("1/100", 0.01), ("1000", 1e3), ("1/1000", 1e-3))
        ]
        found += [("in degrees", 180.0 / pi, 0.0)]
        found += [
            line for f in GRID for line in ((f"in Hz of {f:g}", f, 0.0), (f"in rad/s of {f:g} Hz", 2 * pi * f, 0.0))
        ]
    if pu or any(conversion(unit, b) for b in AMPLITUDES):
        found += _factors({**OF_AMPLITUDES, **OF_POLES})
    if pu or any(conversion(unit, b) for b in POWERS):
        found += _factors({**OF_POWERS, **({} if pu else OF_POLES)})
    if same_unit(unit, "Hz"):
        found += [
            ("in rad/s", 2 * pi, 0.0),
            ("in 1/min", 60.0, 0.0),
            *((f"per unit of {f:g} Hz", 1 / f, 0.0) for f in GRID),
        ]
    if same_unit(unit, "rad/s"):
        found += [("in Hz", 0.5 / pi, 0.0), *((f"per unit of {f:g} Hz", 0.5 / pi / f, 0.0) for f in GRID)]
    return found


def _factors(sizes: Mapping[str, float]) -> list[tuple[str, float, float]]:
    return [(f"a factor of {name}", size, 0.0) for name, size in sizes.items()]


def _of_bases(unit: str, parameters: Mapping[str, Parameter]) -> list[tuple[str, float, float]]:
    """Bases among the parameters: their values for a per-unit signal, and the ratios of two of one kind; for a signal in
    V, A, W, var or VA those of its kind, that it may have been divided by."""
    bases = {n: p for n, p in parameters.items() if p.value > 0.0 and any(conversion(p.unit, b) for b in ELECTRICAL)}
    if not same_unit(unit, "pu"):
        of_kind = [(n, p, by[0] * p.value) for n, p in bases.items() if (by := conversion(p.unit, unit)) is not None]
        return [
            (f"{what} of {n} = {p.value:g} {p.unit}", size / base, 0.0)
            for n, p, base in of_kind
            for what, size in (("per unit", 1.0), ("in per cent", 100.0))
        ]
    found = [(f"in {p.unit} of the base {n} = {p.value:g}", p.value, 0.0) for n, p in bases.items()]
    for (a, one), (b, other) in permutations(bases.items(), 2):
        by = conversion(one.unit, other.unit)
        if by is not None:
            found.append((f"per unit of {b} and not of {a}", by[0] * one.value / other.value, 0.0))
    return found


FINEST = 1e-3
"""No model's level or movement is expected nearer to the plant's than this share, so a nearer match proves no more."""
STRONG = 10.0
"""Odds from which evidence is strong (Jeffreys 1961): what a match has to gain by itself."""
UNCHANGED = Conversion("", 1.0)


@dataclass(frozen=True, eq=False)
class RecordedOutput:
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
    def of(cls, e: Experiment, output: str, unit: str, experiments: Sequence[Experiment]) -> RecordedOutput:
        assert e.measured is not None
        values = e.measured[output]
        finite = np.isfinite(values)
        before = before_event(e.time, values, e.event)
        after = finite & e.compared & ~before
        noise = max(e.noise.get(output) or 0.0, noise_floor(values[finite]))
        deterministic = source_of([e], output) == MISFIT
        return cls(e.name, output, unit, values, before, after if after.any() else finite, noise, deterministic)


@dataclass(frozen=True)
class Movement:
    """The recorded movement as slope times the simulated. error: of the slope, if all that is left of the recorded
    movement beside noise were the model's fault and lay along it."""

    slope: float
    error: float
    misfit: float
    size: float


@dataclass(frozen=True, eq=False)
class Comparison:
    """A record against the model. simulated: (n,) at the given values. recorded, error: level and standard error, None
    where there is no level. model: at the given values. levels: of all runs; movements: of all runs in which both move."""

    record: RecordedOutput
    simulated: Array
    recorded: float | None
    error: float
    model: float | None
    noise: float
    levels: tuple[float, ...]
    movements: tuple[Movement, ...]
    size: float

    @classmethod
    def of(cls, record: RecordedOutput, simulated: Array) -> Comparison:
        movement = _movement(record, simulated)
        misfit = movement.misfit if movement else 0.0
        noise = max(record.noise, misfit) if record.deterministic else record.noise
        size = movement.size if movement else 0.0
        moved = (movement,) if movement else ()
        if not record.before.any():
            return cls(record, simulated, None, 0.0, None, noise, (), moved, size)
        gap = (record.values - simulated)[record.before]
        model = float(simulated[record.before].mean())
        error = _error_of_mean(gap, noise, record.deterministic)
        recorded = float(record.values[record.before].mean())
        return cls(record, simulated, recorded, error, model, noise, (model,), moved, size)

    def with_run(self, simulated: Array) -> Comparison:
        """Return the comparison with one more run of the model."""
        movement = _movement(self.record, simulated)
        level = (float(simulated[self.record.before].mean()),) if self.record.before.any() else ()
        return replace(
            self, levels=(*self.levels, *level), movements=(*self.movements, *((movement,) if movement else ()))
        )

    def differs(self, quantile: float) -> bool:
        """Return whether the recorded level lies outside what the model can be, by more than noise and than a row shows."""
        if self.recorded is None:
            return False
        gap = max(min(self.levels) - self.recorded, self.recorded - max(self.levels), 0.0)
        return gap > max(quantile * self.error, self.noise, FINEST * self.size)

    def moves_otherwise(self, quantile: float) -> bool:
        """Return whether no run of the model moves in the direction and within the size of the record."""
        return bool(self.movements) and all(abs(m.slope - 1.0) > quantile * m.error for m in self.movements)

    def level_mismatch(self, c: Conversion) -> float:
        """Return the mismatch of the level on a logarithmic scale, once the conversion is undone.

        Not below what noise and the finest match leave.
        """
        if self.recorded is None:
            return 1.0
        undone, error = c.undone(self.recorded), self.error / abs(c.factor)
        near = min(max(undone, min(self.levels)), max(self.levels))
        zero = math.hypot(error, self.size) or FINEST * max(abs(undone), abs(near)) or 1.0
        return max(math.hypot(log_distance(undone, near, zero), error / math.hypot(zero, near)), FINEST)

    def movement_mismatch(self, c: Conversion) -> float:
        """Return the mismatch of the movement on a logarithmic scale; 1 where nothing moves, whatever the conversion."""
        if not self.movements:
            return 1.0
        slopes = [m.slope / c.factor for m in self.movements]
        near = min(max(1.0, min(slopes)), max(slopes))
        if near == 1.0:  # between two runs: as well known as the run that follows best
            share = min(m.error / abs(m.slope) for m in self.movements if m.slope)
            return min(max(share, FINEST), 1.0)
        best = int(np.argmin([abs(s - near) for s in slopes]))
        error = max(self.movements[best].error / abs(c.factor), FINEST)
        return max(math.hypot(log_distance(near, 1.0, error), error / math.hypot(1.0, error)), FINEST)

    def is_matched(self, c: Conversion) -> bool:
        """Return whether the conversion, undone, brings the level far nearer; or the movement, with the level near it."""
        return self._is_match(self.level_mismatch(c), self.movement_mismatch(c))

    def is_matched_by(self, other: Comparison) -> bool:
        """Return whether another run, or another output, matches the record as a conversion would have to."""
        other = self._as_sized(other)
        return self._is_match(other.level_mismatch(UNCHANGED), other.movement_mismatch(UNCHANGED))

    def _as_sized(self, other: Comparison) -> Comparison:
        """The other with no larger movement than this one: beside a run that wanders off every level would look near."""
        return replace(other, size=min(self.size, other.size))

    def _is_match(self, level: float, movement: float) -> bool:
        if STRONG * level <= self.level_mismatch(UNCHANGED):
            return True
        return STRONG * movement <= self.movement_mismatch(UNCHANGED) and (
            self.recorded is None or STRONG * level <= 1.0
        )

    def log_odds(self, c: Conversion) -> float:
        """Return the log odds of the conversion against a model that is off, without priors."""
        level = math.log(self.level_mismatch(UNCHANGED) / self.level_mismatch(c))
        return level + math.log(self.movement_mismatch(UNCHANGED) / self.movement_mismatch(c))

    def log_odds_by(self, other: Comparison) -> float:
        """Return the log odds of another run, or another output, against this one, without priors."""
        other = self._as_sized(other)
        level = math.log(self.level_mismatch(UNCHANGED) / other.level_mismatch(UNCHANGED))
        return level + math.log(self.movement_mismatch(UNCHANGED) / other.movement_mismatch(UNCHANGED))


def log_distance(a: float, b: float, zero: float) -> float:
    """Return the distance of two values on a scale that is logarithmic above `zero` and passes through 0."""
    return abs(math.asinh(a / zero) - math.asinh(b / zero))


def _movement(record: RecordedOutput, simulated: Array) -> Movement | None:
    """Return the movement after the event; None where the record shows nothing but noise, or the model stands still."""
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
    return Movement(slope, math.hypot(misfit, record.noise / math.sqrt(n)) / size, misfit, size)


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


def with_candidate_runs(
    simulator: ModelSimulator, e: Experiment, candidates: Sequence[FitParameter], comparisons: Sequence[Comparison]
) -> list[Comparison]:
    """Return the comparisons with the runs at the ends of every candidate's range, and at the corners that move a level most."""
    found = list(comparisons)
    ends: dict[str, dict[str, float]] = {}  # level of each output by candidate and end
    local = unknowns(simulator, e)
    for free in (*candidates, *local):
        for share in (0.0, 1.0):
            run = outputs_of(simulator, e, *_at(e, {free.name: free.draw(share)}))
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
        run = outputs_of(simulator, e, *_at(e, corner))
        if not isinstance(run, str):
            found = [c.with_run(run[c.record.output]) for c in found]
    return found


def _at(e: Experiment, values: Mapping[str, float]) -> tuple[dict[str, float], dict[str, float]]:
    """Return the parameters and the experiment's nuisances among some unknowns of a fit."""
    local = f"{e.name}:"
    parameters = {n: v for n, v in values.items() if not n.startswith(local)}
    return parameters, {n.removeprefix(local): v for n, v in values.items() if n.startswith(local)}
