"""Loci of the eigenvalues along a parameter."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from hvdc_ident.linearize.plots.style import COLOURS, MARK, axes_through_zero, grid
from hvdc_ident.notebook import axes_of

if TYPE_CHECKING:
    from hvdc_ident.linearize.locus import Locus


def locus(found: Locus, left: float | None = None, ax: Any = None) -> Any:
    """The axes: one curve a mode, a dot at the parameter's start, a square at its end. left: edge of the axis."""
    axes = axes_of(ax, 6.5, 5.0)
    for k in range(found.eigenvalues.shape[1]):
        v = found.eigenvalues[:, k]
        if left is not None and v.real.max() < left:
            continue
        colour = COLOURS[k % len(COLOURS)]
        axes.plot(v.real, v.imag, color=colour, linewidth=1.2)
        axes.plot(v.real[:1], v.imag[:1], "o", color=colour, markersize=5)
        axes.plot(v.real[-1:], v.imag[-1:], "s", color=colour, markersize=5)
    for limit in found.limits:
        axes.plot([limit.eigenvalue.real], [limit.eigenvalue.imag], "D", color="#000000", markersize=6)
        axes.annotate(f"{found.parameter} = {limit.value:.4g}", (limit.eigenvalue.real, limit.eigenvalue.imag))
    if left is not None:
        axes.set_xlim(left, None)
    axes.axvline(0.0, color=MARK)
    unit = f" {found.unit}" if found.unit else ""
    axes.set_title(
        f"{found.parameter} from {found.values[0]:g} (dot) to {found.values[-1]:g}{unit} (square)", fontsize="medium"
    )
    axes.set_xlabel("real part, rad/s")
    axes.set_ylabel("imaginary part, rad/s")
    axes_through_zero(axes)
    grid(axes)
    return axes
