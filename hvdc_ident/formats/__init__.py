"""Waveforms in and out: one file format per module, found by walking this folder.

A format module supplies what `Format` lists; nothing else has to be registered.
"""

from __future__ import annotations

import contextlib
import csv
import importlib
import os
import pkgutil
import re
import stat
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from io import StringIO
from pathlib import Path
from typing import Protocol, cast

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, Trajectory, scaled
from hvdc_ident.errors import WaveformError, in_python, unknown_name

__all__ = [
    "MAX_BYTES",
    "Format",
    "check_times",
    "convert",
    "event_rows",
    "files_of",
    "formats",
    "list_signals",
    "once",
    "pick",
    "read_waveforms",
    "unit_since_1970",
    "write_csv",
]

TOP = 65536
"""Bytes at the start of a file that are looked at to recognise its format."""
MAX_BYTES = 2 * 1024**3
"""Largest file, and largest table in memory, in bytes."""

FORMULA_START = re.compile(r"'*[=+\-@\t\r]")
"""A text a spreadsheet would run as a formula, with any apostrophes already put before it."""

_WRITTEN_AT_ONCE = 20_000  # rows
LONGEST = 1e8
"""Seconds beyond which a time is a date, counted since 1970."""
_YEAR_2100 = 4.1e9  # s since 1970
_TICKS = (1.2591e17, 1.5747e17), (6.3082e17, 6.6238e17)  # 100 ns, of the years 2000 to 2100


class Format(Protocol):
    """Protocol of a module of this folder.

    NAME is its key in the catalogue, SUMMARY one line for it, SUFFIXES the usual endings, lower case, with the dot.
    """

    NAME: str
    SUMMARY: str
    SUFFIXES: tuple[str, ...]

    def recognises(self, path: Path, top: bytes) -> bool:
        """True for a file of this format, and for no file of another one. top: its first `TOP` bytes."""

    def read(self, path: Path, signals: Sequence[str] | None = None) -> Trajectory:
        """The waveforms, all or those named in that order; WaveformError where the file cannot be used."""

    # A module that can list name and unit of every signal without reading the waveforms has `signals(path)`; one that can
    # also write its format `write(trajectory, path) -> None`, for `convert`; one whose recordings stand in several files
    # `files(path) -> list[Path]`, all of them that are there; one that takes what others may know better, as any text, `LAST = True`.


@cache
def _catalogue() -> tuple[tuple[str, Format], ...]:
    modules = {}
    for info in pkgutil.iter_modules(__path__):
        if not info.name.startswith("_"):
            module = cast(Format, importlib.import_module(f"{__name__}.{info.name}"))
            modules[module.NAME] = module
    return tuple(sorted(modules.items()))


def formats() -> dict[str, Format]:
    """The format modules of this folder by name, in alphabetical order."""
    return dict(_catalogue())


@in_python
def read_waveforms(path: str | os.PathLike[str], signals: Iterable[str] | None = None) -> Trajectory:
    """Return the waveforms of a file of any known format: time in s, signals in the file's units, NaN where not recorded.

    Parameters
    ----------
    path : str or Path
        The file; its format is recognised by its content.
    signals : list of str, default None
        Names wanted, in that order. None: all of them.

    Returns
    -------
    Trajectory
        time (n,) in s, values (n, signals), names, and units as the file or a signal's name states them ("" where neither does).

    Raises
    ------
    WaveformError
        The file cannot be used.
    UnknownNameError
        A signal that the file does not have.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from hvdc_ident import read_waveforms
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "step.csv")
    ...     _ = path.write_text("time,u [pu],y\\n0,1,0.4\\n0.1,1.5,0.4\\n")
    ...     waveforms = read_waveforms(path, ["y", "u"])
    >>> waveforms.names, waveforms.unit("u"), waveforms["u"].tolist()
    (('y', 'u'), 'pu', [1.0, 1.5])
    """
    file = _usable_file(path)
    wanted = [signals] if isinstance(signals, str) else None if signals is None else list(signals)
    waveforms = _format_of(file).read(file, wanted)
    check_times(waveforms.time, file)
    waveforms = once(waveforms)
    _check(waveforms, file)
    units = _units(list(zip(waveforms.names, waveforms.units, strict=True)))
    return _from_first_row(replace(waveforms, units=tuple(unit for _, unit in units)))


