"""Mode shapes: the entries of an eigenvector as arrows."""

from __future__ import annotations

from typing import Any

from hvdc_ident.linearize.modal import Mode
from hvdc_ident.linearize.plots.style import axes_through_zero, grid, look
from hvdc_ident.notebook import axes_of


def shapes(mode: Mode, smallest: float = 0.01, ax: Any = None) -> Any:
    """The axes of one mode; entries below a share of the largest are left out."""
    axes = axes_of(ax, 5.5, 5.0)
    k = 0
    for name, value in mode.shape.items():
        if abs(value) < smallest:
            continue
        axes.plot([0.0, value.real], [0.0, value.imag], marker="o", markevery=[1], label=name, **look(k))
        k += 1
    axes.set_xlim(-1.15, 1.15)
    axes.set_ylim(-1.15, 1.15)
    axes.set_aspect("equal")
    axes.set_xlabel("real part, largest entry 1")
    axes.set_ylabel("imaginary part")
    axes.set_title(
        f"{mode.eigenvalue.real:.4g} {mode.eigenvalue.imag:+.4g}j rad/s, {mode.frequency_hz:.4g} Hz", fontsize="medium"
    )
    axes_through_zero(axes)
    grid(axes)
    axes.legend(fontsize="small")
    return axes
