"""CSV and its relatives: a line of names, perhaps one of units, then numbers; comma, semicolon, tab or blanks between.

Lines above the names that have another number of cells are a title and left. The time stands in the first column, or
in the one that is called so, in any unit of time; dates or times of day, as phasor measurement units export them, count
in s from the first row. An empty cell, or one of the words for it, was not recorded.
Two readers share one layout: a fast one that only says yes or no, and a careful one that either finds the line and
column that is wrong or, where only columns nobody asked for are, reads around them.
"""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal
from itertools import islice
from pathlib import Path

import numpy as np

from hvdc_ident.data import Array, Origin, Trajectory, gaps, scaled, seconds_of
from hvdc_ident.data.bad_rows import FEWEST, has_clock
from hvdc_ident.errors import WaveformError
from hvdc_ident.formats import LONGEST, TOP, event_rows, pick, unit_since_1970
from hvdc_ident.formats._clock import Clock, is_clock, is_date
from hvdc_ident.formats._labels import is_date_name, merged, names_and_units, time_column, unit_in_name
from hvdc_ident.formats._text import WIDE, encoding_of

NAME = "csv"
SUMMARY = (
    "text columns under their names, and perhaps units, time in s, ms or as dates; comma, semicolon, tab or blanks"
)
SUFFIXES = (".csv", ".tsv", ".txt", ".ssv", ".asc")
LAST = True

_MAX_COLUMNS = 100_000
_MAX_LINE = 32 * 1024**2  # characters
_SEPARATORS = (";", "\t", ",")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_THOUSANDS = re.compile(r"([+-]?[0-9]{1,3}(?:['’\u00a0\u2009\u202f][0-9]{3})+)(?![0-9'’\u00a0\u2009\u202f])(.*)")
"""Pattern of a number whose thousands are set apart as in Switzerland, or by a blank that breaks no line."""
_DATED = re.compile(r":|[^\W\d_]{3}.*\d|\d[-/ ]\w+[-/ ]\d|\d{1,2}\.\d{1,2}\.\d{2,4}\b|\d{8}[T ]\d")
"""Pattern of a date or time of day, in whatever order."""
_SERIAL_UNIT, _SERIAL = 86400.0, ((20_000.0, 80_000.0), (700_000.0, 780_000.0))
"""s in a day, and the days between 1954 and 2119 as spreadsheets count them, since 1899-12-30, and MATLAB, since the year 0."""
_SERIAL_NOTE = "the time is taken for dates as a spreadsheet counts them, in days"
_MAYBE_SERIAL = (
    "the time may be dates as a spreadsheet counts them, in days, and is taken as s: "
    'name the column "date", or its unit "d", if it is'
)
_SHORT_STEP = 1e-3  # d, 86 s: dates of a spreadsheet lie closer, and a clock of seconds seldom begins at half a day
_DATES = "as in 2026-11-21 10:15:00.020, 21/11/2026 10:15:00 or 21-Nov-2026 10:15:00"
_MISSING = {
    "", "nan", "-nan", "+nan", "na", "n/a", "#n/a", "#na", "#nv", "#n/d", "null", "none", "<na>", "1.#qnan", "-1.#qnan",
    "1.#ind", "-1.#ind", "--", "---", "n. def.", "non numérique", "non un numero reale",
}  # fmt: skip
"""Texts, in lower case, of cells in which nothing was recorded: those that pandas reads so, Excel's, and .NET's."""
_QUOTED_COMMA = re.compile(r'(?:^|,)\s*"[^",]*,[^"]*"\s*(?:,|$)')
_EMPTY = ' \t,;"\r\n'
_DIRECTIVE = re.compile(r'"?sep=."?', re.IGNORECASE)
_TOP = 40  # lines within which the numbers begin
_MANY_ROWS_SHARE = 0.2  # of the instants that may have more than two rows (event iterations)


