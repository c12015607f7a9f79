"""COMTRADE records of fault recorders and relays: .cfg with its .dat, or both in one .cff.

IEEE C37.111-1991, -1999 and -2013 (IEC 60255-24), data as ASCII, BINARY, BINARY32 or FLOAT32. The header and the data
are taken apart by the package `comtrade`, in double precision; before it is asked, the number of channels and rows the
header claims is held against what the file has, since the package would set memory aside for any claim, and the fields of
the header that no waveform depends on are made plain (`_comtrade_header`). Times are computed here: from the sampling rates
where the header gives them, with the pauses that the time stamps tell of, else from the time stamps. A sample outside the
range of its channel in the header cannot be what was measured.
"""

from __future__ import annotations

import contextlib
import io
import math
import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hvdc_ident.data import Array, Origin, Trajectory
from hvdc_ident.errors import WaveformError
from hvdc_ident.formats import pick
from hvdc_ident.formats._columns import check_size, damaged, own_names, package
from hvdc_ident.formats._comtrade_header import Range, plain_header, ranges
from hvdc_ident.formats._stamps import placed
from hvdc_ident.formats._text import decoded

NAME = "comtrade"
SUMMARY = "COMTRADE 1991, 1999 and 2013 of recorders and relays, ASCII, binary, float32, or all in one .cff"
SUFFIXES = (".cfg", ".cff")

_MAX_HEADER = 32 * 1024**2  # bytes
_MAX_CHANNELS = 100_000
_BYTES = {"BINARY": 2, "BINARY32": 4, "FLOAT32": 4}
_NO_STAMP = 2**32 - 1  # all bits set
_COUNTS = re.compile(r"\s*(\d{1,6})\s*,\s*(\d{1,6})\s*A\s*,\s*(\d{1,6})\s*D\s*", re.IGNORECASE)
_SECTION = re.compile(rb"^[ \t]*---?[ \t]*file type[ \t]*:?[ \t]*(\w+)(?:[ \t]+(\w+))?[ \t]*(?::[ \t]*(\d+))?[^\n]*---[ \t]*\r?$",
                      re.IGNORECASE | re.MULTILINE)  # fmt: skip
_REFUSALS = (ValueError, TypeError, IndexError, KeyError, AttributeError, OverflowError, struct.error)


@dataclass(frozen=True)
class _Record:
    """A record, its header taken apart.

    text: the header as the package is given it. data: the bytes of the .dat part. names: analog channels, then digital ones.
    ranges: of the analog channels.
    """

    path: Path
    text: str
    header: Any
    data: bytes
    names: tuple[str, ...]
    units: tuple[str, ...]
    ranges: tuple[Range | None, ...]


def recognises(path: Path, top: bytes) -> bool:
    """True for a .cff with a section header, or a .cfg whose second line counts channels."""
    if path.suffix.lower() == ".cff":
        section = _SECTION.search(top)
        return section is not None and section[1].upper() == b"CFG"
    return path.suffix.lower() == ".cfg" and _counts(decoded(top)) is not None


def signals(path: Path) -> list[tuple[str, str]]:
    """Name and unit of every channel, digital ones last, without a unit."""
    text, _, _ = _parts(path, data=False)
    _, names, units = _header(path, plain_header(text, _checked_counts(path, text)))
    return list(zip(names, units, strict=True))


def read(path: Path, signals: Sequence[str] | None = None) -> Trajectory:
    """The channels, all or those named in that order: a x + b in the header's unit, digital ones 0 or 1.

    Primary or secondary values as recorded. A channel's skew moves it by interpolation. Time starts at 0; a pause that the
    time stamps tell of between samples at the sampling rates is kept. A mark outside the range that the header gives a
    channel, 99999 say, is what was not recorded: NaN. `origin.notes` tells of both, and of what is kept outside the range.
    Raises WaveformError for a header or data part that does not hold together.
    """
    record = _open(path)
    wanted = pick(path, signals, record.names)
    rows = _rows(record)
    check_size(rows, len(record.names), path)
    content = _content(record)
    time, notes = _time(record, content, rows)
    if (more := _available(record) - rows) > 0:
        notes = (
            *notes,
            f"{path.name} says {rows} samples, the data hold {more} more: not read; the last sample of its rates says how many",
        )
    columns = []
    for i in wanted:
        if i >= record.header.analog_count:
            columns.append(content.status[i - record.header.analog_count])
            continue
        samples, note = _within_range(record, i, np.array(content.analog[i], dtype=float))
        notes = (*notes, note) if note else notes
        columns.append(_skewed(time, samples, record.header.analog_channels[i].skew))
    values = np.column_stack([np.asarray(c, dtype=float) for c in columns]) if columns else np.empty((rows, 0))
    names, units = tuple(record.names[i] for i in wanted), tuple(record.units[i] for i in wanted)
    return Trajectory(time, values, names, units, Origin(time_unit="s", notes=notes))


