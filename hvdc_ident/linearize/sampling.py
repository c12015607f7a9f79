"""Multipliers of a linear model with sampled blocks: what a deviation is multiplied by over the blocks' common period.

A sampled block is periodic in time. Its transfer function leaves its aliases out, so that roots do not decide on stability near
half the sampling frequency and above; the multipliers do, exactly (Chen and Francis 1995, Optimal Sampled-Data Control Systems, 3).
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from itertools import pairwise
from math import lcm

import numpy as np
import scipy.linalg

from hvdc_ident.linearize.delays import Channel
from hvdc_ident.linearize.system import Array

PERIOD_SAMPLES = 1000
"""Samples in a common period up to which the multipliers are computed."""


def multipliers(matrix: Array, nx: int, channels: Sequence[Channel]) -> tuple[Array, float] | str:
    """Return the multipliers and the common period, s, or the reason why there are none.

    matrix: rows [x', values to sample], columns [x, held values]. All channels are sampled blocks; their values are read
    before anything is published at the same instant, which matters only where they read one another without a state.
    """
    if any(c.kind != "sampled" for c in channels):
        return "sampled blocks beside delays"
    if matrix[nx:, nx:].any():
        return "sampled blocks that read one another without a state on the way"
    period = _common_period(channels)
    if period is None:
        return "sampled blocks without a common period"
    waiting = [int(np.floor(c.compute / c.time + 1e-9)) for c in channels]
    size = matrix.shape[0] + sum(waiting)
    start = np.eye(size)
    x, held = start[:nx], start[nx : matrix.shape[0]].copy()
    ends = np.cumsum([matrix.shape[0], *waiting])
    queues = [list(start[a:b]) for a, b in pairwise(ends)]  # the oldest first
    known: dict[float, Array] = {}
    now = 0.0
    for time, read, published in _events(channels, waiting, period):
        x, now = _flow(matrix, nx, time - now, known) @ np.concatenate([x, held]), time
        for i in published:
            if queues[i]:
                held[i] = queues[i].pop(0)
        for i in read:
            queues[i].append(matrix[nx + i, :nx] @ x)
            if channels[i].compute <= 1e-9 * channels[i].time:
                held[i] = queues[i].pop(0)
    x = _flow(matrix, nx, period - now, known) @ np.concatenate([x, held])
    return np.linalg.eigvals(np.concatenate([x, held, *(np.reshape(q, (-1, size)) for q in queues)])), period


def _common_period(channels: Sequence[Channel]) -> float | None:
    """Return the least common multiple of the sampling periods, s; None where there is none of at most PERIOD_SAMPLES samples."""
    first = channels[0].time
    shares = [Fraction(c.time / first).limit_denominator(PERIOD_SAMPLES) for c in channels]
    if any(abs(float(f) * first - c.time) > 1e-9 * c.time for f, c in zip(shares, channels, strict=True)):
        return None
    below = lcm(*(f.denominator for f in shares))
    whole = lcm(*(f.numerator * (below // f.denominator) for f in shares))
    period = first * whole / below
    return period if sum(period / c.time for c in channels) <= PERIOD_SAMPLES else None


def _events(
    channels: Sequence[Channel], waiting: Sequence[int], period: float
) -> list[tuple[float, list[int], list[int]]]:
    """Return (time, blocks that read, blocks that publish what they read earlier) by time, over one common period."""
    acts: list[tuple[float, int, bool]] = []
    for i, c in enumerate(channels):
        count = round(period / c.time)
        acts += [(k * c.time, i, True) for k in range(count)]
        if c.compute > 1e-9 * c.time:
            late = c.compute - waiting[i] * c.time
            acts += [(k * c.time + (late if late > 1e-9 * c.time else 0.0), i, False) for k in range(count)]
    events: list[tuple[float, list[int], list[int]]] = []
    for time, i, reads in sorted(acts):
        if not events or time > events[-1][0] + 1e-9 * period:
            events.append((time, [], []))
        (events[-1][1] if reads else events[-1][2]).append(i)
    return events


def _flow(matrix: Array, nx: int, time: float, known: dict[float, Array]) -> Array:
    """Return (states, states and held values) what the states become over a time with the held values constant."""
    if time not in known:
        whole = np.zeros(matrix.shape)
        whole[:nx] = matrix[:nx]
        known[time] = scipy.linalg.expm(whole * time)[:nx]
    return known[time]
