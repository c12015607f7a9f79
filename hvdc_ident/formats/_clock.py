"""Seconds from dates and times of day, as text columns give them."""

from __future__ import annotations

import contextlib
import datetime
import re
import unicodedata
from functools import lru_cache

_WORD = r"[^\W\d_]{3,14}\.?"
_BETWEEN = r"(?:[-/. ]{1,2}| de )"
_NUMERIC = r"[0-9]{4}[-/.][0-9]{1,2}[-/.][0-9]{1,2}|[0-9]{1,2}[-/.][0-9]{1,2}[-/.][0-9]{4}"
_NAMED = (
    rf"[0-9]{{1,2}}{_BETWEEN}{_WORD}{_BETWEEN}[0-9]{{2}}(?:[0-9]{{2}})?(?: г\.?)?|"
    rf"{_WORD} [0-9]{{1,2}},? [0-9]{{4}}|[0-9]{{4}}[-/. ]{_WORD}[-/. ][0-9]{{1,2}}"
)
_ZONES = {
    "Z": 0, "UTC": 0, "GMT": 0, "WET": 0, "WEST": 1, "BST": 1, "CET": 1, "MEZ": 1, "CEST": 2, "MESZ": 2, "EET": 2, "EEST": 3,
    "MSK": 3, "JST": 9, "KST": 9, "EST": -5, "EDT": -4, "CST": -6, "CDT": -5, "MST": -7, "MDT": -6, "PST": -8, "PDT": -7,
}  # fmt: skip
"""Hours ahead of UTC. Of a name with several meanings one stands for all: between rows only the change to summer time counts."""
_CLOCK = re.compile(
    rf"(?:(?P<date>{_NUMERIC}|{_NAMED})[T ,_]\s*(?:klo?\.? )?)?"
    r"(?P<h>[0-9]{1,2})(?P<sign>:|(?(date)\.|:))(?P<m>[0-9]{1,2})"
    r"(?:(?P=sign)(?P<s>[0-9]{1,2})(?:[.,:](?P<fraction>[0-9]{1,12}))?|(?(date)|(?!)))"
    rf"\s*(?P<half>[AP]\.?\s?M\.?)?\s*(?P<zone>(?:UTC|GMT)?[+-][0-9]{{1,2}}(?::?[0-9]{{2}})?|{'|'.join(_ZONES)})?",
    re.IGNORECASE,
)
_DATE = re.compile(rf"[0-9]{{4}}([-/.])[0-9]{{1,2}}\1[0-9]{{1,2}}|[0-9]{{1,2}}([-/.])[0-9]{{1,2}}\2[0-9]{{4}}|{_NAMED}")
_MONTHS = (
    "jan gen ene sty tammi янв", "feb fev lut helmi фев", "mar mrt mrz maa мар", "apr avr abr kwi huhti апр",
    "may mai mag mei maj touko маи мая", "jun juin giu cze kesa июн", "jul juil lug lip heina июл",
    "aug aou ago sie elo авг", "sep set wrz syys сен", "oct okt ott out paz loka окт", "nov lis marras ноя",
    "dec dez dic des gru joulu дек",
)  # fmt: skip
"""How the names of the months begin in English, German, French, Spanish, Italian, Portuguese, Dutch, Polish, Swedish, Danish, Norwegian,
Finnish and Russian, without accents; of two that fit the longer counts. Source: Unicode CLDR, `months` of these languages."""
_BEGINNINGS = {word: number for number, words in enumerate(_MONTHS, start=1) for word in words.split()}
_KANJI = (
    (re.compile(r"([0-9]{4})年([0-9]{1,2})月([0-9]{1,2})[日号]"), r"\1-\2-\3 "),
    (re.compile(r"([0-9]{1,2})[时時点]([0-9]{1,2})分(?:([0-9.,]+)秒)?"), lambda m: f"{m[1]}:{m[2]}:{m[3] or '00'}"),
    (re.compile(r"(?:上午|午前)\s*(.*)"), r"\1 AM"),
    (re.compile(r"(?:下午|午後)\s*(.*)"), r"\1 PM"),
)
_DAY, _HOUR = 86400.0, 3600.0  # s


def is_clock(text: str) -> bool:
    """True for a text that is a time of day, with or without a date before it, or a date with hour and minute."""
    return _CLOCK.fullmatch(_plain(text)) is not None


def is_date(text: str) -> bool:
    """Return whether the text is a date alone."""
    return _DATE.fullmatch(_plain(text)) is not None