def files(path: Path) -> list[Path]:
    """The .dat of a .cfg; nothing beside a .cff."""
    return [] if path.suffix.lower() == ".cff" else [_beside(path)]


def _open(path: Path) -> _Record:
    stated, data, form = _parts(path)
    counts = _checked_counts(path, stated)
    text = plain_header(stated, counts)
    header, names, units = _header(path, text)
    if form and form != header.ft.upper():
        raise damaged(path, "the sections contradict the header", expected=f"data {header.ft}", got=form)
    return _Record(path, text, header, data, names, units, ranges(stated, counts))


def _parts(path: Path, data: bool = True) -> tuple[str, bytes, str]:
    """The header's text, the data's bytes, and the data's kind where the file says it outside the header."""
    if path.suffix.lower() == ".cff":
        return _sections(path)
    if path.stat().st_size > _MAX_HEADER:
        raise damaged(path, "the header is too long", expected=f"at most {_MAX_HEADER >> 20} MiB")
    text = decoded(path.read_bytes())
    return text, _beside(path).read_bytes() if data else b"", ""


def _beside(path: Path) -> Path:
    """The .dat of a .cfg, whatever the case of its ending."""
    for other in (path.with_suffix(".dat"), path.with_suffix(".DAT"), path.with_suffix(".Dat")):
        if other.is_file():
            return other
    raise WaveformError(
        "the record has no data file",
        where=str(path),
        expected=f"{path.with_suffix('.dat').name} beside it",
        hint="copy the .dat with the .cfg",
    )


def _sections(path: Path) -> tuple[str, bytes, str]:
    """Header, data and kind of the data of a .cff; binary data come last and reach as far as their mark says."""
    content = path.read_bytes()
    sections: dict[str, tuple[bytes, str]] = {}
    mark = _SECTION.search(content)
    while mark:
        kind, form = mark[1].decode("ascii").upper(), (mark[2] or b"").decode("ascii").upper()
        start = mark.end() + 1  # the line's end
        binary = kind == "DAT" and form not in ("", "ASCII")
        mark_after = None if binary else _SECTION.search(content, start)
        end = mark_after.start() if mark_after else start + int(mark[3]) if binary and mark[3] else len(content)
        sections.setdefault(kind, (content[start:end], form))
        mark = mark_after
    for kind in ("CFG", "DAT"):
        if kind not in sections:
            raise damaged(path, f"no section {kind}", expected=f"a line '--- file type: {kind} ---'")
    return decoded(sections["CFG"][0]), *sections["DAT"]


def _checked_counts(path: Path, text: str) -> tuple[int, int, int]:
    """Channels, analog and digital ones. Raises WaveformError where the header does not count them, or has not as many."""
    counts = _counts(text)
    lines = text.splitlines()
    if counts is None:
        got = f"'{lines[1][:60]}'" if len(lines) > 1 else "no second line"
        raise damaged(path, "line 2 does not count the channels", expected="as in '3,2A,1D'", got=got)
    total, analog, digital = counts
    if total != analog + digital or total > _MAX_CHANNELS or total > len(lines):
        raise damaged(path, "the number of channels does not fit", got=f"{total} channels, {analog}A, {digital}D")
    return counts


