"""Seconds from dates and times of day, as text columns give them."""

from __future__ import annotations

import contextlib
import datetime
import re
import unicodedata
from functools import lru_cache

_MONTH = r"[A-Za-z\u00c0-\u00ff]{3,10}\.?"  # a word, with accents
_DAY_FIGURES = r"\d{4}[-/.]\d{1,2}[-/.]\d{1,2}|\d{1,2}[-/.]\d{1,2}[-/.]\d{4}"
_NAMED_MONTH = rf"\d{{1,2}}[-/. ]{{1,2}}{_MONTH}[-/. ]\d{{2}}(?:\d{{2}})?|{_MONTH} \d{{1,2}},? \d{{4}}"
_CLOCK = re.compile(
    rf"(?:(?P<date>{_DAY_FIGURES}|{_NAMED_MONTH})[T ]\s*)?"
    r"(?P<h>\d{1,2}):(?P<m>\d{2}):(?P<s>\d{2})(?:[.,](?P<fraction>\d{1,12}))?"
    r"\s*(?P<half>AM|PM)?\s*(?P<zone>Z|UTC|[+-]\d{2}:?\d{2})?",
    re.ASCII | re.IGNORECASE,
)
_DATE = re.compile(rf"\d{{4}}([-/.])\d{{1,2}}\1\d{{1,2}}|\d{{1,2}}([-/.])\d{{1,2}}\2\d{{4}}|{_NAMED_MONTH}", re.ASCII)
_MONTHS = (
    "jan gen ene", "feb fev", "mar mrt mrz maa", "apr avr abr", "may mai mag mei maj", "jun juin giu", "jul juil lug",
    "aug aou ago", "sep set", "oct okt ott out", "nov", "dec dez dic",
)  # fmt: skip
"""How the names of the months begin in the languages that read a decimal comma or point, without accents."""
_DAY = 86400.0  # s


def is_clock(text: str) -> bool:
    """True for a text that is a time of day, with or without a date before it."""
    return _CLOCK.fullmatch(text) is not None


def is_date(text: str) -> bool:
    """Return whether the text is a date alone."""
    return _DATE.fullmatch(text) is not None


class Clock:
    """Seconds from the first time asked; a time of day that falls back has passed midnight.

    A date that does not begin with the year may be day first or month first: of two dates of a record the order is the
    one that puts the later row the fewest days after the first. Days, seconds and fractions of a second are kept apart, so
    that these lose no digits to those.
    """

    def __init__(self) -> None:
        self._first: tuple[str, float, float] | None = None
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
        fraction = float(f"0.{match['fraction']}") if match["fraction"] else 0.0
        if match["half"]:  # 12:30 AM is half past midnight
            time_of_day += 43200.0 * ((match["half"].upper() == "PM") - (int(match["h"]) == 12))
        date = match["date"] or ""
        day = self._day_of(time_of_day) if not date else 0
        if self._first is None:
            if date:
                _days_between(date, date)  # refuses what is none
            self._first = (date, time_of_day, fraction)
        elif date:
            day = _days_between(self._first[0], date)
        return day * _DAY + (time_of_day - self._first[1]) + (fraction - self._first[2])

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
    """The number of a date, year first, else day or month first where the month is a figure too."""
    words = re.split(r"[-/., ]+", text)
    named = [word for word in words if not word.isdigit()]
    if named:
        words.remove(named[0])
        day, year = (int(x) for x in words)
        return datetime.date(year if year > 99 else 2000 + year, _month(named[0]), day).toordinal()
    a, b, c = (int(x) for x in words)
    year, month, day = (a, b, c) if a > 31 else (c, a, b) if month_first else (c, b, a)
    return datetime.date(year, month, day).toordinal()


def _month(name: str) -> int:
    """The number of a month by its name, shortened or not. Raises ValueError for a word that is none."""
    plain = unicodedata.normalize("NFKD", name.lower()).encode("ascii", "ignore").decode()
    for number, beginnings in enumerate(_MONTHS, start=1):
        if plain.startswith(tuple(beginnings.split())):
            return number
    raise ValueError(f"'{name}' is no month")


def _zone(text: str | None) -> float:
    """The distance of a time zone from UTC in s."""
    if not text or text.upper() in ("Z", "UTC"):
        return 0.0
    digits = text[1:].replace(":", "")
    return (-1.0 if text[0] == "-" else 1.0) * (3600 * int(digits[:2]) + 60 * int(digits[2:]))
