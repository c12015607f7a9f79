"""Figures as SVG text inside the page: thinned to what can be seen, in the page's colours, some of them with what zooms them.

Colours of a figure are names of the page's style sheet, so that one drawing serves light, dark and paper.
"""

from __future__ import annotations

import base64
import hashlib
import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.colours import DARK, LIGHT, style
from hvdc_ident.data import Array
from hvdc_ident.report.html import captioned, text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

POINTS = 500
"""Points of a curve that are drawn: two for each point of the widest figure's axis are more than can be told apart."""
WIDEST = 8.4
"""rem on the page for an inch of a figure: one of 7.4 inches fills it."""
NAMED = {
    **{colour: name for name, colour in LIGHT.items()},
    "#999999": "mark",
    "#000000": "ink",
    "#ffffff": "paper",
    "#e4e4e4": "grid",
    "#dddddd": "grid",
    "#cccccc": "grid",
    "#c4c4c4": "mark",
    "#b0b0b0": "mark",
}
"""Names in the style sheet of the colours that change with the page's ground; the others are seen on either."""


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


def bode_axes(fig: Figure, columns: int = 1) -> list[tuple[Axes, Axes]]:
    """Axes for gain above phase over frequency, so many pairs beside each other, with their labels and grids."""
    grid = fig.subplots(2, columns, sharex="col", squeeze=False)
    for k, (above, below) in enumerate(zip(*grid, strict=True)):
        below.set_xlabel("frequency, Hz")
        for axes, label in ((above, "gain, dB"), (below, "phase, degrees")):
            axes.set_ylabel(label if k == 0 else "")
            axes.grid(True, color="#e4e4e4", linewidth=0.6)
            axes.tick_params(labelsize=8)
            axes.spines[["top", "right"]].set_visible(False)
        fig.align_ylabels([above, below])
    return list(zip(*grid, strict=True))


def draw_response(
    pair: tuple[Axes, Axes],
    omega: Array,
    values: NDArray[np.complex128],
    phase: Array,
    label: str | None = None,
    **style: Any,
) -> bool:
    """Return whether a response over frequency, rad/s, was drawn as gain and phase, degrees: one that is 0 everywhere is not."""
    keep = (omega > 0) & (np.abs(values) > 0)
    if not keep.any():
        return False
    hertz = omega[keep] / (2 * np.pi)
    pair[0].semilogx(hertz, 20 * np.log10(np.abs(values[keep])), label=label, **style)
    pair[1].semilogx(hertz, phase[keep], **style)
    for axes in pair:
        axes.minorticks_off()  # over three decades nobody reads them, and they take half of the time to draw
    return True


