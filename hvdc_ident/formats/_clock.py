"""Seconds from dates and times of day, as text columns give them."""

from __future__ import annotations

import contextlib
import datetime
import re
from functools import lru_cache

_CLOCK = re.compile(
    r"(?:(?P<date>\d{4}[-/.]\d{1,2}[-/.]\d{1,2}|\d{1,2}[-/.]\d{1,2}[-/.]\d{4})[T ]\s*)?"
    r"(?P<h>\d{1,2}):(?P<m>\d{2}):(?P<s>\d{2})(?:[.,](?P<fraction>\d{1,12}))?"
    r"\s*(?P<half>AM|PM)?\s*(?P<zone>Z|UTC|[+-]\d{2}:?\d{2})?",
    re.ASCII | re.IGNORECASE,
)
_DATE = re.compile(r"\d{4}([-/.])\d{1,2}\1\d{1,2}|\d{1,2}([-/.])\d{1,2}\2\d{4}", re.ASCII)
_DAY = 86400.0  # s


def is_clock(text: str) -> bool:
    """True for a text that is a time of day, with or without a date before it."""
    return _CLOCK.fullmatch(text) is not None


def is_date(text: str) -> bool:
    """Return whether the text is a date alone, in figures."""
    return _DATE.fullmatch(text) is not None


class Clock:
    """Seconds from the first time asked; a time of day that falls back has passed midnight.

    A date that does not begin with the year may be day first or month first: of two dates of a record the order is the
    one that puts the later row the fewest days after the first. Days and seconds are kept apart, so that a fraction of a
    second loses no digits to the date.
    """

    def __init__(self) -> None:
        self._first: tuple[str, float] | None = None
        self._last = 0.0
        self._midnights = 0

    def seconds(self, text: str) -> float:
        """The time in s; ValueError where the text is no date or time of day."""
        match = _CLOCK.fullmatch(text)
        if match is None:
            raise ValueError("no date or time of day")
        if int(match["h"]) > 23 or int(match["m"]) > 59 or int(match["s"]) > 60:
            raise ValueError("no time of day")
        time_of_day = 3600.0 * int(match["h"]) + 60 * int(match["m"]) + int(match["s"]) - _zone(match["zone"])
        time_of_day += float(f"0.{match['fraction']}") if match["fraction"] else 0.0
        if match["half"]:  # 12:30 AM is half past midnight
            time_of_day += 43200.0 * ((match["half"].upper() == "PM") - (int(match["h"]) == 12))
        date = match["date"] or ""
        day = self._day_of(time_of_day) if not date else 0
        if self._first is None:
            if date:
                _days_between(date, date)  # refuses what is none
            self._first = (date, time_of_day)
        elif date:
            day = _days_between(self._first[0], date)
        return day * _DAY + (time_of_day - self._first[1])

    def _day_of(self, time_of_day: float) -> int:
        if time_of_day < self._last - _DAY / 2:
            self._midnights += 1
        self._last = time_of_day
        return self._midnights


@lru_cache(maxsize=1024)
def _days_between(first: str, later: str) -> int:
    """The days from one date to another. Raises ValueError where either is none."""
    if not first:
        raise ValueError("a date after times of day without one")
    found: list[int] = []
    for month_first in (False, True):
        with contextlib.suppress(ValueError):
            found.append(_day(later, month_first) - _day(first, month_first))
    if not found:
        _day(first, False), _day(later, False)
        raise ValueError("dates of two orders")
    return min(found, key=lambda days: (days < 0, abs(days)))


def _day(text: str, month_first: bool) -> int:
    """The number of a date, year first, else day or month first."""
    a, b, c = (int(x) for x in re.split(r"[-/.]", text))
    year, month, day = (a, b, c) if a > 31 else (c, a, b) if month_first else (c, b, a)
    return datetime.date(year, month, day).toordinal()


def _zone(text: str | None) -> float:
    """The distance of a time zone from UTC in s."""
    if not text or text.upper() in ("Z", "UTC"):
        return 0.0
    digits = text[1:].replace(":", "")
    return (-1.0 if text[0] == "-" else 1.0) * (3600 * int(digits[:2]) + 60 * int(digits[2:]))
