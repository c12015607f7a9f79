"""A baseline that names nothing: a sparse equation for the residual of the refitted model (needs pysindy, the extra `bench`).

The residual of the refitted nominal model is treated as a state that is driven by the model's outputs and the inputs.
pysindy fits a sparse polynomial law to the fitted records, and the law is simulated along the held-out one. The BIC of
simulations along the fitted records determines sparsity and smoothing, or rejects the law.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
DEGREES, WINDOWS = (1, 2), (15, 31)
"""Of the polynomials; rows over which the derivative is smoothed."""
THRESHOLDS = (0.01, 0.03, 0.1, 0.3)
"""Of coefficients with every signal scaled to spread 1, and time to UNIT."""
UNIT = 0.02  # s
FARTHEST = 30.0
"""Spreads of the residual beyond which a law has run away."""


def predicted(residuals: Sequence[Array], drivers: Sequence[Array], times: Array) -> tuple[Array | None, int]:
    """Return the residual of the last experiment as predicted by the law of the others, and the number of its terms.

    residuals, drivers: (rows, n) in each experiment, the held-out one last; its residual is not used.
    None if the law diverges along the held-out drivers.
    """
    size = np.maximum(np.std(np.concatenate(residuals[:-1]), axis=0), 1e-12)
    middle = np.mean(np.concatenate(drivers[:-1]), axis=0)
    spread = np.maximum(np.std(np.concatenate(drivers[:-1]), axis=0), 1e-12)
    x = [r / size for r in residuals]
    u = [(d - middle) / spread for d in drivers]
    t = times / UNIT
    data = np.concatenate([part.ravel() for part in x[:-1]])
    best, score, count = None, data.size * np.log(np.mean(data**2)), 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of an ill-conditioned regression: its outcome is what is judged
        for degree, window, threshold in product(DEGREES, WINDOWS, THRESHOLDS):
            law = _law(x[:-1], u[:-1], float(t[1] - t[0]), degree, window, threshold)
            terms = int(np.count_nonzero(law.coefficients()))
            runs = [_run(law, d, t, x[0].shape[1]) for d in u[:-1]] if terms else [None]
            if any(r is None for r in runs):
                continue
            left = data - np.concatenate([r.ravel() for r in runs if r is not None])
            bic = data.size * np.log(np.mean(left**2)) + terms * np.log(data.size)
            if bic < score:
                best, score, count = law, bic, terms
        if best is None:
            return np.zeros_like(residuals[-1]), 0
        found = _run(best, u[-1], t, x[0].shape[1])
    return (None if found is None else found * size), count


def _law(x: Sequence[Array], u: Sequence[Array], step: float, degree: int, window: int, threshold: float) -> Any:
    import pysindy

    law = pysindy.SINDy(
        optimizer=pysindy.STLSQ(threshold=threshold, alpha=1e-3),
        feature_library=pysindy.PolynomialLibrary(degree=degree),
        differentiation_method=pysindy.SmoothedFiniteDifference(smoother_kws={"window_length": window, "polyorder": 3}),
    )
    law.fit(list(x), t=step, u=list(u))
    return law


def _run(law: Any, drivers: Array, t: Array, n: int) -> Array | None:
    """Return (rows, n), the law's simulation from 0 by classical Runge-Kutta steps from row to row; None if it diverges."""
    powers, coefficients = np.asarray(law.feature_library.powers_), np.asarray(law.coefficients())

    def rate(state: Array, now: Array) -> Array:
        return np.asarray(coefficients @ np.prod(np.concatenate([state, now]) ** powers, axis=1))

    found = np.zeros((t.size, n))
    for k in range(t.size - 1):
        h, x, before, after = t[k + 1] - t[k], found[k], drivers[k], drivers[k + 1]
        middle = 0.5 * (before + after)
        a = rate(x, before)
        b = rate(x + 0.5 * h * a, middle)
        c = rate(x + 0.5 * h * b, middle)
        found[k + 1] = x + h / 6 * (a + 2 * b + 2 * c + rate(x + h * c, after))
        if not np.abs(found[k + 1]).max() < FARTHEST:
            return None
    return found
