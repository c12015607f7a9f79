"""Pieces of a page: escaped text, numbers as people read them, tables, figures with captions, parts that unfold."""

from __future__ import annotations

import html
import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from hvdc_ident.display import Table
from hvdc_ident.summary import Results
from hvdc_ident.text import estimate_texts, figures, interval_text

_POWER = re.compile(r"(?<=\d)e([-+]\d+)\b")
_MINUS = re.compile(r"(?<![\w.])-(?=\d)|(?<=<sup>)-")
_BADGE = re.compile(r"\b(PASS|FAIL)\b")


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
    return typeset(figures(value, digits))


def typeset(shown: str) -> str:
    """Return text with numbers in it as HTML: with minus signs, and powers of ten; PASS and FAIL as badges."""
    raised = _POWER.sub(lambda found: f"·10<sup>{int(found[1])}</sup>", text(shown))
    signed = _MINUS.sub("−", raised)
    return _BADGE.sub(lambda found: badge(found[0] == "PASS"), signed)


def estimate(value: float | None, interval: Sequence[float | None] | None) -> tuple[str, str]:
    """Return a value and its interval as HTML, with the digits that the interval leaves; a dash where there is none."""
    return typeset(estimate_texts(value, interval)[0]) or "–", typeset(interval_text(interval)) or "–"


def captioned(drawing: str, caption: str, attributes: str = "") -> str:
    """Return a `<figure>` of a drawing and its caption, both HTML; the page numbers the figures. attributes: of the figure."""
    return f"<figure{attributes}>{drawing}<figcaption>{caption}</figcaption></figure>"


def folded(summary: str, body: str, about: str = "") -> str:
    """Return a part that opens on demand, "" without a body. summary, about: its line and one sentence on it, as HTML."""
    if not body:
        return ""
    more = f"<span class='about'>{about}</span>" if about else ""
    return f"<details><summary>{summary}{more}</summary>{body}</details>"


def badge(passed: bool | None) -> str:
    """Return the word PASS or FAIL, which no colour is needed to tell; a dash where nothing was judged."""
    return "–" if passed is None else f"<b class='{'pass' if passed else 'fail'}'>{'PASS' if passed else 'FAIL'}</b>"


def table_of(found: Table) -> str:
    """Return a table of text and numbers as HTML; a number has four digits, and None is a dash."""
    words = [k for k, numbers in enumerate(found.numeric) if not numbers]
    rows = [[typeset(c) if isinstance(c, str) else number(c) for c in row] for row in found.rows]
    return table([typeset(h) for h in found.header], rows, words=words)


def rows_of(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a table of text and numbers as HTML; "" without rows."""
    cells = tuple(tuple(row) for row in rows)
    return table_of(Table(tuple(header), cells)) if cells else ""


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


@dataclass(frozen=True)
class Section:
    """A part of the page that opens on demand.

    order: its place. title: its heading. about: one sentence on what it shows, which stands beside the heading. render: its
    HTML from the results (empty: the part is left out). A print shows it open.
    """

    order: int
    title: str
    about: str
    render: Callable[[Results], str]
