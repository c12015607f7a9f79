"""Helpers of several readers: unique names, records of several rates, optional packages, libraries that damage ends."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, Origin, Trajectory, scaled, seconds_of
from hvdc_ident.errors import WaveformError, one_line
from hvdc_ident.formats import LONGEST, MAX_BYTES, check_times, once, pick, unit_since_1970
from hvdc_ident.formats._labels import unit_in_name
from hvdc_ident.parallel import ChildEndedError, call

TIME_NAMES = ("time", "t", "tout", "timestamp", "seconds", "zeit", "temps", "tiempo", "tempo",
              *(f"{name}_{unit}" for name in ("time", "t") for unit in ("s", "ms", "us", "ns")))  # fmt: skip
"""Names of a time vector, lower case, in the order of preference."""
ROUNDING = 1e-6
"""Share of a step within which two instants are the same."""
START = 20.0  # s for a process to begin and a small file to be read
RATE = 5e6  # bytes a second, at least
MEMORY = 3 * MAX_BYTES
"""Bytes for reading a file that holds a table of the largest size: the file's numbers, the table, and what is handed over."""


def own_names(labels: Sequence[str]) -> tuple[str, ...]:
    """The labels with those that stand more than once numbered: `a`, `a`, `b` become `a`, `a (2)`, `b`."""
    labelled, names = set(labels), dict[str, None]()
    for label in labels:
        name, n = label, 1
        while name in names or (n > 1 and name in labelled):
            n += 1
            name = f"{label} ({n})"
        names[name] = None
    return tuple(names)


def time_name(names: Sequence[str]) -> str | None:
    """The one of the names that is the time's; None where none is."""
    lower = {name.lower(): name for name in reversed(names)}
    return next((lower[n] for n in TIME_NAMES if n in lower), None)


def guarded(read: Callable[[Path], Trajectory], path: Path) -> Trajectory:
    """Return what a reader of this folder does, read in a process of its own: damaged files end the libraries for HDF5 and MATLAB,
    or hold them up, or let them take all memory.

    Raises WaveformError: its own, or where the file cannot be read, or its process ends or hangs.
    """
    deadline = START + path.stat().st_size / RATE
    try:
        waveforms: Trajectory = call(read, path, seconds=deadline, memory=MEMORY)
    except WaveformError:
        raise
    except TimeoutError:
        raise damaged(path, f"the file could not be read within {deadline:.0f} s") from None
    except MemoryError:
        raise damaged(path, "reading the file takes too much memory", f"at most {MEMORY / 1e9:.1f} GB") from None
    except ChildEndedError as ended:
        said = ended.printed.rpartition("\n")[2]
        raise damaged(path, "reading the file ended the reader", got=said[:200] or str(ended)) from None
    except Exception as error:  # what a library raises over a damaged file may be anything
        raise damaged(path, f"the file cannot be read: {one_line(error)}") from None
    return waveforms


def joined(parts: Sequence[Trajectory]) -> Trajectory:
    """Records of several rates over the instants of all of them, NaN where a record has no row; `origin.records` has their names.

    Instants that differ by rounding are one. A record with one row at an instant at which another has two, before and after a jump,
    has it after.
    """
    begin = min(part.origin.since for part in parts)
    if begin:
        parts = [replace(part, time=part.time + 1e-9 * (part.origin.since - begin)) for part in parts]
    names = own_names([name for part in parts for name in part.names])
    units = tuple(unit for part in parts for unit in part.units)
    first = parts[0]
    if all(np.array_equal(part.time, first.time) for part in parts):
        return Trajectory(first.time, np.column_stack([part.values for part in parts]), names, units, first.origin)
    apart = ROUNDING * min(float(np.median(np.diff(part.time))) for part in parts)
    every = np.sort(np.concatenate([part.time for part in parts]))
    instants = every[np.concatenate([[True], np.diff(every) > apart])]
    places = [np.searchsorted(instants, part.time + apart, side="right") - 1 for part in parts]
    double = np.zeros(instants.size, dtype=bool)
    for place in places:
        double[place[1:][np.diff(place) == 0]] = True
    last = np.cumsum(1 + double) - 1
    time = np.repeat(instants, 1 + double)
    values = np.full((time.size, len(names)), np.nan)
    column = 0
    for part, place in zip(parts, places, strict=True):
        before = np.append(np.diff(place) == 0, False)
        values[last[place] - before, column : column + len(part.names)] = part.values
        column += len(part.names)
    ends = np.cumsum([len(part.names) for part in parts]).tolist()
    records = tuple(names[a:b] for a, b in pairwise([0, *ends]))
    told = ", ".join(f"{len(part)} rows of {record[0]}" for part, record in zip(parts, records, strict=True))
    note = f"records of several rates, each at its own instants: {told}"
    origin = replace(
        first.origin, rows=0, dropped=sum(part.origin.dropped for part in parts), notes=(note,), records=records
    )
    return Trajectory(time, values, names, units, origin)


