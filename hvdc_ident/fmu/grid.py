"""Grids on which signals pass from one simulator to another as lines."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, InputSignal

FIRST = 256  # intervals to begin with
HOLDS = 1e-5  # of the signal's range: what lines may be off by
ROUNDS = 24
MOST = 40_000


def joined(time: Array, breaks: Array, count: int) -> Array:
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
    grid = joined(np.array([begin, end]), breaks, FIRST)
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
    """Which rows a signal keeps: of three at one instant the middle one is passed through in no time."""
    _, moved = _jumps(time, values)
    keep = np.ones(time.size, dtype=bool)
    keep[1:-1] = ~((moved[1:-1] == moved[:-2]) & (moved[1:-1] == moved[2:]))
    return keep


def _jumps(time: Array, values: Array) -> tuple[NDArray[np.bool_], Array]:
    """Which intervals are jumps, and the instants with those intervals closed."""
    short = 1e-6 * max(float(time[-1] - time[0]), 1e-300) / FIRST
    steep = (np.diff(time) <= short) & (np.abs(np.diff(values)) > HOLDS * max(float(np.ptp(values)), 1e-300))
    moved = time.copy()
    moved[:-1][steep] = time[1:][steep]
    return steep, moved
