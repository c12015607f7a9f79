"""Seconds from dates and times of day, as text columns give them."""

from __future__ import annotations

import datetime
import re

_CLOCK = re.compile(
    r"(?:(?P<date>\d{4}[-/.]\d{1,2}[-/.]\d{1,2}|\d{1,2}[-/.]\d{1,2}[-/.]\d{4})[T ]\s*)?"
    r"(?P<h>\d{1,2}):(?P<m>\d{2}):(?P<s>\d{2})(?:[.,](?P<fraction>\d{1,12}))?"
    r"\s*(?P<zone>Z|UTC|[+-]\d{2}:?\d{2})?",
    re.ASCII,
)
_DAY = 86400.0  # s


def is_clock(text: str) -> bool:
    """Whether the text is a time of day, with or without a date before it."""
    return _CLOCK.fullmatch(text) is not None


class Clock:
    """Seconds from the first time asked; a time of day that falls back has passed midnight.

    Days and seconds are kept apart, so that a fraction of a second loses no digits to the date.
    """

    def __init__(self) -> None:
        self._first: tuple[int, float] | None = None
        self._last = 0.0
        self._midnights = 0

    def seconds(self, text: str) -> float:
        """The time in s; ValueError where the text is no date or time of day."""
        match = _CLOCK.fullmatch(text)
        if match is None:
            raise ValueError("no date or time of day")
        if int(match["h"]) > 23 or int(match["m"]) > 59 or int(match["s"]) > 60:
            raise ValueError("no time of day")
        here = 3600.0 * int(match["h"]) + 60 * int(match["m"]) + int(match["s"]) - _zone(match["zone"])
        here += float(f"0.{match['fraction']}") if match["fraction"] else 0.0
        day = _day(match["date"]) if match["date"] else self._day_of(here)
        if self._first is None:
            self._first = (day, here)
        return (day - self._first[0]) * _DAY + (here - self._first[1])

    def _day_of(self, here: float) -> int:
        if here < self._last - _DAY / 2:
            self._midnights += 1
        self._last = here
        return self._midnights


def _day(text: str) -> int:
    """The number of a date, year first or day first."""
    a, b, c = (int(x) for x in re.split(r"[-/.]", text))
    year, month, day = (a, b, c) if a > 31 else (c, b, a)
    return datetime.date(year, month, day).toordinal()


def _zone(text: str | None) -> float:
    """The distance of a time zone from UTC in s."""
    if not text or text in ("Z", "UTC"):
        return 0.0
    digits = text[1:].replace(":", "")
    return (-1.0 if text[0] == "-" else 1.0) * (3600 * int(digits[:2]) + 60 * int(digits[2:]))
