"""Result files of Dymola and OpenModelica: a MATLAB v4 file of the trajectory class.

The file holds `Aclass`, `name`, `description`, `dataInfo` and the tables `data_1` (constants and parameters) and
`data_2` (everything that varies). `dataInfo` says for each name in which table and column it is; a negative column is
an alias with the opposite sign; table 0 is the time itself. Layout "binTrans" stores every matrix but `Aclass`
transposed, "binNormal" as it is.
Source: Dymola User Manual, "Result file format"; MATLAB MAT-File Format, "Level 4 MAT-File Format".
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, Origin, Trajectory
from hvdc_ident.formats import check_times, pick
from hvdc_ident.formats._columns import check_size, damaged
from hvdc_ident.formats._text import decoded

NAME = "dymola-mat"
SUMMARY = "result files of Dymola and OpenModelica (MATLAB v4)"
SUFFIXES = (".mat",)

_TYPES = {0: "f8", 1: "f4", 2: "i4", 3: "i2", 4: "u2", 5: "u1"}
_HEADER = 20  # bytes: type, rows, columns, imaginary part, length of the name
_MAX_MATRICES = 64
_MAX_NAME = 64
_UNIT = re.compile(r"\[([^\[\]]*)\]\s*$")


@dataclass(frozen=True)
class _Matrix:
    """A matrix in the file, still there. values: (columns, rows), as stored: MATLAB puts column after column."""

    name: str
    is_text: bool
    values: NDArray[Any]


@dataclass(frozen=True)
class _Result:
    """A result file, opened. table, column: (n,) of each name. tables: (rows, columns) by number."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    table: NDArray[np.int64]
    column: NDArray[np.int64]
    tables: dict[int, NDArray[Any]]

    @property
    def is_signal(self) -> NDArray[np.bool_]:
        """(n,) whether the name is a signal and not the time."""
        return np.asarray(self.table != 0)


def starts_as_version_4(top: bytes) -> bool:
    """Return whether the bytes begin as a MATLAB v4 file does: its first matrix's header, with a size that can be."""
    order = _order(top)
    if len(top) < _HEADER or order is None:
        return False
    kind, rows, columns, imaginary, length = struct.unpack(f"{order}5i", top[:_HEADER])
    known = kind % 1000 // 10 in _TYPES and kind % 10 <= 1
    return known and imaginary in (0, 1) and 1 < length <= _MAX_NAME and rows >= 0 and columns >= 0


def recognises(path: Path, top: bytes) -> bool:
    """True for a file that starts with the `Aclass` matrix every result file starts with."""
    return _order(top) is not None and top[_HEADER:].startswith(b"Aclass\0")


def signals(path: Path) -> list[tuple[str, str]]:
    """Name and unit of every variable, parameter and alias but the time; WaveformError where the file is damaged."""
    result = _open(path)
    return [(result.names[i], result.units[i]) for i in np.flatnonzero(result.is_signal)]


def read(path: Path, signals: Sequence[str] | None = None) -> Trajectory:
    """The variables, parameters and aliases, all or those named in that order, over the times of the file.

    Parameters are expanded to constants. An instant with more than two rows keeps its first and last: before and after
    the event. Values are what the file stores, often single precision.
    Raises WaveformError for a file that is damaged or too large for memory, UnknownNameError for a name not in it.
    """
    result = _open(path)
    known = np.flatnonzero(result.is_signal)
    wanted = known[pick(path, signals, [result.names[i] for i in known])]
    time = np.asarray(result.tables[2][:, :1], dtype=float).ravel()
    check_times(time, path)
    check_size(time.size, wanted.size, path)
    values = np.empty((time.size, wanted.size))
    for number in np.unique(result.table[wanted]):
        places = np.flatnonzero(result.table[wanted] == number)
        signed = result.column[wanted[places]]
        columns = _resampled(result, int(number), np.abs(signed) - 1, time, path)
        values[:, places] = columns * np.sign(signed)
    names, units = tuple(result.names[i] for i in wanted), tuple(result.units[i] for i in wanted)
    return Trajectory(time, values, names, units, Origin(time_unit="s"))


