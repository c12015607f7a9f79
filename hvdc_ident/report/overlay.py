"""One recorded output over time with the runs of the model laid over it, and their errors below: drawn, and as curves that zoom."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.colours import EFFECT, FITTED, GIVEN, MARK, RECORDED
from hvdc_ident.data import Array, Band, Trajectory, bands
from hvdc_ident.report.drawing import PlottedCurve, figure, svg, visible, visible_rows, zoomable
from hvdc_ident.summary import Results
from hvdc_ident.summary.decisions import STAGES
from hvdc_ident.summary.phrases import WORDS
from hvdc_ident.summary.stage_results import ExperimentContext
from hvdc_ident.text import with_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STYLES = {"given": (GIVEN, (0, (5, 2))), "fitted": (FITTED, "-"), "effect": (EFFECT, (0, (1.5, 1.2)))}
SHARE = 0.995
"""Share of the squared error that a figure's span of time holds where it is cut to the disagreement."""


@dataclass(frozen=True, eq=False)
class Overlay:
    """A recorded output of an experiment and the model's runs by set of values ("given", "fitted", "effect").

    runs: tables with the columns OUTPUT and OUTPUT.measured; with OUTPUT.low and OUTPUT.high, between which a sample is
    expected, that band is shaded. bad: rows that cannot be right or were left out.
    """

    experiment: str
    output: str
    unit: str
    runs: Mapping[str, Trajectory]
    event: float | None = None
    window: tuple[float, float] | None = None
    bad: tuple[Band, ...] = ()

    @property
    def record(self) -> Trajectory:
        """A table that holds the recording."""
        return next(iter(self.runs.values()))

    def error(self, name: str) -> Array:
        """Recorded less simulated, at the times of that run."""
        run = self.runs[name]
        return run[f"{self.output}.measured"] - run[self.output]

    @property
    def title(self) -> str:
        """The output with its unit."""
        return with_unit(self.output, self.unit)

    @property
    def span(self) -> tuple[float, float]:
        """The part of the record that holds nearly all of the squared error, with some time about it, s."""
        time = self.record.time
        whole = float(time[0]), float(time[-1])
        squares = [np.nan_to_num(self.error(n)) ** 2 for n in self.runs if self.runs[n].time.size == time.size]
        summed = np.cumsum(np.max(squares, axis=0))
        if not summed[-1] > 0:
            return whole
        first, last = (float(time[np.searchsorted(summed, q * summed[-1])]) for q in (1.0 - SHARE, SHARE))
        first = first if self.event is None else min(first, self.event)
        air = max(0.15 * (last - first), 0.02 * (whole[1] - whole[0]))
        return max(whole[0], first - air), min(whole[1], last + 2.0 * air)

    def figure(self, sheet: Sheet, caption: str, span: tuple[float, float] | None = None, name: str = "") -> str:
        """The figure as HTML. span: of time that is drawn, s; the whole record where it is left out, and once it zooms.

        name: what it is called where it cannot be seen, before its output and its experiment.
        """
        words = ", ".join(["recorded", *(WORDS[n] for n in self.runs)])
        label = f"{name}{self.output} in {self.experiment}: {words}"
        drawn = svg(sheet.draw(self, span), label)
        return zoomable(drawn, label, caption, *self._curves())

    def _curves(self) -> tuple[dict[str, Array], list[PlottedCurve], tuple[str, str, str]]:
        shown = self.record
        same = {n: t for n, t in self.runs.items() if len(t) == len(shown)}
        columns = {"x": shown.time, "measured": shown[f"{self.output}.measured"]}
        columns |= {n: t[self.output] for n, t in same.items()}
        rows = np.unique(np.concatenate([visible_rows(c) for c in columns.values()]))
        curves = [PlottedCurve("recorded", RECORDED, "measured")]
        for name in same:
            curves.append(PlottedCurve(WORDS[name], STYLES[name][0], name))
            curves.append(PlottedCurve(f"error, {WORDS[name]}", STYLES[name][0], "measured", minus=name, lower=True))
        return {n: v[rows] for n, v in columns.items()}, curves, ("time, s", self.title, with_unit("error", self.unit))


def overlay_of(results: Results, experiment: str, output: str, sets: Sequence[str] = tuple(STAGES)) -> Overlay | None:
    """The recorded output with the runs that the folder holds of these sets of values; None where there is none."""
    runs = {}
    for name in sets:
        table = results.table(f"{STAGES[name]}.{experiment}.csv")
        if table is not None and output in table and f"{output}.measured" in table:
            runs[name] = table
    if not runs:
        return None
    about = results.experiments.get(experiment) or ExperimentContext()
    return Overlay(
        experiment,
        output,
        str(results.units.get(output, "")),
        runs,
        about.event,
        about.window,
        bands(about.recording, results.units.keys() - {output}),
    )


def worst_signal(results: Results, name: str | None, sets: Sequence[str]) -> Overlay | None:
    """The worst signal of the model with a set of values, with the runs that the folder holds of some; None where there is none."""
    judged = results.summary.sets.get(name or "")
    return (
        None if judged is None or judged.worst is None else overlay_of(results, judged.worst[1], judged.worst[0], sets)
    )


