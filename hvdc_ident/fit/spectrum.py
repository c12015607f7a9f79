"""Residuals in the frequency domain: the unitary discrete Fourier transform of the misfit, within a band."""

from __future__ import annotations

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.errors import StudyError
from hvdc_ident.fit.whitening import segments

Band = tuple[float, float]


def transformed(signal: Array, time: Array, band: Band, where: str) -> Array:
    """The real and imaginary parts of the signal's spectrum within the band, (k,) or (k, p).

    signal: (m,) or (m, p) over evenly spaced instants time, (m,) s. band: Hz, ends included. The transform is unitary:
    over the whole band the sum of squares is that of the signal, and white noise stays white.
    Raises StudyError for uneven rows or a band without a frequency.
    """
    if len(segments(time, where)) > 1:
        raise StudyError(
            "the frequency-domain residual needs rows without a gap",
            where=where,
            expected="evenly spaced rows with finite measurements and no guard",
            hint="a window without gaps, or the time-domain residual",
        )
    n = time.size
    step = (time[-1] - time[0]) / max(n - 1, 1)
    frequency = np.fft.rfftfreq(n, step) if step > 0 else np.zeros(1)
    inside = (frequency >= band[0]) & (frequency <= band[1])
    spectrum = np.fft.rfft(signal, axis=0) / np.sqrt(n)
    single = (np.arange(frequency.size) == 0) | ((np.arange(frequency.size) == n // 2) & (n % 2 == 0))
    both = spectrum[inside & ~single] * np.sqrt(2.0)
    result = np.concatenate([spectrum[inside & single].real, both.real, both.imag])
    if not result.shape[0]:
        raise StudyError(
            "the band holds no frequency of the record",
            where=where,
            expected=f"within 0 to {frequency[-1]:g} Hz in steps of {1.0 / (n * step) if step else 0:g} Hz",
            got=f"{band[0]:g} to {band[1]:g} Hz",
        )
    return result
