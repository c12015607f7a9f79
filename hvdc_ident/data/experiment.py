"""Experiments: input signals, measured outputs, noise, window and role of each."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hvdc_ident.data.noise import InputNoise, noise_before, noise_floor
from hvdc_ident.data.signal_table import SignalTable
from hvdc_ident.data.signals import InputSignal, event_time, input_signal
from hvdc_ident.data.trajectory import Array, Origin, Trajectory, trajectory
from hvdc_ident.display import Shown, Table
from hvdc_ident.errors import WaveformError, unknown_name
from hvdc_ident.immutable import FrozenMap

__all__ = ["Experiment", "InputSignal", "SignalLike", "experiment", "recording_lines"]

SignalLike: TypeAlias = InputSignal | float | ArrayLike | Callable[[Array], Any]
"""An input: a signal, a constant, samples at the experiment's times, or a function of time evaluated there."""


@dataclass(frozen=True, eq=False, init=False, repr=False)
class Experiment(SignalTable, Shown):
    """One experiment: its input signals, the instants at which outputs are wanted, and the recorded outputs.

    time: (n,) instants at which outputs are wanted, s; one that stands twice asks for the values before and after a jump.
    name: unique among the experiments of a fit.
    inputs: by input name a number (constant), an InputSignal (`step`, `ramp`, `multisine`), or (n,) samples at `time`,
    joined as those of a data file are (`input_signal`). An input not named keeps the model's start value.
    outputs: by output name (n,) recorded samples at `time`, NaN where not recorded. Left out for a plain simulation.
    noise: standard deviation of each recorded output, in its unit; where it is left out, a fit estimates it.
    event: instant of the first disturbance, s. window: (from, to) in s of the rows that are compared.
    role: "fit" or "holdout".

    Further fields, all by name:
    measured: a Trajectory with the recorded outputs, in place of `outputs`; their units stand there.
    values: inputs held constant at other than the model's start value.
    noise_profile: (n,) by output, the standard deviation of each row over `noise`, where rows differ; noise_dof: number of
    independent samples that `noise` was estimated from (left out: it is exact); noise_from: by which rows, in words.
    drive: names among the inputs that are insertion points of the model and follow their signal in place of their equation.
    instrument: recording chains by output: {"window-mean": s, "delay": s, "class": %}.
    offsets: constants added to inputs all along, in their units. starts: states that begin at a value and not at rest.
    nuisance: unknowns of this experiment alone, estimated with it: "time-shift", or the name of an input
    (its offset), a state (its start) or a parameter (a value of its own). search: of such parameters where
    a fit begins and its bounds, (start, min, max); of one not named they are the model's.
    input_noise: noise of recorded inputs, by name; what it makes of the outputs is noise of theirs. levels: outputs at whose level
    before the event the model starts.
    domain: "time"; or "frequency", where `time` holds frequencies in Hz and the outputs are real and imaginary parts of
    measured responses, which a simulator of its own answers (`fit.frequency_data`).

    Raises WaveformError where times, samples or names do not fit together.

    >>> import numpy as np, hvdc_ident as hi
    >>> t = np.linspace(0.0, 1.0, 5)
    >>> record = hi.Experiment(t, inputs={"u": hi.step(0.0, 1.0, at=0.3)}, outputs={"y": [0.0, 0.0, 0.2, 0.5, 0.7]})
    >>> record.outputs, float(record.inputs["u"](0.5))
    (('y',), 1.0)
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
    noise_from: FrozenMap[str] = field(default_factory=FrozenMap)
    starts: FrozenMap[float] = field(default_factory=FrozenMap)
    noise_profile: FrozenMap[Array] = field(default_factory=FrozenMap)
    search: FrozenMap[tuple[float, float, float]] = field(default_factory=FrozenMap)
    input_noise: FrozenMap[InputNoise] = field(default_factory=FrozenMap)
    levels: tuple[str, ...] = ()
    domain: Literal["time", "frequency"] = "time"

    def __init__(
        self,
        time: ArrayLike,
        name: str = "experiment",
        *,
        inputs: Mapping[str, SignalLike] | None = None,
        outputs: Mapping[str, ArrayLike] | None = None,
        noise: Mapping[str, float] | None = None,
        event: float | None = None,
        window: tuple[float, float] | None = None,
        role: Literal["fit", "holdout"] = "fit",
        **more: Any,
    ) -> None:
        where = f"experiment '{name}'"
        if isinstance(time, str):
            hint = f"Experiment(t, name={time!r}, inputs=..., outputs=...)"
            raise WaveformError(
                "an experiment begins with its times", expected="instants in s", got=repr(time), hint=hint
            )
        for key in more:
            if key not in _FURTHER:
                raise unknown_name("field of an experiment", key, [*_STATED, *_FURTHER], where=where)
        if role not in ("fit", "holdout"):
            raise WaveformError("no such role", where=where, expected='"fit" or "holdout"', got=repr(role))
        instants = _instants(time, where)
        table = more.get("measured")
        if outputs is not None and table is not None:
            raise WaveformError("outputs and measured are both given", where=where, expected="one of them")
        if outputs is not None:
            columns = {n: _samples(n, v, instants, f"{where}, output") for n, v in outputs.items()}
            table = replace(trajectory(instants, columns), origin=Origin(time_unit="s"))
        if table is not None and not np.array_equal(table.time, instants):
            raise WaveformError("the measured outputs stand at other times than the experiment's", where=where)
        signals = {n: _signal(n, v, instants, where) for n, v in (inputs or {}).items()}
        stated = {"inputs": signals, "noise": _deviations(noise or {}, where), "event": event, "window": window}
        given = {**more, **stated, "name": name, "time": instants, "measured": table, "role": role}
        for f in fields(self):
            value = given.get(f.name)
            if value is None and f.default is not MISSING:
                value = f.default
            elif f.default_factory is FrozenMap:
                value = FrozenMap(value or {})
            object.__setattr__(self, f.name, value)
        object.__setattr__(self, "instrument", FrozenMap({k: FrozenMap(v) for k, v in self.instrument.items()}))

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

    def _screen(self) -> Iterator[str | Table]:
        at = self.event if self.event is not None else event_time(self.inputs)
        event = "no event" if at is None else f"event at {at:g} s"
        yield f"Experiment {self.name} ({self.role}): {self.time.size} rows, {self.time[0]:g} to {self.time[-1]:g} s, {event}"
        inputs = [
            (n, float(s.values[0]), float(s.values[-1]), "constant" if s.is_constant else f"{s.jumps.size} jumps")
            for n, s in self.inputs.items()
        ]
        yield Table(("input", "first", "last", "moves"), tuple(inputs)) if inputs else ""
        table = self.measured
        outputs = (
            [(n, table.unit(n), *_ends(table[n]), self._noise(n, at), table.gaps(n)) for n in table.names]
            if table
            else []
        )
        header = ("output", "unit", "smallest", "largest", "noise", "gaps")
        yield Table(header, tuple(outputs)) if outputs else ""

    def _noise(self, output: str, event: float | None) -> float | None:
        """Return the noise of an output as stated, else as its rows show it before the event; None where they do not."""
        if output in self.noise or self.measured is None:
            return self.noise.get(output)
        values = self.measured[output]
        std = noise_before(self.time, values, event).std
        return std if std > noise_floor(values) else None

    def __len__(self) -> int:
        """Return the number of rows; the table is not made for it."""
        return int(self.time.size)

    def table(self) -> Trajectory:
        """Return inputs and recorded outputs over time, as one table."""
        columns = {n: s(self.time) for n, s in self.inputs.items()}
        if self.measured is None:
            return trajectory(self.time, columns)
        recorded = {n: self.measured[n] for n in self.measured.names}
        units = dict(zip(self.measured.names, self.measured.units, strict=True))
        return trajectory(self.time, {**columns, **recorded}, units)

    def to_dataframe(self) -> Any:
        """Return inputs and recorded outputs as a pandas DataFrame over time. Raises InputError where pandas is missing."""
        return self.table().to_dataframe()

    def plot(self, ax: Any = None) -> Any:
        """Draw the recorded outputs, or the inputs where nothing was recorded, over time, and return the axes."""
        axes = self.table().plot(self.outputs or None, ax)
        axes.set_title(self.name, fontsize="small")
        return axes

    def with_(self, **changes: Any) -> Experiment:
        """Return a copy with some fields changed."""
        return replace(self, **changes)

    def until(self, instant: float) -> Experiment:
        """Return the experiment without the rows after an instant, s."""
        rows = self.time <= instant
        return self.with_(
            time=self.time[rows],
            measured=None if self.measured is None else self.measured.rows(rows),
            noise_profile=FrozenMap({o: profile[rows] for o, profile in self.noise_profile.items()}),
        )

    @property
    def recording(self) -> dict[str, Any]:
        """Return what became of the file's rows: {rows, dropped, jumps, time_unit, time_column, converted, notes, not_recorded,
        contradictions}.

        rows: compared or not. dropped: of the file, left out. jumps: instants with two rows. time_unit: as the file or
        the study says it, None where neither does (then s). notes: what else the reader of the file has to tell.
        not_recorded: by output the number of rows without a value. contradictions: stretches that cannot be right, with times in s.
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
            "notes": list(origin.notes),
            "not_recorded": {o: n for o, n in gaps.items() if n},
            "contradictions": [
                {
                    "kind": c.kind,
                    "columns": list(c.columns),
                    "times": list(c.times or ()),
                    "what": f"{c.what}; {c.done}" if c.done else c.what,
                    "text": c.text,
                }
                for c in origin.contradictions
            ],
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
    lines += [*recording["converted"], *recording.get("notes", ())]
    if (n := recording["jumps"]) > 0:
        lines.append(f"{n} instant{'s' if n > 1 else ''} with two rows: a jump, both kept")
    if (n := recording["dropped"]) > 0:
        lines.append(
            f"{n} row{'s' if n > 1 else ''} of the file dropped: a third of one instant, or outside the record of an input"
        )
    lines += [f"{o}: {n} of {rows} rows not recorded" for o, n in recording["not_recorded"].items()]
    return lines


