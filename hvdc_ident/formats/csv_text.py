"""CSV and its relatives: one header line, then numbers, separated by comma, semicolon, tab or blanks.

A first column of dates or times of day, as phasor measurement units export them, counts in s from its first row.
Two readers share one layout: a fast one that only says yes or no, and a careful one that either finds the line and
column that is wrong or, where only columns nobody asked for are, reads around them.
"""

from __future__ import annotations

import codecs
import csv
import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.errors import WaveformError
from hvdc_ident.formats import FORMULA_START, event_rows, pick
from hvdc_ident.formats._clock import Clock, is_clock
from hvdc_ident.trajectory import Array, Trajectory

NAME = "csv"
SUMMARY = "text columns under one header line, the first column time in s or a date; comma, semicolon, tab or blanks"
SUFFIXES = (".csv", ".tsv", ".txt", ".ssv", ".asc")

_MAX_COLUMNS = 100_000
_MAX_LINE = 32 * 1024**2  # characters
_SEPARATORS = (";", "\t", ",")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_UNIT = re.compile(r"(?P<name>.*\S)\s*\[(?P<unit>[^\[\]]*)\]|(?P<name2>.*\S)\s+\((?P<unit2>[^()]*)\)", re.DOTALL)
_SUBSCRIPT = re.compile(r"[\d,:\s]+")
_SECONDS = {"", "s", "sec", "second", "seconds", "-"}
_MANY_ROWS_SHARE = 0.2  # of the instants that may have more than two rows (event iterations)


