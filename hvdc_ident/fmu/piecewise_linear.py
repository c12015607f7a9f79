"""Piecewise linear signals with jumps: their interpolants, and grids that represent a signal."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, InputSignal

FIRST_INTERVALS = 256  # of a grid, before it is refined
LINE_TOLERANCE = 1e-5  # deviation from lines, in shares of the signal's range
MOST_PARTS = 8  # into which an interval is divided at once
MAX_DIVISIONS = 8  # of an interval, which leave 2e-10 of the span around a jump
MAX_POINTS = 40_000  # of a refined grid


class Interpolant:
    """One input's value at any instant, for an integrator that evaluates it thousands of times."""

    def __init__(self, signal: InputSignal) -> None:
        self._times, self._values = signal.times.tolist(), signal.values.tolist()
        self.constant = signal.is_constant

    def is_flat(self, begin: float, end: float) -> bool:
        """Return whether the value is constant from just after `begin` to just before `end`."""
        inside = self._values[bisect_right(self._times, begin) : bisect_left(self._times, end)]
        first = self.at(begin, False)
        return self.at(end, True) == first and all(v == first for v in inside)

    def at(self, t: float, before_jump: bool) -> float:
        """Return the value at t, before the jump there or after it."""
        times, values = self._times, self._values
        index = bisect_left(times, t) if before_jump else bisect_right(times, t)
        if index == 0:
            return float(values[0])
        if index == len(times):
            return float(values[-1])
        t0, t1 = times[index - 1], times[index]
        if t1 <= t0:
            return float(values[index])
        return float(values[index - 1] + (t - t0) / (t1 - t0) * (values[index] - values[index - 1]))


def sampling_grid(time: Array, breaks: Array, count: int) -> Array:
    """Return instants from the first to the last of `time`: all of them, at least `count`, breaks between them twice."""
    begin, end = float(time[0]), float(time[-1])
    inside = breaks[(breaks > begin) & (breaks < end)]
    plain = np.union1d(np.union1d(np.linspace(begin, end, count), time), inside)
    return np.sort(np.concatenate([plain, inside]))


def refined_grid(run: Callable[[Array], Array], time: Array, breaks: Array) -> Array:
    """Return instants such that lines between the run's values, (n, signals), are within LINE_TOLERANCE of them.

    An interval is divided into as many parts as it takes where its deviation falls with the square of their length, as that of
    a smooth signal does, and its parts are looked at in turn; one with a jump inside until its length is negligible.
    """
    begin, end = float(time[0]), float(time[-1])
    if begin == end:
        return time[:1].copy()
    grid = sampling_grid(np.array([begin, end]), breaks, FIRST_INTERVALS)
    coarse = np.diff(grid) > 0
    for _ in range(MAX_DIVISIONS):
        low, length = grid[:-1][coarse], np.diff(grid)[coarse]
        if not low.size or grid.size + low.size > MAX_POINTS:
            break
        finer, middles = _with_points(grid, low + 0.5 * length)
        values = run(finer)
        scale = np.maximum(np.ptp(values, axis=0), 1e-12)
        deviation = np.abs(values[middles] - 0.5 * (values[middles - 1] + values[middles + 1])) / scale
        times = deviation.max(axis=1, initial=0.0) / LINE_TOLERANCE
        parts = np.where(times > 1.0, np.clip(np.ceil(np.sqrt(times)), 2, MOST_PARTS), 2).astype(int)
        inner = parts - 1
        of = np.repeat(np.arange(parts.size), inner)  # the interval of each point inside one
        share = (np.arange(1, of.size + 1) - (np.cumsum(inner) - inner)[of]) / parts[of]
        grid, added = _with_points(grid, low[of] + share * length[of])
        bent = added[times[of] > 1.0]
        coarse = np.zeros(grid.size - 1, dtype=bool)
        coarse[bent - 1] = coarse[bent] = True
    return grid


def _with_points(grid: Array, points: Array) -> tuple[Array, NDArray[np.intp]]:
    """Return a grid with more points, in order, and where these are in it."""
    joined = np.concatenate([grid, points])
    order = np.argsort(joined, kind="stable")
    return joined[order], np.flatnonzero(order >= grid.size)


def signal_of(time: Array, values: Array, breaks: Array) -> InputSignal:
    """Return the signal through the rows, with breaks where it jumps and at the given instants within."""
    jumps, closed = _jumps(time, values)
    kept = kept_rows(time, values)
    inside = breaks[(breaks >= time[0]) & (breaks <= time[-1])]
    return InputSignal(closed[kept], values[kept], np.union1d(closed[1:][jumps], inside))


def kept_rows(time: Array, values: Array) -> NDArray[np.bool_]:
    """Return which rows a signal keeps: of three at one instant the middle one has no duration."""
    _, closed = _jumps(time, values)
    keep = np.ones(time.size, dtype=bool)
    keep[1:-1] = ~((closed[1:-1] == closed[:-2]) & (closed[1:-1] == closed[2:]))
    return keep


def _jumps(time: Array, values: Array) -> tuple[NDArray[np.bool_], Array]:
    """Return which intervals are jumps, and the instants with those intervals closed."""
    short = 1e-6 * max(float(time[-1] - time[0]), 1e-300) / FIRST_INTERVALS
    jumps = (np.diff(time) <= short) & (np.abs(np.diff(values)) > LINE_TOLERANCE * max(float(np.ptp(values)), 1e-300))
    closed = time.copy()
    closed[:-1][jumps] = time[1:][jumps]
    return jumps, closed
