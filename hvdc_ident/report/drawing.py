"""Figures as SVG text inside the page, and waveforms thinned to what can be seen."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LINE, _DIGITS = re.compile(r' d="[^"]*"'), re.compile(r"(?<=\.\d)\d+")  # tenths of a point are seen at most
POINTS = 700
WIDEST = 8.4
"""rem on the page for an inch of a figure: one of 7.4 inches fills it."""
MEASURED, BEFORE, AFTER, MARK = "#222222", "#d08020", "#1f5fa8", "#999999"


def figure(width: float, height: float, margins: Mapping[str, float] | None = None) -> Figure:
    """An empty figure, sizes in inches; no window, no state shared with other figures.

    margins: as `subplots_adjust` takes them; without, they are found by drawing it twice.
    """
    from matplotlib.figure import Figure

    if margins is None:
        return Figure(figsize=(width, height), layout="constrained")
    fig = Figure(figsize=(width, height))
    fig.subplots_adjust(**margins)
    return fig


def svg(fig: Figure, label: str) -> str:
    """The figure as an `<svg>` element, the same bytes each time; text stays text."""
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.ticker import LogFormatter

    from hvdc_ident.report.html import text

    for axes in fig.axes:
        for axis, scale in ((axes.xaxis, axes.get_xscale()), (axes.yaxis, axes.get_yscale())):
            if scale == "log":  # powers of ten as plain numbers: formulas are not typeset
                axis.set_major_formatter(lambda x, _: f"{x:g}")
                axis.set_minor_formatter(LogFormatter(minor_thresholds=(1.0, 0.4)))
    style = {"svg.fonttype": "none", "svg.hashsalt": label, "font.family": "sans-serif", "text.parse_math": False}
    stream = io.StringIO()
    with matplotlib.rc_context(style):  # `savefig` would draw everything twice
        FigureCanvasSVG(fig).print_svg(stream, metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    drawn = _LINE.sub(lambda line: _DIGITS.sub("", line[0]), stream.getvalue())
    widest = f"{WIDEST * fig.get_figwidth():.1f}rem"  # a narrow figure is not blown up to the page's width
    opening = f'<svg role="img" aria-label="{text(label)}" style="max-width: {widest}"'
    return drawn[drawn.index("<svg") :].replace("<svg", opening, 1)


def visible(time: Array, values: Array, points: int = POINTS) -> tuple[Array, Array]:
    """At most about so many points that draw the same line: the smallest and the largest of each stretch, in order.

    A NaN in a stretch stays one, so that the line has a gap there.
    """
    rows = visible_rows(values, points)
    return time[rows], values[rows]


def visible_rows(values: Array, points: int = POINTS) -> NDArray[np.intp]:
    """The rows of these points."""
    if values.size <= points:
        return np.arange(values.size)
    width = -(-2 * values.size // points)
    whole = np.append(values, np.full(-values.size % width, values[-1])).reshape(-1, width)
    begins = np.arange(0, values.size, width)
    missing = np.isnan(whole)
    low, high = np.where(missing, np.inf, whole).argmin(axis=1), np.where(missing, -np.inf, whole).argmax(axis=1)
    parts = [[0, values.size - 1], begins + low, begins + high]
    if missing.any():
        parts.append(begins + missing.argmax(axis=1))
    rows = np.concatenate(parts)
    return np.unique(np.minimum(rows, values.size - 1))