@dataclass(frozen=True, eq=False)
class Sheet:
    """A figure with two axes on which one overlay after the other is drawn: making axes takes longer than filling them."""

    figure: Figure
    top: Axes
    strip: Axes

    @classmethod
    def new(cls, width: float = 6.4, height: float = 3.4, strip: float = 1.0 / 3.0) -> Sheet:
        """An empty sheet, sizes in inches. strip: height of the errors' axes over that of the signal's."""
        margins = {"left": 0.72 / width, "right": 1.0 - 0.16 / width, "bottom": 0.42 / height}
        fig = figure(width, height, {**margins, "top": 1.0 - 0.28 / height, "hspace": 0.1})
        top, below = fig.subplots(2, 1, sharex=True, height_ratios=[1.0, strip])
        below.set_xlabel("time, s", fontsize=8)
        for axes in (top, below):
            axes.yaxis.set_label_coords(
                -0.61 / (width - 0.88), 0.5
            )  # one below the other, however wide the numbers are
            axes.grid(True, color="#e4e4e4", linewidth=0.6)
            axes.spines[["top", "right"]].set_visible(False)
            axes.tick_params(labelsize=8, left=False, bottom=False)  # the grid marks them
        return cls(fig, top, below)

    def draw(self, overlay: Overlay, span: tuple[float, float] | None = None) -> Figure:
        """The overlay on the sheet, which is wiped first."""
        self._wipe()
        shown, output = overlay.record, overlay.output
        self._line(self.top, shown.time, shown[f"{output}.measured"], span, RECORDED, "-", 1.0, "recorded")
        for name, run in overlay.runs.items():
            color, dashes = STYLES[name]
            self._line(self.top, run.time, run[output], span, color, dashes, 1.3, WORDS[name])
            self._line(
                self.strip, run.time, overlay.error(name), span, color, dashes if name != "given" else "-", 0.9, ""
            )
            if f"{output}.low" in run and span is None and len(overlay.runs) < 3:
                low, high = (run[f"{output}.{end}"] for end in ("low", "high"))
                kind = "95 % band of a sample"
                self.top.fill_between(run.time, low, high, color=color, alpha=0.15, linewidth=0, label=kind)
        self.top.set_ylabel(overlay.title, fontsize=8)
        self.strip.set_ylabel(with_unit("error", overlay.unit), fontsize=8)
        self.strip.axhline(0.0, color=MARK, linewidth=0.6)
        for axes in (self.top, self.strip):
            if overlay.event is not None:
                axes.axvline(overlay.event, color=MARK, linewidth=0.8, linestyle=":")
            for k, band in enumerate(overlay.bad):
                name = "rows that cannot be right, or were left out" if axes is self.top and k == 0 else "_"
                axes.axvspan(
                    band.first, band.last, color=GIVEN, alpha=0.25, linewidth=1.5, label=name
                )  # the edge shows one row too
            if overlay.window is not None:
                axes.axvspan(*overlay.window, color=FITTED, alpha=0.05, linewidth=0)
            if span is not None:
                axes.set_xlim(*span)
        self._explain()
        self.top.set_ylim(*_limits(overlay, span))
        return self.figure

    @staticmethod
    def _line(
        axes: Axes,
        time: Array,
        values: Array,
        span: tuple[float, float] | None,
        color: str,
        dashes: object,
        width: float,
        label: str,
    ) -> None:
        inside = slice(None)
        if span is not None:
            inside = slice(max(int(np.searchsorted(time, span[0])) - 1, 0), int(np.searchsorted(time, span[1])) + 1)
        style: dict[str, Any] = {"color": color, "linewidth": width, "linestyle": dashes, "label": label or "_"}
        axes.plot(*visible(time[inside], values[inside]), **style)

    def _wipe(self) -> None:
        for axes in (self.top, self.strip):
            for drawn in [*axes.lines, *axes.collections, *axes.patches]:
                drawn.remove()
            axes.relim()
            axes.set_autoscale_on(True)

    def _explain(self) -> None:
        """Draw the legend of the curves; replace one that lists others."""
        handles, labels = self.top.get_legend_handles_labels()
        for legend in list(self.figure.legends):
            if [t.get_text() for t in legend.texts] == labels:
                return
            legend.remove()
        self.figure.legend(handles, labels, fontsize=8, frameon=False, loc="upper right", ncols=5, columnspacing=1.2)


def _limits(overlay: Overlay, span: tuple[float, float] | None) -> tuple[float, float]:
    """The range of the recording and of what is simulated, with some air; never of no height."""
    columns = []
    for run in overlay.runs.values():
        inside = np.ones(run.time.size, dtype=bool)
        if span is not None:
            inside = (run.time >= span[0]) & (run.time <= span[1])
        columns += [run[c][inside] for c in (overlay.output, f"{overlay.output}.measured")]
    finite = [c[np.isfinite(c)] for c in columns]
    low, high = min(c.min(initial=np.inf) for c in finite), max(c.max(initial=-np.inf) for c in finite)
    if not high >= low:
        return 0.0, 1.0
    air = 0.06 * (high - low) or 0.05 * max(abs(high), 1e-3)
    return float(low - air), float(high + air)
