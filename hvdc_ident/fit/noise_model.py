"""Noise of the measured outputs: its standard deviation, given or from the misfit, and its colour.

The colour is a tuple of AR coefficients phi: e_k = phi_1 e_(k-1) + ... + phi_p e_(k-p) + white noise; () is white.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import pairwise

import numpy as np

from hvdc_ident.data import (
    FEWEST_QUIET,
    FLOOR_SHARE,
    GAP,
    Array,
    Experiment,
    at_rest,
    noise_estimate,
    noise_floor,
    row_scatter,
)
from hvdc_ident.errors import StudyError

AR = tuple[float, ...]

GIVEN = "given"
ESTIMATED = "estimated before the event"
MISFIT = "misfit"
MOST = 8
"""The highest AR order that is tried."""
FEWEST = 20
"""From fewer rows no AR model of the noise is made."""
UNEVEN = 0.02
"""Steps may differ from the median by this share."""


def from_misfit(source: str) -> bool:
    """Return whether a `noise_source` says that the standard deviation is that of the fit's own residual."""
    return source.startswith(MISFIT)


def _has_quiet_rows(experiments: Sequence[Experiment], output: str) -> bool:
    """Return whether every record of an output has enough rows before its event to estimate its noise from."""
    counts = [
        0 if e.event is None else int(np.isfinite(e.measured[output][e.time < e.event]).sum())
        for e in experiments
        if output in e.outputs and e.measured is not None
    ]
    return min(counts, default=0) >= FEWEST_QUIET


def unknown_noise(experiments: Sequence[Experiment], sources: Mapping[str, str]) -> dict[str, str]:
    """Return by output, as a clause, the reason why its standard deviation is that of the misfit. sources: `noise_source`.

    Data have no noise only where the model itself meets them to the last digits; a record that was measured has some, if not
    in the rows before the event.
    """
    reasons = {}
    for output, source in sources.items():
        if not from_misfit(source):
            continue
        if source != MISFIT:
            reasons[output] = "the record has no noise (the model meets it to 1e-6 of its range)"
        elif _has_quiet_rows(experiments, output) and not _moves_before(experiments, output):
            reasons[output] = "the record shows no noise before the event"
        else:
            reasons[output] = "its noise is not given, and no quiet rows before an event tell it"
    return reasons


def _moves_before(experiments: Sequence[Experiment], output: str) -> bool:
    """Return whether a record shows noise above its floor before its event."""
    for e in experiments:
        if output in e.outputs and e.measured is not None and e.event is not None:
            keep = (e.time < e.event) & np.isfinite(e.measured[output])
            v = e.measured[output]
            if noise_estimate(e.time[keep], v[keep], e.event) > noise_floor(v[np.isfinite(v)]):
                return True
    return False


def scatter_of(experiments: Sequence[Experiment], output: str) -> tuple[float, int] | None:
    """Return the white noise that an output's compared rows show from one to the next, and the number of rows behind it.

    In the output's unit, over all its records, each by its rows; None where one of them does not show it (`row_scatter`), or
    is a frequency response, which is as rough as the plant makes it.
    """
    scatters = []
    for e in experiments:
        if output in e.outputs and e.measured is not None:
            if e.domain != "time":
                return None
            keep = e.compared & np.isfinite(e.measured[output])
            scatter = row_scatter(e.time[keep], e.measured[output][keep])
            if scatter is None:
                return None
            scatters.append((scatter, int(keep.sum())))
    rows = sum(n for _, n in scatters)
    return (float(np.sqrt(sum(s * s * n for s, n in scatters) / rows)), rows) if rows else None


def source_text(experiments: Sequence[Experiment], output: str, weight: float | None) -> str:
    """Return the source of an output's standard deviation, in words. weight: that of the misfit, in the output's unit."""
    if source_of(experiments, output) == MISFIT:
        floor = weight is not None and weight <= floor_of(experiments, output)
        return f"{MISFIT}, at the floor of 1e-6 of the range" if floor else MISFIT
    measured = [e for e in experiments if output in e.outputs]
    estimated = [e.name for e in measured if output in e.noise_dof]
    if not estimated:
        return GIVEN
    everywhere = len(estimated) == len(measured)
    return ESTIMATED if everywhere else f"{ESTIMATED} in {', '.join(estimated)}, given for the others"


