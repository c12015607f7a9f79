"""The figure of profiles: the rise of the cost over each parameter, with the threshold and the interval."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.report.drawing import AFTER, MARK, figure
from hvdc_ident.trajectory import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLUMNS = 3


def _joined(x: Array, y: Array) -> tuple[Array, Array]:
    """The points joined by pieces of parabolas: straight lines in the signed root of the rise."""
    root = np.sqrt(np.clip(y, 0.0, None)) * np.where(x < x[int(np.argmin(y))], -1.0, 1.0)
    dense = np.unique(np.concatenate([x, np.linspace(x[0], x[-1], 200)]))
    return dense, np.interp(dense, x, root) ** 2


def profiles(found: Mapping[str, Mapping[str, Any]], parameters: Mapping[str, Mapping[str, Any]]) -> Figure:
    """One small plot a parameter: rise over its threshold against the parameter, in its unit; 1 is the 95 % level."""
    rows = -(-len(found) // COLUMNS)
    fig = figure(7.4, 1.9 * rows)
    for place, (name, p) in enumerate(found.items(), start=1):
        axes = fig.add_subplot(rows, COLUMNS, place)
        x, y = np.array(p["values"], dtype=float), np.array(p["rises"], dtype=float) / p["threshold"]
        axes.plot(*_joined(x, y), color=AFTER, linewidth=1.2)
        axes.plot(x, y, color=AFTER, linewidth=0, marker="o", markersize=2.5)
        axes.axhline(1.0, color=MARK, linewidth=0.8, linestyle="--")
        for end in ("lower", "upper"):
            if p[end]["limit"] is not None:
                axes.axvline(p[end]["limit"], color=MARK, linewidth=0.7, linestyle=":")
        line = parameters.get(name, {})
        unit = f", {line['unit']}" if line.get("unit") else ""
        axes.set_xlabel(f"{name}{unit}", fontsize=8)
        axes.set_title(str(line.get("verdict", "")), fontsize=8)
        axes.set_ylim(-0.05, min(max(1.6, float(np.nanmax(y, initial=0.0)) * 1.05), 4.0))
        axes.tick_params(labelsize=7)
        axes.ticklabel_format(axis="x", useOffset=False)
        axes.grid(True, color="#e4e4e4", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
    fig.supylabel("rise of the cost / 95 % level", fontsize=8)
    return fig


def pair_map(pair: Mapping[str, Any], parameters: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Contours of the rise over two parameters, in units of the 95 % level of one; 1.56 is the joint 95 % region."""
    fig = figure(4.6, 3.6)
    axes = fig.add_subplot()
    rises = np.array([[np.nan if v is None else v for v in row] for row in pair["rises"]], dtype=float).T
    drawn = axes.contour(pair["first"], pair["second"], np.ma.masked_invalid(rises), levels=[0.25, 1.0, 1.56, 4.0])
    axes.clabel(drawn, fontsize=7)
    labels = []
    for name in pair["names"]:
        unit = parameters.get(name, {}).get("unit")
        labels.append(f"{name}, {unit}" if unit else str(name))
    axes.set_xlabel(labels[0], fontsize=8)
    axes.set_ylabel(labels[1], fontsize=8)
    axes.ticklabel_format(useOffset=False)
    axes.tick_params(axis="x", labelrotation=20)
    axes.tick_params(labelsize=7)
    axes.spines[["top", "right"]].set_visible(False)
    return fig
