"""Autoregressive models of noise and of residuals, and whitening with them.

A model is a tuple of AR coefficients phi from row to row: e_k = phi_1 e_(k-1) + ... + phi_p e_(k-p) + white noise; () is white.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.data.noise import FirstOrder, common_colours
from hvdc_ident.errors import StudyError

AR = tuple[float, ...]

HIGHEST_ORDER = 8
"""The highest AR order that is tried."""
FEWEST = 20
"""From fewer rows the noise is not whitened: a coefficient would be known to 0.2 at best."""


def autocorrelation(residuals: Sequence[Array], unknowns: float) -> float:
    """Return the AR(1) coefficient of several records together, 0 where it is not significant (5 %, one-sided) or negative.

    With a few tens of rows it is a rough guess and errs to the wide side; of four or fewer none is significant.

    unknowns: how many parameters were fitted to them; a fit lowers the coefficient by about (k + (k + 2) rho)/n
    (Marriott and Pope 1954, for k = 1 and 2), which is added back.
    """
    n = sum(r.size for r in residuals)
    power = sum(float(r @ r) for r in residuals)
    if power == 0.0:
        return 0.0
    rho = sum(float(r[1:] @ r[:-1]) for r in residuals) / power
    if rho < 1.645 / np.sqrt(n):
        return 0.0
    return float(min(rho + (unknowns + (unknowns + 2.0) * rho) / n, 1.0 - 2.0 / n))


def independent_samples(residuals: Sequence[Array], unknowns: float) -> tuple[float, float]:
    """Return the AR(1) coefficient of several records together (`autocorrelation`), and the independent samples they are worth."""
    rho = autocorrelation(residuals, unknowns)
    return rho, sum(r.size for r in residuals) * (1.0 - rho) / (1.0 + rho)


def autoregression(records: Sequence[Array], most: int = HIGHEST_ORDER) -> AR:
    """Return the AR model of the noise in several records together, its order by BIC; () where it is white.

    records: (n,) each, evenly sampled, without trend. One coefficient at most for ten rows: of fewer BIC finds too many in every tenth
    record, of more in one of 15 to 50. Yule-Walker on the pooled autocovariances, by Levinson's recursion: the
    model is stationary whatever the data. A single coefficient is that of the restricted likelihood (`FirstOrder`), which is
    not biased in short records.
    """
    n = sum(r.size for r in records)
    if n < FEWEST:
        return ()
    most = min(most, n // 10)
    covariance = [sum(float(r[k:] @ r[: max(r.size - k, 0)]) for r in records) / n for k in range(most + 1)]
    if covariance[0] <= 0:
        return ()
    best: tuple[float, AR] = (n * np.log(covariance[0]), ())
    model: list[float] = []
    error = covariance[0]
    for order in range(1, most + 1):
        reflection = (covariance[order] - sum(c * covariance[order - 1 - i] for i, c in enumerate(model))) / error
        model = [c - reflection * model[order - 2 - i] for i, c in enumerate(model)] + [reflection]
        error *= 1.0 - reflection**2
        if error <= 0:
            break
        score = n * np.log(error) + order * np.log(n)
        if score < best[0]:
            best = (score, tuple(model))
    if len(best[1]) == 1 and any(r.size > 3 for r in records):
        (colour,) = common_colours([FirstOrder.of(records)])
        return (colour.rho,) if colour.tanh else best[1]
    return best[1]


def whitened(signal: Array, model: AR, parts: Sequence[slice] | None = None) -> Array:
    """Return the signal, (m,) or (m, p), as white noise of the same size if it was AR noise of that model.

    The first rows of every stretch by the Cholesky factor of their covariance, then the innovations: the exact
    likelihood of a stationary AR noise, up to a constant. Raises StudyError for a model that is not stationary.
    """
    if not any(model):
        return signal
    start, scale = _stationary(tuple(model))
    white = np.empty_like(signal)
    for part in parts if parts is not None else [slice(0, signal.shape[0])]:
        s = signal[part]
        head = min(len(model), s.shape[0])
        w = white[part]
        w[:head] = start[:head, :head] @ s[:head]
        innovation = s[head:].copy()
        for lag, phi in enumerate(model, start=1):
            innovation -= phi * s[head - lag : s.shape[0] - lag]
        w[head:] = innovation * scale
    return white


@lru_cache(maxsize=64)
def _stationary(model: AR) -> tuple[Array, float]:
    """Return the matrix that whitens the first rows, (p, p), and the inverse of the innovations' share of the std."""
    p = len(model)
    roots = np.roots([1.0, *(-c for c in model)])
    if not np.isfinite(model).all() or np.abs(roots).max(initial=0.0) >= 1.0:
        raise StudyError(
            "an AR model of noise is not stationary",
            expected="roots inside the unit circle (for one coefficient: -1 < rho < 1)",
            got=", ".join(f"{c:g}" for c in model),
        )
    # Yule-Walker with r_0 = 1: r_k = sum phi_i r_|k-i| for k = 1 .. p
    matrix, right = np.eye(p), np.zeros(p)
    for k in range(1, p + 1):
        for i, phi in enumerate(model, start=1):
            if k == i:
                right[k - 1] += phi
            else:
                matrix[k - 1, abs(k - i) - 1] -= phi
    r = np.linalg.solve(matrix, right)
    variance = 1.0 - float(np.dot(model, r))
    index = np.abs(np.subtract.outer(np.arange(p), np.arange(p)))
    factor = np.linalg.cholesky(np.concatenate([[1.0], r])[index])
    return np.linalg.inv(factor), 1.0 / float(np.sqrt(variance))


def innovation_share(model: AR) -> float:
    """Return the share of the power of AR noise that earlier rows do not foretell; 1 of white noise."""
    return _stationary(tuple(model))[1] ** -2 if any(model) else 1.0


def sum_of_squares(model: AR) -> float:
    """Return the sum of the squared autocorrelations of AR noise over all lags: so many rows tell of a variance as one white row.

    By Parseval from the spectrum, which is that of 1/A(z); (1 + rho^2)/(1 - rho^2) for one coefficient.
    """
    if len(model) < 2:
        rho = sum(model)
        return (1.0 + rho**2) / (1.0 - rho**2)
    spectrum = np.abs(np.fft.rfft([1.0, *(-c for c in model)], 1 << 14)) ** -2.0
    return float(np.mean(spectrum**2) / np.mean(spectrum) ** 2)