def _header(path: Path, text: str) -> tuple[Any, tuple[str, ...], tuple[str, ...]]:
    """The header as the package reads it, and the names and units of all channels."""
    with _refusals(path, "the header"):
        header = package("comtrade", path).Cfg(ignore_warnings=True)
        header.read(text)
    analog, digital = header.analog_count, header.status_count
    if header.ft.upper() not in ("ASCII", *_BYTES):
        raise damaged(path, "no such kind of data", expected="ASCII, BINARY, BINARY32 or FLOAT32", got=f"'{header.ft}'")
    with _refusals(path, "a number in the header"):
        _check_numbers(path, header)
    channels = [*header.analog_channels, *header.status_channels]
    plain = [c.name.strip() or f"{'A' if i < analog else 'D'}{c.n}" for i, c in enumerate(channels)]
    double = {name for name in plain if plain.count(name) > 1} if len(set(plain)) < len(plain) else set()
    names = [f"{n} {c.ph.strip()}".strip() if n in double else n for n, c in zip(plain, channels, strict=True)]
    units = [c.uu.strip() for c in header.analog_channels] + [""] * digital
    return header, own_names(names), tuple(units)


def _check_numbers(path: Path, header: Any) -> None:
    numbers = [x for c in header.analog_channels for x in (c.a, c.b, c.skew)]
    numbers += [x for rate in header.sample_rates for x in rate] + [2.0**64 * header.timemult]
    numbers += [end / rate for rate, end in header.sample_rates if rate]
    if not all(map(math.isfinite, numbers)):
        raise damaged(path, "a number in the header is not finite")
    ends = [end for _, end in header.sample_rates]
    if any(rate < 0 for rate, _ in header.sample_rates) or ends != sorted(set(ends)) or ends[0] < 1:
        raise damaged(
            path, "the sampling rates do not fit", expected="rates above 0, last samples that do not decrease"
        )
    if not header.timestamp_critical and any(rate == 0 for rate, _ in header.sample_rates):
        raise damaged(path, "a sampling rate of 0", expected="0 rates, for time stamps that count, or rates above 0")
    if header.timemult <= 0:
        raise damaged(path, "the time multiplier is not above 0", got=f"{header.timemult}")


def _rows(record: _Record) -> int:
    """The number of rows, as the header claims and the data hold."""
    claimed, available = int(record.header.sample_rates[-1][1]), _available(record)
    if available < claimed:
        raise damaged(
            record.path, "the data end early", expected=f"{claimed} samples as in the header", got=f"{available}"
        )
    return claimed


def _available(record: _Record) -> int:
    """The number of rows that the data hold."""
    if record.header.ft.upper() == "ASCII":
        return sum(1 for line in record.data.splitlines() if line.strip(b" \t\x1a"))
    return len(record.data) // _width(record.header)


def _width(header: Any) -> int:
    """The bytes of a sample of binary data: its number, its stamp, the analog channels, 16 digital ones in a word."""
    return int(8 + _BYTES[header.ft.upper()] * header.analog_count + 2 * math.ceil(header.status_count / 16))


def _content(record: _Record) -> Any:
    """The record as the package reads it, in double precision."""
    with _refusals(record.path, "the data"):
        reader = package("comtrade", record.path).Comtrade(
            ignore_warnings=True, use_numpy_arrays=True, use_double_precision=True
        )
        ascii_data = record.header.ft.upper() == "ASCII"
        reader.read(io.StringIO(record.text), _filled(record) if ascii_data else record.data)
        return reader


def _time(record: _Record, content: Any, rows: int) -> tuple[Array, tuple[str, ...]]:
    """(n,) in s from the first sample, by the rates of the header and the pauses of the stamps, else the stamps; remarks."""
    header = record.header
    if header.timestamp_critical:
        stamps = np.asarray(content.time, dtype=float)[:rows]
        return stamps - stamps[0], ()
    ends = [0, *(int(end) for _, end in header.sample_rates)]
    rates = np.repeat([rate for rate, _ in header.sample_rates], np.diff(ends))[1:]
    return placed(rates, _stamps(record, rows), header.timemult * header.time_base)


