"""The figure of one output in one experiment: measured against simulated before and after, and what is left over."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.report.drawing import AFTER, BEFORE, MARK, MEASURED, figure, visible
from hvdc_ident.report.html import text
from hvdc_ident.report.interactive import numbers
from hvdc_ident.trajectory import Array, Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def waveforms(
    output: str,
    unit: str,
    before: Trajectory | None,
    after: Trajectory | None,
    event: float | None = None,
    window: tuple[float, float] | None = None,
) -> Figure:
    """The recorded and simulated output over time, and below it measured minus simulated.

    before, after: tables with the columns OUTPUT and OUTPUT.measured, at the start values and at the estimates.
    """
    fig = figure(7.4, 3.5)
    top, strip = fig.subplots(2, 1, sharex=True, height_ratios=[3, 1])
    shown = after if after is not None else before
    if shown is not None:
        top.plot(*visible(shown.time, shown[f"{output}.measured"]), color=MEASURED, linewidth=1.0, label="measured")
    for table, color, label in ((before, BEFORE, "before: start values"), (after, AFTER, "after: fitted")):
        if table is None:
            continue
        dashes = (0, (5, 2)) if table is before else "-"
        top.plot(*visible(table.time, table[output]), color=color, linewidth=1.3, linestyle=dashes, label=label)
        left = table[f"{output}.measured"] - table[output]
        strip.plot(*visible(table.time, left), color=color, linewidth=0.8)
    unit_text = f", {unit}" if unit else ""
    top.set_ylabel(f"{output}{unit_text}")
    strip.set_ylabel("residual")
    strip.set_xlabel("time, s")
    strip.axhline(0.0, color=MARK, linewidth=0.6)
    for axes in (top, strip):
        axes.grid(True, color="#e4e4e4", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8)
        if event is not None:
            axes.axvline(event, color=MARK, linewidth=0.8, linestyle=":")
        if window is not None:
            axes.axvspan(*window, color="#1f5fa8", alpha=0.05, linewidth=0)
    fig.legend(*top.get_legend_handles_labels(), fontsize=8, frameon=False, loc="outside upper right", ncols=3)
    if shown is not None:
        top.set_ylim(*_limits([t for t in (before, after) if t is not None], output))
    return fig


def traces(
    output: str, unit: str, before: Trajectory | None, after: Trajectory | None
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """The same curves for a figure that zooms: its traces and its layout, the residual below on the same time axis."""
    found: list[dict[str, Any]] = []
    shown = after if after is not None else before
    if shown is not None:
        found.append(_trace(shown.time, shown[f"{output}.measured"], "measured", MEASURED))
    for table, color, label in ((before, BEFORE, "before"), (after, AFTER, "after")):
        if table is not None:
            left = table[f"{output}.measured"] - table[output]
            found.append(_trace(table.time, table[output], label, color))
            found.append(_trace(table.time, left, f"residual {label}", color) | {"yaxis": "y2"})
    layout = {
        "xaxis": {"title": {"text": "time, s"}, "anchor": "y2"},
        "yaxis": {"title": {"text": text(f"{output}, {unit}" if unit else output)}, "domain": [0.3, 1.0]},
        "yaxis2": {"title": {"text": "residual"}, "domain": [0.0, 0.24]},
    }
    return found, layout


def _trace(time: Array, values: Array, name: str, color: str) -> dict[str, Any]:
    x, y = visible(time, values)
    line = {"color": color, "width": 1.3}
    return {"type": "scatter", "mode": "lines", "x": numbers(x), "y": numbers(y), "name": name, "line": line}


def _limits(tables: list[Trajectory], output: str) -> tuple[float, float]:
    """The range of the recording and of what is simulated, with some air; never of no height."""
    columns: list[Array] = [t[c] for t in tables for c in (output, f"{output}.measured")]
    low, high = float(np.min([c.min() for c in columns])), float(np.max([c.max() for c in columns]))
    air = 0.06 * (high - low) or 0.05 * max(abs(high), 1e-3)
    return low - air, high + air
