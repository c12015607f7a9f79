"""Pole-zero maps."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.plots.style import COLOURS, axes_through_zero, figure, grid

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def poles(model: LinearModel) -> Figure:
    """The figure: crosses for poles, circles for invariant zeros, rad/s; a symmetric log axis where they spread."""
    fig = figure(6.0, 5.0)
    axes = fig.subplots()
    p, z = model.poles(), model.zeros()
    axes.plot(p.real, p.imag, "x", color=COLOURS[0], markersize=8, label="poles")
    axes.plot(z.real, z.imag, "o", color=COLOURS[1], markerfacecolor="none", markersize=8, label="zeros")
    if p.size and abs(p.real).max() > 100 * max(float(abs(p.imag).max()), 1.0):
        axes.set_xscale("symlog", linthresh=1.0)
    axes.set_xlabel("real part, rad/s")
    axes.set_ylabel("imaginary part, rad/s")
    axes_through_zero(axes)
    grid(axes)
    axes.legend(fontsize="small")
    return fig
