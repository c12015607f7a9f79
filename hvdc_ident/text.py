"""Text of quantities, durations, ranges and lists for messages and reports."""

from __future__ import annotations

import math
import re
import shlex
import textwrap
from collections.abc import Iterable, Sequence
from typing import Protocol

Interval = Sequence[float | None]
"""The ends of an interval; one that is None is open."""
_SMALLER = ((1e-4, 1e6, "µs"), (0.1, 1e3, "ms"))


def figures(value: float, digits: int = 4) -> str:
    """Return a number with so many significant digits; below 1e6 without exponent: 153 with two digits is 153, not 1.5e+02."""
    shown = f"{value:.{digits}g}"
    return f"{value:.0f}" if "e+" in shown and abs(value) < 1e6 else shown


def estimate_texts(value: float | None, interval: Interval | None = None, digits: int = 4) -> tuple[str, str, str]:
    """Return a value and the ends of its interval as text, each "" where there is none: the one form that these have anywhere.

    All have the decimals that show two digits of half the interval's width; without two ends, so many significant digits.
    """
    low, high = interval or (None, None)
    each = (value, low, high)
    size = max((abs(v) for v in each if v is not None), default=0.0)
    if low is not None and high is not None and low < high and size < 1e6:
        places = max(1 - math.floor(math.log10(0.5 * (high - low))), 0)
        if places <= 5 and size >= 10.0 ** (1 - places):
            low_text, high_text, value_text = ("" if v is None else f"{v:.{places}f}" for v in (low, high, value))
            return value_text, low_text, high_text
        digits = figures_of(interval, digits)
    value_text, low_text, high_text = ("" if v is None else figures(v, digits) for v in each)
    return value_text, low_text, high_text


def quantity(value: float, unit: str = "", digits: int = 4, interval: Interval | None = None) -> str:
    """Return a value with its unit, so many significant digits, or those that its interval leaves; short times in ms or µs."""
    factor, unit = _scale(value, unit)
    low, high = interval or (None, None)
    scaled = None if low is None or high is None else (factor * low, factor * high)
    return f"{estimate_texts(factor * value, scaled, digits)[0]} {unit}".rstrip()


def estimate_text(value: float, unit: str, interval: Interval | None) -> str:
    """Return a value with its interval in one unit, "17.96 ms (17.87 to 18.05 ms)"; without an interval as `quantity`."""
    factor, smaller = _scale(value, unit)
    ends = interval_text([None if end is None else factor * end for end in interval or (None, None)])
    return quantity(value, unit, interval=interval) + (f" ({ends} {smaller}".rstrip() + ")" if ends else "")


def _scale(value: float, unit: str) -> tuple[float, str]:
    """Return the factor and the unit in which a value is read best."""
    for below, factor, smaller in _SMALLER:
        if unit == "s" and 0.0 < abs(value) < below:
            return factor, smaller
    return 1.0, unit


def with_unit(name: str, unit: str) -> str:
    """Return a name with its unit, as axes and legends have it; the name alone where there is no unit."""
    return f"{name}, {unit}" if unit else name


def percentage(share: float, digits: int = 0) -> str:
    """Return a share of 1 in per cent, so many digits after the point."""
    return f"{100.0 * share:.{digits}f} %"


def duration(seconds: float) -> str:
    """Return a waiting time in s, min or h with two digits."""
    for above, unit in ((3600.0, "h"), (60.0, "min")):
        if seconds >= 2.0 * above:
            return f"{seconds / above:.2g} {unit}"
    return f"{seconds:.2g} s" if seconds < 100.0 else f"{seconds:.0f} s"


def span(low: float, high: float, unit: str = "", digits: int = 4, word: str = "and") -> str:
    """Return the two ends of a range with one unit, that of the upper one, with as many digits as tell them apart."""
    factor, unit = _scale(high, unit)
    digits = figures_of((low, high), digits)
    return f"{figures(factor * low, digits)} {word} {figures(factor * high, digits)} {unit}".rstrip()


def interval_text(interval: Interval | None, word: str = " to ") -> str:
    """Return an interval as "A to B"; one end that is open as "above A" or "below B"; empty where both are."""
    _, low, high = estimate_texts(None, interval)
    if low and high:
        return f"{low}{word}{high}"
    return f"above {low}" if low else f"below {high}" if high else ""


def change_text(after: float | None, before: float | None) -> str:
    """Return the change from before to after in per cent with its sign; "" where it cannot be told."""
    if after is None or not before:
        return ""
    change = 100.0 * (after / before - 1.0)
    return "0.0 %" if abs(change) < 0.05 else f"{change:+.1f} %"