@dataclass(frozen=True)
class _Layout:
    """Layout of a file as its top declares it. labels: the header cells as they stand, the time's included.

    units: the time's included, as the header says them. time: the column of times; scale: s in its unit. date: the
    column of dates beside it, -1 where there is none. absolute: whether its times are dates or times of day. since: where
    the times are numbers counted since 1970, or days as spreadsheets count them, that of the first row, which the readers take
    off before a double is made: 1.7e18 ns has more digits than a double. notes: what is not certain about them.
    """

    path: Path
    encoding: str
    header_line: int
    separator: str | None
    trailing: bool
    labels: tuple[str, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    time: int = 0
    scale: float = 1.0
    date: int = -1
    absolute: bool = False
    since: Decimal | None = None
    notes: tuple[str, ...] = ()

    def column(self, i: int) -> str:
        return f"column {i + 1} ('{_short(self.labels[i])}')"

    @property
    def signals(self) -> list[int]:
        """The columns that are not times or dates."""
        return [i for i in range(len(self.labels)) if i not in (self.time, self.date)]


def recognises(path: Path, top: bytes) -> bool:
    """True for a file whose ending is one of text columns and that starts like text."""
    return path.suffix.lower() in SUFFIXES and (top.startswith(WIDE) or b"\0" not in top)


def signals(path: Path) -> list[tuple[str, str]]:
    """Name and unit of every column but the time's; WaveformError where the top of the file is wrong."""
    layout = _layout(path)
    return [(layout.names[i], layout.units[i]) for i in layout.signals]


def read(path: Path, signals: Sequence[str] | None = None) -> Trajectory:
    """The columns, all or those named (as in the header, with or without the unit), in that order.

    A time with more than two rows keeps its first and last where this is rare (the steps of an event that some
    simulators write out). Raises WaveformError with line and column, UnknownNameError for a column that is not there.
    """
    layout = _layout(path)
    _check_text(layout)
    known = layout.signals
    wanted = pick(path, signals, [layout.names[i] for i in known], [layout.labels[i] for i in known])
    columns = [layout.time] + [known[i] for i in wanted]
    clock = Clock()
    table = None if layout.absolute else _fast(layout, columns)
    if table is None:
        table = _careful(layout, columns, clock)
    if len(table) < 2:
        raise WaveformError("too few rows", where=str(path), expected="at least 2 rows of numbers", got=f"{len(table)}")
    _check_times(layout, table)
    names = tuple(signals) if signals is not None else tuple(layout.names[i] for i in known)
    dated = layout.absolute or layout.since is not None
    unit = "date" if dated else layout.units[layout.time]
    notes = (
        *layout.notes,
        *clock.notes,
        *([_MAYBE_SERIAL] if not unit and _may_be_serial(table[:, 0]) else []),
    )
    origin = Origin(time_unit=unit, time_column=layout.labels[layout.time] if layout.time else "", notes=notes)
    time = table[:, 0] - table[0, 0] if dated else table[:, 0]
    time = scaled(time, layout.scale)
    return Trajectory(time, table[:, 1:], names, tuple(layout.units[i] for i in columns[1:]), origin)


def _layout(path: Path) -> _Layout:
    encoding = _encoding(path)
    top = list(islice(_lines(path, encoding), _TOP))
    if not top:
        raise WaveformError("nothing but blank lines and comments", where=str(path), expected="names and numbers")
    first = next((k for k, (_, line) in enumerate(top) if _is_row(line)), min(1, len(top)))
    row = top[first][1] if first < len(top) else ""
    if first == 0:
        raise _no_header(path, top[0][0])
    number, header = top[first - 1]
    separator = _separator(header, row)
    _check_columns(path, number, header.split(separator, 4))
    rows = [_header_cells(header, separator, path, number)]
    for above, line in reversed(top[: first - 1]):
        cells = _header_cells(line, separator, path, above)
        if separator is None or len(cells) != len(rows[0]) or len(cells) < 2 or len(rows) == 3 or not any(cells[1:]):
            break
        rows.insert(0, cells)
    labels = merged(rows) if len(rows) > 1 else rows[0]
    trailing = len(labels) > 1 and labels[-1] == ""
    if trailing:
        labels = labels[:-1]
    elif separator and row:
        cells = row.split(separator)
        trailing = len(cells) == len(labels) + 1 and not cells[-1].strip()
    time = time_column(labels)
    if time and not labels[0]:
        labels[0] = "row"  # the index that some packages write first and without a name
    _check_labels(labels, path, number)
    names, units = names_and_units(labels)
    if not units[time] and (unit := unit_in_name(labels[time], labels)):
        units = (*units[:time], unit, *units[time + 1 :])
    cells = [c.strip(' "') for c in _split(row, separator)]
    absolute, date = False, -1
    if len(cells) >= len(labels) > 1:
        absolute = is_clock(cells[time])
        if (
            is_date(cells[time]) and len(cells) > time + 1 and is_clock(cells[time + 1])
        ):  # a date beside its time of day
            absolute, date, time = True, time, time + 1
        elif absolute and time and is_date(cells[time - 1]):
            date = time - 1
    scale = 1.0 if absolute else seconds_of(units[time])
    if scale is None:
        raise WaveformError(
            "the time is in a unit that is none of time",
            where=f"{path}, line {number}, column {time + 1}",
            expected="s, ms, us, min, h, or dates",
            got=f"'{_short(labels[time])}'",
            hint="put the column of times first, or name it 'time [s]'",
        )
    since, notes = None, tuple[str, ...]()
    if not absolute and len(cells) > time:
        since, scale, notes = _epoch(cells[time], labels[time], units[time], scale)
    return _Layout(
        path,
        encoding,
        number,
        separator,
        trailing,
        tuple(labels),
        names,
        units,
        time,
        scale,
        date,
        absolute,
        since,
        notes,
    )


def _epoch(cell: str, label: str, unit: str, scale: float) -> tuple[Decimal | None, float, tuple[str, ...]]:
    """The first time where it is a number counted since 1970, or the number of a day, else None; s in its unit; remarks.

    scale: s in the unit that the header says, 1 where it says none.
    """
    text = _plain(cell if "." in cell else cell.replace(",", ".", 1))
    if not _NUMBER.fullmatch(text):
        return None, scale, ()
    if not unit and is_date_name(label) and _is_serial(float(text)):
        return Decimal(text), _SERIAL_UNIT, (_SERIAL_NOTE,)
    if float(text) * scale >= LONGEST:
        return Decimal(text), scale if unit else unit_since_1970(float(text)), ()
    return None, scale, ()


def _is_serial(number: float) -> bool:
    return any(low <= number < high for low, high in _SERIAL)


def _may_be_serial(time: Array) -> bool:
    """Return whether times without a unit may be days. time: (n,) as in the file."""
    steps = np.diff(time)
    return _is_serial(time[0]) and _is_serial(time[-1]) and 0.0 < float(np.median(steps)) < _SHORT_STEP


def _plain(cell: str) -> str:
    """The number of a cell without marks between its thousands, and with a plain minus."""
    if cell.isascii() and "'" not in cell:
        return cell
    text = cell.replace("\u2212", "-")
    grouped = _THOUSANDS.fullmatch(text)
    return re.sub(r"[^0-9+-]", "", grouped[1]) + grouped[2] if grouped else text


def _is_row(line: str) -> bool:
    """Return whether a line is one of numbers, not of names: one of its first cells is a number, a date or a time of day."""
    for separator in (*_SEPARATORS, None):
        cells = [c.strip(' "') for c in line.split(separator, 2)]  # of a line that may be very long
        if len(cells) > 1 or (separator is None and not any(s in line for s in _SEPARATORS)):
            tops = cells[:2] if cells[0] == "" or is_date(cells[0]) else cells[:1]
            decimal = "," if separator == "," else "."
            if any(_NUMBER.fullmatch(_plain(c).replace(",", decimal, 1)) or is_clock(c) or is_date(c) for c in tops):
                return True
    return False


def _encoding(path: Path) -> str:
    with open(path, "rb") as file:
        return encoding_of(file.read(TOP))


def _lines(path: Path, encoding: str) -> Iterator[tuple[int, str]]:
    """Line number and text of the lines that are neither blank, nor comments, nor Excel's `sep=;`.

    Lines of nothing but separators are left out at the end only, where spreadsheets put them.
    """
    empty: list[tuple[int, str]] = []
    with open(path, encoding=encoding, errors="replace") as file:
        number = 0
        while line := file.readline(_MAX_LINE):
            number += 1
            if len(line) == _MAX_LINE:
                raise WaveformError("a line has no end", where=f"{path}, line {number}", expected="lines of numbers")
            if "\0" in line:
                raise _binary(path, number)
            text = line.strip(" \r\n")
            if not text.strip() or text.startswith("#") or _DIRECTIVE.fullmatch(text):
                continue
            if not text.strip(_EMPTY):
                empty.append((number, text))
                continue
            yield from empty
            empty.clear()
            yield number, text


def _binary(path: Path, line: int) -> WaveformError:
    return WaveformError(
        "binary content", where=f"{path}, line {line}", expected="text", got="a NUL byte", hint="export the data as CSV"
    )


def _check_text(layout: _Layout) -> None:
    """Refuse a file with a NUL byte anywhere; says in which line."""
    line = 1
    if layout.encoding == "utf-16":
        return  # where every second byte is one; the lines are looked at instead
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


def _check_columns(path: Path, line: int, cells: Sequence[str]) -> None:
    """Refuse a table that lies on its side. cells: the first of the line of names."""
    beside = [c.strip(' "').replace(",", ".") for c in cells[1:4]]
    if len(beside) > 1 and all(_NUMBER.fullmatch(c) for c in beside):
        raise WaveformError(
            "the signals stand in rows",
            where=f"{path}, line {line}",
            expected="one column a signal, under its name",
            got=f"'{_short(cells[0])}' with numbers beside it",
            hint="turn the table: in a spreadsheet paste it transposed; in pandas read_csv(..., index_col=0).T",
        )


def _no_header(path: Path, line: int) -> WaveformError:
    return WaveformError(
        "no header",
        where=f"{path}, line {line}",
        expected="a line with the names of the columns",
        got="numbers",
        hint="put one before the numbers, without # at its start",
    )


def _check_labels(labels: Sequence[str], path: Path, line: int) -> None:
    where = f"{path}, line {line}"
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


def _fast(layout: _Layout, columns: list[int]) -> Array | None:
    """(n, columns) the numbers, or None where anything about the file is not as it should be."""
    try:
        table = np.loadtxt(
            _rows(layout), delimiter=layout.separator, comments=None, ndmin=2, dtype=float, encoding=None,
            converters=None if layout.since is None else {layout.time: lambda cell: _after(cell.strip(), layout.since)},
        )  # fmt: skip
    except (ValueError, StopIteration):
        return None
    if table.shape[1] != len(layout.labels):
        return None
    table = table[:, columns] if columns != list(range(table.shape[1])) else table
    return table if np.isfinite(table[:, 0]).all() and not np.isinf(table).any() else None


def _after(cell: str, since: Decimal | None) -> float:
    """The number of a cell less `since`, taken off in decimal figures. Raises ValueError where it is no number."""
    if since is None or not _NUMBER.fullmatch(cell):
        return float(cell)
    return float(Decimal(cell) - since)


def _rows(layout: _Layout) -> Iterator[str]:
    """The lines of numbers, made plain for the fast reader; ValueError where that cannot be done without doubt."""
    separator = layout.separator
    void = False
    comma = point = False
    empty = True
    with open(layout.path, encoding=layout.encoding, errors="replace") as file:
        for _ in range(layout.header_line):
            next(file, "")
        for line in file:
            if line.isspace() or line.startswith("#") or line.lstrip().startswith("#"):
                continue
            if not line.strip(_EMPTY):
                void = True
                continue
            if void:
                raise ValueError("a row of nothing but separators")
            if '"' in line:
                if separator == "," and _QUOTED_COMMA.search(line):
                    raise ValueError("decimal commas in quotes")
                line = line.replace('"', "")
            if layout.trailing:
                line = line.rstrip(" \r\n")
                line = line[:-1] if line.endswith(separator or " ") else line
            if separator != ",":
                comma, point = comma or "," in line, point or "." in line
                if comma and point:
                    raise ValueError("both decimal signs")
                line = line.replace(",", ".") if comma else line
            if separator and separator * 2 in line:
                line = line.replace(separator * 2, f"{separator}nan{separator}").replace(
                    separator * 2, f"{separator}nan{separator}"
                )
            empty = False
            yield line
    if empty:
        raise ValueError("no rows")


def _careful(layout: _Layout, columns: list[int], clock: Clock) -> Array:
    """(n, columns) the numbers, read cell by cell; WaveformError with line and column at the first that is wrong."""
    rows = []
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
            if i == layout.time and layout.absolute:
                dated = f"{cells[layout.date]} {cell}" if layout.date >= 0 else cell
                row.append(_clock_time(clock, dated, layout, number))
                continue
            cell = _plain(cell)
            if layout.separator != "," or "," in cell:
                comma_line, point_line = comma_line or number * ("," in cell), point_line or number * ("." in cell)
                if "," in cell and "." not in cell:
                    cell = cell.replace(",", ".", 1)
            row.append(_number(cell, layout, number, i))
        if comma_line and point_line:
            raise WaveformError(
                f"decimal commas (line {comma_line}) and decimal points (line {point_line}) in one file",
                where=f"{layout.path}, line {number}",
                expected="one decimal sign and no thousands separator",
            )
        rows.append(row)
    return np.array(rows, dtype=float).reshape(len(rows), len(columns))


def _clock_time(clock: Clock, cell: str, layout: _Layout, line: int) -> float:
    """The time of a cell in s from the first row."""
    try:
        return clock.seconds(cell)
    except ValueError as error:
        raise WaveformError(
            f"{error} where the time stands",
            where=f"{layout.path}, line {line}, {layout.column(layout.time)}",
            expected=_DATES,
            got=f"'{_short(cell)}'",
            hint="write the time in seconds",
        ) from None


def _cells(line: str, layout: _Layout) -> list[str]:
    cells = _split(line, layout.separator)
    if layout.trailing and len(cells) == len(layout.labels) + 1 and not cells[-1].strip():
        cells.pop()
    return [cell.strip().strip('"').strip() for cell in cells]


def _split(line: str, separator: str | None) -> list[str]:
    """The cells of a line, at its separators outside quotes where there are commas in quotes."""
    if separator == "," and _QUOTED_COMMA.search(line):
        (cells,) = csv.reader([line], skipinitialspace=True)
        return cells
    return line.split(separator)


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
    since = layout.since if column == layout.time else None
    value = _after(cell, since) if _NUMBER.fullmatch(cell) else math.nan
    if math.isfinite(value) or (column != layout.time and cell.lower() in _MISSING):
        return value
    lowered = cell.lower().lstrip("+-")
    what = "an empty cell" if not cell else "a value that is not finite" if lowered[:3] in ("nan", "inf") else "text"
    if _NUMBER.fullmatch(cell):
        what = "a number too large"
    if column == layout.time and _DATED.search(cell):
        raise WaveformError(
            "the time is a date in no known form",
            where=f"{layout.path}, line {line}, {layout.column(column)}",
            expected=f"{_DATES}; or a number",
            got=f"'{_short(cell)}'",
            hint="write the dates as year-month-day hour:minute:second, or the time in seconds",
        )
    raise WaveformError(
        f"{what} where a number belongs",
        where=f"{layout.path}, line {line}, {layout.column(column)}",
        expected="a finite number" + ("" if column == layout.time else ", or an empty cell where nothing was recorded"),
        got=f"'{_short(cell)}'",
        hint="write numbers without separators of thousands"
        if "," in cell and "." in cell
        else "take out the row, or the column if it is not needed",
    )


def _how_to_order(table: Array) -> str:
    """Return what makes one record of rows whose time goes back.

    table: (n, k), instants first. Rows that stand twice to the last digit are taken out, and the others sorted, where that gives one
    record of even steps: enough rows to tell, no two different ones of one instant that stand apart, none between others and no gap.
    Else a clock was set back, or an instant is wrong.
    """
    order = np.argsort(table[:, 0], kind="stable")
    ranked = table[order]
    apart = (np.append(False, np.diff(order) != 1)) & (np.append(False, np.diff(ranked[:, 0]) == 0))
    alike = (ranked[1:] == ranked[:-1]) | (np.isnan(ranked[1:]) & np.isnan(ranked[:-1]))
    twice = apart & np.append(False, alike.all(axis=1))
    time = ranked[~twice, 0]
    steps = np.diff(time)
    between = steps[steps > 0].min(initial=np.inf) < 0.5 * np.median(steps)
    if (apart & ~twice).any() or time.size < FEWEST or between or not has_clock(time) or gaps(time):
        return "sort the rows by time, or cut the record where its time begins again"
    if not (number := int(twice.sum())):
        return "sort the rows by time: they are those of one record in another order"
    first = int(order[twice].min())
    sorted_else = bool((np.diff(np.delete(table[:, 0], order[twice])) >= 0).all())
    then = "" if sorted_else else ", and sort the others by time"
    if number == 1:
        return f"take out data row {first + 1}, which stands twice to the last digit{then}"
    return (
        f"take out the {number} rows that stand twice to the last digit, the first of them data row {first + 1}{then}"
    )


def _check_times(layout: _Layout, table: Array) -> None:
    """WaveformError where the time goes back or stands still. table: (n, k), instants in the file's unit first."""
    time = table[:, 0]
    back = np.flatnonzero(np.diff(time) < 0)
    unit = "s" if layout.absolute else layout.units[layout.time] or "s"
    if back.size:
        row = int(back[0]) + 1
        raise WaveformError(
            "the time goes back",
            where=f"{layout.path}, line {_line_of(layout, row)}, {layout.column(layout.time)}",
            expected=f"at least {time[row - 1]:.12g} {unit}, the time of the row before",
            got=f"{time[row]:.12g} {unit}",
            hint=_how_to_order(table),
        )
    if event_rows(time).all():
        return
    instants, rows = np.unique(time, return_counts=True)
    if np.count_nonzero(rows > 2) > _MANY_ROWS_SHARE * instants.size:
        t = instants[np.argmax(rows > 2)]
        row = int(np.flatnonzero(time == t)[2])
        raise WaveformError(
            f"the time {t:.12g} {unit} stands more than twice",
            where=f"{layout.path}, line {_line_of(layout, row)}, {layout.column(layout.time)}",
            expected="two rows at a jump, one anywhere else",
            got=f"{int(rows[instants == t][0])} rows",
            hint="export the time with more digits",
        )


def _line_of(layout: _Layout, row: int) -> int:
    """The line of the file in which a row of numbers stands."""
    for i, (number, _) in enumerate(_lines(layout.path, layout.encoding)):
        if i == row + 1:
            return number
    return 0


def _short(text: str) -> str:
    printable = "".join(c if c.isprintable() else "?" for c in text[:61])
    return printable if len(text) <= 60 else printable[:57] + "..."
