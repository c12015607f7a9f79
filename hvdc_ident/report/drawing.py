"""Figures as SVG text inside the page, thinned to what can be seen, and those that zoom with what they need.

A page that has no figure that zooms carries none of that.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array
from hvdc_ident.report.html import text

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


@dataclass(frozen=True)
class PlottedCurve:
    """A curve of a figure that zooms: columns by name. minus: a column taken off y. lower: in the strip below."""

    name: str
    color: str
    y: str
    minus: str = ""
    lower: bool = False


def zoomable(
    drawn: str, label: str, columns: Mapping[str, Array], curves: Sequence[PlottedCurve], titles: tuple[str, str, str]
) -> str:
    """A `<figure>` with the drawing, which a button turns into an interactive one of the same curves.

    columns: of one length; `x` is the abscissa of all. titles: of the abscissa, the figure and the strip below it.
    """
    data = {
        "columns": {
            name: base64.b64encode(values.astype("<f4").tobytes()).decode() for name, values in columns.items()
        },
        "curves": [asdict(curve) | {"name": text(curve.name)} for curve in curves],
        "titles": [text(title) for title in titles],
    }
    script = f'<script type="application/json">{json.dumps(data)}</script>'
    return f'<figure data-zoom="{text(label)}">{drawn}{script}</figure>'


def scripts(body: str) -> tuple[str, str, str]:
    """Return the page's script and the drawing library that this body needs, and the policy that allows them alone.

    Each is "" where the body needs none.
    """
    zooms, moves = "data-zoom=" in body, "data-sizes=" in body
    if not (zooms or moves):
        return "", "", ""
    code = asset("page.js")
    mark = base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()
    return code, _library() if zooms else "", f"script-src 'sha256-{mark}' blob:"


@cache
def asset(name: str) -> str:
    """Return the text of a file in `templates/`."""
    return resources.files("hvdc_ident.report").joinpath("templates", name).read_text(encoding="utf-8")


@cache
def _library() -> str:
    """plotly.js, compressed, as text."""
    code = resources.files("plotly").joinpath("package_data", "plotly.min.js").read_bytes()
    return base64.b64encode(gzip.compress(code, 6, mtime=0)).decode()
