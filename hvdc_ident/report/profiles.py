"""The figure of profiles: the rise of the cost over each parameter, with the threshold and the interval."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.axes import draw_intervals, draw_profile
from hvdc_ident.report.drawing import figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLUMNS = 3


def profiles(found: Mapping[str, Mapping[str, Any]], parameters: Mapping[str, Mapping[str, Any]]) -> Figure:
    """One small plot a parameter: rise over its threshold against the parameter, in its unit; 1 is the 95 % level."""
    rows = -(-len(found) // COLUMNS)
    high = 1.9 * rows
    edges = {
        "left": 0.085,
        "right": 0.985,
        "bottom": 0.42 / high,
        "top": 1.0 - 0.22 / high,
        "wspace": 0.25,
        "hspace": 0.62,
    }
    fig = figure(7.4, high, edges)
    for place, (name, p) in enumerate(found.items(), start=1):
        axes = fig.add_subplot(rows, COLUMNS, place)
        draw_profile(axes, name, p, parameters.get(name, {}))
        axes.set_ylabel("")
    fig.supylabel("rise of the cost / 95 % level", fontsize=8, x=0.01)
    return fig


def intervals(parameters: Mapping[str, Mapping[str, Any]]) -> Figure:
    """The interval and the verdict of every candidate, a line each."""
    fig = figure(7.0, 0.8 + 0.34 * len(parameters))
    draw_intervals(fig.add_subplot(), parameters)
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
