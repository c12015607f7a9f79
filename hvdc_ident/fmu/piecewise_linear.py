"""Piecewise linear signals with jumps: inputs as arrays for the worker, their interpolants, and grids that represent a signal."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, InputSignal

FIRST_INTERVALS = 256  # of a grid, before it is refined
LINE_TOLERANCE = 1e-5  # deviation from lines, in shares of the signal's range
MOST_PARTS = 8  # into which an interval is divided at once
MAX_DIVISIONS = 8  # of an interval, which leave 2e-10 of the span around a jump
MAX_POINTS = 40_000  # of a refined grid


@dataclass(frozen=True, eq=False)
class PackedInputs:
    """Piecewise linear inputs with jumps, in joined arrays.

    sizes: (nu,) points of each. times, values: the points, joined. breaks: instants an integrator has to stop at, s.
    """

    sizes: Array
    times: Array
    values: Array
    breaks: Array

    @classmethod
    def of(cls, inputs: Sequence[InputSignal]) -> PackedInputs:
        """Return some inputs, packed."""
        return cls(
            np.array([i.times.size for i in inputs], dtype=float),
            np.concatenate([np.empty(0), *(i.times for i in inputs)]),
            np.concatenate([np.empty(0), *(i.values for i in inputs)]),
            np.unique(np.concatenate([np.empty(0), *(i.breaks for i in inputs)])),
        )

    def each(self) -> list[tuple[Array, Array]]:
        """Return times and values of each input; they are views."""
        ends = np.cumsum(self.sizes).astype(int)[:-1]
        return (
            list(zip(np.split(self.times, ends), np.split(self.values, ends), strict=True)) if self.sizes.size else []
        )

    def constant(self, k: int) -> Array:
        """Return values that are 1 at the points of one input, and 0 at those of the others."""
        return np.repeat(np.arange(self.sizes.size) == k, self.sizes.astype(int)).astype(float)

    def stepped(self, by: Sequence[float], at: float) -> PackedInputs:
        """Return the inputs with a step added to each at an instant, s."""
        times, values = [], []
        for (t, v), step in zip(self.each(), by, strict=True):
            k = int(np.searchsorted(t, at, side="right"))
            before = float(np.interp(at, t, v))
            times.append(np.concatenate([t[:k], [at, at], t[k:]]))
            values.append(np.concatenate([v[:k], [before, before + step], v[k:] + step]))
        breaks = np.union1d(self.breaks, np.array([at]))
        return PackedInputs(self.sizes + 2.0, np.concatenate(times), np.concatenate(values), breaks)

    def at(self, t: Array, side: str = "right") -> Array:
        """(n, nu) values at the instants, after the jumps ("right") or before them ("left")."""
        result = np.empty((t.size, self.sizes.size))
        for k, (times, values) in enumerate(self.each()):
            index = np.searchsorted(times, t, side="right" if side == "right" else "left")
            i, j = np.clip(index - 1, 0, None), np.clip(index, None, times.size - 1)
            width = times[j] - times[i]
            share = np.clip((t - times[i]) / np.where(width > 0, width, 1.0), 0.0, 1.0)
            result[:, k] = values[i] + np.where(width > 0, share, 0.0) * (values[j] - values[i])
        return result


class Interpolant:
    """One input's value at any instant, for an integrator that evaluates it thousands of times."""

    def __init__(self, times: Array, values: Array) -> None:
        self._times, self._values = times.tolist(), values.tolist()
        self.constant = bool((values == values[0]).all())

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
        share = np.concatenate([np.arange(1, k) / k for k in parts])
        grid, added = _with_points(grid, np.repeat(low, parts - 1) + share * np.repeat(length, parts - 1))
        bent = added[np.repeat(times > 1.0, parts - 1)]
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
