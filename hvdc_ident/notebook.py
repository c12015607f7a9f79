"""How values show themselves: a table for notebooks, and the axes a figure is drawn on."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from typing import Any


def table_html(title: str, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """An HTML table with a title; numbers with six digits, text escaped."""
    head = "".join(f"<th>{escape(h)}</th>" for h in header)
    body = "".join("<tr>" + "".join(f"<td>{_cell(c)}</td>" for c in row) + "</tr>" for row in rows)
    return f"<p>{escape(title)}</p><table><tr>{head}</tr>{body}</table>"


def axes_of(ax: Any, width: float = 7.0, height: float = 5.0, *, rows: int = 1) -> Any:
    """The axes given; else those of a new figure, sizes in inches: one, or an array of so many above each other."""
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.subplots(rows, 1, sharex=rows > 1, figsize=(width, height), layout="constrained")[1]


def _cell(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else escape(str(value))
