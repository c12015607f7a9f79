"""Named signals over one time axis, and how they came out of a file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.codec import Coded, read_fields
from hvdc_ident.data.contradiction import Contradiction
from hvdc_ident.data.signal_table import SignalTable
from hvdc_ident.display import Shown, Table, axes_of, data_frame, first_rows, library
from hvdc_ident.errors import StudyError, WaveformError, unknown_name
from hvdc_ident.text import with_unit

Array = NDArray[np.float64]

GAP = 1.5
"""A step over so many median steps is a gap: a new record begins."""
UNEVEN = 0.02
"""Steps may differ from the median by this share: rows are then evenly spaced."""


@dataclass(frozen=True)
class Origin:
    """Origin of the rows of a trajectory in a file.

    rows: number in the file; 0 where there is none. dropped: number left out, the third and later rows of an instant and
    those outside the records of the inputs. time_unit: as the file states it, "" where it does not; times are in
    s in any case. time_column: the column that the time came from, where it was not the first. converted: the signals whose
    unit was changed to the model's, in words. notes: what else a reader has to tell, in words. records: the names of signals that
    were recorded together, where several records of other instants make up the rows; () where all stand at all rows. since: ns since
    1970 of the first row, where the file counts times so in whole numbers, else 0. contradictions: rows that cannot be right.
    """

    rows: int = 0
    dropped: int = 0
    time_unit: str = ""
    time_column: str = ""
    converted: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    records: tuple[tuple[str, ...], ...] = ()
    since: int = 0
    contradictions: tuple[Contradiction, ...] = ()


@dataclass(frozen=True, eq=False)
class _Columns:
    """A trajectory as JSON has it."""

    time: Array
    signals: Mapping[str, Array]
    units: Mapping[str, str]


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(SignalTable, Coded, Shown):
    """Signals sampled at the same instants.

    time: (n,) in s, non-decreasing; a time that stands twice is a jump, the first row before it and the second after.
    values: (n, k), one column a signal, NaN where it was not recorded. names: k names. units: k units ("" where unknown).
    origin: what became of the file's rows, where it comes from a file.
    """

    time: Array
    values: Array
    names: tuple[str, ...]
    units: tuple[str, ...] = ()
    origin: Origin = Origin()

    def __post_init__(self) -> None:
        time = np.ascontiguousarray(self.time, dtype=float)
        values = np.ascontiguousarray(self.values, dtype=float)
        names = tuple(self.names)
        units = tuple(self.units) or ("",) * len(names)
        if time.ndim != 1 or values.shape != (time.size, len(names)) or len(units) != len(names):
            raise WaveformError(
                "a trajectory's parts do not fit",
                expected=f"values of shape ({time.size}, {len(names)})",
                got=f"{values.shape} and {len(units)} units",
            )
        time.setflags(write=False)
        values.setflags(write=False)
        for name, value in (("time", time), ("values", values), ("names", names), ("units", units)):
            object.__setattr__(self, name, value)

    def table(self) -> Trajectory:
        """Return the trajectory itself."""
        return self

    def unit(self, name: str) -> str:
        """Return the unit of a signal."""
        return self.units[self.column(name)]

    def select(self, names: Iterable[str]) -> Trajectory:
        """Return the named signals only, in the order given."""
        columns = [self.column(n) for n in names]
        return Trajectory(
            self.time,
            self.values[:, columns],
            tuple(self.names[c] for c in columns),
            tuple(self.units[c] for c in columns),
            self.origin,
        )

    def rows(self, mask: NDArray[np.bool_]) -> Trajectory:
        """Return the rows where the mask holds."""
        return Trajectory(self.time[mask], self.values[mask], self.names, self.units, self.origin)

    def own_rows(self, name: str) -> NDArray[np.bool_]:
        """Return (n,) the rows of the record that the signal stands in: those at which any signal of that has a value."""
        record = next((r for r in self.origin.records if name in r), None)
        if record is None:
            return np.ones(len(self), dtype=bool)
        columns = [k for k, other in enumerate(self.names) if other in record]
        return np.asarray(np.isfinite(self.values[:, columns]).any(axis=1))

    def gaps(self, name: str) -> int:
        """Return the number of rows of its record at which the signal was not recorded."""
        return int(np.count_nonzero(self.own_rows(name) & np.isnan(self[name])))

    def plot(self, names: str | Iterable[str] | None = None, ax: Any = None) -> Any:
        """Return axes with the signals over time, all or those named."""
        axes = axes_of(ax)
        for name in self.names if names is None else [names] if isinstance(names, str) else names:
            unit = self.unit(name)
            axes.plot(self.time, self[name], label=with_unit(name, unit))
        axes.set_xlabel("time, s")
        axes.legend(fontsize="small")
        return axes

    def to_dataframe(self) -> Any:
        """Return the signals as a pandas DataFrame over time in s. Raises InputError where pandas is not installed."""
        return data_frame({n: self[n] for n in self.names}, self.time, "time")

    def to_xarray(self) -> Any:
        """Return the signals as an xarray Dataset over time in s, each with its unit."""
        columns = {n: ("time", self[n], {"units": u}) for n, u in zip(self.names, self.units, strict=True)}
        return library("xarray", "to_xarray").Dataset(columns, coords={"time": ("time", self.time, {"units": "s"})})

    def _screen(self) -> Iterator[str | Table]:
        if not len(self):
            yield f"Trajectory: no rows of {', '.join(self.names)}"
            return
        yield f"Trajectory: {len(self)} rows, {self.time[0]:g} to {self.time[-1]:g} s"
        columns = zip(self.names, self.units, self.values.T, strict=True)
        rows = [
            (n, u, float(v[0]), float(v[-1]), float(np.fmin.reduce(v)), float(np.fmax.reduce(v))) for n, u, v in columns
        ]
        yield from first_rows(("signal", "unit", "first", "last", "smallest", "largest"), rows, "signals")

    def to_dict(self) -> dict[str, Any]:
        """Return time, signals and units as plain lists."""
        return {
            "time": self.time.tolist(),
            "signals": {n: self[n].tolist() for n in self.names},
            "units": dict(zip(self.names, self.units, strict=True)),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Trajectory:
        """Return the trajectory that `to_dict` wrote. Raises InputError for anything else."""
        table = read_fields(_Columns, data)
        columns = np.reshape(list(table.signals.values()), (len(table.signals), table.time.size)).T
        return cls(table.time, columns, tuple(table.signals), tuple(table.units.get(n, "") for n in table.signals))

    def column(self, name: str) -> int:
        """Return the column of a signal. Raises UnknownNameError, which says which signals there are."""
        try:
            return self.names.index(name)
        except ValueError:
            raise unknown_name("signal", name, self.names) from None


def trajectory(
    time: Sequence[float] | Array, signals: dict[str, Any], units: dict[str, str] | None = None
) -> Trajectory:
    """Return a trajectory from a time axis and a dict of columns."""
    columns = [np.asarray(v, dtype=float) for v in signals.values()]
    values = np.column_stack(columns) if columns else np.empty((len(time), 0))
    return Trajectory(
        np.asarray(time, dtype=float), values, tuple(signals), tuple((units or {}).get(n, "") for n in signals)
    )


def segments(time: Array, where: str) -> tuple[slice, ...]:
    """Return the stretches of evenly spaced rows; a gap, or a second row at one instant, begins a new one.

    Raises StudyError where steps within a stretch differ: an AR model from row to row would then mean nothing.
    """
    parts, steps, median = _stretches(np.asarray(time, dtype=float).tobytes())
    if steps is not None:
        raise StudyError(
            "whitening needs evenly spaced rows",
            where=where,
            expected=f"steps of {median:g} s",
            got=f"steps from {steps[0]:g} to {steps[1]:g} s",
            hint="resample the record, or leave `whiten` out: intervals are then corrected for correlated samples",
        )
    return parts


def is_even(time: Array) -> bool:
    """Return whether rows are evenly spaced but for gaps, so that a correlation from row to row means something."""
    return _stretches(np.asarray(time, dtype=float).tobytes())[1] is None


@lru_cache(maxsize=256)
def _stretches(instants: bytes) -> tuple[tuple[slice, ...], tuple[float, float] | None, float]:
    """Return the stretches, the smallest and the largest step where they differ, and the median; a fit asks again and again."""
    time = np.frombuffer(instants)
    steps = np.diff(time)
    positive = steps[steps > 0]
    if not positive.size:
        return tuple(slice(k, k + 1) for k in range(time.size)), None, 0.0
    median = float(np.median(positive))
    cut = (steps <= 0) | (steps > GAP * median)
    inner = steps[~cut]
    differ = bool(inner.size) and float(np.abs(inner - median).max()) > UNEVEN * median
    ends = [0, *(np.flatnonzero(cut) + 1).tolist(), time.size]
    return (
        tuple(slice(a, b) for a, b in pairwise(ends)),
        (float(inner.min()), float(inner.max())) if differ else None,
        median,
    )
