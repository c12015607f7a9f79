"""Noise of the records, and differences in units of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
RHO = 0.9
KINDS = ("white", "ar", "quantised")
WRONG = ("told-half", "told-white", "heavy", "louder-later")
"""Kinds for clean cases in which what a record says of its noise, or the whole noise model, is wrong."""


def added(rng: np.random.Generator, clean: Array, sigma: Array, kind: str, event: int) -> Array:
    """Return the record: clean (rows, outputs) with noise of standard deviation sigma (outputs,). event: its row.

    told-half: white, told-white: AR(1); only the stated noise differs. heavy: Student's t with 3 degrees of freedom.
    louder-later: one and a half times as large from the event on. quantised: rounded to steps whose error has this
    standard deviation, after white noise of a quarter of a step.
    """
    e = rng.standard_normal(clean.shape)
    if kind == "quantised":
        step = sigma * np.sqrt(12.0)
        return np.round((clean + 0.25 * step * e) / step) * step
    if kind in ("ar", "told-white"):
        e[1:] *= np.sqrt(1.0 - RHO**2)
        for k in range(1, e.shape[0]):
            e[k] += RHO * e[k - 1]
    elif kind == "heavy":
        e = rng.standard_t(3, clean.shape) / np.sqrt(3.0)
    elif kind == "louder-later":
        e[event:] *= 1.5
    return clean + sigma * e


def whitened(difference: Array, sigma: Array, kind: str, gone: NDArray[np.bool_] | None = None) -> Array:
    """Return a difference (rows, runs, ..., outputs) in units of independent noise. gone: (rows, runs), omitted rows, which are 0.

    The correlation counts from the last row that is not omitted.
    """
    d = difference / sigma
    if kind == "ar":
        gone = np.zeros(d.shape[:2], dtype=bool) if gone is None else gone
        for run in range(d.shape[1]):
            rows = np.flatnonzero(~gone[:, run])
            share = (RHO ** np.diff(rows)).reshape(-1, *[1] * (d.ndim - 2))
            d[rows[1:], run] = (d[rows[1:], run] - share * d[rows[:-1], run]) / np.sqrt(1.0 - share**2)
    elif kind == "quantised":
        d = d / np.sqrt(1.0 + 12.0 * 0.25**2)
    if gone is not None:
        d[gone] = 0.0
    return np.asarray(d)
