"""The participation of states in modes as a heat map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hvdc_ident.linearize.modal import Mode
from hvdc_ident.notebook import axes_of


def participation(modes: Sequence[Mode], ax: Any = None) -> Any:
    """The axes: a row for each state, a column for each mode (one of each conjugate pair), shares from 0 to 1."""
    shown = [m for m in modes if m.eigenvalue.imag >= 0]
    names = list(shown[0].participation) if shown else []
    table = np.array([[m.participation[n] for m in shown] for n in names]).reshape(len(names), len(shown))
    axes = axes_of(ax, 1.8 + 0.75 * len(shown), 1.4 + 0.32 * len(names))
    image = axes.imshow(table, cmap="cividis", vmin=0.0, vmax=1.0, aspect="auto")
    axes.set_yticks(range(len(names)), names, fontsize="small")
    labels = [f"{m.eigenvalue.real:.3g}\n{m.frequency_hz:.3g} Hz" for m in shown]
    axes.set_xticks(range(len(shown)), labels, fontsize="x-small")
    axes.set_xlabel("mode: real part in 1/s, frequency")
    for i in range(len(names)):
        for j in range(len(shown)):
            if table[i, j] >= 0.01:
                colour = "#000000" if table[i, j] > 0.5 else "#ffffff"
                axes.text(j, i, f"{table[i, j]:.2f}", ha="center", va="center", fontsize="x-small", color=colour)
    axes.figure.colorbar(image, ax=axes, label="participation")
    return axes