def _open(path: Path) -> _Result:
    matrices = matrices_of(path)
    transposed = _is_transposed(matrices, path)
    for needed in ("name", "dataInfo", "data_2"):
        if needed not in matrices:
            raise damaged(path, f"no matrix '{needed}'", expected=f"one beside {', '.join(matrices)}")
    # one line per name, per row of a table: stored transposed, that is how the bytes already lie
    lines = {k: m.values if transposed else m.values.T for k, m in matrices.items()}
    names = _texts(lines["name"])
    info = lines["dataInfo"]
    if info.shape[0] != len(names) or info.shape[1] < 2:
        raise damaged(path, "matrix 'dataInfo' does not fit", expected=f"{len(names)} x 4", got=_shape(info))
    described = "description" in lines and lines["description"].size > 0
    descriptions = _texts(lines["description"]) if described else ("",) * len(names)
    if len(descriptions) != len(names):
        raise damaged(path, "matrix 'description' does not fit", expected=f"{len(names)}", got=f"{len(descriptions)}")
    tables = {int(k[5:]): v for k, v in lines.items() if re.fullmatch(r"data_[1-9]\d?", k)}
    table, column = _places(info, path)
    result = _Result(names, tuple(_unit(text) for text in descriptions), table, column, tables)
    _check_places(result, path)
    return result


def _is_transposed(matrices: dict[str, _Matrix], path: Path) -> bool:
    if "Aclass" not in matrices:
        raise damaged(path, "not a result file", expected="a matrix 'Aclass'", got=", ".join(matrices) or "none")
    lines = _texts(matrices["Aclass"].values.T)  # never transposed itself
    if len(lines) < 4 or lines[0] != "Atrajectory":
        raise damaged(path, "not a trajectory", expected="class 'Atrajectory'", got=f"'{lines[0][:30]}'")
    if lines[3] not in ("binTrans", "binNormal"):
        raise damaged(path, "unknown layout", expected="binTrans or binNormal", got=f"'{lines[3][:30]}'")
    return lines[3] == "binTrans"


