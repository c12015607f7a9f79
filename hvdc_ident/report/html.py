"""Pieces of a page: escaped text, numbers as people read them, tables."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Sequence
from typing import Any


def text(value: Any) -> str:
    """Any value as text that is safe inside a page."""
    return html.escape(str(value), quote=True)


def number(value: Any, digits: int = 4) -> str:
    """A number with so many significant digits; a dash where there is none."""
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        return "–"
    shown = f"{value:.{digits}g}"
    if "e" in shown:
        mantissa, exponent = shown.split("e")
        return f"{mantissa}·10<sup>{int(exponent)}</sup>".replace("-", "−")
    return shown.replace("-", "−")


def share(after: Any, before: Any) -> str:
    """The change from before to after in per cent; a dash where it cannot be told."""
    if not all(isinstance(v, int | float) and not isinstance(v, bool) for v in (after, before)) or not before:
        return "–"
    return f"{100.0 * (after / before - 1.0):+.1f} %".replace("-", "−")


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
