"""Nyquist diagrams of loops, with the critical point and, where asked, the disk that the modulus margin keeps free."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hvdc_ident.linearize.frequency import Response
from hvdc_ident.linearize.plots.style import MARK, axes_through_zero, grid, look
from hvdc_ident.notebook import axes_of


def nyquist(responses: Sequence[Response], modulus: float = 0.0, reach: float = 3.0, ax: Any = None) -> Any:
    """The axes; reach: how far the axes go where the curves go further. modulus: radius of the disk around -1."""
    axes = axes_of(ax, 6.0, 6.0)
    k, largest = 0, 1.5
    for r in responses:
        for i, output in enumerate(r.output_names):
            for j, input in enumerate(r.input_names):
                v = r.values[:, i, j]
                style = look(k)
                axes.plot(v.real, v.imag, label=f"{input} to {output}", **style)
                axes.plot(v.real, -v.imag, color=style["color"], linewidth=0.6)
                largest = max(largest, float(np.abs(v).max(initial=0.0)))
                k += 1
    axes.plot([-1.0], [0.0], marker="+", color="#000000", markersize=10, linestyle="none", label="-1")
    if modulus > 0:
        angle = np.linspace(0, 2 * np.pi, 200)
        axes.plot(-1 + modulus * np.cos(angle), modulus * np.sin(angle), color=MARK, linewidth=0.8)
    edge = min(largest * 1.05, reach)
    axes.set_xlim(-edge, edge)
    axes.set_ylim(-edge, edge)
    axes.set_aspect("equal")
    axes.set_xlabel("real part")
    axes.set_ylabel("imaginary part")
    axes_through_zero(axes)
    grid(axes)
    axes.legend(fontsize="small")
    return axes
