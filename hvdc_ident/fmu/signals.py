"""Inputs over a run, as plain arrays that travel to the worker."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hvdc_ident.data import Array, InputSignal


@dataclass(frozen=True, eq=False)
class Signals:
    """Piecewise linear inputs with jumps, one after the other.

    sizes: (nu,) points of each. times, values: the points, joined. breaks: instants an integrator has to stop at, s.
    """

    sizes: Array
    times: Array
    values: Array
    breaks: Array

    @classmethod
    def of(cls, inputs: Sequence[InputSignal]) -> Signals:
        """The signals of some inputs."""
        joined = np.concatenate([np.empty(0), *(i.breaks for i in inputs)])
        return cls(
            np.array([i.times.size for i in inputs], dtype=float),
            np.concatenate([np.empty(0), *(i.times for i in inputs)]),
            np.concatenate([np.empty(0), *(i.values for i in inputs)]),
            np.unique(joined),
        )

    def each(self) -> list[tuple[Array, Array]]:
        """Times and values of each input."""
        ends = np.cumsum(self.sizes).astype(int)
        return [
            (self.times[e - int(n) : e], self.values[e - int(n) : e]) for e, n in zip(ends, self.sizes, strict=True)
        ]

    def raised(self, k: int, by: float) -> Signals:
        """The signals with a constant added to one."""
        ends = np.cumsum(self.sizes).astype(int)
        values = self.values.copy()
        values[ends[k] - int(self.sizes[k]) : ends[k]] += by
        return Signals(self.sizes, self.times, values, self.breaks)

    def stirred(self, by: Sequence[float], at: float) -> Signals:
        """Return the signals with a step added to each at an instant, s."""
        times, values = [], []
        for (t, v), step in zip(self.each(), by, strict=True):
            k = int(np.searchsorted(t, at, side="right"))
            here = float(np.interp(at, t, v))
            times.append(np.concatenate([t[:k], [at, at], t[k:]]))
            values.append(np.concatenate([v[:k], [here, here + step], v[k:] + step]))
        return Signals(
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


class Moving:
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