@dataclass(frozen=True)
class _Layout:
    """What the top of a file says about the rest. labels: the header cells as they stand, the time's included.

    absolute: the first column holds dates or times of day.
    """

    path: Path
    encoding: str
    header_line: int
    separator: str | None
    trailing: bool
    labels: tuple[str, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    absolute: bool = False

    def column(self, i: int) -> str:
        return f"column {i + 1} ('{_short(self.labels[i])}')"


def recognises(path: Path) -> bool:
    """Whether the file's ending is one of text columns and it starts like text."""
    if path.suffix.lower() not in SUFFIXES:
        return False
    with open(path, "rb") as file:
        return b"\0" not in file.read(65536)


def signals(path: Path) -> list[tuple[str, str]]:
    """Name and unit of every column but the time's; WaveformError where the top of the file is wrong."""
    layout = _layout(path)
    return list(zip(layout.names[1:], layout.units[1:], strict=True))


def read(path: Path, signals: Sequence[str] | None = None) -> Trajectory:
    """The columns, all or those named (as in the header, with or without the unit), in that order.

    A time with more than two rows keeps its first and last where this is rare (the steps of an event that some
    simulators write out). Raises WaveformError with line and column, UnknownNameError for a column that is not there.
    """
    layout = _layout(path)
    _check_text(layout)
    wanted = pick(path, signals, layout.names[1:], layout.labels[1:])
    columns = [0] + [i + 1 for i in wanted]
    table = None if layout.absolute else _fast(layout, columns)
    if table is None:
        table = _careful(layout, columns)
    if len(table) < 2:
        raise WaveformError("too few rows", where=str(path), expected="at least 2 rows of numbers", got=f"{len(table)}")
    time = table[:, 0]
    keep = _checked_rows(layout, time)
    if not keep.all():
        table = table[keep]
    names = tuple(signals) if signals is not None else layout.names[1:]
    return Trajectory(table[:, 0], table[:, 1:], names, tuple(layout.units[i] for i in columns[1:]))


def sample(path: Path) -> None:
    """Nothing; a small file with a unit and a jump is at the path afterwards."""
    path.write_text("# two signals\ntime,u [pu],y\n0.0,1.0,0.4\n0.1,1.0,0.4\n0.1,1.5,0.4\n0.25,1.5,-2e-3\n", "utf-8")


def _layout(path: Path) -> _Layout:
    encoding = _encoding(path)
    lines = _lines(path, encoding)
    number, header = next(lines, (0, ""))
    if not header:
        raise WaveformError("nothing but blank lines and comments", where=str(path), expected="a header and numbers")
    _, row = next(lines, (0, ""))
    separator = _separator(header, row)
    labels = _header_cells(header, separator, path, number)
    trailing = len(labels) > 1 and labels[-1] == ""
    if trailing:
        labels = labels[:-1]
    elif separator and row:
        cells = row.split(separator)
        trailing = len(cells) == len(labels) + 1 and not cells[-1].strip()
    _check_labels(labels, path, number)
    names, units = _names_and_units(labels)
    absolute = separator is not None and is_clock(row.split(separator)[0].strip(' "'))
    if not absolute and units[0].lower() not in _SECONDS:
        raise WaveformError(
            "the first column is not in seconds",
            where=f"{path}, line {number}, column 1",
            expected="time in s",
            got=f"'{_short(labels[0])}'",
            hint="write the time in seconds",
        )
    return _Layout(path, encoding, number, separator, trailing, tuple(labels), names, units, absolute)


def _encoding(path: Path) -> str:
    with open(path, "rb") as file:
        top = file.read(65536)
    if top.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise WaveformError("the text is UTF-16", where=str(path), expected="UTF-8", hint="save it as UTF-8")
    try:
        codecs.getincrementaldecoder("utf-8")().decode(top)
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8-sig"


def _lines(path: Path, encoding: str) -> Iterator[tuple[int, str]]:
    """Line number and text of the lines that are neither blank nor comments."""
    with open(path, encoding=encoding, errors="replace") as file:
        number = 0
        while line := file.readline(_MAX_LINE):
            number += 1
            if len(line) == _MAX_LINE:
                raise WaveformError("a line has no end", where=f"{path}, line {number}", expected="lines of numbers")
            if "\0" in line:
                raise _binary(path, number)
            text = line.strip(" \r\n")
            if text.strip() and not text.startswith("#"):
                yield number, text


def _binary(path: Path, line: int) -> WaveformError:
    return WaveformError(
        "binary content", where=f"{path}, line {line}", expected="text", got="a NUL byte", hint="export the data as CSV"
    )


def _check_text(layout: _Layout) -> None:
    """Refuse a file with a NUL byte anywhere; says in which line."""
    line = 1
    with open(layout.path, "rb") as file:
        while chunk := file.read(1 << 20):
            place = chunk.find(b"\0")
            if place >= 0:
                raise _binary(layout.path, line + chunk.count(b"\n", 0, place))
            line += chunk.count(b"\n")


def _separator(header: str, row: str) -> str | None:
    """The separator that both the header (outside quotes) and the first row of numbers show; None: blanks."""
    bare = re.sub(r'"[^"]*"', "", header)
    for separator in _SEPARATORS:
        if separator in bare and (separator in row or not row):
            return separator
    if not re.search(r"\s", bare) or not re.search(r"\s", row):
        return next((s for s in _SEPARATORS if s in bare), None)
    return None


def _header_cells(header: str, separator: str | None, path: Path, line: int) -> list[str]:
    if header.count(separator or " ") >= _MAX_COLUMNS:
        raise WaveformError("too many columns", where=f"{path}, line {line}", expected=f"at most {_MAX_COLUMNS}")
    if separator is None:
        cells = re.findall(r'(?:"[^"]*"|\S+)(?:\s+(?:\[[^\]]*\]|\([^)]*\)))?', header)
        return [cell.replace('"', "") for cell in cells]
    try:
        (cells,) = csv.reader([header], delimiter=separator, skipinitialspace=True)
    except (csv.Error, ValueError) as error:
        raise WaveformError("the header cannot be read", where=f"{path}, line {line}", got=str(error)) from None
    return [cell.strip() for cell in cells]


def _check_labels(labels: Sequence[str], path: Path, line: int) -> None:
    where = f"{path}, line {line}"
    if all(_NUMBER.fullmatch(cell.replace(",", ".")) for cell in labels):
        raise WaveformError(
            "no header",
            where=where,
            expected="a line with the names of the columns",
            got="numbers",
            hint="put one before the numbers, without # at its start",
        )
    if len(labels) < 2:
        raise WaveformError(
            "only one column",
            where=where,
            expected="time and at least one signal",
            got=f"'{_short(labels[0])}'" if labels else "nothing",
            hint="separate the columns with commas, semicolons, tabs or blanks",
        )
    for i, label in enumerate(labels):
        if not label:
            raise WaveformError("a column without a name", where=f"{where}, column {i + 1}", hint="name it")
    double = [(label, n) for label, n in Counter(labels).items() if n > 1]
    if double:
        label, n = double[0]
        at = [i + 1 for i, other in enumerate(labels) if other == label]
        raise WaveformError(
            f"{n} columns have the name '{_short(label)}'", where=f"{where}, columns {at[0]} and {at[1]}", hint="rename"
        )


def _names_and_units(labels: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units of the header cells; a cell keeps its unit in the name where two would be the same without."""
    parts = [_name_and_unit(label) for label in labels]
    counts = Counter(name for name, _ in parts)
    names = [name if counts[name] == 1 else label for (name, _), label in zip(parts, labels, strict=True)]
    return tuple(names), tuple(unit for _, unit in parts)


def _name_and_unit(label: str) -> tuple[str, str]:
    match = _UNIT.fullmatch(label)
    name, unit = label, ""
    if match and match["name"] is not None and not _SUBSCRIPT.fullmatch(match["unit"]):
        name, unit = match["name"], match["unit"].strip()
    elif match and match["name2"] is not None:
        name, unit = match["name2"], match["unit2"].strip()
    if name.startswith("'") and FORMULA_START.match(name[1:]):
        name = name[1:]
    return name, unit


def _fast(layout: _Layout, columns: list[int]) -> Array | None:
    """(n, columns) the numbers, or None where anything about the file is not as it should be."""
    try:
        table = np.loadtxt(_rows(layout), delimiter=layout.separator, comments=None, ndmin=2, dtype=float)
    except (ValueError, StopIteration):
        return None
    if table.shape[1] != len(layout.labels):
        return None
    table = table[:, columns] if columns != list(range(table.shape[1])) else table
    return table if np.isfinite(table).all() else None


def _rows(layout: _Layout) -> Iterator[str]:
    """The lines of numbers, made plain for the fast reader; ValueError where that cannot be done without doubt."""
    separator = layout.separator
    comma = point = False
    empty = True
    with open(layout.path, encoding=layout.encoding, errors="replace") as file:
        for _ in range(layout.header_line):
            next(file, "")
        for line in file:
            if line.isspace() or line.startswith("#") or line.lstrip().startswith("#"):
                continue
            if '"' in line:
                line = line.replace('"', "")
            if layout.trailing:
                line = line.rstrip(" \r\n")
                line = line[:-1] if line.endswith(separator or " ") else line
            if separator != ",":
                comma, point = comma or "," in line, point or "." in line
                if comma and point:
                    raise ValueError("both decimal signs")
                line = line.replace(",", ".") if comma else line
            empty = False
            yield line
    if empty:
        raise ValueError("no rows")


def _careful(layout: _Layout, columns: list[int]) -> Array:
    """(n, columns) the numbers, read cell by cell; WaveformError with line and column at the first that is wrong."""
    found = []
    clock = Clock()
    width = len(layout.labels)
    comma_line = point_line = 0
    for number, line in _lines(layout.path, layout.encoding):
        if number <= layout.header_line:
            continue
        cells = _cells(line, layout)
        if len(cells) != width:
            raise _ragged(layout, number, len(cells))
        row = []
        for i in columns:
            cell = cells[i]
            if i == 0 and layout.absolute:
                row.append(_clock_time(clock, cell, layout, number))
                continue
            if layout.separator != ",":
                comma_line, point_line = comma_line or number * ("," in cell), point_line or number * ("." in cell)
                cell = cell.replace(",", ".", 1)
            row.append(_number(cell, layout, number, i))
        if comma_line and point_line:
            raise WaveformError(
                f"decimal commas (line {comma_line}) and decimal points (line {point_line}) in one file",
                where=f"{layout.path}, line {number}",
                expected="one decimal sign and no thousands separator",
            )
        found.append(row)
    return np.array(found, dtype=float).reshape(len(found), len(columns))


def _clock_time(clock: Clock, cell: str, layout: _Layout, line: int) -> float:
    """The time of a cell in s from the first row."""
    try:
        return clock.seconds(cell)
    except ValueError as error:
        raise WaveformError(
            f"{error} where the time stands",
            where=f"{layout.path}, line {line}, {layout.column(0)}",
            expected="as in 2026-11-21 10:15:00.020 (or 21/11/2026, day first)",
            got=f"'{_short(cell)}'",
            hint="write the time in seconds",
        ) from None


def _cells(line: str, layout: _Layout) -> list[str]:
    cells = line.split(layout.separator)
    if layout.trailing and len(cells) == len(layout.labels) + 1 and not cells[-1].strip():
        cells.pop()
    return [cell.strip().strip('"').strip() for cell in cells]


def _ragged(layout: _Layout, line: int, got: int) -> WaveformError:
    commas = layout.separator == "," and got > len(layout.labels)
    hint = "if commas are decimal signs, separate the columns with semicolons" if commas else ""
    return WaveformError(
        "the row has another number of cells than the header",
        where=f"{layout.path}, line {line}",
        expected=f"{len(layout.labels)} as in line {layout.header_line}",
        got=str(got),
        hint=hint or "complete the row or take it out; the file may have been cut off there",
    )


def _number(cell: str, layout: _Layout, line: int, column: int) -> float:
    value = float(cell) if _NUMBER.fullmatch(cell) else math.nan
    if math.isfinite(value):
        return value
    lowered = cell.lower().lstrip("+-")
    what = "an empty cell" if not cell else "a value that is not finite" if lowered[:3] in ("nan", "inf") else "text"
    if _NUMBER.fullmatch(cell):
        what = "a number too large"
    raise WaveformError(
        f"{what} where a number belongs",
        where=f"{layout.path}, line {line}, {layout.column(column)}",
        expected="a finite number",
        got=f"'{_short(cell)}'",
        hint="take out the row, or the column if it is not needed",
    )


def _checked_rows(layout: _Layout, time: Array) -> NDArray[np.bool_]:
    """(n,) the rows that stay; WaveformError where the time goes back or stands still."""
    back = np.flatnonzero(np.diff(time) < 0)
    if back.size:
        row = int(back[0]) + 1
        raise WaveformError(
            "the time goes back",
            where=f"{layout.path}, line {_line_of(layout, row)}, {layout.column(0)}",
            expected=f"at least {time[row - 1]:.12g} s, the time of the row before",
            got=f"{time[row]:.12g} s",
            hint="sort the rows by time",
        )
    keep = event_rows(time)
    if keep.all():
        return keep
    instants, rows = np.unique(time, return_counts=True)
    if np.count_nonzero(rows > 2) > _MANY_ROWS_SHARE * instants.size:
        t = instants[np.argmax(rows > 2)]
        row = int(np.flatnonzero(time == t)[2])
        raise WaveformError(
            f"the time {t:.12g} s stands more than twice",
            where=f"{layout.path}, line {_line_of(layout, row)}, {layout.column(0)}",
            expected="two rows at a jump, one anywhere else",
            got=f"{int(rows[instants == t][0])} rows",
            hint="export the time with more digits",
        )
    return keep


def _line_of(layout: _Layout, row: int) -> int:
    """The line of the file in which a row of numbers stands."""
    for i, (number, _) in enumerate(_lines(layout.path, layout.encoding)):
        if i == row + 1:
            return number
    return 0


def _short(text: str) -> str:
    printable = "".join(c if c.isprintable() else "?" for c in text[:61])
    return printable if len(text) <= 60 else printable[:57] + "..."
