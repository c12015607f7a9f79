"""The sweep: the error over each parameter, where it is smallest, the poles, and the points that failed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.colours import MARK, SERIES
from hvdc_ident.data import Array
from hvdc_ident.report.drawing import bode_axes, draw_response, figure, svg
from hvdc_ident.report.html import Section, captioned, number, table, text
from hvdc_ident.summary import Results
from hvdc_ident.text import with_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST = 2000
"""Rows that are drawn; of more, every so many."""
CURVES, CHANNELS = 40, 4
"""Frequency responses drawn in one figure, and figures of them."""
OTHERS = "#c4c4c4"


def _render(results: Results) -> str:
    found = results.get("sweep")
    points, parameters = found.get("points") or [], found.get("parameters") or {}
    if not points or not parameters:
        return ""
    names = ", ".join(text(p) for p in parameters)
    against = {"data": "the recordings", "base": "the run at the base values"}.get(
        str(found.get("against")), f"model {found.get('against')}"
    )
    lines = [f"<p>{len(points)} points of {names} against {text(against)}.</p>"]
    failed = [p for p in points if p.get("status") == "failed"]
    if failed:
        reasons = list(dict.fromkeys(str(p.get("reason")) for p in failed))[:3]
        lines.append(f"<p>{len(failed)} points failed: {'; '.join(map(text, reasons))}.</p>")
    good = [p for p in points if p.get("status") == "done"]
    if not good:
        return "".join(lines)
    errors = _errors(good)
    lines.append(_best(good, list(parameters), errors, found.get("units") or {}))
    step = max(1, len(good) // MOST)
    units, omega = found.get("units") or {}, found.get("omega") or []
    lines += [_figures(p, parameters, good[::step], errors, step, units, omega) for p in parameters]
    return "\n".join(lines)


def _errors(points: list[dict[str, Any]]) -> dict[tuple[str, str], Array]:
    """The RMSE of each (output, experiment) over the points."""
    series = [(o, e) for o, line in points[0]["rmse"].items() for e in line]
    return {(o, e): np.array([p["rmse"][o][e] for p in points], dtype=float) for o, e in series}


def _best(
    points: list[dict[str, Any]], names: list[str], errors: dict[tuple[str, str], Array], units: dict[str, Any]
) -> str:
    rows = []
    for (output, experiment), values in errors.items():
        extremes = [number(float(values.min()), 3), number(float(values.max()), 3)]
        best = points[int(np.argmin(values))]["values"]
        at = [
            "–" if extremes[0] == extremes[1] else number(best[n], 5) for n in names
        ]  # of a flat line none is the best
        rows.append([text(output), text(experiment), *at, *extremes, text(units.get(output, ""))])
    header = ["output", "experiment", *(f"best {text(n)}" for n in names), "smallest RMSE", "largest", "unit"]
    return table(header, rows, words=(0, 1, len(header) - 1)) if rows else ""


def _figures(
    name: str,
    parameters: dict[str, Any],
    points: list[dict[str, Any]],
    errors: dict[tuple[str, str], Array],
    step: int,
    units: dict[str, Any],
    omega: list[float],
) -> str:
    values = np.array([p["values"][name] for p in points], dtype=float)
    about = parameters[name]
    curve = len(parameters) == 1
    order = np.argsort(values, kind="stable") if curve else np.arange(values.size)
    drawn = []
    for unit in dict.fromkeys(str(units.get(o, "")) for o, _ in errors):
        chosen = {f"{o}, {e}": v[::step][order] for (o, e), v in errors.items() if str(units.get(o, "")) == unit}
        fig = sweep_errors(name, str(about.get("unit", "")), values[order], chosen, unit, about.get("base"), curve)
        label = f"RMSE over {name}"
        caption = f"Root mean square error over {text(name)}; the dotted line is the given value."
        drawn.append(captioned(svg(fig, label), caption))
    if points[0].get("poles"):
        poles = np.array([p["poles"] for p in points], dtype=float)
        fig = sweep_poles(name, values, poles[..., 0] + 1j * poles[..., 1])
        caption = f"Poles over {text(name)}, those slower than 2000 1/s."
        drawn.append(captioned(svg(fig, f"poles over {name}"), caption))
    if points[0].get("bode"):
        drawn += _bode(name, values, points, omega)
    return "\n".join(drawn)


def _bode(name: str, values: Array, points: list[dict[str, Any]], omega: list[float]) -> list[str]:
    """One figure a channel, up to a few, with a curve for every so many points."""
    rows = np.flatnonzero(np.array(omega) > 0)
    some = np.unique(np.linspace(0, len(points) - 1, min(len(points), CURVES)).astype(int))
    channels = [(o, i) for o, line in points[0]["bode"].items() for i in line][:CHANNELS]
    drawn = []
    for output, source in channels:
        pairs = np.array([points[k]["bode"][output][source] for k in some], dtype=float)
        label = f"{output} over {source}"
        responses = (pairs[..., 0] + 1j * pairs[..., 1])[:, rows]
        fig = sweep_bode(name, values[some], np.array(omega)[rows], responses, label)
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


def sweep_bode(parameter: str, values: Array, omega: Array, response: np.ndarray, channel: str) -> Figure:
    """Gain and phase of one channel, a curve a row, (rows, frequencies) complex, colored by the parameter."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    fig = figure(7.4, 4.4)
    (pair,) = bode_axes(fig)
    scale = Normalize(float(values.min()), float(values.max()))
    for value, row in zip(values, response, strict=True):
        draw_response(pair, omega, row, color=colormaps["viridis"](scale(value)), linewidth=0.9)
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
