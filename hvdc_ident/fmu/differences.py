"""Derivatives of runs by differences: their noise, the steps chosen against it, and the runs that they need.

A run has noise (its integrator's, and that of rows which an event passes): fourth differences over short steps of all
parameters at once show it. A pair of runs around a parameter then gives its derivative, and the curvature from which the
best step of a one-sided difference follows: from the second time on, a derivative costs one run. Where one side cannot be
accurate, the step of a central difference is chosen against the noise. J. J. More and S. M. Wild, ACM TOMS 38 (2012) 19.

Each rule is a generator that yields runs to be made and is sent their rows: `together` makes those of many at once.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from hvdc_ident.data import Array

SHORT_STEP = 1e-3 / 2**0.5
"""Step of the differences that show a run's noise, in sizes of the parameter: about as long as those of a search, and irrational,
for a parameter is often a whole number of a simulator's fixed steps, and jumps at even distances would look smooth."""
SECOND_STEP = 4.0  # the second pair's step, in those of the first
LEAST_STEP, LARGEST_STEP = 1e-6, 5e-2  # that are chosen from, in sizes of the parameter
SUFFICIENT = 1e-3
"""Relative error of a derivative that one-sided differences may leave. It turns a Gauss-Newton step by as much and
changes a standard error by as much, a tenth of what the second figure of an interval shows."""

Run = TypeVar("Run")
Result = TypeVar("Result")
Differences = Generator[list[Run], list[Array], Result]
"""Yields runs to be made, is sent their outputs, (n, outputs) each, and returns what follows from them."""


@dataclass(frozen=True, eq=False)
class ParameterRuns(Generic[Run]):
    """Runs along one parameter. at: the run at a value of it. value: where the derivative is taken, within [low, high].

    size: a typical size of the parameter. middle: (n, outputs), the outputs at the value.
    """

    at: Callable[[float], Run]
    value: float
    size: float
    low: float
    high: float
    middle: Array


def together(rules: Sequence[Differences[Run, Result]], make: Callable[[list[Run]], list[Array]]) -> list[Result]:
    """Return what each rule returns. make: makes runs; those that all rules ask for at one time are made together."""
    results: dict[int, Result] = {}
    answers: dict[int, Any] = dict.fromkeys(range(len(rules)))
    while answers:
        asked: dict[int, list[Run]] = {}
        for k, rows in answers.items():
            try:
                asked[k] = rules[k].send(rows)
            except StopIteration as end:
                results[k] = end.value
        made = iter(make([run for runs in asked.values() for run in runs]))
        answers = {k: [next(made) for _ in runs] for k, runs in asked.items()}
    return [results[k] for k in range(len(rules))]


@dataclass(frozen=True)
class DifferenceStep:
    """A difference step. h: step in the parameter's unit. error: relative, that it leaves. sides: 1 or 2."""

    h: float
    error: float
    sides: int = 2


def noise_of(run: Callable[[float], Run], middle: Array) -> Differences[Run, Array]:
    """Return the noise of each output, (outputs,) rms over rows, from six runs.

    run: a run at a number of short steps, all parameters moved at once: one that changes nothing shows no noise. Fourth
    differences over half a step and over a whole one hold the same noise, and the curvature 16 times: their squares tell
    both. So what jumps over a few steps, as a row does that an event passes, counts as noise, and what bends does not; nor
    does a jump that the longer ones alone show look like a bend, for it is more than 16 times what the shorter ones show.
    """
    steps = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0)
    rows = yield [run(k) for k in steps]
    at = {0.0: middle, **dict(zip(steps, rows, strict=True))}
    half, whole = (at[0.0] - 4.0 * at[k] + 6.0 * at[2 * k] - 4.0 * at[3 * k] + at[4 * k] for k in (0.5, 1.0))
    rounding = np.finfo(float).eps * np.abs(middle).max(axis=0, initial=0.0)
    # 1 + 16 + 36 + 16 + 1 times the square of one run's noise.
    unbent = 256.0 * np.mean(half**2, axis=0) - np.mean(whole**2, axis=0)
    square = np.where(unbent > 0.0, unbent / 255.0, -unbent) / 70.0
    return np.asarray(np.sqrt(np.maximum(square, rounding**2)))