def gap_text(share: float) -> str:
    """Return a share of the gap in per cent: one digit wherever it is told, so that what is explained and what is left add up to 100 %."""
    return percentage(share, 1)


def probability_text(share: float) -> str:
    """Return a share of 1 in whole per cent; one that is nearly nothing, or nearly all, is said so."""
    return "< 1 %" if 0 < share < 0.005 else "> 99 %" if 0.995 <= share < 1.0 - 1e-9 else percentage(share)


def interval_words(*, beyond_noise: bool) -> str:
    """Return what an interval is called: of a model that leaves more than noise none covers the truth in 95 of 100 cases."""
    return "interval if nothing else is missing" if beyond_noise else "95 % interval"


def figures_of(ci95: Sequence[float | None] | None, fewest: int = 6) -> int:
    """Return the significant figures that tell the ends of an interval apart: two more than they share, 15 at most."""
    low, high = ci95 or (None, None)
    if low is None or high is None or low >= high:
        return fewest
    return min(15, max(fewest, math.ceil(math.log10(max(abs(low), abs(high)) / (high - low))) + 2))


def factor_text(factor: float) -> str:
    """Return "31" or "1,030": two figures, or whole numbers from 100 on."""
    return f"{factor:.2g}" if factor < 99.5 else f"{factor:,.0f}"


def times_text(factor: float) -> str:
    """Return "31 times" or "1,030 times"."""
    return f"{factor_text(factor)} times"


_COMMAND = re.compile(r"`hvdc-ident [^`]*`|(?<![`\w/.-])hvdc-ident .*$")


def folded(text: str, width: int) -> str:
    """Return the text with lines of at most so many characters, later ones indented; tables and commands stay whole.

    A command is what stands in backquotes, or from `hvdc-ident` to the end of the line: it can still be copied.
    """
    return "\n".join(_folded(line, width) for line in text.splitlines())


def _folded(line: str, width: int) -> str:
    if len(line) <= width or re.search(r"\S {2,}\S.*\S {2,}\S", line):
        return line
    kept = _COMMAND.sub(lambda match: match[0].replace(" ", "\0"), line)
    settings = {"break_long_words": False, "break_on_hyphens": False}
    return textwrap.fill(kept, width, subsequent_indent="  ", **settings).replace("\0", " ")  # type: ignore[arg-type]


def capital(words: str) -> str:
    """Return the words with a capital at their beginning."""
    return words[:1].upper() + words[1:]


def listed(names: Iterable[str]) -> str:
    """Return the names as "A, B and C"."""
    *most, last = [*names] or [""]
    return f"{', '.join(most)} and {last}" if most else last


def one_of(names: Sequence[str], most: int = 4) -> str:
    """Return the names as "A or B", and of more than `most` the first and the number of the others: "A or B or one of 3 more"."""
    shown = list(names[:most]) + ([f"one of {len(names) - most} more"] if len(names) > most else [])
    return " or ".join(shown)


def with_study(text: str, study: str, *options: str) -> str:
    """Return the text with every "hvdc-ident COMMAND STUDY" in it made a command to paste, with this study and these options."""
    typed = shlex.join([study, *options])
    return re.sub(r"(hvdc-ident [a-z]+) STUDY\b", lambda match: f"{match[1]} {typed}", text)


class ValueAtPlace(Protocol):
    """The value of something if an effect is at a place. source: the signal brought in there."""

    @property
    def value(self) -> float: ...
    @property
    def unit(self) -> str: ...
    @property
    def effect(self) -> str: ...
    @property
    def at(self) -> tuple[str, ...]: ...
    @property
    def source(self) -> str: ...


def value_by_place(values: Sequence[ValueAtPlace]) -> str:
    """Return a value that depends on what is missing where, as "0.1 s if the lag is at ya, 0.4 s if it is at a or b".

    Places with the same value to three digits stand together.
    """
    places: dict[str, tuple[str, dict[str, list[str]]]] = {}
    for v in values:
        brought = f" with {v.source}" if v.source else ""
        shown = quantity(v.value, v.unit)
        by_effect = places.setdefault(f"{v.value:.3g}", (shown, {}))[1]
        by_effect.setdefault(v.effect, []).append(f"{listed(v.at)}{brought}")
    one_effect = len({v.effect for v in values}) == 1
    told = []
    for k, (value, by_effect) in enumerate(places.values()):
        where = " or ".join(
            f"{'it' if one_effect and k else f'the {effect}'} is at {one_of(at)}" for effect, at in by_effect.items()
        )
        told.append(f"{value} if {where}")
    return ", ".join(told)