def _units(signals: list[tuple[str, str]]) -> list[tuple[str, str]]:
    """Names and units, those that the file does not state as the names say them."""
    from hvdc_ident.formats._labels import unit_in_name

    names = [name for name, _ in signals]
    return [(name, unit or unit_in_name(name, names)) for name, unit in signals]


def _from_first_row(waveforms: Trajectory) -> Trajectory:
    """The waveforms with a time since 1970 counted from the first row; others as they are.

    Three years are no record's own clock.
    """
    first = float(waveforms.time[0])
    if first < LONGEST:
        return waveforms
    scale = 1.0 if waveforms.origin.time_unit else unit_since_1970(first)
    time = scaled(waveforms.time - first, scale)
    return replace(waveforms, time=time, origin=replace(waveforms.origin, time_unit="date"))


def unit_since_1970(number: float) -> float:
    """The unit in s of a time that a file states no unit of: the largest of s, ms, us and ns since 1970 before 2100.

    Whole tenths of a microsecond since 1601 and since the year 1, as Windows and .NET count them, are told by the years 2000 to 2100.
    """
    if any(low <= number < high for low, high in _TICKS):
        return 1e-7
    return next((s for s in (1.0, 1e-3, 1e-6) if number * s < _YEAR_2100), 1e-9)


def files_of(path: str | os.PathLike[str]) -> tuple[Path, ...]:
    """Every file that the recording at a path stands in, that one first. Raises WaveformError where it cannot be used."""
    file = _usable_file(path)
    module = _format_of(file)
    others = module.files(file) if hasattr(module, "files") else []
    return (file, *(other for other in others if other != file))


def list_signals(path: str | os.PathLike[str], search: str = "") -> list[tuple[str, str]]:
    """Name and unit ("" where unknown) of the signals in a file whose names fit the search, in the file's order.

    search: part of the name, or a pattern of the whole name with * and ?; upper and lower case count the same.
    Raises WaveformError where the file cannot be used.
    """
    file = _usable_file(path)
    if "*" in search or "?" in search:
        pattern = re.escape(search).replace(r"\*", ".*").replace(r"\?", ".")
        fits = re.compile(pattern, re.IGNORECASE | re.DOTALL).fullmatch
    else:
        fits = re.compile(re.escape(search), re.IGNORECASE).search
    module = _format_of(file)
    if hasattr(module, "signals"):
        listed = module.signals(file)
    else:
        waveforms = module.read(file)
        listed = list(zip(waveforms.names, waveforms.units, strict=True))
    return [(name, unit) for name, unit in _units(listed) if fits(name)]


def convert(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    signals: Iterable[str] | None = None,
    window: tuple[float, float] | None = None,
) -> Trajectory:
    """The waveforms of a file of any known format, after they were written to a CSV or Parquet file, by its ending.

    signals: names wanted; None for all. window: from and to in s, ends included, of what is written; None for all.
    Times stay what they are. Raises WaveformError where the source cannot be used or the target not written.
    """
    file = Path(target)
    writers = {
        suffix: module for module in formats().values() if hasattr(module, "write") for suffix in module.SUFFIXES
    }
    if file.suffix.lower() != ".csv" and file.suffix.lower() not in writers:
        raise WaveformError(
            "waveforms are not written in that format",
            expected=f"a name ending in {' or '.join(['.csv', *writers])}",
            got=str(file),
        )
    if file.exists() and Path(source).exists() and file.samefile(source):
        raise WaveformError("source and target are the same file", where=str(file), hint="another name")
    waveforms = read_waveforms(source, signals)
    if window is not None:
        waveforms = _cut(waveforms, window, str(source))
    if file.suffix.lower() == ".csv":
        write_csv(waveforms, file)
    else:
        with _whole(file) as temporary:
            writers[file.suffix.lower()].write(waveforms, temporary)
    return waveforms


