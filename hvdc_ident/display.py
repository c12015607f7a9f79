"""Display of results: one screen of text, a table in a notebook, a figure, a data frame."""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from textwrap import fill
from typing import Any

from hvdc_ident.errors import InputError

WIDTH = 110
"""Characters in a line of a summary."""
_ONE = r"[-+<>]? ?[\d.,]*(e[-+]?\d+)?( %|j)?"
_NUMBER = re.compile(rf"((below|above) )?{_ONE}( (to|>|±) {_ONE})?|–")
ROWS_SHOWN = 40
"""Rows of a table that a summary lists, where nothing else is said."""


@dataclass(frozen=True)
class Table:
    """Rows under a header; numbers are shown with six digits, None as an empty cell."""

    header: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]

    def __str__(self) -> str:
        cells = [self.header, *(tuple(map(_text, row)) for row in self.rows)]
        widths = [max(len(row[k]) for row in cells) for k in range(len(self.header))]
        numbers = self.numeric

        def line(row: Sequence[str]) -> str:
            padded = (c.rjust(w) if right else c.ljust(w) for c, w, right in zip(row, widths, numbers, strict=True))
            return "  ".join(padded).rstrip()

        return "\n".join(map(line, cells))

    @property
    def numeric(self) -> list[bool]:
        """By column True where it holds numbers alone."""
        return [all(_is_number(row[k]) for row in self.rows) for k in range(len(self.header))]

    def without_empty(self) -> Table:
        """Return the table without the columns that have nothing in any row."""
        keep = [k for k in range(len(self.header)) if any(row[k] not in (None, "") for row in self.rows)]
        return Table(tuple(self.header[k] for k in keep), tuple(tuple(row[k] for k in keep) for row in self.rows))

    @property
    def html(self) -> str:
        """The table as HTML."""
        head = "".join(f"<th>{escape(h)}</th>" for h in self.header)
        body = "".join("<tr>" + "".join(f"<td>{escape(_text(c))}</td>" for c in row) + "</tr>" for row in self.rows)
        return f"<table><tr>{head}</tr>{body}</table>"


def rounded(value: float | None, digits: int = 4) -> float | None:
    """Return a number with so many significant digits, for a cell of a table."""
    return None if value is None else float(f"{value:.{digits}g}")


def first_rows(
    header: tuple[str, ...], rows: Sequence[tuple[Any, ...]], kind: str = "", most: int = ROWS_SHOWN
) -> Iterator[str | Table]:
    """Yield a table of the first rows, and the number of the others. kind: of what the rows are."""
    yield Table(header, tuple(rows[:most]))
    yield f"and {len(rows) - most} more {kind}".rstrip() if len(rows) > most else ""


class Shown:
    """A result that shows itself: `print` gives its screen, a notebook the same with tables.

    A class gives `_screen`; its first text is the headline, which `repr` shows alone.
    """

    def _screen(self) -> Iterable[str | Table]:
        raise NotImplementedError

    def __str__(self) -> str:
        blocks = (str(b) if isinstance(b, Table) else _wrapped(b) for b in self._screen())
        return "\n\n".join(b for b in blocks if b)

    def summary(self) -> str:
        """Return what `print` shows: one screen of text."""
        return str(self)

    @property
    def lines(self) -> list[str]:
        """The screen as lines, which are as long as they are."""
        lines: list[str] = []
        for block in self._screen():
            lines += [*str(block).splitlines(), ""] if str(block) else []
        return lines[:-1]

    def __repr__(self) -> str:
        first = next((text for text in map(str, self._screen()) if text), "")
        headline, kind = first.partition("\n")[0], type(self).__name__
        return f"<{headline}>" if headline.startswith(kind) else f"<{kind}: {headline}>"

    def _repr_html_(self) -> str:
        blocks = [b for b in self._screen() if b]
        return "".join(b.html if isinstance(b, Table) else f"<p>{_breaks(b)}</p>" for b in blocks)


def _wrapped(text: str) -> str:
    return "\n".join(fill(line, WIDTH, subsequent_indent="  ", break_long_words=False) for line in text.splitlines())


def _breaks(text: str) -> str:
    return escape(text).replace("\n", "<br>")


def library(name: str, purpose: str, package: str = "") -> Any:
    """Return an optional library, imported now. Raises InputError where it is not installed.

    package: what pip installs, where that is not the library's own name.
    """
    try:
        return importlib.import_module(name)
    except ImportError:
        raise InputError(
            f"{purpose} needs {name}, which is not installed", hint=f"pip install {package or name}"
        ) from None


def data_frame(columns: Mapping[str, Any], index: Any = None, index_name: str | None = None) -> Any:
    """Return a pandas DataFrame. Raises InputError where pandas is not installed."""
    frame = library("pandas", "to_dataframe").DataFrame(dict(columns), index=index)
    frame.index.name = index_name
    return frame


def axes_of(ax: Any, width: float = 7.0, height: float = 5.0, *, rows: int = 1) -> Any:
    """Return the axes given; else those of a new figure, sizes in inches: one, or an array of so many above each other."""
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.subplots(rows, 1, sharex=rows > 1, figsize=(width, height), layout="constrained")[1]


def _is_number(cell: Any) -> bool:
    return cell is None or isinstance(cell, int | float) or _NUMBER.fullmatch(cell) is not None


def _text(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)
