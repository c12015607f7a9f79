"""Coloured noise made white: autoregressive models of it, and the residuals they leave.

A noise model is a tuple of AR coefficients phi: e_k = phi_1 e_(k-1) + ... + phi_p e_(k-p) + white noise; () is white.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import pairwise

import numpy as np

from hvdc_ident.data import Array, Experiment
from hvdc_ident.errors import StudyError

AR = tuple[float, ...]
MOST = 8
"""The highest order that is tried."""
FEWEST = 20
"""From fewer rows no model of the noise is made."""
GAP = 1.5
"""A step over so many median steps is a gap: a new record begins."""
UNEVEN = 0.02
"""Steps may differ from the median by this share."""


def segments(time: Array, where: str) -> tuple[slice, ...]:
    """The stretches of evenly spaced rows; a gap, or a second row at one instant, begins a new one.

    Raises StudyError where steps within a stretch differ: an AR model from row to row would then mean nothing.
    """
    return _segments(np.asarray(time, dtype=float).tobytes(), where)


@lru_cache(maxsize=256)
def _segments(instants: bytes, where: str) -> tuple[slice, ...]:
    """Those of the bytes of the instants: a fit asks for the same ones at every step."""
    time = np.frombuffer(instants)
    steps = np.diff(time)
    positive = steps[steps > 0]
    if not positive.size:
        return tuple(slice(k, k + 1) for k in range(time.size))
    median = float(np.median(positive))
    cut = (steps <= 0) | (steps > GAP * median)
    inner = steps[~cut]
    if inner.size and np.abs(inner - median).max() > UNEVEN * median:
        raise StudyError(
            "whitening needs evenly spaced rows",
            where=where,
            expected=f"steps of {median:g} s",
            got=f"steps from {inner.min():g} to {inner.max():g} s",
            hint="resample the record, or leave `whiten` out: intervals are then corrected for correlated samples",
        )
    ends = [0, *(np.flatnonzero(cut) + 1).tolist(), time.size]
    return tuple(slice(a, b) for a, b in pairwise(ends))


def whitened(signal: Array, model: AR, parts: Sequence[slice] | None = None) -> Array:
    """The signal, (m,) or (m, p), as white noise of the same size if it was AR noise of that model.

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
    """What whitens the first rows, (p, p), and one over the innovations' share of the standard deviation."""
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


def autoregression(records: Sequence[Array], most: int = MOST) -> AR:
    """The AR model of the noise in several records together, its order by BIC; () where it is white.

    Yule-Walker on the pooled autocovariances, by Levinson's recursion: the model is stationary whatever the data.
    records: (n,) each, evenly sampled, without trend.
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
    return best[1]


def before_event(experiments: Sequence[Experiment], outputs: Sequence[str]) -> Mapping[str, AR]:
    """The noise model of each output, from the rows before the event of every experiment.

    Raises StudyError for an output with fewer than 20 such rows, or whose record does not move there.
    """
    models = {}
    for output in outputs:
        records = [r for e in experiments if output in e.outputs for r in _quiet(e, output)]
        if sum(r.size for r in records) < FEWEST or not any(np.ptp(r) > 0 for r in records):
            raise StudyError(
                f"no noise of '{output}' before the event to whiten with",
                expected=f"at least {FEWEST} rows before the event, with noise in them",
                got=f"{sum(r.size for r in records)} rows",
                hint='whiten = "residual" takes the model of the noise from the residuals',
            )
        models[output] = autoregression(records)
    return models


def _quiet(experiment: Experiment, output: str) -> list[Array]:
    """The stretches of an output before the event, without their straight line."""
    assert experiment.measured is not None
    if experiment.event is None:
        return []
    y = experiment.measured[output]
    rows = np.flatnonzero((experiment.time < experiment.event) & np.isfinite(y))
    if rows.size < 3:
        return []
    t, y = experiment.time[rows], y[rows]
    found = []
    for part in segments(t, f"experiment '{experiment.name}'"):
        if part.stop - part.start >= 3:
            x = t[part] - t[part].mean()
            level = y[part] - y[part].mean()
            found.append(level - x * float(x @ level) / float(x @ x))
    return found
