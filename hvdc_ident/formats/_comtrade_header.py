"""Headers of COMTRADE records: what the waveforms depend on, field by field, and the range of each analog channel."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array

_ANALOG, _DIGITAL = 13, 5
"""Fields of a channel's line since the edition of 1999."""

_FRACTION = re.compile(r"\.(\d+)\s*$")
_MICROSECONDS = 6  # digits of a second's fraction; with more of them the unit of the stamps is 1 ns


@dataclass(frozen=True)
class Range:
    """Smallest and largest number that a channel's samples can have, and the last digit's unit of each."""

    low: float
    high: float
    low_digit: float
    high_digit: float

    @property
    def digit(self) -> float:
        """Return the smaller of the two units."""
        return min(self.low_digit, self.high_digit)

    def outside(self, raw: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return (n,) which samples lie below and which above, by a unit of the limit's last digit at least.

        A limit may be the extreme of the samples, rounded to its digits.
        """
        almost = 1.0 - 1e-6  # raw was scaled to the channel's unit and back
        return raw <= self.low - almost * self.low_digit, raw >= self.high + almost * self.high_digit

    def __str__(self) -> str:
        return f"{self.low:.10g} to {self.high:.10g}"


def plain_header(text: str, counts: tuple[int, int, int]) -> str:
    """Return the header with fixed text in the fields that no waveform depends on, where devices differ most.

    counts: channels, analog and digital ones. The edition is 1991 where line 1 says so or has no year, else 1999: that is
    all that counts for the data. Dates, numbers of channels, ranges and ratios, the frequency, segments without samples,
    and what follows the time multiplier are left out. A header that is too short for that is returned as it is.
    """
    lines = text.replace("\x1a", "").splitlines()
    total, analog, _ = counts
    place = 2 + total  # the frequency
    n = _whole(lines[place + 1]) if len(lines) > place + 1 else None
    if n is None or len(lines) < place + max(1, n) + 5:
        return text
    segments = lines[place + 2 : place + 2 + max(1, n)]
    start, trigger, kind, *rest = lines[place + 2 + len(segments) :]
    filled = _filled_segments(segments)
    first = [cell.strip() for cell in lines[0].split(",")]
    edition = first[-1] if len(first) > 2 else "1991"
    return "\n".join(
        [
            f"STATION,DEVICE,{'1991' if edition == '1991' else '1999'}",
            lines[1],
            *(_analog(k + 1, line) for k, line in enumerate(lines[2 : 2 + analog])),
            *(_digital(k + 1, line) for k, line in enumerate(lines[2 + analog : place])),
            "0",
            str(len(filled)) if n else "0",
            *filled,
            _date(start),
            _date(trigger),
            kind.strip(),
            _multiplier(rest[0] if rest else "", needed=n == 0),
            "",
        ]
    )


def ranges(text: str, counts: tuple[int, int, int]) -> tuple[Range | None, ...]:
    """Return the ranges of the analog channels, None where the header gives none."""
    lines = text.splitlines()[2 : 2 + counts[1]]
    return tuple(_range(_fields(line, _ANALOG)) for line in lines)


def _range(fields: Sequence[str]) -> Range | None:
    try:
        low, high = Decimal(fields[8]), Decimal(fields[9])
    except InvalidOperation:
        return None
    if not (low.is_finite() and high.is_finite() and low < high):
        return None
    limits = Range(float(low), float(high), _digit(low), _digit(high))
    return limits if all(map(math.isfinite, (limits.low, limits.high, limits.low_digit, limits.high_digit))) else None


def _digit(number: Decimal) -> float:
    """Return the unit of a number's last digit: 0.01 of 1.25."""
    return float(Decimal((0, (1,), int(number.as_tuple().exponent))))


def _fields(line: str, n: int) -> list[str]:
    cells = [cell.strip() for cell in line.split(",")][:n]
    return cells + [""] * (n - len(cells))


def _analog(number: int, line: str) -> str:
    """Return the line with name, phase, unit, factor, offset and skew as they are."""
    fields = _fields(line, _ANALOG)
    return ",".join([str(number), *fields[1:8], "0", "0", "1", "1", "P"])


def _digital(number: int, line: str) -> str:
    """Return the line with name and phase; in 1991 there are neither phase nor component, and the third field is the state."""
    fields = _fields(line, _DIGITAL)
    phase = fields[2] if line.count(",") > 2 else ""
    return f"{number},{fields[1]},{phase},,0"


def _filled_segments(lines: Sequence[str]) -> list[str]:
    """Return the lines of rates without those whose last sample is that of the line before: they have no samples."""
    kept: list[str] = []
    last = None
    for line in lines:
        end = line.rpartition(",")[2].strip()
        if end != last:
            kept.append(line)
        last = end
    return kept


def _date(line: str) -> str:
    """Return a date in the order of every edition, with as many digits of a second: they tell the unit of the stamps."""
    fraction = _FRACTION.search(line)
    return f"01/01/2000,00:00:00.{'0' * (9 if fraction and len(fraction[1]) > _MICROSECONDS else 6)}"


def _multiplier(line: str, needed: bool) -> str:
    """Return the time multiplier, empty (which is 1) where the line holds no number and none is needed."""
    text = line.strip()
    try:
        float(text)
    except ValueError:
        return text if needed else ""
    return text


def _whole(text: str) -> int | None:
    return int(text) if re.fullmatch(r"\s*\d{1,6}\s*", text) else None
