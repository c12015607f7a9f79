"""Derivatives of whole runs by differences, as many runs as the accuracy asks for and no more.

A run has noise (its integrator's, and that of rows which an event passes): fourth differences over short steps of all
parameters at once show it.
A pair of runs around a parameter then gives its derivative, and the bend from which the best step of a one-sided
difference follows: from the second time on, a derivative costs one run. Where one side cannot be accurate, the step of a
central difference is chosen against the noise. J. J. More and S. M. Wild, ACM TOMS 38 (2012) 19.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hvdc_ident.data import Array

SHORT = 1e-3  # step of the differences that show the noise, in sizes of the parameter: as long as those of a search
FARTHER = 4.0  # the second pair's step, in those of the first
LEAST, MOST = 1e-6, 5e-2  # steps that are chosen from, in sizes of the parameter
ENOUGH = 1e-3
"""Relative error of a derivative that one-sided differences may leave. It turns a Gauss-Newton step by as much and
changes a standard error by as much, a tenth of what the second figure of an interval shows."""

Runs = Callable[[float], Array]
"""A run at a value of the parameter: (n, outputs)."""


@dataclass(frozen=True)
class Step:
    """A difference step. h: step in the parameter's unit. error: relative, that it leaves. sides: 1 or 2."""

    h: float
    error: float
    sides: int = 2


def noise_of(runs: Runs, middle: Array) -> Array:
    """Return the noise of each output, (outputs,) rms over rows, from six runs.

    runs: runs at a number of short steps, all parameters moved at once: one that changes nothing shows no noise. Fourth
    differences over half a step and over a whole one hold the same noise, and the bend 16 times: their squares tell
    both. So what jumps over a few steps, as a row does that an event passes, counts as noise, and what bends does not.
    """
    at = {0.0: middle, **{k: runs(k) for k in (0.5, 1.0, 1.5, 2.0, 3.0, 4.0)}}
    half, whole = (at[0.0] - 4.0 * at[k] + 6.0 * at[2 * k] - 4.0 * at[3 * k] + at[4 * k] for k in (0.5, 1.0))
    rounding = np.finfo(float).eps * np.abs(middle).max(axis=0, initial=0.0)
    # 1 + 16 + 36 + 16 + 1 times the square of one run's noise.
    square = (256.0 * np.mean(half**2, axis=0) - np.mean(whole**2, axis=0)) / (255.0 * 70.0)
    return np.asarray(np.sqrt(np.maximum(square, rounding**2)))


def first(
    runs: Runs, at: float, size: float, low: float, high: float, middle: Array, noise: Array
) -> tuple[Array, Step]:
    """Return the derivative (n, outputs) at `at` within [low, high], from two runs or four, and the step for later.

    size: a typical size of the parameter. middle: the run at `at`. noise: (outputs,). Errors are those of the output
    that is worst off, rms over rows and in its range.
    """
    room = max(at - low, high - at)
    size = min(size, 10.0 * room) if np.isfinite(room) and room > 0 else size
    scale = _scale(middle)
    level = float((noise / scale).max(initial=0.0))
    # A pair's best step is cbrt(3 level) sizes where the third derivative is as large as the parameter's size makes it:
    # that is the second pair's. The first, closer one bears a third derivative sixteen times as large.
    close = _clipped(float(np.cbrt(3.0 * level)) * size, size) / FARTHER
    near, bend = pair(runs, at, close, low, high, middle)
    strength, curve = _norm(near, scale), _norm(bend, scale)
    if strength == 0.0:
        return near, Step(close, 0.0, 1)
    h = _clipped(2.0 * float(np.sqrt(level / curve)) if curve > 0.0 else MOST * size, size)
    error = (0.5 * curve * h + 2.0 * level / h) / strength
    own = level / (close * strength) + (close / size) ** 2 / 6.0
    if max(error, own) <= ENOUGH:
        return near, Step(h, float(max(error, own)), 1)
    far, _ = pair(runs, at, FARTHER * close, low, high, middle)
    twist = _norm(near - far, scale) / ((FARTHER**2 - 1.0) * close**2)
    h = _clipped(float(np.cbrt(level / (2.0 * twist))) if twist > 0.0 else MOST * size, size)
    step = Step(h, float((twist * h * h + level / h) / strength))
    apart = [abs(float(np.log(h / c))) for c in (close, FARTHER * close)]
    if min(apart) < np.log(2.0):  # within a factor of two of the best step the error is within twice the least
        return (near if apart[0] < apart[1] else far), step
    return derivative(runs, at, step, low, high, middle), step


def derivative(runs: Runs, at: float, step: Step, low: float, high: float, middle: Array) -> Array:
    """Return the derivative (n, outputs) at `at`, to the order of the step: from one run, or from two."""
    h = step.h
    if step.sides == 1:
        side = h if at + h <= high else -h
        return np.asarray((runs(at + side) - middle) / side)
    return pair(runs, at, h, low, high, middle)[0]


def pair(runs: Runs, at: float, h: float, low: float, high: float, middle: Array) -> tuple[Array, Array]:
    """Return first and second derivative from two more runs: on both sides, or on one where a bound is near."""
    if at - h >= low and at + h <= high:
        up, down = runs(at + h), runs(at - h)
        return np.asarray((up - down) / (2.0 * h)), np.asarray((up - 2.0 * middle + down) / h**2)
    side = h if at + 2.0 * h <= high else -h
    one, two = runs(at + side), runs(at + 2.0 * side)
    return np.asarray((-3.0 * middle + 4.0 * one - two) / (2.0 * side)), np.asarray(
        (middle - 2.0 * one + two) / side**2
    )


def _clipped(h: float, size: float) -> float:
    return float(np.clip(h, LEAST * size, MOST * size))


def _scale(runs: Array) -> Array:
    """Return the range of each output, (outputs,), or its size where it stands still, or 1."""
    spread = np.ptp(runs, axis=0)
    size = np.abs(runs).max(axis=0, initial=0.0)
    return np.where(spread > 1e-9 * size, spread, np.where(size > 0.0, size, 1.0))


def _norm(change: Array, scale: Array) -> float:
    """Return the root mean square over rows of the output that changes most, in its range."""
    if not change.size:
        return 0.0
    return float(rms(change / scale).max())


def rms(rows: Array) -> Array:
    """Return the root mean square over rows, (outputs,)."""
    return np.asarray(np.sqrt(np.mean(rows**2, axis=0)))