class Clock:
    """Seconds from the first time asked; a time of day that falls back has passed midnight.

    A date that does not begin with the year may be day first or month first: of two dates of a record the order is the
    one that puts the later row the fewest days after the first. Days, seconds and fractions of a second are kept apart, so
    that these lose no digits to those. A clock without a time zone that falls back by an hour, and goes on in its step, has
    ended summer time. notes: what the times do not say for certain.
    """

    def __init__(self) -> None:
        self._first: tuple[str, float, float] | None = None
        self._last = self._step = 0.0
        self._time_of_day = 0.0
        self._midnights = 0
        self._turned = 0.0
        self.notes: tuple[str, ...] = ()

    def seconds(self, text: str) -> float:
        """The time in s; ValueError where the text is no date or time of day."""
        match = _CLOCK.fullmatch(_plain(text))
        if match is None:
            raise ValueError("no date or time of day")
        hour, minute, second = int(match["h"]), int(match["m"]), int(match["s"] or 0)
        if hour > 23 or minute > 59 or second > 60:
            raise ValueError("no time of day")
        time_of_day = 3600.0 * hour + 60.0 * minute + second - _zone(match["zone"])
        fraction = float(f"0.{match['fraction']}") if match["fraction"] else 0.0
        if match["half"]:  # 12:30 AM is half past midnight
            time_of_day += 43200.0 * ((match["half"][0] in "Pp") - (hour == 12))
        date = match["date"] or ""
        day = self._day_of(time_of_day) if not date else 0
        if self._first is None:
            if date:
                _days_between(date, date)  # refuses what is none
            self._first = (date, time_of_day, fraction)
        elif date:
            day = _days_between(self._first[0], date)
        elapsed = day * _DAY + (time_of_day - self._first[1]) + (fraction - self._first[2])
        return elapsed if match["zone"] else self._through_summer_time(elapsed, text)

    def _day_of(self, time_of_day: float) -> int:
        if time_of_day < self._time_of_day - _DAY / 2:
            self._midnights += 1
        self._time_of_day = time_of_day
        return self._midnights

    def _through_summer_time(self, time: float, text: str) -> float:
        """The time with the hours that the clock was put back added."""
        time += self._turned
        step = time - self._last
        if 0.0 < self._step < _HOUR / 2 and abs(abs(step - self._step) - _HOUR) < 0.5 * self._step:
            if step < 0.0:
                self._turned += _HOUR
                time, step = time + _HOUR, step + _HOUR
                self.notes += (f"the clock goes back an hour at {text}: taken for the end of summer time",)
            else:
                self.notes += (
                    f"the clock leaps an hour at {text}: kept as a pause; where summer time began there is none",
                )
        self._last, self._step = time, step
        return time


def _plain(text: str) -> str:
    """The text with signs of every script's own in place of Chinese and Japanese ones."""
    if text.isascii():
        return text
    plain = unicodedata.normalize("NFKC", text)
    for pattern, sign in _KANJI:
        plain = pattern.sub(sign, plain)
    return plain.strip()


@lru_cache(maxsize=1024)
def _days_between(first: str, later: str) -> int:
    """The days from one date to another. Raises ValueError where either is none."""
    if not first:
        raise ValueError("a date after times of day without one")
    counts: list[int] = []
    for month_first in (False, True):
        with contextlib.suppress(ValueError):
            counts.append(_day(later, month_first) - _day(first, month_first))
    if not counts:
        _day(first, False), _day(later, False)
        raise ValueError("dates of two orders")
    return min(counts, key=lambda days: (days < 0, abs(days)))


def _day(text: str, month_first: bool) -> int:
    """The number of a date, year first, else day or month first where the month is a figure too."""
    numbers = [int(figures) for figures in re.findall("[0-9]+", text)]
    words = [word for word in re.findall(r"[^\W\d_]+", text) if word not in ("de", "г")]
    if words:
        day, year = numbers if numbers[0] <= 31 else numbers[::-1]
        return datetime.date(year if year > 99 else 2000 + year, _month(words[0]), day).toordinal()
    a, b, c = numbers
    year, month, day = (a, b, c) if a > 31 else (c, a, b) if month_first else (c, b, a)
    return datetime.date(year, month, day).toordinal()


def _month(name: str) -> int:
    """The number of a month by its name, shortened or not. Raises ValueError for a word that is none."""
    letters = unicodedata.normalize("NFKD", name.casefold())
    plain = "".join(c for c in letters if not unicodedata.combining(c))
    begins = max((word for word in _BEGINNINGS if plain.startswith(word)), key=len, default="")
    if not begins:
        raise ValueError(f"'{name}' is no month")
    return _BEGINNINGS[begins]


def _zone(text: str | None) -> float:
    """The distance of a time zone from UTC in s."""
    name = (text or "Z").upper()
    if name in _ZONES:
        return 3600.0 * _ZONES[name]
    offset = name.removeprefix("UTC").removeprefix("GMT")
    hours, minutes = re.fullmatch(r"[+-]([0-9]{1,2}):?([0-9]{2})?", offset).groups("0")  # type: ignore[union-attr]
    return (-1.0 if offset[0] == "-" else 1.0) * (3600 * int(hours) + 60 * int(minutes))