def range_of(experiments: Sequence[Experiment], output: str) -> float:
    """Return the largest range of an output within one record, in its unit; its size, or 1, where it stands still."""
    records = [e.measured[output] for e in experiments if e.measured is not None and output in e.measured]
    records = [r[np.isfinite(r)] for r in records]
    records = [r for r in records if r.size]
    width = max((float(np.ptp(r)) for r in records), default=0.0)
    size = max((float(np.abs(r).max()) for r in records), default=0.0)
    return width or size or 1.0


def floor_of(experiments: Sequence[Experiment], output: str) -> float:
    """Return the smallest standard deviation an output may have, in its unit."""
    return FLOOR_SHARE * range_of(experiments, output)


def source_of(experiments: Sequence[Experiment], output: str) -> str:
    """Return the source of an output's standard deviation: "given", or "misfit".

    It is the misfit where a record has no noise, or where all noise given is the floor: such data are deterministic.
    """
    noises = [e.noise.get(output) for e in experiments if output in e.outputs]
    limit = floor_of(experiments, output) * (1.0 + 1e-6)
    return GIVEN if noises and all(n is not None for n in noises) and any(n > limit for n in noises if n) else MISFIT


def sigmas(experiment: Experiment, experiments: Sequence[Experiment], weights: Mapping[str, float]) -> dict[str, float]:
    """Return the standard deviation of each output of an experiment, in the output's unit, never below the floor.

    The first that is there: `weights`, the experiment's own noise where `source_of` says "given", a tenth of the range
    (a first weight, to be replaced by the misfit). Raises StudyError for a noise that is not positive.
    """
    deviations: dict[str, float] = {}
    for output in experiment.outputs:
        given = experiment.noise.get(output)
        if given is not None and not (np.isfinite(given) and given >= 0):
            raise StudyError(
                f"the noise of '{output}' is wrong",
                where=f"experiment '{experiment.name}'",
                expected="a finite standard deviation, not negative",
                got=f"{given:g}",
            )
        known = weights.get(output)
        if known is None and given is not None and source_of(experiments, output) == GIVEN:
            known = given
        if known is None:
            known = 0.1 * range_of([*experiments, experiment], output)
        deviations[output] = max(known, floor_of([*experiments, experiment], output))
    return deviations


def segments(time: Array, where: str) -> tuple[slice, ...]:
    """Return the stretches of evenly spaced rows; a gap, or a second row at one instant, begins a new one.

    Raises StudyError where steps within a stretch differ: an AR model from row to row would then mean nothing.
    """
    return _segments(np.asarray(time, dtype=float).tobytes(), where)


@lru_cache(maxsize=256)
def _segments(instants: bytes, where: str) -> tuple[slice, ...]:
    """Return the stretches from the bytes of the instants: a fit asks for the same ones at every step."""
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


def autoregression(records: Sequence[Array], most: int = MOST) -> AR:
    """Return the AR model of the noise in several records together, its order by BIC; () where it is white.

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
    """Return the noise model of each output, from the rows before the event of every experiment that are at rest (`at_rest`).

    Raises StudyError for an output with fewer than 20 such rows, or whose record shows no noise there.
    """
    models = {}
    for output in outputs:
        records = [r for e in experiments if output in e.outputs for r in _quiet(e, output)]
        if sum(r.size for r in records) < FEWEST or not any(np.ptp(r) > 0 for r in records):
            raise StudyError(
                f"no noise of '{output}' before the event to whiten with",
                expected=f"at least {FEWEST} rows before the event, at rest and with noise in them",
                got=f"{sum(r.size for r in records)} rows",
                hint='whiten = "residual" takes the model of the noise from the residuals',
            )
        models[output] = autoregression(records)
    return models


def _quiet(experiment: Experiment, output: str) -> list[Array]:
    """Return the stretches of an output before the event that are at rest, without their straight line."""
    assert experiment.measured is not None
    if experiment.event is None:
        return []
    y = experiment.measured[output]
    rows = np.flatnonzero((experiment.time < experiment.event) & np.isfinite(y))
    if rows.size < 3:
        return []
    t, y = experiment.time[rows], y[rows]
    stretches = []
    for part in segments(t, f"experiment '{experiment.name}'"):
        if part.stop - part.start >= 3 and at_rest(y[part]):
            x = t[part] - t[part].mean()
            level = y[part] - y[part].mean()
            stretches.append(level - x * float(x @ level) / float(x @ x))
    return stretches
