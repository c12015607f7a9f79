"""What was done to the system and what was recorded: input signals, measured outputs, noise, window, role."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.errors import WaveformError
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.trajectory import Array, Origin, Trajectory


@dataclass(frozen=True, eq=False)
class InputSignal:
    """A piecewise linear signal with jumps.

    times: (n,) in s, non-decreasing; a time that stands twice is a jump. values: (n,).
    Before the first and after the last point the signal is constant.
    breaks: instants at which an integrator has to stop: jumps and the corners that matter.
    """

    times: Array
    values: Array
    breaks: Array

    def __post_init__(self) -> None:
        for name in ("times", "values", "breaks"):
            array = np.ascontiguousarray(getattr(self, name), dtype=float)
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        t = self.times
        if t.ndim != 1 or t.size == 0 or t.shape != self.values.shape:
            raise WaveformError(
                "an input signal's times and values do not fit",
                expected="two vectors of one length, at least 1",
                got=f"shapes {t.shape} and {self.values.shape}",
            )
        if not (np.isfinite(t).all() and np.isfinite(self.values).all()):
            raise WaveformError("an input signal has a time or value that is not finite")
        if (np.diff(t) < 0).any():
            raise WaveformError("an input signal's times go back", expected="non-decreasing times")
        if t.size > 2 and (t[2:] == t[:-2]).any():
            raise WaveformError(
                "an input signal has one time more than twice",
                expected="at most two values at one instant: before and after a jump",
            )

    @classmethod
    def constant(cls, value: float) -> InputSignal:
        """A signal that never changes."""
        return cls(np.zeros(1), np.array([float(value)]), np.empty(0))

    @classmethod
    def corners(cls, points: Iterable[tuple[float, float]]) -> InputSignal:
        """The signal through (time, value) points joined by lines; two points at one time are a jump. Every point is a break."""
        t, v = np.array(list(points), dtype=float).T
        return cls(t, v, np.unique(t))

    @classmethod
    def step(cls, time: float, before: float, after: float) -> InputSignal:
        """A jump from one value to another."""
        return cls.corners([(time, before), (time, after)])

    @classmethod
    def ramp(cls, start: float, before: float, end: float, after: float) -> InputSignal:
        """A ramp between two constant values."""
        return cls.corners([(start, before), (end, after)])

    def __call__(self, t: float | Array) -> Array:
        """The value at t, after the jump where there is one."""
        t = np.asarray(t, dtype=float)
        right = np.searchsorted(self.times, t, side="right")
        i, j = np.clip(right - 1, 0, None), np.clip(right, None, self.times.size - 1)
        t0, t1 = self.times[i], self.times[j]
        share = np.where(t1 > t0, np.clip((t - t0) / np.where(t1 > t0, t1 - t0, 1.0), 0.0, 1.0), 0.0)
        return np.where(right == 0, self.values[0], self.values[i] + share * (self.values[j] - self.values[i]))

    @property
    def jumps(self) -> Array:
        """(k,) instants at which the value changes at once, s."""
        return np.asarray(self.times[1:][(np.diff(self.times) == 0) & (np.diff(self.values) != 0)])

    @property
    def is_constant(self) -> bool:
        """Whether the signal never changes."""
        return bool((self.values == self.values[0]).all())


@dataclass(frozen=True, eq=False)
class Experiment:
    """One experiment: what the inputs did, when the outputs are wanted and what was measured.

    time: (n,) instants at which outputs are wanted, s; one that stands twice asks for the values before and after a jump.
    inputs: signals by input name; an input not named keeps the model's start value. A name in `drive` is a slot that follows its signal.
    values: inputs held constant at other than the model's start value.
    measured: the recorded outputs at `time`, under the names of the model's outputs, NaN where not recorded; None for a
    plain simulation.
    noise: standard deviation of each measured output, in its unit; noise_profile: (n,) by output, the standard deviation
    of each row over that one, where rows differ; noise_dof: how many independent samples it was estimated from, where it
    was (else it is exact). event: instant of the first disturbance, s.
    window: (from, to) in s of what is compared. role: "fit" or "holdout".
    instrument: recording chains by output: {"window-mean": s, "delay": s, "class": %}.
    offsets: constants added to inputs all along, in their units. starts: states that begin at a value and not at rest.
    nuisance: what is unknown about this experiment alone and is estimated with it: "time-shift", or the name of an input
    (its offset), a state (its start) or a parameter (a value of its own). search: of such parameters where
    a fit begins and its bounds, (start, min, max); of one not named they are the model's.
    domain: "time"; or "frequency", where `time` holds frequencies in Hz and the outputs are real and imaginary parts of
    measured responses, which a simulator of its own answers (`fit.frequency_data`).
    """

    name: str
    time: Array
    inputs: FrozenMap[InputSignal] = field(default_factory=FrozenMap)
    values: FrozenMap[float] = field(default_factory=FrozenMap)
    measured: Trajectory | None = None
    noise: FrozenMap[float] = field(default_factory=FrozenMap)
    event: float | None = None
    window: tuple[float, float] | None = None
    role: Literal["fit", "holdout"] = "fit"
    drive: tuple[str, ...] = ()
    instrument: FrozenMap[FrozenMap[float]] = field(default_factory=FrozenMap)
    nuisance: tuple[str, ...] = ()
    offsets: FrozenMap[float] = field(default_factory=FrozenMap)
    noise_dof: FrozenMap[float] = field(default_factory=FrozenMap)
    starts: FrozenMap[float] = field(default_factory=FrozenMap)
    noise_profile: FrozenMap[Array] = field(default_factory=FrozenMap)
    search: FrozenMap[tuple[float, float, float]] = field(default_factory=FrozenMap)
    domain: Literal["time", "frequency"] = "time"

    def __post_init__(self) -> None:
        time = np.ascontiguousarray(self.time, dtype=float)
        if time.ndim != 1 or time.size == 0 or not np.isfinite(time).all() or (np.diff(time) < 0).any():
            raise WaveformError(
                "an experiment's times are wrong",
                where=f"experiment '{self.name}'",
                expected="finite, non-decreasing instants, at least one",
            )
        time.setflags(write=False)
        object.__setattr__(self, "time", time)
        for name in ("inputs", "values", "noise", "offsets", "noise_dof", "starts", "noise_profile", "search"):
            object.__setattr__(self, name, FrozenMap(getattr(self, name)))
        object.__setattr__(self, "instrument", FrozenMap({k: FrozenMap(v) for k, v in self.instrument.items()}))
        if self.measured is not None and not np.array_equal(self.measured.time, time):
            raise WaveformError(
                "the measured outputs stand at other times than the experiment's", where=f"experiment '{self.name}'"
            )

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the measured outputs."""
        return self.measured.names if self.measured is not None else ()

    @property
    def compared(self) -> NDArray[np.bool_]:
        """(n,) which rows are compared: those inside the window."""
        if self.window is None:
            return np.ones(self.time.size, dtype=bool)
        return (self.time >= self.window[0]) & (self.time <= self.window[1])

    def with_(self, **changes: Any) -> Experiment:
        """A copy with some fields changed."""
        return replace(self, **changes)

    @property
    def recording(self) -> dict[str, Any]:
        """Return what became of the file's rows: {rows, dropped, jumps, time_unit, time_column, converted, not_recorded}.

        rows: compared or not. dropped: of the file, left out. jumps: instants with two rows. time_unit: as the file or
        the study says it, None where neither does (then s). not_recorded: by output the number of rows without a value.
        """
        origin = self.measured.origin if self.measured is not None else Origin()
        gaps = {o: self.measured.gaps(o) for o in self.outputs} if self.measured is not None else {}
        return {
            "rows": int(self.time.size),
            "dropped": origin.dropped,
            "jumps": int(np.count_nonzero(np.diff(self.time) == 0)),
            "time_unit": origin.time_unit or None,
            "time_column": origin.time_column or None,
            "converted": list(origin.converted),
            "not_recorded": {o: n for o, n in gaps.items() if n},
        }