def _stamps(record: _Record, rows: int) -> Array:
    """(n,) the time stamps as they stand, NaN where there is none."""
    if record.header.ft.upper() == "ASCII":
        lines = [line for line in record.data.splitlines() if line.strip(b" \t\x1a")][:rows]
        cells = [line.split(b",", 2)[1].strip() for line in lines]
        stamps = np.array([float(cell) if cell else math.nan for cell in cells])
    else:
        row = np.dtype([("number", "<u4"), ("stamp", "<u4"), ("samples", f"V{_width(record.header) - 8}")])
        stamps = np.frombuffer(record.data, row, rows)["stamp"].astype(float)
    return np.where((stamps == _NO_STAMP) | (np.abs(stamps) >= 2.0**53), math.nan, stamps)


def _within_range(record: _Record, channel: int, values: Array) -> tuple[Array, str]:
    """The values of an analog channel, NaN where a mark stands in for one, and a remark on what lies outside its range.

    A mark is one and the same number above the range, or below, whose digits are all nines or which is the lowest of its binary kind
    (IEC 60255-24). Other numbers there are a signal that the header gives too narrow a range: they stay.
    """
    limits, about = record.ranges[channel], record.header.analog_channels[channel]
    if (
        limits is None or not np.spacing(abs(about.b)) < 1e-6 * abs(about.a) * limits.digit
    ):  # else the offset swallows it
        return values, ""
    raw = (values - about.b) / about.a
    notes = []
    for outside in limits.outside(raw):
        if not outside.any():
            continue
        low, high = float(raw[outside].min()), float(raw[outside].max())
        n = int(np.count_nonzero(outside))
        samples = f"{n} sample{'s' if n > 1 else ''} outside the range of the header, {limits}"
        if high - low <= 1e-9 * abs(high) and _is_mark(high):
            values = np.where(outside, math.nan, values)
            notes.append(f"{samples}: {high:.10g} is taken as the mark of what was not recorded")
        else:
            notes.append(f"{samples}: kept, for none is a mark of what was not recorded, {low:.10g} to {high:.10g}")
    return values, f"{record.names[channel]}: {'; '.join(notes)}" if notes else ""


def _is_mark(number: float) -> bool:
    """True for 99999, 999999, ... of either sign, and for the lowest number of 16 or 32 bits."""
    digits = f"{abs(number):.0f}"
    return (set(digits) == {"9"} and len(digits) > 4) or number in (-(2.0**15), -(2.0**31))


def _skewed(time: Array, values: Any, skew: float) -> Array:
    """The values of a channel sampled `skew` microseconds late, at the instants of the record."""
    return np.asarray(np.interp(time, time + 1e-6 * skew, values) if skew else values, dtype=float)


def _counts(text: str) -> tuple[int, int, int] | None:
    """Channels, analog and digital ones, from line 2 of a header; None where it does not count them."""
    lines = text.splitlines()
    match = _COUNTS.fullmatch(lines[1]) if len(lines) > 1 else None
    return (int(match[1]), int(match[2]), int(match[3])) if match else None


def _filled(record: _Record) -> str:
    """The lines of ASCII data with the mark of a missing sample in empty cells, as the editions after 1991 have them too.

    The package knows the mark 99999 there, and the empty cell only in the first edition.
    """
    text = _lines(record.data)
    if str(record.header.rev_year) == "1991" or not re.search(r",\s*(?:,|$)", text, re.MULTILINE):
        return text
    last = 2 + record.header.analog_count
    rows = [line.split(",") for line in text.splitlines()]
    return "\n".join(
        ",".join(c if c.strip() or not 2 <= k < last else "99999" for k, c in enumerate(row)) for row in rows
    )


def _lines(data: bytes) -> str:
    return "\n".join(line for line in decoded(data).replace("\x1a", "").splitlines() if line.strip())


@contextlib.contextmanager
def _refusals(path: Path, part: str) -> Iterator[None]:
    """Turn errors of the package into a WaveformError that names the file."""
    try:
        yield
    except _REFUSALS as error:
        raise damaged(path, f"{part} cannot be read: {error}") from None
    except Exception as error:
        if type(error).__name__ != "ComtradeError":  # a plain Exception of the package, which is imported late
            raise
        raise damaged(path, f"{part} cannot be read: {error}") from None
