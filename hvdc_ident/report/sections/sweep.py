"""The sweep: the error over each parameter, where it is smallest, the poles, and the points that failed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.colours import MARK, SERIES
from hvdc_ident.data import Array
from hvdc_ident.report.drawing import bode_axes, draw_response, figure, svg
from hvdc_ident.report.html import Section, captioned, rows_of, text
from hvdc_ident.sensitivity import SweepResult
from hvdc_ident.summary import Results
from hvdc_ident.text import figures, with_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROWS_DRAWN = 2000
"""Rows that are drawn; of more, every so many."""
CURVES, CHANNELS = 40, 4
"""Frequency responses drawn in one figure, and figures of them."""
OTHERS = "#c4c4c4"


def _render(results: Results) -> str:
    data = results.get("sweep")
    if not data.get("points") or not data.get("parameters"):
        return ""
    sweep = SweepResult.from_dict(data)
    names = ", ".join(map(text, sweep.parameters))
    against = {"data": "the recordings", "base": "the run at the base values"}.get(
        sweep.against, f"model {sweep.against}"
    )
    lines = [f"<p>{len(sweep)} points of {names} against {text(against)}.</p>"]
    if sweep.failed:
        reasons = list(dict.fromkeys(sweep.failed.values()))[:3]
        lines.append(f"<p>{len(sweep.failed)} points failed: {'; '.join(map(text, reasons))}.</p>")
    good = np.array([k for k in range(len(sweep)) if k not in sweep.failed], dtype=int)
    if not good.size:
        return "".join(lines)
    rows = good[:: max(1, good.size // ROWS_DRAWN)]
    return "\n".join([*lines, _best(sweep), *(_figures(sweep, name, rows) for name in sweep.parameters)])


def _best(sweep: SweepResult) -> str:
    rows = []
    for line in sweep.bests:
        extremes = [figures(line.smallest, 3), figures(line.largest, 3)]
        flat = extremes[0] == extremes[1]  # of a flat line none is the best
        at = ["–" if flat else figures(v, 5) for v in line.at.values()]
        rows.append((line.output, line.experiment, *at, *extremes, line.unit))
    header = ["output", "experiment", *(f"best {n}" for n in sweep.parameters), "smallest RMSE", "largest", "unit"]
    return rows_of(header, rows)


def _figures(sweep: SweepResult, name: str, rows: Array) -> str:
    """The figures over one parameter. rows: (n,) the points that are drawn."""
    values = sweep.values(name)[rows]
    curve = len(sweep.parameters) == 1
    order = np.argsort(values, kind="stable") if curve else np.arange(values.size)
    drawn = []
    for unit in dict.fromkeys(sweep.series_units):
        chosen = {
            f"{o}, {e}": sweep.error(o, e)[rows][order]
            for (o, e), own in zip(sweep.series, sweep.series_units, strict=True)
            if own == unit
        }
        fig = sweep_errors(name, sweep.units[name], values[order], chosen, unit, sweep.base[name], curve)
        caption = f"Root mean square error over {text(name)}; the dotted line is the given value."
        drawn.append(captioned(svg(fig, f"RMSE over {name}"), caption))
    if "poles" in sweep.wanted:
        caption = f"Poles over {text(name)}, those slower than 2000 1/s."
        drawn.append(captioned(svg(sweep_poles(name, values, sweep.poles[rows]), f"poles over {name}"), caption))
    if "bode" in sweep.wanted:
        drawn += _bode(sweep, name, rows)
    return "\n".join(drawn)


def _bode(sweep: SweepResult, name: str, rows: Array) -> list[str]:
    """One figure a channel, up to a few, with a curve for every so many points."""
    positive = sweep.omega > 0
    some = rows[np.unique(np.linspace(0, rows.size - 1, min(rows.size, CURVES)).astype(int))]
    inputs, outputs = sweep.channels
    drawn = []
    for b, a in [(b, a) for b in range(len(outputs)) for a in range(len(inputs))][:CHANNELS]:
        label = f"{outputs[b]} over {inputs[a]}"
        responses, phases = (x[some][:, positive, b, a] for x in (sweep.response, sweep.phase_deg))
        phases = phases + 360.0 * np.round((phases[:1, :1] - phases[:, :1]) / 360.0)  # all begin within half a turn
        fig = sweep_bode(name, sweep.values(name)[some], sweep.omega[positive], responses, phases, label)
        caption = f"Frequency response of {text(label)} over {text(name)}, gain above phase."
        drawn.append(captioned(svg(fig, f"frequency response of {label} over {name}"), caption))
    return drawn


def sweep_errors(
    parameter: str,
    unit: str,
    values: Array,
    errors: Mapping[str, Array],
    error_unit: str,
    base: float | None,
    curve: bool,
) -> Figure:
    """The RMSE of each series over one parameter: a curve, or a point for each row where others move too.

    Those that move most have colours and names, the others are grey.
    """
    most = sorted(errors, key=lambda n: -float(np.ptp(errors[n])))[: len(SERIES)]
    color = dict(zip([n for n in errors if n in most], SERIES, strict=False))
    lines = -(-(len(color) + (len(errors) > len(color))) // 3)
    high = 3.2 + 0.18 * lines
    fig = figure(
        7.4, high, {"left": 0.1, "right": 0.985, "bottom": 0.48 / high, "top": 1.0 - (0.12 + 0.18 * lines) / high}
    )
    axes = fig.subplots()
    style: dict[str, Any] = {"linewidth": 1.3} if curve else {"marker": ".", "linestyle": "none", "markersize": 3}
    for name in [*(n for n in errors if n not in color), *color]:
        axes.plot(values, errors[name], color=color.get(name, OTHERS), label=name if name in color else "_", **style)
    if len(errors) > len(color):
        axes.plot([], [], color=OTHERS, label=f"{len(errors) - len(color)} others that move less", **style)
    if base is not None:
        axes.axvline(base, color=MARK, linewidth=0.8, linestyle=":")
    axes.set_xlabel(with_unit(parameter, unit))
    axes.set_ylabel(f"RMSE, {error_unit}" if error_unit else "RMSE")
    axes.set_ylim(bottom=0)
    axes.grid(True, color="#e4e4e4", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8)
    fig.legend(*axes.get_legend_handles_labels(), fontsize=8, frameon=False, loc="upper right", ncols=3)
    return fig


def sweep_poles(parameter: str, values: Array, poles: np.ndarray) -> Figure:
    """The poles of every row, (n, modes) 1/s, colored by the parameter; those slower than 2000 1/s."""
    fig = figure(7.4, 3.6, {"left": 0.1, "right": 0.99, "bottom": 0.14, "top": 0.97})
    axes = fig.subplots()
    color = np.repeat(values, poles.shape[1])
    flat = poles.ravel()
    near = np.isfinite(flat) & (np.abs(flat) < 2000.0)
    drawn = axes.scatter(flat.real[near], flat.imag[near] / (2 * np.pi), c=color[near], s=6, cmap="viridis")
    fig.colorbar(drawn, ax=axes, label=parameter)
    axes.axvline(0.0, color=MARK, linewidth=0.8)
    axes.set_xlabel("real part, 1/s")
    axes.set_ylabel("imaginary part, Hz")
    axes.grid(True, color="#e4e4e4", linewidth=0.6)
    axes.tick_params(labelsize=8)
    return fig


def sweep_bode(parameter: str, values: Array, omega: Array, response: np.ndarray, phase: Array, channel: str) -> Figure:
    """Gain and phase of one channel, a curve a row, (rows, frequencies) complex and degrees, colored by the parameter."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    fig = figure(7.4, 4.4)
    (pair,) = bode_axes(fig)
    scale = Normalize(float(values.min()), float(values.max()))
    for value, row, turned in zip(values, response, phase, strict=True):
        draw_response(pair, omega, row, turned, color=colormaps["viridis"](scale(value)), linewidth=0.9)
    pair[0].set_title(channel, fontsize=8)
    pair[0].set_xlim(omega[0] / (2 * np.pi), omega[-1] / (2 * np.pi))
    fig.colorbar(ScalarMappable(scale, "viridis"), ax=list(pair), label=parameter)
    return fig


SECTION = Section(
    order=85,
    title="Sweep",
    about="The error, the poles or the frequency response over values of a parameter.",
    render=_render,
)