_STATED = ("name", "inputs", "outputs", "noise", "event", "window", "role")
_FURTHER = tuple(f.name for f in fields(Experiment) if f.name not in (*_STATED, "time"))


def experiment(name: str, time: Any, inputs: Mapping[str, SignalLike] | None = None, **rest: Any) -> Experiment:
    """Return an experiment, its name first."""
    return Experiment(time, name, inputs=inputs, **rest)


def _ends(values: Array) -> tuple[float, float]:
    return float(np.fmin.reduce(values)), float(np.fmax.reduce(values))


def _instants(time: ArrayLike, where: str) -> Array:
    """Return the times as an array that cannot be changed. Raises WaveformError."""
    expected = "finite, non-decreasing instants in s, at least one"
    kept = isinstance(time, np.ndarray) and time.dtype == np.float64 and not time.flags.writeable
    try:
        instants = np.asarray(time) if kept else np.array(time, dtype=float)
    except (TypeError, ValueError):
        raise WaveformError(
            "an experiment's times are no numbers", where=where, expected=expected, got=str(time)[:60]
        ) from None
    if instants.ndim != 1 or instants.size == 0 or not np.isfinite(instants).all() or (np.diff(instants) < 0).any():
        got = f"shape {instants.shape}" if instants.ndim != 1 or instants.size == 0 else ""
        raise WaveformError("an experiment's times are wrong", where=where, expected=expected, got=got)
    instants.setflags(write=False)
    return instants


