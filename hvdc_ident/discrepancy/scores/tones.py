"""Frequencies that stand out in what the model leaves."""

from __future__ import annotations

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.refits.nominal import Nominal

MOST = 4
FULL = 0.9
"""Share of the rows of an even grid that have to be there; those that are not, on a jump of an input say, count as 0."""
OUT = 6.0
"""Standard deviations by which the power at a frequency, over all records, must exceed that of white noise."""
APART = 0.08
"""Tones nearer to each other than this, in the logarithm, are one."""


def tones(nominal: Nominal) -> tuple[float, ...]:
    """Hz, the strongest first; none where no frequency stands out, or rows lie on no even grid.

    The whitened residuals' periodograms are added up over outputs and experiments: a disturbance is in many of them.
    """
    experiments = {e.name: e for e in nominal.problem.fitted_experiments}
    spectra: list[tuple[Array, Array]] = []
    for b in nominal.blocks:
        t = experiments[b.experiment].time[b.rows]
        if t.size < 64:
            continue
        step = float(np.median(np.diff(t)))
        at = np.rint((t - t[0]) / step).astype(np.intp) if step > 0 else np.zeros(1, dtype=np.intp)
        count = int(at[-1]) + 1
        if (np.diff(at) <= 0).any() or t.size < FULL * count or np.abs(t - t[0] - at * step).max() > 0.02 * step:
            continue
        even = np.zeros(count)
        even[at] = b.residual - b.residual.mean()
        window = np.hanning(count)
        line = np.abs(np.fft.rfft(even * window, 4 * count)) ** 2
        axis = np.asarray(np.fft.rfftfreq(4 * count, step), dtype=float)
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