def _places(info: NDArray[Any], path: Path) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Table and signed column of each name."""
    numbers = np.asarray(info[:, :2], dtype=float)
    if not np.isfinite(numbers).all() or (numbers != np.round(numbers)).any() or (np.abs(numbers) > 2**31).any():
        raise damaged(path, "matrix 'dataInfo' holds other than whole numbers")
    places = numbers.astype(np.int64)
    return places[:, 0], places[:, 1]


def _check_places(result: _Result, path: Path) -> None:
    """Every name leads to a column that is there, and no two signals have one name."""
    width = np.zeros(100, dtype=np.int64)
    width[0] = 1
    for number, table in result.tables.items():
        width[number] = table.shape[1]
    inside = (result.table >= 0) & (result.table < 100)
    place = np.abs(result.column)
    bad = ~inside | (place < 1) | (place > width[np.where(inside, result.table, 0)])
    if bad.any():
        i = int(np.argmax(bad))
        got = f"table {result.table[i]}, column {result.column[i]}"
        raise damaged(path, f"signal '{result.names[i][:80]}' has no column in the tables of the file", got=got)
    if len(set(result.names)) < len(result.names):
        seen: set[str] = set()
        double = next(n for n in result.names if n in seen or seen.add(n))  # type: ignore[func-returns-value]
        raise damaged(path, f"two signals have the name '{double[:80]}'")


def _resampled(result: _Result, number: int, columns: NDArray[np.int64], time: Array, path: Path) -> Array:
    """(n or 1, k) columns of a table at the times of data_2; one row for a table of constants."""
    table = result.tables[number]
    if number == 2:
        return np.asarray(table[:, columns], dtype=float)
    times = np.asarray(table[:, 0], dtype=float)
    if np.array_equal(times, time):
        return np.asarray(table[:, columns], dtype=float)
    values = np.asarray(table[:, columns], dtype=float)
    if len(times) and (values == values[0]).all():
        return values[:1]
    if len(times) < 2 or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise damaged(path, f"matrix 'data_{number}' has times of its own that do not increase", got=_shape(table))
    return np.column_stack([np.interp(time, times, values[:, j]) for j in range(columns.size)])


def matrices_of(path: Path) -> dict[str, _Matrix]:
    """The matrices of a MATLAB v4 file by name; nothing is read before the file is known to hold it."""
    try:
        data: NDArray[np.uint8] = np.memmap(path, dtype=np.uint8, mode="r")
    except (OSError, ValueError) as error:
        raise damaged(path, f"cannot open the file: {error}") from None
    matrices: dict[str, _Matrix] = {}
    place = 0
    while place < data.size:
        if len(matrices) >= _MAX_MATRICES:
            raise damaged(path, "too many matrices", expected=f"at most {_MAX_MATRICES}")
        matrix, place = _matrix(data, place, path)
        if matrix.name in matrices:
            raise damaged(path, f"matrix '{matrix.name}' stands twice")
        matrices[matrix.name] = matrix
    return matrices


def _matrix(data: NDArray[np.uint8], place: int, path: Path) -> tuple[_Matrix, int]:
    """The matrix at a byte of the file and the byte after it."""
    top = data[place : place + _HEADER].tobytes()
    order = _order(top)
    if len(top) < _HEADER or order is None:
        raise damaged(path, f"no matrix header at byte {place}", expected="a MATLAB v4 matrix", got=f"{top[:8]!r}")
    kind, rows, columns, imaginary, length = struct.unpack(f"{order}5i", top)
    code, text = kind % 1000 // 10, kind % 10
    if code not in _TYPES or text > 1 or imaginary or not 1 < length <= _MAX_NAME or rows < 0 or columns < 0:
        got = f"type {kind}, {rows} x {columns}, name of {length} bytes"
        raise damaged(path, f"no matrix header at byte {place}", expected="a real MATLAB v4 matrix", got=got)
    name = data[place + _HEADER : place + _HEADER + length].tobytes().split(b"\0")[0].decode("latin-1")
    dtype = np.dtype(f"{order}{_TYPES[code]}")
    start = place + _HEADER + length
    size = rows * columns * dtype.itemsize  # whole numbers of any length: cannot overflow
    if size > data.size - start:
        got = f"{max(0, data.size - start)} left in the file"
        raise damaged(path, f"matrix '{name}' of {rows} x {columns} is cut off", f"{size} bytes", got)
    if size == 0:  # no bytes behind a number of rows or columns, which may be any
        rows = columns = 0
    values = data[start : start + size].view(dtype).reshape(columns, rows)
    return _Matrix(name, text == 1, values), start + size


def _order(top: bytes) -> str | None:
    """The byte order of a matrix header, "<" or ">"; None where it is no header."""
    if len(top) < 4:
        return None
    for order, thousands in (("<", 0), (">", 1)):
        (kind,) = struct.unpack(f"{order}i", top[:4])
        if kind // 1000 == thousands and kind % 1000 // 100 == 0:
            return order
    return None


def _texts(lines: NDArray[Any]) -> tuple[str, ...]:
    """One text per row of a matrix of character codes."""
    if lines.dtype.kind == "f":
        lines = np.nan_to_num(lines, nan=0.0)
    codes = np.ascontiguousarray(np.clip(lines, 0, 255).astype(np.uint8))
    return tuple(decoded(row.tobytes().split(b"\0")[0].rstrip()) for row in codes) or ("",)


def _unit(description: str) -> str:
    """The unit at the end of a description: `[unit]`, `[unit|display unit]` or `[unit:#(attributes)]`."""
    match = _UNIT.search(description)
    return re.split(r"[|:]", match[1])[0].strip() if match else ""


def _shape(values: NDArray[Any]) -> str:
    return " x ".join(str(n) for n in values.shape)