def svg(fig: Figure, label: str) -> str:
    """The figure as an `<svg>` element, the same bytes each time; text stays text."""
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.ticker import LogFormatter

    for axes in fig.axes:
        for axis, scale in ((axes.xaxis, axes.get_xscale()), (axes.yaxis, axes.get_yscale())):
            if scale in ("log", "symlog"):  # powers of ten as plain numbers: formulas are not typeset
                axis.set_major_formatter(lambda x, _: f"{x:g}")
            if scale == "log":
                axis.set_minor_formatter(LogFormatter(minor_thresholds=(1.0, 0.4)))
    style = {"svg.fonttype": "none", "svg.hashsalt": label, "font.family": "sans-serif", "text.parse_math": False}
    stream = io.StringIO()
    with matplotlib.rc_context(style):  # `savefig` would draw everything twice
        FigureCanvasSVG(fig).print_svg(stream, metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    widest = f"{WIDEST * fig.get_figwidth():.1f}rem"  # a narrow figure is not blown up to the page's width
    opening = f'<svg role="img" aria-label="{text(label)}" style="max-width: {widest}"'
    drawn = stream.getvalue()
    return _compact(drawn[drawn.index("<svg") :]).replace("<svg", opening, 1)


_TAG = re.compile(r"<[^>]*>")
_PATH = re.compile(r' d="([^"]*)"')
_STEP = re.compile(r"([MLz])(?: ([-\d.]+) ([-\d.]+))?")
_COLOUR = re.compile("|".join(NAMED))
_DIGITS = re.compile(r"(?<=\.\d)\d+")
_NEEDLESS = re.compile(
    r' id="(?:figure|patch|axes|matplotlib|xtick|ytick|line2d|text|legend|\w*Collection)[\w.]*"'
    r'| transform="rotate\(-0[^"]*\)"| xmlns(?::xlink)?="[^"]*"| ?font-family: [^;"]*;?',
)


def _compact(drawn: str) -> str:
    """The same drawing in fewer bytes, with the colours of the page: tenths of a point, no names that nothing refers to."""
    drawn = re.sub(r"<defs>\s*<style.*?</style>\s*</defs>", "", drawn, count=1, flags=re.DOTALL)
    drawn = re.sub(r">\s+<", "><", _TAG.sub(lambda match: _compact_tag(match[0]), drawn))
    while "<g></g>" in drawn:
        drawn = drawn.replace("<g></g>", "")
    return drawn


def _compact_tag(tag: str) -> str:
    tag = _PATH.sub(lambda match: f' d="{_short(match[1])}"', tag)
    tag = _DIGITS.sub("", _NEEDLESS.sub("", tag)).replace("xlink:href", "href")
    return _COLOUR.sub(lambda match: f"var(--{NAMED[match[0]]})", tag)


def _short(path: str) -> str:
    """A path of straight lines with steps in place of points; any other path as it is."""
    if "C" in path or "Q" in path:
        return " ".join(path.split())
    parts: list[str] = []
    x = y = 0
    for letter, right, down in _STEP.findall(path):
        if letter == "z":
            parts.append("z")
            continue
        to = round(10 * float(right)), round(10 * float(down))
        if letter == "M":
            parts.append(f"M{to[0] / 10:g} {to[1] / 10:g}")
        elif to != (x, y) or len(parts) == 1:
            parts.append(f"l{(to[0] - x) / 10:g} {(to[1] - y) / 10:g}")
        x, y = to
    return "".join(parts).replace("l0.", "l.").replace(" 0.", " .").replace("-0.", "-.")


def on_paper(page: str) -> str:
    """The page with plain colours in its figures, for a program that does not read the names of a style sheet there."""
    plain = {name: colour for colour, name in reversed(NAMED.items())}
    return re.sub(r"var\(--(\w+)\)", lambda match: plain.get(match[1], match[0]), page)


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
    drawn: str,
    label: str,
    caption: str,
    columns: Mapping[str, Array],
    curves: Sequence[PlottedCurve],
    titles: tuple[str, str, str],
) -> str:
    """A `<figure>` with the drawing and its caption, which a button turns into an interactive one of the same curves.

    columns: of one length; `x` is the abscissa of all. titles: of the abscissa, the figure and the strip below it.
    """
    data = {
        "columns": {
            name: base64.b64encode(values.astype("<f4").tobytes()).decode() for name, values in columns.items()
        },
        "curves": [asdict(curve) | {"color": _named(curve.color)} for curve in curves],
        "titles": list(titles),
    }
    within = json.dumps(data).replace("<", "\\u003c")  # no name ends the script
    script = f'<script type="application/json">{within}</script>'
    return captioned(drawn + script, caption, f' data-zoom="{text(label)}"')


def _named(colour: str) -> str:
    return f"var(--{NAMED[colour]})" if colour in NAMED else colour


def script(body: str) -> tuple[str, str]:
    """Return the page's script and the policy that allows it alone; both "" where nothing in the body needs it."""
    if "data-zoom=" not in body and "data-sizes=" not in body:
        return "", ""
    code = asset("page.js")
    mark = base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()
    return code, f"script-src 'sha256-{mark}'"


@cache
def base_style() -> str:
    """Return the type, the tiles and the colours, those of curves among them, that report and workbench share."""
    dark = f"@media screen and (prefers-color-scheme: dark) {{ :root {{ {style(DARK)} }} }}"
    return f":root {{ {style(LIGHT)} }}\n{dark}\n{asset('base.css')}"


@cache
def style_sheet() -> str:
    """Return the style sheet of a page."""
    return base_style() + asset("page.css")


@cache
def asset(name: str) -> str:
    """Return the text of a file in `templates/`."""
    return resources.files("hvdc_ident.report").joinpath("templates", name).read_text(encoding="utf-8")
