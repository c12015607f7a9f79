"""The window of a recorder, seen in the noise of its rows: the mean over several rows has a spectrum that is 0 at whole turns of a row."""

from __future__ import annotations

import math

import numpy as np

from hvdc_ident.data.noise import quiet_rows
from hvdc_ident.data.trajectory import Array

CHANCE = 1e-3
"""Chance at most that noise of another kind is taken for that of a window: by Bayes, with all lengths as likely beforehand."""
LONGEST = 20
"""Rows of the longest window that is looked for."""
_ROWS = 2000  # the last before the event: more make it surer than it has to be
_PERIODS = 10  # of the longest window: the record holds so many at least
_POLES = np.linspace(0.0, 0.98, 25)
_WHITE = np.concatenate([[0.0], np.geomspace(1e-4, 10.0, 11)])  # beside the coloured noise, of its mean power


def window_rows(time: Array, values: Array, event: float | None) -> int | None:
    """Return over how many rows a record is a mean, as its noise before the event tells; None where it tells of no such window.

    time: (n,) s. values: (n,), NaN where not recorded. event: s. The noise of means over m rows has a spectrum in proportion to
    (sin(m w/2)/sin(w/2))^2, w in rad per row. By the Whittle likelihood of the periodogram (Whittle 1953) that, beside white noise
    of rounding, has to be more likely than noise of first order and than the square of that spectrum, of a window that is a
    triangle, beside white noise too.
    """
    quiet = quiet_rows(time, values, event)
    rows, rest = quiet.rows[-_ROWS:], quiet.values[-_ROWS:]
    if rest.size == 0 or np.ptp(np.diff(time[rows])) > 1e-3 * np.median(np.diff(time[rows])):
        return None
    lengths = range(2, min(LONGEST, rest.size // _PERIODS) + 1)
    w = 2.0 * np.pi * np.arange(1, rest.size // 2 + 1) / rest.size
    power = np.abs(np.fft.rfft(rest)[1 : w.size + 1]) ** 2
    if not lengths or not power.sum() > 0.0:
        return None
    boxes = {m: (np.sin(0.5 * m * w) / (m * np.sin(0.5 * w))) ** 2 for m in lengths}
    known = {m: _likelihood(power, g) for m, g in boxes.items()}
    best = max(known, key=lambda m: known[m])
    first_order = max(_likelihood(power, 1.0 / (1.0 + r * r - 2.0 * r * np.cos(w))) for r in _POLES)
    others = max(first_order, *(_likelihood(power, g * g) for g in boxes.values()))
    return best if known[best] - others > math.log(len(lengths) / CHANCE) else None


def _likelihood(power: Array, shape: Array) -> float:
    """Return the largest logarithm of the likelihood of a periodogram, of noise of a spectrum beside white noise of some share."""
    spectra = shape / shape.mean() + _WHITE[:, None]
    sizes = np.maximum(spectra, 1e-12)
    levels = (power / sizes).mean(axis=1)
    return float((-power.size * np.log(levels) - np.log(sizes).sum(axis=1)).max())
