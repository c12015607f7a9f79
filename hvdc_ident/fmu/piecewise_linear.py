"""Piecewise linear signals with jumps: inputs as arrays for the worker, their interpolants, and grids that represent a signal."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, InputSignal


@dataclass(frozen=True, eq=False)
class PackedInputs:
    """Piecewise linear inputs with jumps, one after the other.

    sizes: (nu,) points of each. times, values: the points, joined. breaks: instants an integrator has to stop at, s.
    """

    sizes: Array
    times: Array
    values: Array
    breaks: Array

    @classmethod
    def of(cls, inputs: Sequence[InputSignal]) -> PackedInputs:
        """The signals of some inputs."""
        breaks = np.concatenate([np.empty(0), *(i.breaks for i in inputs)])
        return cls(
            np.array([i.times.size for i in inputs], dtype=float),
            np.concatenate([np.empty(0), *(i.times for i in inputs)]),
            np.concatenate([np.empty(0), *(i.values for i in inputs)]),
            np.unique(breaks),
        )

    def each(self) -> list[tuple[Array, Array]]:
        """Times and values of each input."""
        ends = np.cumsum(self.sizes).astype(int)
        return [
            (self.times[e - int(n) : e], self.values[e - int(n) : e]) for e, n in zip(ends, self.sizes, strict=True)
        ]

    def raised(self, k: int, by: float) -> PackedInputs:
        """The signals with a constant added to one."""
        ends = np.cumsum(self.sizes).astype(int)
        values = self.values.copy()
        values[ends[k] - int(self.sizes[k]) : ends[k]] += by
        return PackedInputs(self.sizes, self.times, values, self.breaks)

    def stirred(self, by: Sequence[float], at: float) -> PackedInputs:
        """Return the signals with a step added to each at an instant, s."""
        times, values = [], []
        for (t, v), step in zip(self.each(), by, strict=True):
            k = int(np.searchsorted(t, at, side="right"))
            here = float(np.interp(at, t, v))
            times.append(np.concatenate([t[:k], [at, at], t[k:]]))
            values.append(np.concatenate([v[:k], [here, here + step], v[k:] + step]))
        return PackedInputs(
            self.sizes + 2.0, np.concatenate(times), np.concatenate(values), np.union1d(self.breaks, np.array([at]))
        )

    def at(self, t: Array, side: str = "right") -> Array:
        """(n, nu) values at the instants, after the jumps ("right") or before them ("left")."""
        found = np.empty((t.size, self.sizes.size))
        for k, (times, values) in enumerate(self.each()):
            place = np.searchsorted(times, t, side="right" if side == "right" else "left")
            i, j = np.clip(place - 1, 0, None), np.clip(place, None, times.size - 1)
            width = times[j] - times[i]
            share = np.clip((t - times[i]) / np.where(width > 0, width, 1.0), 0.0, 1.0)
            found[:, k] = values[i] + np.where(width > 0, share, 0.0) * (values[j] - values[i])
        return found


class Interpolant:
    """One input's value at any instant, for an integrator that asks thousands of times."""

    def __init__(self, times: Array, values: Array) -> None:
        self._times, self._values = times.tolist(), values.tolist()
        self.constant = bool((values == values[0]).all())

    def is_flat(self, begin: float, end: float) -> bool:
        """Return whether the value stands from just after `begin` to just before `end`."""
        inside = self._values[bisect_right(self._times, begin) : bisect_left(self._times, end)]
        first = self.at(begin, False)
        return self.at(end, True) == first and all(v == first for v in inside)

    def at(self, t: float, before_jump: bool) -> float:
        """The value at t, before the jump there or after it."""
        times, values = self._times, self._values
        place = bisect_left(times, t) if before_jump else bisect_right(times, t)
        if place == 0:
            return float(values[0])
        if place == len(times):
            return float(values[-1])
        t0, t1 = times[place - 1], times[place]
        if t1 <= t0:
            return float(values[place])
        return float(values[place - 1] + (t - t0) / (t1 - t0) * (values[place] - values[place - 1]))


FIRST = 256  # intervals to begin with
HOLDS = 1e-5  # of the signal's range: what lines may be off by
ROUNDS = 24
MOST = 40_000


def sampling_grid(time: Array, breaks: Array, count: int) -> Array:
    """Instants from the first to the last of `time`: all of them, at least `count`, breaks between them twice."""
    begin, end = float(time[0]), float(time[-1])
    inside = breaks[(breaks > begin) & (breaks < end)]
    plain = np.union1d(np.union1d(np.linspace(begin, end, count), time), inside)
    return np.sort(np.concatenate([plain, inside]))


def refined(run: Callable[[Array], Array], time: Array, breaks: Array) -> Array:
    """Instants such that lines between the run's values, (n, signals), hold to HOLDS of each signal's range.

    An interval with a jump inside is halved until it is of no length worth speaking of.
    """
    begin, end = float(time[0]), float(time[-1])
    if begin == end:
        return time[:1].copy()
    grid = sampling_grid(np.array([begin, end]), breaks, FIRST)
    open_ = np.ones(grid.size - 1, dtype=bool) & (np.diff(grid) > 0)
    for _ in range(ROUNDS):
        middles = 0.5 * (grid[:-1] + grid[1:])[open_]
        if not middles.size or grid.size + middles.size > MOST:
            break
        order = np.argsort(np.concatenate([grid, middles]), kind="stable")
        finer = np.concatenate([grid, middles])[order]
        fresh = order >= grid.size
        values = run(finer)
        scale = np.maximum(np.ptp(values, axis=0), 1e-12)
        places = np.flatnonzero(fresh)
        off = np.abs(values[places] - 0.5 * (values[places - 1] + values[places + 1])) / scale
        bad = (off > HOLDS).any(axis=1)
        open_ = np.zeros(finer.size - 1, dtype=bool)
        open_[places[bad] - 1] = open_[places[bad]] = True
        grid = finer
    return grid


def signal_of(time: Array, values: Array, breaks: Array) -> InputSignal:
    """The signal through the rows; breaks where it jumps, and at the given instants within."""
    steep, moved = _jumps(time, values)
    kept = kept_rows(time, values)
    inside = breaks[(breaks >= time[0]) & (breaks <= time[-1])]
    return InputSignal(moved[kept], values[kept], np.union1d(moved[1:][steep], inside))


def kept_rows(time: Array, values: Array) -> NDArray[np.bool_]:
    """Return which rows a signal keeps: of three at one instant the middle one is passed through in no time."""
    _, moved = _jumps(time, values)
    keep = np.ones(time.size, dtype=bool)
    keep[1:-1] = ~((moved[1:-1] == moved[:-2]) & (moved[1:-1] == moved[2:]))
    return keep


def _jumps(time: Array, values: Array) -> tuple[NDArray[np.bool_], Array]:
    """Return which intervals are jumps, and the instants with those intervals closed."""
    short = 1e-6 * max(float(time[-1] - time[0]), 1e-300) / FIRST
    steep = (np.diff(time) <= short) & (np.abs(np.diff(values)) > HOLDS * max(float(np.ptp(values)), 1e-300))
    moved = time.copy()
    moved[:-1][steep] = time[1:][steep]
    return steep, moved
