"""Section of the page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from hvdc_ident.report.results import Results


@dataclass(frozen=True)
class Section:
    """A part of the page: its place, its heading, and its HTML from the results (empty: the part is left out)."""

    order: int
    title: str
    render: Callable[[Results], str]
