"""The figures of a sweep: the error over one parameter, and where the poles go."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.report.drawing import AFTER, BEFORE, MARK, MEASURED, figure
from hvdc_ident.trajectory import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

OTHERS = "#c4c4c4"
COLORS = (AFTER, BEFORE, MEASURED, "#3a7d44", "#8a3ffc", "#b3261e")


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
    most = sorted(errors, key=lambda n: -float(np.ptp(errors[n])))[: len(COLORS)]
    color = dict(zip([n for n in errors if n in most], COLORS, strict=False))
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
    axes.set_xlabel(f"{parameter}, {unit}" if unit else parameter)
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
    gain, phase = fig.subplots(2, 1, sharex=True)
    scale, hertz = Normalize(float(values.min()), float(values.max())), omega / (2 * np.pi)
    for value, row in zip(values, response, strict=True):
        color = colormaps["viridis"](scale(value))
        size = np.abs(row)
        gain.plot(hertz, 20 * np.log10(np.where(size > 0, size, np.nan)), color=color, linewidth=0.9)
        phase.plot(hertz, np.degrees(np.unwrap(np.angle(row))), color=color, linewidth=0.9)
    gain.set_xscale("log")
    marks = [10.0**k for k in range(int(np.floor(np.log10(hertz[0]))), int(np.ceil(np.log10(hertz[-1]))) + 1)]
    gain.set_xticks(marks, [f"{m:g}" for m in marks])
    gain.set_xticks([], minor=True)
    gain.set_xlim(hertz[0], hertz[-1])
    gain.set_ylabel("gain, dB")
    gain.set_title(channel, fontsize=8)
    phase.set_ylabel("phase, deg")
    phase.set_xlabel("frequency, Hz")
    for axes in (gain, phase):
        axes.grid(True, color="#e4e4e4", linewidth=0.6)
        axes.tick_params(labelsize=8)
        axes.spines[["top", "right"]].set_visible(False)
    fig.colorbar(ScalarMappable(scale, "viridis"), ax=[gain, phase], label=parameter)
    return fig
