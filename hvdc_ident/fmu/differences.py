"""Derivatives of whole runs by central differences, with steps chosen against the noise of the runs.

The noise of a run (its integrator's, mostly) is what fourth differences over a tiny step leave, the truncation what two
steps disagree by; the step makes their sum least. J. J. More and S. M. Wild, ACM TOMS 38 (2012) 19.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hvdc_ident.trajectory import Array

TINY = 1e-6  # step of the fourth difference, in sizes of the parameter
TRIED = (1e-2, 1e-3)  # steps that tell the truncation
LEAST, MOST = 1e-6, 5e-2  # steps that are chosen from

Runs = Callable[[float], Array]
"""A run at a value of the parameter: (n, outputs)."""


@dataclass(frozen=True)
class Step:
    """A step in the parameter's unit, and the relative error it leaves in the derivative."""

    h: float
    error: float


def choose(runs: Runs, at: float, size: float, low: float, high: float) -> Step:
    """The step for a parameter that stands at `at`, within [low, high]; eight or so runs.

    size: a typical size of the parameter. The error is that of the whole derivative, output by output in their ranges.
    """
    room = max(at - low, high - at)
    size = min(size, 10.0 * room) if np.isfinite(room) and room > 0 else size
    middle = runs(at)
    scale = _scale(middle)
    tiny = TINY * size
    noise = _norm(_fourth(runs, at, tiny, low, high, middle), scale) / np.sqrt(70.0)
    noise = max(noise, 4.0 * np.finfo(float).eps * float(np.abs(middle / scale).max(initial=0.0)))
    first, second = (slope(runs, at, t * size, low, high, middle) for t in TRIED)
    bend = _norm(first - second, scale) / ((TRIED[0] ** 2 - TRIED[1] ** 2) * size**2)
    best = MOST * size if bend <= 0.0 else float(np.cbrt(noise / (2.0 * bend)))
    h = float(np.clip(best, LEAST * size, MOST * size))
    strength = _norm(second, scale)
    error = (bend * h * h + noise / h) / strength if strength > 0.0 else 0.0
    return Step(h, float(error))


def slope(runs: Runs, at: float, h: float, low: float, high: float, middle: Array | None = None) -> Array:
    """(n, outputs) the derivative at `at`: central, or of second order to one side where a bound is near."""
    if at - h >= low and at + h <= high:
        return np.asarray((runs(at + h) - runs(at - h)) / (2.0 * h))
    side = h if at + 2.0 * h <= high else -h
    here = runs(at) if middle is None else middle
    return np.asarray((-3.0 * here + 4.0 * runs(at + side) - runs(at + 2.0 * side)) / (2.0 * side))


def _fourth(runs: Runs, at: float, h: float, low: float, high: float, middle: Array) -> Array:
    """Fourth differences around `at`, or beside it at a bound."""
    if at - 2 * h >= low and at + 2 * h <= high:
        return np.asarray(runs(at - 2 * h) - 4 * runs(at - h) + 6 * middle - 4 * runs(at + h) + runs(at + 2 * h))
    side = h if at + 4 * h <= high else -h
    a, b, c, d = (runs(at + k * side) for k in range(1, 5))
    return np.asarray(middle - 4 * a + 6 * b - 4 * c + d)


def _scale(runs: Array) -> Array:
    """(outputs,) the range of each output, or its size where it stands still, or 1."""
    spread = np.ptp(runs, axis=0)
    size = np.abs(runs).max(axis=0, initial=0.0)
    return np.where(spread > 1e-9 * size, spread, np.where(size > 0.0, size, 1.0))


def _norm(change: Array, scale: Array) -> float:
    """The root mean square over rows of the output that changes most, in its range."""
    if not change.size:
        return 0.0
    return float(np.sqrt(np.mean((change / scale) ** 2, axis=0)).max())
