"""Curves on the page: grids with one abscissa and one cursor, drawn on canvas by uPlot, whose files come with the package.

Single columns of numbers are replaced, not figures: one curve of a thousand points takes a millisecond, where a whole
figure of ECharts or plotly takes ten and more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from nicegui import ui
from numpy.typing import NDArray

from hvdc_ident.colours import variable
from hvdc_ident.data import Array, Band
from hvdc_ident.report.drawing import base_style

RECORDED, GIVEN, NOW, EFFECT = (variable(name) for name in ("measured", "given", "fitted", "effect"))
"""Colours, as the page's style sheet names them; `NOW` is that of the values at hand."""
ROWS_DRAWN = 4000
"""Rows that are drawn as they are: a screen has fewer columns than half of them."""
ASSETS = Path(__file__).parent / "static" / "uplot"
HEAD = f"""<link rel="stylesheet" href="/assets/uPlot.min.css"><script src="/assets/uPlot.iife.min.js"></script>
<style>{base_style()}{(Path(__file__).parent / "page.css").read_text("utf-8")}</style>"""
"""Head of the page: the report's type and colours, the page's own; the server offers the folder `ASSETS` as /assets."""


@dataclass(frozen=True)
class Trace:
    """One curve of a grid. mark: drawn as points, not as a line."""

    name: str
    color: str
    dashed: bool = False
    mark: Literal["", "dot", "ring", "cross"] = ""
    size: int = 7


@dataclass(frozen=True)
class Marker:
    """A line across all grids that can be dragged. at: on the abscissa."""

    key: str
    label: str
    color: str
    at: float


@dataclass(frozen=True)
class Grid:
    """One picture of a plot: its ordinate's title, with the unit, and its curves."""

    title: str
    curves: tuple[Trace, ...]


class Plot(ui.element, component="plot.js"):  # type: ignore[call-arg]
    """Grids one above the other. log: of the abscissa. plane: both axes are looked into, by dragging a rectangle.

    markers: lines that can be dragged. Where one was, the plot says "marked" with {key, at}; with markers it says "viewed" with
    {from, to} when another part of the abscissa is looked at.
    """

    def __init__(
        self,
        grids: Sequence[Grid],
        x_title: str,
        height: int,
        label: str,
        *,
        log: bool = False,
        plane: bool = False,
        markers: Sequence[Marker] = (),
    ) -> None:
        """Build the plot without data. height: px. label: what is shown, for those who cannot see it."""
        super().__init__()
        self._props.update(
            grids=[asdict(g) for g in grids],
            xtitle=x_title,
            height=height,
            label=label,
            log=log,
            plane=plane,
            markers=[asdict(m) for m in markers],
        )
        self._drawn: dict[int, list[NDArray[np.float32]]] = {}
        self._shaded: dict[int, list[dict[str, Any]]] = {}
        self.on("ready", self._draw)  # the browser builds a plot when its tab is opened for the first time

    def _draw(self) -> None:
        """Send what was sent before there was a plot."""
        for grid, columns in self._drawn.items():
            self.run_method("whole", grid, columns)
        for grid, bands in self._shaded.items():
            self.run_method("shade", grid, bands)

    def put(self, grid: int, column: int, values: Array) -> None:
        """Replace the values of one column (0: the abscissa) of a grid: (n,), thinned as the others were."""
        short = _short(values)
        if grid in self._drawn:
            self._drawn[grid][column] = short
        self.run_method("put", grid, column, short)

    def whole(self, grid: int, columns: Sequence[Array]) -> None:
        """Replace all columns of a grid, the abscissa first: (n,) each."""
        self._drawn[grid] = [_short(c) for c in columns]
        self.run_method("whole", grid, self._drawn[grid])

    def refine(self, grid: int, columns: Sequence[Array]) -> None:
        """Replace all columns of a grid and go on looking at the same part of it: (n,) each."""
        self.run_method("refine", grid, [np.ascontiguousarray(columns[0]), *(_short(c) for c in columns[1:])])

    def shade(self, grid: int, bands: Sequence[Band]) -> None:
        """Shade spans of the abscissa of a grid, in place of those before: each with its kind, and what it is where it is pointed at."""
        self._shaded[grid] = [asdict(b) for b in bands]
        self.run_method("shade", grid, self._shaded[grid])

    def mark(self, key: str, at: float) -> None:
        """Move a marker."""
        self.run_method("mark", key, at)


