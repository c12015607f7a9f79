"""Roots of a model with delays along a parameter, and the values at which their number right of the axis changes."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from scipy.optimize import linear_sum_assignment

from hvdc_ident.linearize.stability import Characteristic
from hvdc_ident.linearize.system import Array

At = Callable[[float], Characteristic]
"""The characteristic equation at a value of the parameter."""


def followed(at: At, values: Array) -> tuple[Array, tuple[float | None, ...]]:
    """Return (points, modes) roots, each column one root throughout, and at each point how many are unstable.

    There are as many columns as the fewest rightmost roots found at one of the points, at least one for each state.
    """
    found = [at(float(v)).roots for v in values]
    count = min(r.values.size for r in found)
    rows: list[Array] = []
    for r in found:
        roots = r.values
        if rows:
            before = rows[-1]
            size = np.maximum(np.maximum(np.abs(before)[:, None], np.abs(roots)[None, :]), 1e-300)
            roots = roots[linear_sum_assignment(np.abs(before[:, None] - roots[None, :]) / size)[1]]
        rows.append(roots[:count])
    return np.array(rows).reshape(len(values), count), tuple(r.unstable for r in found)


def crossings(at: At, values: Array, unstable: tuple[float | None, ...]) -> Iterator[tuple[float, complex, bool]]:
    """Return (value, root, lost) where the number of unstable roots changes, by bisection on that number.

    Between values where it is unknown or infinite nothing is looked for.
    """
    for low, high, first, last in zip(values[:-1], values[1:], unstable[:-1], unstable[1:], strict=True):
        if first is None or last is None or np.isinf(first) or np.isinf(last):
            continue
        a, own = float(low), first
        while own != last:
            b, other = float(high), last
            while abs(b - a) > 1e-12 * max(abs(a), abs(b)):
                middle = 0.5 * (a + b)
                if middle in (a, b):
                    break
                count = at(middle).counts()[0]
                if count == own:
                    a = middle
                else:
                    b, other = middle, last if count is None else count
            roots = at(b).roots.values
            upper = roots[roots.imag >= 0]
            yield 0.5 * (a + b), complex(upper[np.argmin(np.abs(upper.real))]), other > own
            a, own = b, other
