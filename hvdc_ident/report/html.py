"""Pieces of a page: escaped text, numbers as people read them, tables, figures with captions, parts that unfold."""

from __future__ import annotations

import html
import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup

from hvdc_ident.display import Table
from hvdc_ident.summary import Results
from hvdc_ident.text import estimate_texts, figures, interval_text

_POWER = re.compile(r"(?<=\d)e([-+]\d+)\b")
_MINUS = re.compile(r"(?<![\w.])-(?=\d)|(?<=<sup>)-")
_RAISED = re.compile(r"·10<sup>(.*?)</sup>")
_TAG = re.compile(r"<[^>]*>")
_BADGE = re.compile(r"\b(PASS|FAIL)\b")


def text(value: Any) -> str:
    """Any value as text that is safe inside a page."""
    return html.escape(str(value), quote=True)


def prose(value: Any) -> str:
    """Text for people as HTML, with what stands between backticks as code."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", text(value))


def shown(value: Any, digits: int = 4) -> str:
    """Return a number with so many significant digits as text; a dash where there is none."""
    known = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return figures(value, digits) if known else "–"


def number(value: Any, digits: int = 4) -> str:
    """Return a number with so many significant digits as HTML; a dash where there is none."""
    return typeset(shown(value, digits))


def typeset(shown: str) -> str:
    """Return text with numbers in it as HTML: with minus signs, and powers of ten; PASS and FAIL as badges."""
    raised = _POWER.sub(lambda match: f"·10<sup>{int(match[1])}</sup>", text(shown))
    signed = _MINUS.sub("−", raised)
    return _BADGE.sub(lambda match: badge(match[0] == "PASS"), signed)


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


def table_of(table: Table) -> str:
    """Return a table of text, numbers and markup as HTML; a number has four digits, and None is a dash.

    A column without anything in it is left out.
    """
    plain = Table(
        table.header, tuple(tuple(_plain(c) if isinstance(c, Markup) else c for c in row) for row in table.rows)
    )
    kinds = ["" if not numbers else ' class="n"' for numbers in plain.numeric]
    rows = [[_cell(c) for c in row] for row in table.rows]
    kept = [k for k in range(len(table.header)) if not rows or any(row[k] for row in rows)]
    head = "".join(f"<th{kinds[k]}>{typeset(table.header[k])}</th>" for k in kept)
    body = "\n".join("<tr>" + "".join(f"<td{kinds[k]}>{row[k]}</td>" for k in kept) + "</tr>" for row in rows)
    return f'<div class="wide"><table>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody></table></div>'


def rows_of(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a table of text, numbers and markup as HTML; "" without rows."""
    cells = tuple(tuple(row) for row in rows)
    return table_of(Table(tuple(header), cells)) if cells else ""


def _plain(value: Markup) -> str:
    """Return what a cell says, with powers of ten as numbers have them."""
    return html.unescape(_TAG.sub("", _RAISED.sub(r"e\1", value))).replace("−", "-")


def _cell(value: Any) -> str:
    return value if isinstance(value, Markup) else typeset(value) if isinstance(value, str) else number(value)


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
