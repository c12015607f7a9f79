"""Noise of recorded signals, and the instant at which they begin to move."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from hvdc_ident.data.signals import MERGE_TOLERANCE, InputSignal, off_line
from hvdc_ident.data.trajectory import Array

FLOOR_SHARE = 1e-6
"""Smallest noise that is assumed, as a share of the range."""
FEWEST_QUIET = 8
"""Rows before an event from which the noise of a record is estimated."""
GAP = 1.5
"""A step over so many median steps is a gap: a new record begins."""
MAD_TO_STD = 1.482602218505602
"""Standard deviation over median absolute deviation, of a normal distribution."""

_SMOOTH = 0.35  # row-to-row curvature over change, medians: white noise 0.87, any first-order noise over 0.7
_ROWS_OF_SCATTER = 32  # see row_scatter
_QUANTISED_CHANGES = 20  # changes needed before a resolution is read off them
_DEPARTURE = 6.0  # standard deviations
_OUTLIER = 5.0  # standard deviations
_LONGEST = 1000  # rows, the last of a longer record: enough to see a motion, and tens of milliseconds
_LIKELIER = 6.9  # log of 1000: the ratio of the likelihoods is 1 on average under noise, so above 1000 once in 1000 records at most
_RHO = np.tanh(np.linspace(-0.5, 3.5, 21))  # lag-1 coefficients of noise that are compared, to 0.998
_WHITE = np.concatenate([[0.0], np.geomspace(1e-2, 1e2, 9)])  # white noise beside that, in its variances
_BENDS = np.concatenate(
    [[0.0], np.geomspace(1e-8, 1e4, 25)]
)  # variance of a motion's second differences, in those of white noise


def event_time(inputs: Mapping[str, InputSignal]) -> float | None:
    """Return the instant of the first change of any input in s; None where none changes.

    Noise of a recorded input is no change: without a break in it, the signal has to leave its first level by six times
    the scatter from point to point.
    """
    instants = [t for t in map(_first_change, inputs.values()) if t is not None]
    return min(instants) if instants else None


def noise_estimate(time: ArrayLike, values: ArrayLike, event: float | None) -> float:
    """Return the standard deviation of the noise in a record, in its unit; 0.0 where the record is deterministic.

    time: (n,) in s. values: (n,), NaN where not recorded. event: instant of the first disturbance in s; None where there
    is none. Before the event: the scatter around a line, by the median. Where fewer than 8 rows lie before it, none is given, or
    the record moves before it (`at_rest`): the scatter of all rows about the line through their neighbours, which white noise
    makes and a motion that the rows follow does not. A record is deterministic
    where it is smooth from row to row: its curvature is small beside its change, which no first-order noise is.
    """
    t, v = np.asarray(time, dtype=float), np.asarray(values, dtype=float)
    single = np.append(np.diff(t) > 0, True)  # of two rows at one time the second
    there = single & ~np.isnan(v)
    before = there & (t < event) if event is not None else np.zeros(t.size, dtype=bool)
    settled = int(before.sum()) >= FEWEST_QUIET and at_rest(v[before])
    rows = before if settled else there
    t, v, number = t[rows], v[rows], np.cumsum(single)[rows]
    if t.size < FEWEST_QUIET or (v == v[0]).all():
        return 0.0
    stride = np.diff(number)
    apart = stride > GAP * np.median(stride)  # rows on two sides of a gap are no neighbours
    bend, change = _bend(t, v)
    near = ~(apart[1:] | apart[:-1])
    if _scatter(bend[near]) < _SMOOTH * _scatter(np.diff(v)[~apart]):
        return 0.0
    if not settled:
        return _scatter((bend / change)[near])
    return _scatter(_detrended(t, v))


def at_rest(values: ArrayLike) -> bool:
    """Return False where a record is a motion with white noise on it rather than noise about a line: its scatter is then no noise.

    values: (n,) rows in their order, evenly sampled, without NaN; of more than 1000 the last count. Two explanations with as
    many parameters are compared by their restricted likelihoods: stationary noise, white and of first order together, about a
    line; and white noise on a smooth course, whose second differences are random (the model behind a smoothing spline). The
    record moves where the second is a thousand times as likely. Noise of any correlation time keeps below that, for it is
    rougher from row to row than a motion is.
    Source: Patterson and Thompson, Biometrika 58 (1971); Wahba, J. R. Stat. Soc. B 40 (1978).
    """
    v = np.asarray(values, dtype=float)[-_LONGEST:]
    if v.size < FEWEST_QUIET:
        return True
    line = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, v.size), 2))[0]
    rest = v - line @ (line.T @ v)
    power = float(rest @ rest)
    # Of white noise the squared steps are twice its variance, within their error; then nothing but white noise is there.
    steps = float(np.sum(np.diff(rest) ** 2)) / 2.0
    if power <= (1e-12 * float(np.abs(v).max())) ** 2 * v.size or power < (1.0 + 2.0 / np.sqrt(v.size)) * steps:
        return True
    return _of_motion(rest) - _of_noise(rest, line) < _LIKELIER


def _of_motion(v: Array) -> float:
    """Return the largest restricted log-likelihood of white noise on a course with random second differences."""
    z = np.diff(v, 2)
    cover = np.ones((3, z.size))  # of the second differences of white noise: 6, -4, 1, by diagonals
    cover[1] = -4.0
    best, first = -np.inf, 0.0
    for k, bends in enumerate(_BENDS):
        cover[0] = 6.0 + bends
        size, solved = _solved(cover, z)
        first = first if k else size
        best = max(best, _likelihood(float(z @ solved), z.size, size - first))
    return best


def _of_noise(v: Array, line: Array) -> float:
    """Return the largest restricted log-likelihood of noise of first order and white noise about a line. line: (n, 2) orthonormal."""
    rows, best = np.column_stack([line, v]), -np.inf
    cover = np.empty((2, v.size))
    for rho in _RHO:
        steps = rows.copy()
        steps[1:] -= rho * rows[:-1]
        for white in _WHITE:
            # Noise of first order leaves white steps; of white noise they are a moving average, correlated with the next ones.
            cover[0], cover[1] = 1.0 - rho**2 + white * (1.0 + rho**2), -rho * white
            cover[0, 0] = 1.0 + white
            size, solved = _solved(cover, steps)
            square = steps.T @ solved
            slopes = np.linalg.solve(square[:2, :2], square[:2, 2])
            size += float(np.linalg.slogdet(square[:2, :2])[1])
            best = max(best, _likelihood(float(square[2, 2] - square[2, :2] @ slopes), v.size - 2, size))
    return best


def _likelihood(square: float, count: int, size: float) -> float:
    """Return the log-likelihood at its best variance, up to a constant. square: whitened sum; size: log-determinant."""
    return -0.5 * (count * (np.log(square / count) + 1.0) + size)


def _solved(cover: Array, rows: Array) -> tuple[float, Array]:
    """Return the log-determinant of a banded covariance (its lower diagonals), and its inverse times rows."""
    from scipy.linalg import cho_solve_banded, cholesky_banded  # a simulation does without it

    factor = cholesky_banded(cover, lower=True, check_finite=False)
    return 2.0 * float(np.sum(np.log(factor[0]))), cho_solve_banded((factor, True), rows, check_finite=False)


def row_scatter(time: ArrayLike, values: ArrayLike) -> float | None:
    """Return the standard deviation of the white noise that a record shows from row to row, in its unit; None where it does not.

    time: (n,) in s, uneven allowed; values: (n,), NaN where nothing was recorded. The divided differences of second,
    third and fourth order of white noise give the same standard deviation once each is scaled, and so do those of
    every other row; those of a signal do not, for every order sees less of a smooth course and more of one that the
    rows hardly follow, and coloured noise grows with the distance of rows (Moré and Wild 2011, doi
    10.1137/100786125). So they have to agree, within three standard errors of their ratios (0.9/sqrt(n) and, for
    every other row, 1.9/sqrt(n) in the logarithm, by simulation). Below 32 rows such an agreement would say nothing:
    any two orders agree within a factor of 1.6.
    """
    t, v = np.asarray(time, dtype=float), np.asarray(values, dtype=float)
    t, v = _distinct(t[np.isfinite(v)], v[np.isfinite(v)])
    if t.size < _ROWS_OF_SCATTER or np.ptp(v) == 0.0:
        return None
    orders = [_scatter(_difference(t, v, k)) for k in (2, 3, 4)]
    sparse = float(np.mean([_scatter(_difference(t[i::2], v[i::2], 3)) for i in (0, 1)]))
    if min(*orders, sparse) <= noise_floor(v):
        return None
    error = 3.0 / np.sqrt(t.size)
    agree = np.log(max(orders) / min(orders)) <= 0.9 * error and abs(np.log(sparse / orders[0])) <= 1.9 * error
    return orders[0] if agree else None


def _difference(t: Array, v: Array, order: int) -> Array:
    """Return (n - order,) divided differences, scaled so that white noise of 1 makes a standard deviation of 1."""
    windows = np.lib.stride_tricks.sliding_window_view(t, order + 1)
    gaps = windows[:, :, None] - windows[:, None, :]
    gaps[:, range(order + 1), range(order + 1)] = np.median(np.diff(t))  # leaves the product's scale as it is
    weights = 1.0 / gaps.prod(axis=2)
    weights /= np.linalg.norm(weights, axis=1, keepdims=True)
    return np.asarray((weights * np.lib.stride_tricks.sliding_window_view(v, order + 1)).sum(axis=1))


def noise_floor(values: ArrayLike) -> float:
    """Return the smallest noise to assume of a record, in its unit: 1e-6 of the range or the resolution of the file.

    values: (n,), NaN where not recorded. The resolution is the smallest change between rows, over the square root of 12;
    it counts only where the values are clearly quantised: every change a multiple of it, as a converter or few written
    digits make them.
    """
    v = np.asarray(values, dtype=float)
    v = v[~np.isnan(v)]
    if v.size == 0:
        return 0.0
    return max(FLOOR_SHARE * float(np.ptp(v)), _resolution(v) / np.sqrt(12.0))


def pre_event_ar(values: ArrayLike) -> float:
    """Return the lag-1 autocorrelation of noise, -0.99 .. 0.99, around its trend; 0.0 where there is no noise to tell from.

    values: (n,) the rows before the event, evenly sampled. Corrected for the bias the trend makes in short records.
    """
    v = np.asarray(values, dtype=float)
    if v.size < FEWEST_QUIET or np.ptp(v) == 0.0:
        return 0.0
    x = _detrended(np.arange(v.size, dtype=float), v)
    power = float(x @ x)
    if power <= (1e-12 * float(np.abs(v).max())) ** 2 * v.size:
        return 0.0
    r = float(x[1:] @ x[:-1]) / power
    return float(np.clip((v.size * r + 2.0) / (v.size - 4.0), -0.99, 0.99))


def _first_change(signal: InputSignal) -> float | None:
    t, v = signal.times, signal.values
    if signal.is_constant:
        return None
    at_break = np.flatnonzero((np.diff(v) != 0) & np.isin(t[:-1], signal.breaks))
    end = int(at_break[0]) + 1 if at_break.size else t.size
    # Up to the first break a smooth course, a noisy one, or both: what moves there is not quiet because a break follows.
    x = v[:end]
    scatter = _scatter(_bend(*_distinct(t[:end], x))[0])
    level = float(np.median(x[: max(1, min(20, x.size // 10))]))
    away = np.abs(x - level) > max(_DEPARTURE * scatter, MERGE_TOLERANCE * float(np.ptp(v)))
    if away.any():
        return float(t[max(0, int(np.argmax(away)) - 1)])
    return float(t[at_break[0]]) if at_break.size else None


def _distinct(t: Array, v: Array) -> tuple[Array, Array]:
    """Return the rows with the first of two at one time left out."""
    keep = np.append(np.diff(t) > 0, True)
    return t[keep], v[keep]


def _bend(t: Array, v: Array) -> tuple[Array, Array]:
    """Return (n - 2,) distances of the inner rows from the line through their neighbours, and what white noise of 1 makes."""
    if t.size < 3:
        return np.zeros(0), np.ones(0)
    share = (t[1:-1] - t[:-2]) / (t[2:] - t[:-2])
    return off_line(t, v), np.sqrt(1.0 + share**2 + (1.0 - share) ** 2)


def _detrended(t: Array, v: Array) -> Array:
    """Return the values less the straight line that fits them best once outliers are left out."""
    rest = v - np.median(v)
    for _ in range(5):
        near = np.abs(rest - np.median(rest)) <= _OUTLIER * _scatter(rest)
        middle, level = t[near].mean(), v[near].mean()
        x = t[near] - middle
        power = float(x @ x)
        slope = float(x @ (v[near] - level)) / power if power else 0.0
        rest = v - level - slope * (t - middle)
    return np.asarray(rest)


def _scatter(x: Array) -> float:
    """Return the standard deviation, by the median where that says anything: not where half the values are equal."""
    if x.size == 0:
        return 0.0
    middle = float(np.median(x))
    by_median = MAD_TO_STD * float(np.median(np.abs(x - middle)))
    return by_median if by_median > 0 else float(np.std(x))


def _resolution(v: Array) -> float:
    """Return the step all changes are multiples of; 0.0 where they are not, or too few to tell."""
    change = np.diff(v)
    change = change[change != 0]
    if change.size < _QUANTISED_CHANGES:
        return 0.0
    size = np.abs(change)
    step = float(size.min())
    if step < 16 * np.finfo(float).eps * float(np.abs(v).max()):
        return 0.0
    multiple = np.round(size / step)
    if (np.abs(size - multiple * step) > 0.01 * step).any():
        return 0.0
    # a ramp changes by one step in every row, too: different multiples, or a value that flickers, tell a quantised one
    flickers = float(np.mean(change[1:] * change[:-1] < 0)) > 0.25
    return step if flickers or np.unique(multiple).size >= 3 else 0.0
