"""Pole-zero maps."""

from __future__ import annotations

from typing import Any

from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.plots.style import COLOURS, axes_through_zero, grid
from hvdc_ident.notebook import axes_of


def poles(model: LinearModel, ax: Any = None) -> Any:
    """The axes: crosses for poles, circles for invariant zeros, rad/s; a symmetric log axis where they spread."""
    axes = axes_of(ax, 6.0, 5.0)
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
    return axes