def _cut(waveforms: Trajectory, window: tuple[float, float], where: str) -> Trajectory:
    """The rows within the window. Raises WaveformError where there are fewer than two."""
    low, high = window
    inside = (waveforms.time >= low) & (waveforms.time <= high)
    if int(inside.sum()) < 2:
        start, end = float(waveforms.time[0]), float(waveforms.time[-1])
        reason = "ends before it begins" if high < low else "holds too few rows"
        reason = "lies outside the record" if low > end or high < start else reason
        raise WaveformError(
            f"the window from {low:g} to {high:g} s {reason}",
            where=where,
            expected=f"at least 2 of the {len(waveforms)} rows from {start:g} to {end:g} s",
            got=f"{int(inside.sum())} rows",
            hint=f"{high:g} {low:g}" if high < low else f"{start:g} {end:g}, which is all of it",
        )
    return waveforms.rows(inside)


def write_csv(trajectory: Trajectory, path: str | os.PathLike[str], *, units: bool = False) -> None:
    """Write the trajectory to the path, whole or not at all, every number to the last bit.

    First column `time` in s, then the signals, an empty cell where a value was not recorded. units: write `name [unit]`
    where the unit is known. A name a spreadsheet would take for a formula gets an apostrophe before it, which the reader
    takes off. Raises WaveformError for infinite values, a signal called `time`, and a place that cannot be written.
    """
    target = Path(path)
    _check(trajectory, target, rows=0)
    if "time" in trajectory.names:
        raise WaveformError("a signal is called 'time' like the first column", where=str(target), hint="rename it")
    with _whole(target) as temporary, open(temporary, "w", encoding="utf-8", newline="") as file:
        file.writelines(_csv_text(trajectory, units))


@contextlib.contextmanager
def _whole(target: Path) -> Iterator[Path]:
    """A path to write to, whose file takes the target's place when nothing went wrong."""
    temporary = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        raise WaveformError(
            "cannot write the file", where=str(target), got=error.strerror or str(error), hint="another folder"
        ) from None
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def pick(path: Path, wanted: Sequence[str] | None, names: Sequence[str], *others: Sequence[str]) -> list[int]:
    """Positions of the wanted signals among `names`, then among `others` (the same signals spelt another way).

    All of them for None. Raises UnknownNameError with the nearest names.
    """
    if wanted is None:
        return list(range(len(names)))
    positions: dict[str, int] = {}
    for spelling in (names, *others):
        for i, name in enumerate(spelling):
            positions.setdefault(name, i)
    for name in wanted:
        if name not in positions:
            raise unknown_name("signal", name, names, where=str(path))
    return [positions[name] for name in wanted]


def event_rows(time: Array) -> NDArray[np.bool_]:
    """(n,) the rows that stay when every instant keeps its first and its last row only: before and after an event.

    time: (n,) in s, non-decreasing.
    """
    new = np.diff(time) != 0
    first = np.concatenate([[True], new])
    last = np.concatenate([new, [True]])
    return np.asarray(first | last)


def once(waveforms: Trajectory) -> Trajectory:
    """The waveforms with the first and the last row of every instant alone; `origin` counts what is left out."""
    keep = event_rows(waveforms.time)
    before = waveforms.origin
    origin = replace(before, rows=before.rows or len(waveforms), dropped=before.dropped + int(np.count_nonzero(~keep)))
    kept = waveforms if keep.all() else waveforms.rows(keep)
    return replace(kept, origin=origin)


def _csv_text(trajectory: Trajectory, units: bool) -> Iterator[str]:
    labels = ["time [s]" if units else "time"]
    for name, unit in zip(trajectory.names, trajectory.units, strict=True):
        label = f"'{name}" if FORMULA_START.match(name) else name
        labels.append(f"{label} [{unit}]" if units and unit else label)
    header = StringIO()
    csv.writer(header, lineterminator="\n").writerow(labels)
    yield header.getvalue()
    for start in range(0, len(trajectory), _WRITTEN_AT_ONCE):
        part = slice(start, start + _WRITTEN_AT_ONCE)
        table = np.column_stack([trajectory.time[part], trajectory.values[part]])
        lines = "".join(",".join(map(repr, row)) + "\n" for row in table.tolist())
        yield lines.replace("nan", "") if np.isnan(table).any() else lines


