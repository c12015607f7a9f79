"""Frequencies that stand out in what the model leaves."""

from __future__ import annotations

import numpy as np

from hvdc_ident.discrepancy.nominal import Nominal
from hvdc_ident.trajectory import Array

MOST = 4
OUT = 6.0
"""Standard deviations by which the power at a frequency, over all records, must exceed that of white noise."""
APART = 0.08
"""Tones nearer to each other than this, in the logarithm, are one."""


def tones(nominal: Nominal) -> tuple[float, ...]:
    """Hz, the strongest first; none where no frequency stands out, or rows are unevenly spaced.

    The whitened residuals' periodograms are added up over outputs and experiments: a disturbance is in many of them.
    """
    experiments = {e.name: e for e in nominal.problem.fitted_experiments}
    spectra: list[tuple[Array, Array]] = []
    for b in nominal.blocks:
        t = experiments[b.experiment].time[b.rows]
        steps = np.diff(t)
        if t.size < 64 or (steps <= 0).any() or np.ptp(steps) > 0.02 * float(np.median(steps)):
            continue
        window = np.hanning(t.size)
        line = np.abs(np.fft.rfft((b.residual - b.residual.mean()) * window, 4 * t.size)) ** 2
        axis = np.asarray(np.fft.rfftfreq(4 * t.size, float(np.median(steps))), dtype=float)
        spectra.append((axis, line / float(window @ window)))
    if not spectra:
        return ()
    frequency = max((f for f, _ in spectra), key=len)
    power = np.sum([np.interp(frequency, f, p, right=1.0) for f, p in spectra], axis=0)
    count = len(spectra)
    inner = np.flatnonzero((power[1:-1] > power[:-2]) & (power[1:-1] >= power[2:])) + 1
    # Below two periods a record the residual of anything slow has power.
    inner = inner[(inner > 8) & (power[inner] > count + OUT * np.sqrt(count))]
    found: list[float] = []
    for k in inner[np.argsort(-power[inner])]:
        if all(abs(np.log(frequency[k] / other)) > APART for other in found):
            found.append(float(frequency[k]))
    return tuple(found[:MOST])