def first_difference(line: ParameterRuns[Run], noise: Array) -> Differences[Run, tuple[Array, DifferenceStep]]:
    """Return the derivative, (n, outputs), from two runs or four, and the step for later.

    noise: (outputs,). Errors are those of the output with the largest, rms over rows and in its range.
    """
    room = max(line.value - line.low, line.high - line.value)
    size = min(line.size, 10.0 * room) if np.isfinite(room) and room > 0 else line.size
    scale = _ranges(line.middle)
    level = float((noise / scale).max(initial=0.0))
    # A pair's best step is cbrt(3 level) sizes where the third derivative is as large as the parameter's size makes it:
    # that is the second pair's. The first, closer one bears a third derivative sixteen times as large.
    close = _clipped(float(np.cbrt(3.0 * level)) * size, size) / SECOND_STEP
    near, second_derivative = yield from difference_pair(line, close)
    strength, curvature = _largest(near, scale), _largest(second_derivative, scale)
    if strength == 0.0:
        return (yield from _over_steps(line, size))
    h = _clipped(2.0 * float(np.sqrt(level / curvature)) if curvature > 0.0 else LARGEST_STEP * size, size)
    error = (0.5 * curvature * h + 2.0 * level / h) / strength
    pair_error = level / (close * strength) + (close / size) ** 2 / 6.0
    if max(error, pair_error) <= SUFFICIENT:
        return near, DifferenceStep(h, float(max(error, pair_error)), 1)
    far, _ = yield from difference_pair(line, SECOND_STEP * close)
    third = _largest(near - far, scale) / ((SECOND_STEP**2 - 1.0) * close**2)
    h = _clipped(float(np.cbrt(level / (2.0 * third))) if third > 0.0 else LARGEST_STEP * size, size)
    step = DifferenceStep(h, float((third * h * h + level / h) / strength))
    ratios = [abs(float(np.log(h / c))) for c in (close, SECOND_STEP * close)]
    if min(ratios) < np.log(2.0):  # within a factor of two of the best step the error is within twice the least
        return (near if ratios[0] < ratios[1] else far), step
    return (yield from difference(line, step)), step


def _over_steps(line: ParameterRuns[Run], size: float) -> Differences[Run, tuple[Array, DifferenceStep]]:
    """Return the derivative and the step for later where a short step changes nothing: over the longest one.

    A simulator of fixed steps may answer in jumps, between which all is the same; one that does not answer at all has 0.
    """
    h = LARGEST_STEP * size
    far, _ = yield from difference_pair(line, h)
    strength = _largest(far, scale := _ranges(line.middle))
    if strength == 0.0:
        return far, DifferenceStep(h, 0.0, 1)
    nearer, _ = yield from difference_pair(line, 0.5 * h)
    return far, DifferenceStep(h, _largest(far - nearer, scale) / strength)


def difference(line: ParameterRuns[Run], step: DifferenceStep) -> Differences[Run, Array]:
    """Return the derivative, (n, outputs), to the order of the step: from one run, or from two."""
    if step.sides == 2:
        return (yield from difference_pair(line, step.h))[0]
    side = step.h if line.value + step.h <= line.high else -step.h
    (beside,) = yield [line.at(line.value + side)]
    return np.asarray((beside - line.middle) / side)


def difference_pair(line: ParameterRuns[Run], h: float) -> Differences[Run, tuple[Array, Array]]:
    """Return first and second derivative from two more runs: on both sides, or on one where a bound is near."""
    value, middle = line.value, line.middle
    if value - h >= line.low and value + h <= line.high:
        up, down = yield [line.at(value + h), line.at(value - h)]
        return np.asarray((up - down) / (2.0 * h)), np.asarray((up - 2.0 * middle + down) / h**2)
    side = h if value + 2.0 * h <= line.high else -h
    one, two = yield [line.at(value + side), line.at(value + 2.0 * side)]
    first = (-3.0 * middle + 4.0 * one - two) / (2.0 * side)
    return np.asarray(first), np.asarray((middle - 2.0 * one + two) / side**2)


def extrapolated_difference(line: ParameterRuns[Run], h: float) -> Differences[Run, Array]:
    """Return the derivative from pairs at h and at half of it, whose errors of second order cancel."""
    coarse, _ = yield from difference_pair(line, h)
    fine, _ = yield from difference_pair(line, 0.5 * h)
    return np.asarray((4.0 * fine - coarse) / 3.0)


def _clipped(h: float, size: float) -> float:
    return float(np.clip(h, LEAST_STEP * size, LARGEST_STEP * size))


def _ranges(outputs: Array) -> Array:
    """Return the range of each output, (outputs,), or its size where it is constant, or 1."""
    spread = np.ptp(outputs, axis=0)
    size = np.abs(outputs).max(axis=0, initial=0.0)
    return np.where(spread > 1e-9 * size, spread, np.where(size > 0.0, size, 1.0))


def _largest(change: Array, scale: Array) -> float:
    """Return the root mean square over rows of the output that changes most, in its range."""
    return float(rms(change / scale).max()) if change.size else 0.0


def rms(rows: Array) -> Array:
    """Return the root mean square over rows, (outputs,)."""
    return np.asarray(np.sqrt(np.mean(rows**2, axis=0)))