def _usable_file(path: str | os.PathLike[str]) -> Path:
    file = Path(path)
    try:
        status = file.stat()
    except (OSError, ValueError) as error:
        missing = isinstance(error, FileNotFoundError)
        what = "no such file" if missing else f"cannot open the file: {getattr(error, 'strerror', None) or error}"
        raise WaveformError(
            what, where=str(file), hint="check the path; a study's are relative to the study file"
        ) from None
    if not stat.S_ISREG(status.st_mode):
        got = "a folder" if stat.S_ISDIR(status.st_mode) else "something else"
        raise WaveformError("not a file of waveforms", where=str(file), expected="a regular file", got=got)
    if status.st_size > MAX_BYTES:
        raise WaveformError(
            "the file is too large",
            where=str(file),
            expected=f"at most {MAX_BYTES / 1e9:.1f} GB",
            got=f"{status.st_size / 1e9:.1f} GB",
            hint="export fewer signals or a shorter time",
        )
    if status.st_size == 0:
        raise WaveformError("the file is empty", where=str(file), expected="waveforms", got="0 bytes")
    if not os.access(file, os.R_OK):
        raise WaveformError("no permission to read the file", where=str(file))
    return file


SPREADSHEETS = (".xlsx", ".xlsm", ".xlsb", ".xls", ".ods", ".numbers")


def _comes_last(module: Format) -> bool:
    return getattr(module, "LAST", False)


def _format_of(path: Path) -> Format:
    known = sorted(formats().values(), key=_comes_last)
    with open(path, "rb") as file:
        top = file.read(TOP)
    for module in known:
        with contextlib.suppress(OSError):  # of a file beside it
            if module.recognises(path, top):
                return module
    for module in known:  # damaged: the format its name promises has the better message
        if path.suffix.lower() in module.SUFFIXES:
            return module
    if path.suffix.lower() in SPREADSHEETS:
        raise WaveformError(
            "a spreadsheet, which may hold anything anywhere, is no file of waveforms",
            where=str(path),
            expected="columns under their names, the first of them the time, as CSV or Parquet",
            got=f"'{path.suffix}'",
            hint="save the sheet as CSV (UTF-8), without other tables and notes beside the columns",
        )
    listed = "; ".join(f"{m.NAME} ({', '.join(m.SUFFIXES)}): {m.SUMMARY}" for m in formats().values())
    raise WaveformError(
        "the file is of no known waveform format",
        where=str(path),
        expected=f"one of: {listed}",
        got=f"'{path.suffix}'" if path.suffix else "no ending",
        hint="export it as CSV from the tool that wrote it, or give it its usual ending",
    )


def check_times(t: Array, path: Path, rows: int = 2) -> None:
    """Raise WaveformError where there are fewer rows, or the times, (n,) in s, are not finite or go back."""
    where = str(path)
    if t.size < rows:
        hint = "export it again; it may have been cut off"
        raise WaveformError("too few rows", where=where, expected=f"at least {rows}", got=f"{t.size}", hint=hint)
    if not np.isfinite(t).all():
        row = int(np.argmin(np.isfinite(t)))
        raise WaveformError(
            f"the time in row {row + 1} is not finite", where=where, expected="a time in s", got=f"{t[row]}",
            hint="cut the rows without a time, or export it again; it may have been cut off",
        )  # fmt: skip
    back = np.flatnonzero(np.diff(t) < 0)
    if back.size:
        raise WaveformError(
            f"the time goes back in row {back[0] + 2}, from {t[back[0]]:g} s to {t[back[0] + 1]:g} s",
            where=where,
            expected="increasing times",
            hint="sort the rows by time, or cut the record where its time begins again",
        )


def _check(waveforms: Trajectory, path: Path, rows: int = 2) -> None:
    """Refuse a trajectory without the properties that every format promises, which its module need not check."""
    check_times(waveforms.time, path, rows)
    where = str(path)
    if not event_rows(waveforms.time).all():
        raise WaveformError("one time stands more than twice", where=where, expected="two rows at a jump")
    bad = np.argwhere(np.isinf(waveforms.values))
    if bad.size:
        row, column = bad[0]
        raise WaveformError(
            f"signal '{waveforms.names[column]}' is infinite at {waveforms.time[row]:g} s",
            where=where,
            got=str(waveforms.values[row, column]),
            expected="a finite number, or an empty cell or NaN where nothing was recorded",
            hint="select the signals you need, or cut the time in which it is infinite",
        )