def recording_lines(recording: Mapping[str, Any]) -> list[str]:
    """Sentences on what `Experiment.recording` tells beside the number of rows; none where there is nothing to tell."""
    rows, lines = recording["rows"], []
    if recording["time_column"]:
        lines.append(f"the time is column '{recording['time_column']}'")
    unit = recording["time_unit"]
    if not unit:
        lines.append("the file does not say the unit of its time: taken as s")
    elif unit not in ("s", "date"):
        lines.append(f"time in {unit}, converted to s")
    elif unit == "date":
        lines.append("dates, counted in s from the first row")
    lines += recording["converted"]
    if (n := recording["jumps"]) > 0:
        lines.append(f"{n} instant{'s' if n > 1 else ''} with two rows: a jump, both kept")
    if (n := recording["dropped"]) > 0:
        lines.append(
            f"{n} row{'s' if n > 1 else ''} of the file dropped: a third of one instant, or outside another record"
        )
    lines += [f"{o}: {n} of {rows} rows not recorded" for o, n in recording["not_recorded"].items()]
    return lines


def experiment(
    name: str, time: Any, inputs: Mapping[str, InputSignal | float] | None = None, **rest: Any
) -> Experiment:
    """An experiment whose inputs may be given as numbers too."""
    signals = {k: v if isinstance(v, InputSignal) else InputSignal.constant(v) for k, v in (inputs or {}).items()}
    return Experiment(name, np.asarray(time, dtype=float), FrozenMap(signals), **rest)