def _samples(name: str, values: ArrayLike, time: Array, where: str) -> Array:
    """Return (n,) recorded samples. Raises WaveformError where they are no numbers or not as many as the times."""
    place = f"{where} '{name}'"
    try:
        samples = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise WaveformError(
            "the samples are no numbers", where=place, expected=f"{time.size} numbers", got=str(values)[:60]
        ) from None
    if samples.shape != time.shape:
        raise WaveformError(
            "the samples are not as many as the times",
            where=place,
            expected=f"shape {time.shape}",
            got=f"{samples.shape}",
        )
    return samples


def _signal(name: str, value: SignalLike, time: Array, where: str) -> InputSignal:
    """Return the input signal that a number or samples stand for."""
    if isinstance(value, InputSignal):
        return value
    if isinstance(value, int | float | np.number):
        if not np.isfinite(value):
            raise WaveformError("an input's value is not finite", where=f"{where}, input '{name}'", got=f"{value}")
        return InputSignal.constant(float(value))
    if callable(value):
        value = np.asarray(value(time))
    samples = _samples(name, value, time, f"{where}, input")
    if not np.isfinite(samples).all():
        first = time[int(np.argmin(np.isfinite(samples)))]
        raise WaveformError(
            f"the input is not recorded at {first:g} s",
            where=f"{where}, input '{name}'",
            expected="a number at every time: only outputs may have gaps",
        )
    return input_signal(time, samples)


def _deviations(noise: Mapping[str, float], where: str) -> dict[str, float]:
    """Return the standard deviations as plain numbers. Raises WaveformError for one that is none."""
    if not isinstance(noise, Mapping):
        raise WaveformError(
            "noise is not given by output",
            where=where,
            expected='a standard deviation by output: noise={"y": 1e-3}',
            got=repr(noise),
        )
    for name, value in noise.items():
        if not (isinstance(value, int | float | np.number) and not np.isnan(value)):
            raise WaveformError(
                "no standard deviation",
                where=f"{where}, noise of '{name}'",
                expected="a number",
                got=repr(value),
            )
    return {n: float(v) for n, v in noise.items()}
