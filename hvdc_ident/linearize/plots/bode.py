"""Bode diagrams: gain in dB and phase in degrees over Hz, several responses in one, bands where they are known."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hvdc_ident.linearize.frequency import Response
from hvdc_ident.linearize.plots.style import grid, look
from hvdc_ident.notebook import axes_of


def bode(responses: Sequence[Response], labels: Sequence[str] = (), ax: Any = None) -> Any:
    """The two axes, gain above phase; every channel of every response is one curve, measured ones are dots."""
    gain, phase = pair = axes_of(ax, 7.0, 6.0, rows=2)
    k = 0
    for number, r in enumerate(responses):
        name = f"{labels[number]}: " if number < len(labels) else ""
        for i, output in enumerate(r.output_names):
            for j, input in enumerate(r.input_names):
                keep = (r.omega > 0) & (r.magnitude[:, i, j] > 0)
                f, db = r.frequency_hz[keep], r.magnitude_db[keep, i, j]
                style = look(k)
                if r.source in ("recording", "simulation"):
                    style = {"color": style["color"], "linestyle": "none", "marker": ".", "markersize": 4}
                gain.semilogx(f, db, label=f"{name}{input} to {output}", **style)
                phase.semilogx(f, np.degrees(np.unwrap(np.angle(r.values[keep, i, j]))), **style)
                if r.std is not None:
                    size, spread = r.magnitude[keep, i, j], 2.0 * r.std[keep, i, j]
                    low = 20 * np.log10(np.maximum(size - spread, 1e-3 * size))
                    gain.fill_between(
                        f, low, 20 * np.log10(size + spread), color=style["color"], alpha=0.2, linewidth=0
                    )
                k += 1
    gain.set_ylabel("gain, dB")
    phase.set_ylabel("phase, degrees")
    phase.set_xlabel("frequency, Hz")
    for axes in (gain, phase):
        grid(axes)
    if k:
        gain.legend(fontsize="small")
    return pair
