"""Recorded waveforms as a model needs them: input signals with their breaks, the event, the noise.

The rules stand in the description of the study file: how rows are joined, what a jump is, what counts as noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hvdc_ident.data.signals import InputSignal
from hvdc_ident.data.trajectory import Array
from hvdc_ident.errors import WaveformError

__all__ = [
    "Interpolation",
    "event_time",
    "input_signal",
    "noise_estimate",
    "noise_floor",
    "pre_event_ar",
    "row_scatter",
]

Interpolation = Literal["hold", "linear"]

HOLD_SHARE = 0.9
"""Share of successive equal rows from which a signal is taken to hold its value between rows."""
JUMP_RATIO = 20.0
"""A change over so many times the median nonzero change is a jump."""
MERGE_TOLERANCE = 1e-9
"""Rows this close to the line through their neighbours, as a share of the range, are merged into it."""
CORNER_TOLERANCE = 1e-4
"""A corner is marked where leaving it out moves the signal by more than this share of its range."""
MAX_CORNERS = 64
"""With more marked corners the signal is curved or noisy, and none of them is a break."""
FLOOR_SHARE = 1e-6
"""Smallest noise that is assumed, as a share of the range."""

_SMOOTH = 0.35  # row-to-row curvature over change, medians: white noise 0.87, any first-order noise over 0.7
_FEW_ROWS = 8  # too few for a standard deviation before the event
_ROWS_OF_SCATTER = 32  # see row_scatter
_MAD_TO_STD = 1.482602218505602  # of a normal distribution
_QUANTISED_CHANGES = 20  # changes needed before a resolution is read off them
_GAP = 1.5  # times the median stride between recorded rows, the same share as `fit.whitening.GAP`
_DEPARTURE = 6.0  # standard deviations
_OUTLIER = 5.0  # standard deviations


def input_signal(time: ArrayLike, values: ArrayLike, interpolation: Interpolation | None = None) -> InputSignal:
    """The signal recorded by rows, as a piecewise linear one with jumps.

    time: (n,) in s, non-decreasing; two rows at one time are a jump. values: (n,), any unit.
    interpolation: "hold": a value holds from its row until the next, so that a step lies at the first row that shows
    the new value. "linear": joined by lines. None: hold where at least 90 % of successive rows are equal; else linear,
    where a change of over 20 times the median nonzero change is a jump at the new row.
    Rows on one line are merged. Breaks are the jumps and, where they are few, the corners.
    Raises WaveformError for rows that are not finite, go back in time or stand more than twice at one time.
    """
    whole = InputSignal(np.array(time, dtype=float), np.array(values, dtype=float), np.empty(0))
    t, v = whole.times, whole.values
    if interpolation not in (None, "hold", "linear"):
        raise WaveformError("no such interpolation", expected="'hold' or 'linear'", got=f"{interpolation!r}")
    if interpolation == "hold" or (interpolation is None and _holds(v)):
        return _held(t, v)
    jumps = _large_changes(v) if interpolation is None else np.zeros(v.size, dtype=bool)
    return _joined(*_with_jumps(t, v, jumps))


def event_time(inputs: Mapping[str, InputSignal]) -> float | None:
    """The instant of the first change of any input in s; None where none changes.

    Noise of a recorded input is no change: without a break in it, the signal has to leave its first level by six times
    the scatter from point to point.
    """
    instants = [t for t in map(_first_change, inputs.values()) if t is not None]
    return min(instants) if instants else None


def noise_estimate(time: ArrayLike, values: ArrayLike, event: float | None) -> float:
    """The standard deviation of the noise in a record, in its unit; 0.0 where the record is deterministic.

    time: (n,) in s. values: (n,), NaN where not recorded. event: instant of the first disturbance in s; None where there
    is none. Before the event: the scatter around a line, by the median. Where fewer than 8 rows lie before it, or none is given:
    the scatter of the rows about the line through their neighbours, which white noise makes. A record is deterministic
    where it is smooth from row to row: its curvature is small beside its change, which no first-order noise is.
    """
    t, v = np.asarray(time, dtype=float), np.asarray(values, dtype=float)
    single = np.append(np.diff(t) > 0, True)  # of two rows at one time the second
    there = single & ~np.isnan(v)
    before = there & (t < event) if event is not None else np.zeros(t.size, dtype=bool)
    settled = int(before.sum()) >= _FEW_ROWS
    rows = before if settled else there
    t, v, number = t[rows], v[rows], np.cumsum(single)[rows]
    if t.size < _FEW_ROWS or (v == v[0]).all():
        return 0.0
    stride = np.diff(number)
    apart = stride > _GAP * np.median(stride)  # rows on two sides of a gap are no neighbours
    bend, change = _bend(t, v)
    near = ~(apart[1:] | apart[:-1])
    if _scatter(bend[near]) < _SMOOTH * _scatter(np.diff(v)[~apart]):
        return 0.0
    if not settled:
        return _scatter((bend / change)[near])
    return _scatter(_detrended(t, v))


def row_scatter(time: ArrayLike, values: ArrayLike) -> float | None:
    """The standard deviation of the white noise that a record shows from row to row, in its unit; None where it does not.

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
    """(n - order,) divided differences, scaled so that white noise of 1 makes a standard deviation of 1."""
    windows = np.lib.stride_tricks.sliding_window_view(t, order + 1)
    gaps = windows[:, :, None] - windows[:, None, :]
    gaps[:, range(order + 1), range(order + 1)] = np.median(np.diff(t))  # leaves the product's scale as it is
    weights = 1.0 / gaps.prod(axis=2)
    weights /= np.linalg.norm(weights, axis=1, keepdims=True)
    return np.asarray((weights * np.lib.stride_tricks.sliding_window_view(v, order + 1)).sum(axis=1))


