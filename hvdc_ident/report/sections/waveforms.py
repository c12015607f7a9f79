"""The waveforms of every experiment, one figure an output."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.data import Array, Trajectory, recording_lines
from hvdc_ident.report.drawing import (
    AFTER,
    BEFORE,
    MARK,
    MEASURED,
    PlottedCurve,
    figure,
    svg,
    visible,
    visible_rows,
    zoomable,
)
from hvdc_ident.report.html import text
from hvdc_ident.report.results import Results, Section

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST = 60
MARGINS = {"left": 0.11, "right": 0.99, "bottom": 0.12, "top": 0.91, "hspace": 0.1}


def _render(results: Results) -> str:
    experiments, units = results.experiments, results.units
    if not experiments:
        return ""
    parts: list[str] = []
    left, sheet = MOST, Sheet.new()
    for name, about in experiments.items():
        before, after = results.table(f"simulation.{name}.csv"), results.table(f"fit.{name}.csv")
        outputs = _outputs(after if after is not None else before)
        drawn = [_figure(sheet, name, o, str(units.get(o, "")), before, after, about) for o in outputs[:left]]
        left -= len(drawn)
        if drawn:
            role = " (held out: not used by the fit)" if about.get("role") == "holdout" else ""
            told = "; ".join(recording_lines(about["recording"])) if about.get("recording") else ""
            note = f"<p class='small'>The recording: {text(told)}.</p>\n" if told else ""
            parts.append(f"<h3>{text(name)}{role}</h3>\n{note}" + "\n".join(drawn))
    if left <= 0:
        parts.append(f"<p>Only the first {MOST} waveforms are drawn; the CSV files beside this page hold all.</p>")
    return "\n".join(parts)


def _outputs(table: Trajectory | None) -> list[str]:
    names = table.names if table is not None else ()
    return [n for n in names if f"{n}.measured" in names]


def _figure(
    sheet: Sheet,
    name: str,
    output: str,
    unit: str,
    before: Trajectory | None,
    after: Trajectory | None,
    about: dict[str, Any],
) -> str:
    tables = [t if t is not None and output in t and f"{output}.measured" in t else None for t in (before, after)]
    window = about.get("window")
    fig = waveforms(sheet, output, unit, tables[0], tables[1], about.get("event"), tuple(window) if window else None)
    label = f"{output} in {name}: measured and simulated"
    return zoomable(svg(fig, label), label, *curves(output, unit, tables[0], tables[1]))


@dataclass(frozen=True, eq=False)
class Sheet:
    """A figure with two axes on which one waveform after the other is drawn: making axes takes longer than filling them."""

    figure: Figure
    top: Axes
    strip: Axes

    @classmethod
    def new(cls) -> Sheet:
        """An empty sheet."""
        fig = figure(7.4, 3.5, MARGINS)
        top, strip = fig.subplots(2, 1, sharex=True, height_ratios=[3, 1])
        strip.set_ylabel("residual")
        strip.set_xlabel("time, s")
        for axes in (top, strip):
            axes.yaxis.set_label_coords(-0.1, 0.5)  # one below the other, however wide the numbers are
            axes.grid(True, color="#e4e4e4", linewidth=0.6)
            axes.spines[["top", "right"]].set_visible(False)
            axes.tick_params(labelsize=8, left=False, bottom=False)  # the grid marks them
        return cls(fig, top, strip)

    def wiped(self) -> tuple[Axes, Axes]:
        """The axes, with nothing drawn on them and free to find their limits."""
        for axes in (self.top, self.strip):
            for drawn in [*axes.lines, *axes.collections, *axes.patches]:
                drawn.remove()
            axes.relim()
            axes.set_autoscale_on(True)
        return self.top, self.strip

    def explain(self) -> None:
        """Draw the legend of the curves; replace one that lists others."""
        handles, labels = self.top.get_legend_handles_labels()
        for legend in list(self.figure.legends):
            if [t.get_text() for t in legend.texts] == labels:
                return
            legend.remove()
        self.figure.legend(handles, labels, fontsize=8, frameon=False, loc="upper right", ncols=4)


def waveforms(
    sheet: Sheet,
    output: str,
    unit: str,
    before: Trajectory | None,
    after: Trajectory | None,
    event: float | None = None,
    window: tuple[float, float] | None = None,
) -> Figure:
    """The recorded and simulated output over time, and below it measured minus simulated, on a sheet that is wiped first.

    before, after: tables with the columns OUTPUT and OUTPUT.measured, at the given values and at the estimates; with
    OUTPUT.low and OUTPUT.high the band between them is shaded.
    """
    top, strip = sheet.wiped()
    shown = after if after is not None else before
    if shown is not None:
        top.plot(*visible(shown.time, shown[f"{output}.measured"]), color=MEASURED, linewidth=1.0, label="measured")
    for table, color, label in ((before, BEFORE, "before: given values"), (after, AFTER, "after: fitted")):
        if table is None:
            continue
        dashes = (0, (5, 2)) if table is before else "-"
        top.plot(*visible(table.time, table[output]), color=color, linewidth=1.3, linestyle=dashes, label=label)
        if f"{output}.low" in table:
            low, high = (table[f"{output}.{end}"] for end in ("low", "high"))
            top.fill_between(table.time, low, high, color=color, alpha=0.15, linewidth=0, label="95 % band of a sample")
        left = table[f"{output}.measured"] - table[output]
        strip.plot(*visible(table.time, left), color=color, linewidth=0.8)
    top.set_ylabel(f"{output}, {unit}" if unit else output)
    strip.axhline(0.0, color=MARK, linewidth=0.6)
    for axes in (top, strip):
        if event is not None:
            axes.axvline(event, color=MARK, linewidth=0.8, linestyle=":")
        if window is not None:
            axes.axvspan(*window, color="#1f5fa8", alpha=0.05, linewidth=0)
    sheet.explain()
    if shown is not None:
        top.set_ylim(*_limits([t for t in (before, after) if t is not None], output))
    return sheet.figure


def curves(
    output: str, unit: str, before: Trajectory | None, after: Trajectory | None
) -> tuple[dict[str, Array], list[PlottedCurve], tuple[str, str, str]]:
    """Return the waveforms for a figure that zooms: its columns, its curves, and the titles of its axes."""
    tables = {label: t for label, t in (("before", before), ("after", after)) if t is not None}
    shown = after if after is not None else before
    assert shown is not None
    columns = {"x": shown.time, "measured": shown[f"{output}.measured"]}
    columns |= {label: t[output] for label, t in tables.items() if len(t) == len(shown)}
    rows = np.unique(np.concatenate([visible_rows(c) for c in columns.values()]))
    found = [PlottedCurve("measured", MEASURED, "measured")]
    for label, color in (("before", BEFORE), ("after", AFTER)):
        if label in columns:
            found.append(PlottedCurve(label, color, label))
            found.append(PlottedCurve(f"residual {label}", color, "measured", minus=label, lower=True))
    titles = ("time, s", f"{output}, {unit}" if unit else output, "residual")
    return {name: values[rows] for name, values in columns.items()}, found, titles


def _limits(tables: list[Trajectory], output: str) -> tuple[float, float]:
    """The range of the recording and of what is simulated, with some air; never of no height."""
    columns: list[Array] = [t[c] for t in tables for c in (output, f"{output}.measured")]
    low, high = float(np.nanmin([np.nanmin(c) for c in columns])), float(np.nanmax([np.nanmax(c) for c in columns]))
    air = 0.06 * (high - low) or 0.05 * max(abs(high), 1e-3)
    return low - air, high + air


SECTION = Section(order=40, title="Waveforms", render=_render)