def chosen(waveforms: Trajectory, signals: Sequence[str] | None, path: Path) -> Trajectory:
    """The signals, all or those named in that order, over the rows of their own records. Raises UnknownNameError."""
    kept = waveforms.select([waveforms.names[i] for i in pick(path, signals, waveforms.names)])
    records = [r for r in waveforms.origin.records if not set(r).isdisjoint(kept.names)]
    if len(records) == len(waveforms.origin.records):
        return kept
    rows = np.logical_or.reduce([waveforms.own_rows(record[0]) for record in records])
    if len(records) < 2:
        kept = replace(kept, origin=replace(kept.origin, records=(), notes=()))
    return kept.rows(rows)


def checked(record: Trajectory, path: Path) -> Trajectory:
    """Return the record with the first and last row of every instant alone. Raises WaveformError as `check_times`."""
    check_times(record.time, path)
    return once(record)


def instants(values: NDArray[Any], name: str, unit: str, path: Path) -> tuple[Array, Origin]:
    """Times in s, and their origin, with the unit that the file, or the name, says; "date" for whole numbers since 1970.

    These count from the first, for a double has not all digits of nanoseconds since 1970.
    Raises WaveformError for a unit that is none of time.
    """
    unit = unit or unit_in_name(name, ())
    length = seconds_of(unit)
    if length is None:
        raise damaged(path, "the time is in a unit that is none of time", expected="s, ms, us, min, h", got=f"'{unit}'")
    if values.dtype.kind in "iu" and values.size and float(values[0]) * length >= LONGEST:
        counts = values.astype(np.int64)
        scale = length if unit else unit_since_1970(float(counts[0]))
        since = int(counts[0]) * round(scale * 1e9)
        return scaled((counts - counts[0]).astype(float), scale), Origin(time_unit="date", since=since)
    return scaled(values.astype(float), length), Origin(time_unit=unit)


def check_size(rows: int, columns: int, path: Path) -> None:
    """Raise WaveformError where so many numbers do not fit in the memory a table may take."""
    size = rows * columns * 8
    if size > MAX_BYTES:
        raise WaveformError(
            f"{columns} signals of {rows} rows take {size / 1e9:.1f} GB",
            where=str(path),
            expected=f"at most {MAX_BYTES / 1e9:.1f} GB",
            hint="name the signals you need, or export a shorter time",
        )


def package(name: str, path: Path) -> Any:
    """The package, imported; WaveformError naming the extra, with which all of them come, where it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise WaveformError(
            f"this file needs the package '{name}'",
            where=str(path),
            hint="pip install 'hvdc_ident[formats]', or export the file as CSV",
        ) from None


def damaged(path: Path, what: str, expected: str = "", got: str = "") -> WaveformError:
    """An error for a file whose content does not hold together."""
    return WaveformError(
        what, where=str(path), expected=expected, got=got, hint="export it again; it may have been cut off"
    )