def _short(values: Array) -> NDArray[np.float32]:
    """Return the values in half the digits, which is more than a screen shows; what is no number is sent as null.

    As an array, for a list is looked through number by number on its way out.
    """
    return np.ascontiguousarray(values, dtype=np.float32)


def thinned(x: Array, *ys: Array, most: int = ROWS_DRAWN) -> list[Array]:
    """Return x and curves over it as they are drawn, (n,) each: of every stretch of many rows the least and the largest value.

    No peak is lost. x: rising. most: rows that are drawn.
    """
    if x.size <= most:
        return [x, *ys]
    edges = np.linspace(0, x.size, most // 2 + 1).astype(int)[:-1]
    middle = (edges + np.append(edges[1:], x.size)) // 2
    drawn = [np.column_stack([x[edges], x[middle]]).ravel()]
    drawn[0][-1] = x[-1]
    for y in ys:
        drawn.append(np.column_stack([np.fmin.reduceat(y, edges), np.fmax.reduceat(y, edges)]).ravel())
    return drawn


def focused(x: Array, low: float, high: float, *ys: Array) -> list[Array]:
    """Return x and curves as they are drawn by somebody who looks at low to high, (n,) each: closely there, coarsely beside."""
    ends = [0, *np.searchsorted(x, [low, high]).clip(0, x.size).tolist(), x.size]
    ends[1], ends[2] = max(ends[1] - 1, 0), min(ends[2] + 1, x.size)  # lines that go on beyond the edge
    parts = [
        thinned(x[a:b], *(y[a:b] for y in ys), most=most)
        for a, b, most in zip(ends, ends[1:], (ROWS_DRAWN // 8, ROWS_DRAWN, ROWS_DRAWN // 8), strict=False)
        if a < b
    ]
    return [np.concatenate(columns) for columns in zip(*parts, strict=True)]


def sketch(x: Array, y: Array, width: int, height: int) -> str:
    """Return a curve as a small picture (SVG) in the colour of the text, without axes; gaps stay open."""
    drawn_x, drawn_y = thinned(x, y, most=2 * width)
    known = np.isfinite(drawn_y)
    low, high = (float(drawn_y[known].min()), float(drawn_y[known].max())) if known.any() else (0.0, 0.0)
    span, length = (high - low) or 1.0, float(x[-1] - x[0]) or 1.0
    across = (drawn_x - x[0]) / length * width
    up = height - 2 - ((drawn_y - low) / span if high > low else np.where(known, 0.5, np.nan)) * (height - 4)
    pieces, drawing = [], False
    for a, b, there in zip(across.tolist(), up.tolist(), known.tolist(), strict=True):
        if there:
            pieces.append(f"{'L' if drawing else 'M'}{a:.1f} {b:.1f}")
        drawing = there
    return (
        f'<svg width="{width}" height="{height}" viewBox="0 0 {width} {height}" aria-hidden="true">'
        f'<path d="{"".join(pieces)}" fill="none" style="stroke: {RECORDED}" stroke-width="1"/></svg>'
    )


def scattered(*sets: Array) -> list[Array]:
    """Return complex numbers of several sets as columns of a plane: the real parts, rising, then by set the imaginary parts.

    Where a set has no point it is nan.
    """
    x = np.concatenate([s.real for s in sets])
    columns = []
    for k in range(len(sets)):
        own = np.concatenate([s.imag if n == k else np.full(s.size, np.nan) for n, s in enumerate(sets)])
        columns.append(own)
    order = np.argsort(x, kind="stable")
    return [x[order], *(c[order] for c in columns)]
