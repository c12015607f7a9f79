"""Pieces of a page: escaped text, numbers as people read them, tables, figures with captions, parts that unfold."""

from __future__ import annotations

import html
import math
import re
from collections.abc import Iterable, Sequence
from typing import Any

from hvdc_ident.text import figures, figures_of, percentage


def text(value: Any) -> str:
    """Any value as text that is safe inside a page."""
    return html.escape(str(value), quote=True)


def prose(value: Any) -> str:
    """Text for people as HTML, with what stands between backticks as code."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", text(value))


def number(value: Any, digits: int = 4) -> str:
    """A number with so many significant digits; a dash where there is none."""
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        return "–"
    shown = figures(value, digits)
    if "e" in shown:
        mantissa, exponent = shown.split("e")
        return f"{mantissa}·10<sup>{int(exponent)}</sup>".replace("-", "−")
    return shown.replace("-", "−")


def rough(value: Any, digits: int = 2) -> str:
    """A number with exactly so many significant digits, zeros at its end too; a dash where there is none."""
    if not isinstance(value, int | float) or not math.isfinite(value) or not 1e-4 <= abs(value) < 1e6:
        return number(value, digits)
    if abs(value) >= 10.0**digits:
        return f"{float(f'{value:.{digits}g}'):.0f}".replace("-", "−")
    return f"{value:#.{digits}g}".rstrip(".").replace("-", "−")


def percent(share: float) -> str:
    """A share of 1 in whole per cent; one that is nearly nothing, or nearly all, is said so."""
    return "< 1 %" if 0 < share < 0.005 else "> 99 %" if 0.995 <= share < 1.0 - 1e-9 else percentage(share)


def decimals(low: float, high: float) -> int:
    """Return the decimals that show two digits of half an interval's width: at least 0, at most 6."""
    half = 0.5 * abs(high - low)
    return min(max(1 - math.floor(math.log10(half)), 0), 6) if half > 0 and math.isfinite(half) else 6


def estimate(value: Any, interval: Sequence[float | None] | None) -> tuple[str, str]:
    """Return a value and its 95 % interval as text, with the digits that the interval leaves; a dash where there is none."""
    low, high = interval or (None, None)
    if not all(isinstance(v, int | float) and math.isfinite(v) for v in (value, low, high)) or not 0 < abs(value) < 1e6:
        digits = figures_of(interval, 3) if all(isinstance(v, int | float) for v in (low, high)) else 3
        ends = [number(v, digits) if v is not None else "" for v in (low, high)]
        one_sided = f"below {ends[1]}" if low is None else f"above {ends[0]}" if high is None else " … ".join(ends)
        return number(value), one_sided if interval and (low, high) != (None, None) else "–"
    assert low is not None and high is not None
    places = decimals(low, high)
    if abs(value) < 10.0 ** (1 - places) or places == 6:
        digits = figures_of((low, high), 4)
        return number(value, digits), f"{number(low, digits)} … {number(high, digits)}"
    shown = [f"{v:.{places}f}".replace("-", "−") for v in (value, low, high)]
    return shown[0], f"{shown[1]} … {shown[2]}"


def share(after: Any, before: Any) -> str:
    """The change from before to after in per cent; a dash where it cannot be told."""
    if not all(isinstance(v, int | float) and not isinstance(v, bool) for v in (after, before)) or not before:
        return "–"
    change = 100.0 * (after / before - 1.0)
    return "0.0 %" if abs(change) < 0.05 else f"{change:+.1f} %".replace("-", "−")


def captioned(drawing: str, caption: str, attributes: str = "") -> str:
    """Return a `<figure>` of a drawing and its caption, both HTML; the page numbers the figures. attributes: of the figure."""
    return f"<figure{attributes}>{drawing}<figcaption>{caption}</figcaption></figure>"


def folded(summary: str, body: str, about: str = "", *, printed: bool = False) -> str:
    """Return a part that opens on demand, "" without a body. summary, about: its line and one sentence on it, as HTML.

    printed: whether it is printed open even where the reader left it closed; others are printed as their line.
    """
    if not body:
        return ""
    more = f"<span class='about'>{about}</span>" if about else ""
    kind = " class='printed'" if printed else ""
    return f"<details{kind}><summary>{summary}{more}</summary>{body}</details>"


def badge(passed: bool | None) -> str:
    """Return the word PASS or FAIL, which no colour is needed to tell; a dash where nothing was judged."""
    return "–" if passed is None else f"<b class='{'pass' if passed else 'fail'}'>{'PASS' if passed else 'FAIL'}</b>"


def table(header: Sequence[str], rows: Iterable[Sequence[str]], *, words: Sequence[int] = (0,)) -> str:
    """A table. header and cells are HTML already; `words` are the columns of text, the others are numbers.

    A column without anything in it is left out.
    """
    rows = [list(row) for row in rows]
    keep = [i for i in range(len(header)) if not rows or any(row[i] for row in rows)]
    header, rows = [header[i] for i in keep], [[row[i] for i in keep] for row in rows]
    words = [new for new, old in enumerate(keep) if old in words]
    head = "".join(f"<th{_kind(i, words)}>{h}</th>" for i, h in enumerate(header))
    body = "\n".join(
        "<tr>" + "".join(f"<td{_kind(i, words)}>{c}</td>" for i, c in enumerate(row)) + "</tr>" for row in rows
    )
    return f'<div class="wide"><table>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody></table></div>'


def _kind(column: int, words: Sequence[int]) -> str:
    return "" if column in words else ' class="n"'
