"""PSCAD output: an .inf that names the channels and numbered .out files of up to ten channels each.

Channel n of `run.inf`, a line `PGB(n) Output Desc="P1" Group="Main" Max=2 Min=-2 Units="MW"`, stands in
`run_01.out` for n = 1 to 10, `run_02.out` for 11 to 20, and so on, in column (n - 1) mod 10 behind the time in s.
Source: PSCAD manual, "Output files"; the files themselves.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hvdc_ident.data import Array, Origin, Trajectory
from hvdc_ident.errors import WaveformError
from hvdc_ident.formats import TOP, pick
from hvdc_ident.formats._columns import check_size, damaged, own_names
from hvdc_ident.formats._text import decoded

NAME = "pscad"
SUMMARY = "PSCAD output: the .inf, with its numbered .out files beside it"
SUFFIXES = (".inf", ".out")

_PER_FILE = 10
_MAX_HEADER = 32 * 1024**2  # bytes
_MAX_CHANNELS = 100_000
_CHANNEL = re.compile(r"^\s*PGB\((\d{1,6})\)\s+\w+\s+(.*)$", re.MULTILINE)
_FIELD = re.compile(r'(\w+)="([^"]*)"')


@dataclass(frozen=True)
class _Channel:
    number: int
    name: str
    unit: str


def recognises(path: Path, top: bytes) -> bool:
    """Return whether it is an .inf with a channel line, or an .out of such a run."""
    inf = _inf(path)
    if path.suffix.lower() not in SUFFIXES or not inf.is_file():
        return False
    start = top if inf == path else inf.read_bytes()[:TOP]
    return _CHANNEL.search(start.decode("latin-1")) is not None


def signals(path: Path) -> list[tuple[str, str]]:
    """Name and unit of every channel of the run; a name that stands twice carries its group, then a number."""
    return [(c.name, c.unit) for c in _channels(_inf(path))]


def read(path: Path, signals: Sequence[str] | None = None) -> Trajectory:
    """The channels, all or those named in that order, over the time of the .out files.

    Only the files with wanted channels are opened. An instant with more than two rows keeps its first and last.
    Raises WaveformError for a file that is missing, cut off, or has another time than the first.
    """
    path = _inf(path)
    channels = _channels(path)
    wanted = [channels[i] for i in pick(path, signals, [c.name for c in channels])]
    tables: dict[int, Array] = {}
    for channel in wanted:
        number = (channel.number - 1) // _PER_FILE
        if number not in tables:
            last = max(c.number for c in channels if (c.number - 1) // _PER_FILE == number)
            tables[number] = _table(_out_file(path, number + 1), (last - 1) % _PER_FILE + 1)
    if not tables:
        raise damaged(path, "no channels", expected="a line PGB(1) Output Desc=...")
    first = next(iter(tables.values()))
    for number, table in tables.items():
        if table.shape[0] != first.shape[0] or not np.array_equal(table[:, 0], first[:, 0], equal_nan=True):
            raise damaged(_out_file(path, number + 1), "its times differ from those of the other .out files")
    check_size(len(first), len(wanted), path)
    values = np.column_stack([tables[(c.number - 1) // _PER_FILE][:, (c.number - 1) % _PER_FILE + 1] for c in wanted])
    names, units = tuple(c.name for c in wanted), tuple(c.unit for c in wanted)
    return Trajectory(first[:, 0], values, names, units, Origin(time_unit="s"))


def files(path: Path) -> list[Path]:
    """The .inf, and the .out files of the channels that are there."""
    path = _inf(path)
    numbers = sorted({(c.number - 1) // _PER_FILE + 1 for c in _channels(path)})
    outputs = (_there(path, number) for number in numbers)
    return [path, *(file for file in outputs if file is not None)]


def _inf(path: Path) -> Path:
    """The .inf of a run, from itself or one of its .out files: `run_01.out`, `run.out`."""
    if path.suffix.lower() != ".out":
        return path
    stem = re.sub(r"_\d{2,}$", "", path.stem)
    return next(
        (p for end in (".inf", ".INF") if (p := path.with_name(stem + end)).is_file()), path.with_name(f"{stem}.inf")
    )


def _channels(path: Path) -> list[_Channel]:
    if not path.is_file():
        raise WaveformError(
            "the list of channels is missing",
            where=str(path),
            expected="the .inf that PSCAD writes beside the .out files of a run",
            hint="copy it too; an .out of PSS/E is another format: export it as CSV",
        )
    if path.stat().st_size > _MAX_HEADER:
        raise damaged(path, "the list of channels is too long", expected=f"at most {_MAX_HEADER >> 20} MiB")
    channels = {}
    for match in _CHANNEL.finditer(decoded(path.read_bytes())):
        number, fields = int(match[1]), dict(_FIELD.findall(match[2]))
        if number in channels or not 1 <= number <= _MAX_CHANNELS:
            raise damaged(path, f"channel {number} stands twice or is out of range", got=match[0].strip()[:80])
        channels[number] = (fields.get("Desc", "").strip() or f"PGB{number}", fields.get("Group", ""), fields)
    if not channels:
        raise damaged(path, "no channels", expected='lines PGB(1) Output Desc="..."')
    plain = [name for name, _, _ in channels.values()]
    labels = [f"{group}.{name}" if plain.count(name) > 1 and group else name for name, group, _ in channels.values()]
    units = [fields.get("Units", "").strip() for _, _, fields in channels.values()]
    return [_Channel(n, name, unit) for n, name, unit in zip(channels, own_names(labels), units, strict=True)]


def _out_file(path: Path, number: int) -> Path:
    """The .out file of a number. Raises WaveformError where it is missing."""
    file = _there(path, number)
    if file is None:
        raise WaveformError(
            f"a file of channels {(number - 1) * _PER_FILE + 1} to {number * _PER_FILE} is missing",
            where=str(path),
            expected=f"{path.stem}_{number:02d}.out beside it",
            hint="copy all .out files of the run",
        )
    return file


def _there(path: Path, number: int) -> Path | None:
    """The .out file of a number, where there is one."""
    names = (f"{path.stem}_{number:02d}.out", f"{path.stem}_{number:02d}.OUT", f"{path.stem}.out")
    for name in names[: 3 if number == 1 else 2]:
        if (other := path.with_name(name)).is_file():
            return other
    return None


def _table(path: Path, columns: int) -> Array:
    """(n, columns + 1) the numbers of an .out file, time first; a first line of words is skipped."""
    with open(path, encoding="latin-1") as file:
        head = file.readline(65536)
        try:
            skip = 0 if [float(x) for x in head.split()] else 1
        except ValueError:
            skip = 1
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)  # no rows at all
            table = np.loadtxt(path, skiprows=skip, ndmin=2, dtype=float, encoding="latin-1")
    except (ValueError, UserWarning) as error:
        raise damaged(path, f"not a table of numbers: {error}") from None
    if table.shape[0] < 2 or table.shape[1] < columns + 1:
        raise damaged(path, "the table is too small", f"{columns + 1} columns, 2 rows", f"{table.shape}")
    return np.asarray(table)
