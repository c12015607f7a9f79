"""The figures of a sweep: the error over one parameter, and where the poles go."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from hvdc_ident.report.drawing import AFTER, BEFORE, MARK, MEASURED, figure
from hvdc_ident.trajectory import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
    """The RMSE of each series over one parameter: a curve, or a point for each row where others move too."""
    fig = figure(7.4, 3.2)
    axes = fig.subplots()
    for (name, series), color in zip(errors.items(), COLORS * (1 + len(errors) // len(COLORS)), strict=False):
        if curve:
            axes.plot(values, series, color=color, linewidth=1.3, label=name)
        else:
            axes.plot(values, series, ".", color=color, markersize=3, label=name)
    if base is not None:
        axes.axvline(base, color=MARK, linewidth=0.8, linestyle=":")
    axes.set_xlabel(f"{parameter}, {unit}" if unit else parameter)
    axes.set_ylabel(f"RMSE, {error_unit}" if error_unit else "RMSE")
    axes.set_ylim(bottom=0)
    axes.grid(True, color="#e4e4e4", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8)
    fig.legend(*axes.get_legend_handles_labels(), fontsize=8, frameon=False, loc="outside upper right", ncols=3)
    return fig


def sweep_poles(parameter: str, values: Array, poles: np.ndarray) -> Figure:
    """The poles of every row, (n, modes) 1/s, colored by the parameter; those slower than 2000 1/s."""
    fig = figure(7.4, 3.6)
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
