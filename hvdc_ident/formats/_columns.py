"""Helpers of several readers: unique names, records of several rates, optional packages, libraries that damage ends."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, Trajectory, scaled, seconds_of
from hvdc_ident.errors import WaveformError, one_line
from hvdc_ident.formats import LONGEST, MAX_BYTES, check_times, once, unit_since_1970
from hvdc_ident.formats._labels import unit_in_name
from hvdc_ident.parallel import ChildEndedError, call

TIME_NAMES = ("time", "t", "tout", "timestamp", "seconds", "zeit", "temps", "tiempo", "tempo",
              *(f"{name}_{unit}" for name in ("time", "t") for unit in ("s", "ms", "us", "ns")))  # fmt: skip
"""Names of a time vector, lower case, in the order of preference."""
START = 20.0  # s for a process to begin and a small file to be read
RATE = 5e6  # bytes a second, at least
MEMORY = 3 * MAX_BYTES
"""Bytes for reading a file that holds a table of the largest size: the file's numbers, the table, and what is handed over."""


def own_names(labels: Sequence[str]) -> tuple[str, ...]:
    """The labels with those that stand more than once numbered: `a`, `a`, `b` become `a`, `a (2)`, `b`."""
    taken = set(labels)
    found: list[str] = []
    for label in labels:
        name, n = label, 1
        while name in found:
            n += 1
            name = f"{label} ({n})"
            if name in taken and name not in found:
                continue
        found.append(name)
    return tuple(found)


def time_name(names: Sequence[str]) -> str | None:
    """The one of the names that is the time's; None where none is."""
    lower = {name.lower(): name for name in reversed(names)}
    return next((lower[n] for n in TIME_NAMES if n in lower), None)


def guarded(read: Callable[[Path], Trajectory], path: Path) -> Trajectory:
    """What a reader of this folder returns, read in a process of its own: damaged files end the libraries for HDF5 and MATLAB,
    or hold them up, or let them take all memory.

    Raises WaveformError: its own, or where the file cannot be read, or its process ends or hangs.
    """
    deadline = START + path.stat().st_size / RATE
    try:
        found: Trajectory = call(read, path, seconds=deadline, memory=MEMORY)
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
    return found


def joined(parts: Sequence[Trajectory], path: Path) -> Trajectory:
    """Records of several rates over one time axis: that of the part with most rows, within the time all of them cover.

    Slower signals are joined by lines in between; `origin` counts the rows left out. Raises WaveformError where the parts share no time.
    """
    finest = max(parts, key=len)
    if all(part.time is finest.time or np.array_equal(part.time, finest.time) for part in parts):
        values = np.column_stack([part.values for part in parts])
        return Trajectory(finest.time, values, _names(parts), _units(parts), finest.origin)
    start, end = max(float(p.time[0]) for p in parts), min(float(p.time[-1]) for p in parts)
    time = finest.time[(finest.time >= start) & (finest.time <= end)]
    if time.size < 2:
        spans = ", ".join(f"{p.names[0]} {p.time[0]:g} to {p.time[-1]:g} s" for p in parts[:4])
        raise WaveformError(
            "the signals share no time",
            where=str(path),
            expected="records that overlap",
            got=spans,
            hint="select signals of one record",
        )
    values = np.column_stack([_at(part, j, time) for part in parts for j in range(len(part.names))])
    origin = replace(finest.origin, dropped=finest.origin.dropped + len(finest) - time.size)
    return Trajectory(time, values, _names(parts), _units(parts), origin)


def checked(record: Trajectory, path: Path) -> Trajectory:
    """Return the record with the first and last row of every instant alone. Raises WaveformError as `check_times`."""
    check_times(record, path)
    return once(record)


def instants(values: NDArray[Any], name: str, unit: str, path: Path) -> tuple[Array, str]:
    """Times in s, and the unit that the file, or the name, says; "date" for whole numbers since 1970.

    These count from the first, for a double has not all digits of nanoseconds since 1970.
    Raises WaveformError for a unit that is none of time.
    """
    unit = unit or unit_in_name(name, ())
    length = seconds_of(unit)
    if length is None:
        raise damaged(path, "the time is in a unit that is none of time", expected="s, ms, us, min, h", got=f"'{unit}'")
    if values.dtype.kind in "iu" and values.size and float(values[0]) * length >= LONGEST:
        counts = values.astype(np.int64)
        return scaled((counts - counts[0]).astype(float), length if unit else unit_since_1970(float(counts[0]))), "date"
    return scaled(values.astype(float), length), unit


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


def _at(part: Trajectory, column: int, time: Array) -> Array:
    return np.asarray(np.interp(time, part.time, part.values[:, column]))


def _names(parts: Sequence[Trajectory]) -> tuple[str, ...]:
    return own_names([name for part in parts for name in part.names])


def _units(parts: Sequence[Trajectory]) -> tuple[str, ...]:
    return tuple(unit for part in parts for unit in part.units)