def noise_floor(values: ArrayLike) -> float:
    """The smallest noise to assume of a record, in its unit: 1e-6 of the range or the resolution of the file.

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
    """The lag-1 autocorrelation of noise, -0.99 .. 0.99, around its trend; 0.0 where there is no noise to tell from.

    values: (n,) the rows before the event, evenly sampled. Corrected for the bias the trend makes in short records.
    """
    v = np.asarray(values, dtype=float)
    if v.size < _FEW_ROWS or np.ptp(v) == 0.0:
        return 0.0
    x = _detrended(np.arange(v.size, dtype=float), v)
    power = float(x @ x)
    if power <= (1e-12 * float(np.abs(v).max())) ** 2 * v.size:
        return 0.0
    r = float(x[1:] @ x[:-1]) / power
    return float(np.clip((v.size * r + 2.0) / (v.size - 4.0), -0.99, 0.99))


def _holds(v: Array) -> bool:
    return v.size < 2 or float(np.mean(np.diff(v) == 0)) >= HOLD_SHARE


def _held(t: Array, v: Array) -> InputSignal:
    """The staircase through the rows; of two rows at one time the second holds."""
    last = np.append(np.diff(t) > 0, True)
    times, after = t[last], v[last]
    before = np.concatenate([v[:1], after[:-1]])
    steps = after != before
    at = times[steps]
    corner_times = np.concatenate([t[:1], np.repeat(at, 2)])
    corner_values = np.concatenate([v[:1], np.column_stack([before[steps], after[steps]]).ravel()])
    if at.size and at[0] == t[0]:  # a jump at the very first row: the start and its own "before" are one point
        corner_times, corner_values = corner_times[1:], corner_values[1:]
    return InputSignal(corner_times, corner_values, at)


def _large_changes(v: Array) -> NDArray[np.bool_]:
    """(n,) the rows that show a change of over 20 times the median nonzero one."""
    change = np.abs(np.diff(v, prepend=v[:1]))
    nonzero = change[change > 0]
    return change > (JUMP_RATIO * np.median(nonzero) if nonzero.size else np.inf)


def _with_jumps(t: Array, v: Array, jumps: NDArray[np.bool_]) -> tuple[Array, Array]:
    """The rows with the value before each jump put in at its instant; no instant more than twice, no row twice."""
    at = np.flatnonzero(jumps)
    t, v = np.insert(t, at, t[at]), np.insert(v, at, v[at - 1])
    new = np.diff(t) > 0
    keep = np.append(True, new) | np.append(new, True)  # first and last row of each instant
    t, v = t[keep], v[keep]
    keep = np.append(True, (np.diff(t) > 0) | (np.diff(v) != 0))
    return t[keep], v[keep]


def _joined(t: Array, v: Array) -> InputSignal:
    """The polygon through the rows, rows on one line merged."""
    scale = float(np.ptp(v))
    if scale == 0.0:
        return InputSignal(t[:1], v[:1], np.empty(0))
    double = np.append(np.diff(t) == 0, False)
    fixed = double | np.append(False, double[:-1])
    fixed[[0, -1]] = True
    bent = fixed.copy()
    bent[1:-1] |= np.abs(_off_line(t, v)) > MERGE_TOLERANCE * scale
    kept = _simplified(t, v, bent, MERGE_TOLERANCE * scale, t.size)
    marked = _simplified(t, v, fixed, CORNER_TOLERANCE * scale, int(fixed.sum()) + MAX_CORNERS)
    corners = marked & ~fixed
    breaks = t[double] if corners.sum() > MAX_CORNERS else t[double | corners]
    return InputSignal(t[kept], v[kept], np.unique(breaks))


def _off_line(t: Array, v: Array) -> Array:
    """(n - 2,) how far each inner row lies off the line through its neighbours; 0 beside a jump."""
    width = t[2:] - t[:-2]
    share = (t[1:-1] - t[:-2]) / np.where(width > 0, width, 1.0)
    return np.where(width > 0, v[1:-1] - v[:-2] - share * (v[2:] - v[:-2]), 0.0)


def _simplified(t: Array, v: Array, kept: NDArray[np.bool_], tolerance: float, most: int) -> NDArray[np.bool_]:
    """(n,) the rows through which the polygon stays within the tolerance of all rows.

    Starts from `kept` and adds the farthest row of every stretch that is off (Douglas and Peucker 1973), all stretches
    at once; stops when more than `most` rows are kept.
    """
    kept = kept.copy()
    while kept.sum() <= most:
        corners = np.flatnonzero(kept)
        width = np.diff(t[corners])
        slope = np.diff(v[corners]) / np.where(width > 0, width, 1.0)
        stretch = np.cumsum(kept)[:-1] - 1
        start = corners[stretch]
        off = np.abs(v[:-1] - v[start] - slope[stretch] * (t[:-1] - t[start]))
        off[corners[:-1]] = 0.0
        farthest = np.maximum.reduceat(off, corners[:-1])
        candidates = np.flatnonzero((off == farthest[stretch]) & (off > tolerance))
        if candidates.size == 0:
            break
        kept[candidates[np.unique(stretch[candidates], return_index=True)[1]]] = True  # the first of each stretch
    return kept


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
    """The rows with the first of two at one time left out."""
    keep = np.append(np.diff(t) > 0, True)
    return t[keep], v[keep]


def _bend(t: Array, v: Array) -> tuple[Array, Array]:
    """(n - 2,) distances of the inner rows from the line through their neighbours, and what white noise of 1 makes."""
    if t.size < 3:
        return np.zeros(0), np.ones(0)
    share = (t[1:-1] - t[:-2]) / (t[2:] - t[:-2])
    return _off_line(t, v), np.sqrt(1.0 + share**2 + (1.0 - share) ** 2)


def _detrended(t: Array, v: Array) -> Array:
    """The values less the straight line that fits them best once outliers are left out."""
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
    """The standard deviation, by the median where that says anything: not where half the values are equal."""
    if x.size == 0:
        return 0.0
    middle = float(np.median(x))
    by_median = _MAD_TO_STD * float(np.median(np.abs(x - middle)))
    return by_median if by_median > 0 else float(np.std(x))


def _resolution(v: Array) -> float:
    """The step all changes are multiples of; 0.0 where they are not, or too few to tell."""
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
