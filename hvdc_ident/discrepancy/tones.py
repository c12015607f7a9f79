"""Frequencies that stand out in what the model leaves."""

from __future__ import annotations

import numpy as np

from hvdc_ident.discrepancy.nominal import Nominal

MOST = 3
OUT = 8.0
"""How far a frequency's power must stand above the median of those around it."""


def tones(nominal: Nominal) -> tuple[float, ...]:
    """Hz, the strongest first; none where no frequency stands out.

    Records before the event count as the rest: a disturbance is there all along.
    """
    experiments = {e.name: e for e in nominal.problem.fitted_experiments}
    power: dict[float, float] = {}
    for b in nominal.blocks:
        t = experiments[b.experiment].time[b.rows]
        steps = np.diff(t)
        if t.size < 64 or (steps <= 0).any() or np.ptp(steps) > 0.02 * float(np.median(steps)):
            continue
        window = np.hanning(t.size)
        spectrum = np.abs(np.fft.rfft((b.residual - b.residual.mean()) * window, 4 * t.size)) ** 2
        frequency = np.fft.rfftfreq(4 * t.size, float(np.median(steps)))
        floor = np.array([np.median(spectrum[max(0, k - 60) : k + 61]) for k in range(0, spectrum.size, 20)])
        around = np.interp(np.arange(spectrum.size), np.arange(0, spectrum.size, 20), floor)
        ratio = spectrum / np.maximum(around, 1e-300)
        inner = np.flatnonzero((ratio[1:-1] > ratio[:-2]) & (ratio[1:-1] >= ratio[2:]) & (ratio[1:-1] > OUT)) + 1
        for k in inner[inner > 12]:
            power[float(frequency[k])] = max(power.get(float(frequency[k]), 0.0), float(ratio[k]))
    found: list[float] = []
    for f in sorted(power, key=lambda f: -power[f]):
        if all(abs(np.log(f / other)) > 0.1 for other in found):
            found.append(f)
    return tuple(found[:MOST])
