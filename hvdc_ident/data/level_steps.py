"""Steps of the level of a record at rest: a tap that moves or a range that is switched is no noise."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from hvdc_ident.data.trajectory import Array

UNLIKELY = 1e-2
"""Chance that a step is seen in noise."""

_BLOCKS = 1000  # means of neighbouring rows that a longer record is looked at by
_COEFFICIENTS = np.tanh(np.linspace(0.0, 2.5, 11))  # lag-1 coefficients of noise, to 0.987
_WHITE = 0.0, 0.1, 0.3, 1.0, 3.0, 10.0  # variance of white noise beside it, to its innovations

_NONE = 1e-300  # a sum of squares that counts as 0, and has a logarithm


def without_steps(values: Array, floor: float = 0.0) -> Array:
    """Return the values, (n,) less their line, less the steps of their level and the line about those.

    floor: the least standard deviation there can be. Two explanations are compared by their likelihoods, whatever the colour: noise,
    white and of first order together, about a line; and such noise about a line with a step at the row that suits best. There is one
    where it is as much likelier as noise makes it in one record of a hundred: by a quantile of Student's t, for as many places as there
    are rows.
    """
    n = values.size
    steps = float(np.sum(np.diff(values) ** 2)) / 2.0
    # Of white noise the squared steps from row to row are twice its variance, within their error: it holds no steps of the level.
    if n < 4 or not steps or float(values @ values) < (1.0 + 2.0 / math.sqrt(n)) * steps:
        return values
    width = -(-n // _BLOCKS)
    count = n // width
    means = values[: count * width].reshape(count, width).mean(axis=1)
    places: list[int] = []
    while len(places) < count // 4:
        place = _next_step(means, places, floor / math.sqrt(width))
        if place is None:
            break
        places.append(place)
    if not places:
        return values
    rows = [_refined(values, p * width, width) for p in places]
    columns = _columns(n, rows)
    return np.asarray(values - columns @ np.linalg.lstsq(columns, values)[0])


def _columns(count: int, places: Sequence[int]) -> Array:
    """Return (count, 2 + k) a level, a slope, and steps at the places."""
    rows = np.arange(count)
    return np.column_stack([np.ones(count), rows / count - 0.5, *(rows >= p for p in places)]).astype(float)


def _refined(values: Array, place: int, width: int) -> int:
    """Return the row of a step within a block or two, where the squares about the two levels are least."""
    if width == 1:
        return place
    first, last = max(place - 2 * width, 0), min(place + 2 * width, values.size)
    own = values[first:last]
    squares = [own[:k].var() * k + own[k:].var() * (own.size - k) for k in range(1, own.size)]
    return first + 1 + int(np.argmin(squares))


def _next_step(values: Array, places: Sequence[int], floor: float) -> int | None:
    """Return the row of the step that is seen beside those at the places; None for none."""
    from scipy.special import stdtrit  # a simulation does without it

    n = values.size
    known = _columns(n, places)
    none, best, row = -math.inf, -math.inf, 0
    for rho in _COEFFICIENTS.tolist():
        for white in _WHITE if rho else (0.0,):
            factor = _factor(n, rho, white)
            rows = _whitened(np.column_stack([known, values]), rho, factor)
            basis = np.linalg.qr(rows[:, :-1])[0]
            rest = rows[:, -1] - basis @ (basis.T @ rows[:, -1])
            least = n * (floor**2) * (1.0 + rho**2 + white) / (1.0 + white)
            power = float(rest @ rest) + least
            size = -float(np.sum(np.log(factor[0])))
            none = max(none, size - 0.5 * n * math.log(power))
            across = _against_steps(np.column_stack([rest, basis]), rho, factor)
            norms = _norms(n, rho, factor) - np.sum(across[1:, 1:] ** 2, axis=1)
            taken = across[1:, 0] ** 2 / np.where(norms > 1e-9, norms, np.inf)
            place = int(np.argmax(taken))
            likely = size - 0.5 * n * math.log(max(power - float(taken[place]), least, _NONE))
            if likely > best:
                best, row = likely, place + 1
    freedom = max(n - known.shape[1] - 1, 1)
    t = float(stdtrit(freedom, 1.0 - 0.5 * UNLIKELY / n))
    return row if 2.0 * (best - none) > n * math.log1p(t * t / freedom) else None


def _factor(count: int, rho: float, white: float) -> Array:
    """Return (2, count) the Cholesky factor of what noise of first order and white noise leave of their steps from row to row."""
    from scipy.linalg import cholesky_banded  # a simulation does without it

    cover = np.empty((2, count))
    cover[0], cover[1] = 1.0 + white * (1.0 + rho**2), -rho * white
    cover[0, 0] = 1.0 / (1.0 - rho**2) + white
    return np.asarray(cholesky_banded(cover, lower=True, check_finite=False))


def _whitened(rows: Array, rho: float, factor: Array) -> Array:
    """Return rows, (n, k), as white noise."""
    from scipy.linalg import solve_banded  # a simulation does without it

    steps = rows.copy()
    steps[1:] -= rho * rows[:-1]
    return np.asarray(solve_banded((1, 0), factor, steps, check_finite=False))


def _against_steps(rows: Array, rho: float, factor: Array) -> Array:
    """Return (n, k) the products of whitened rows with a whitened step at each row."""
    from scipy.linalg import solve_banded  # a simulation does without it

    turned = np.zeros_like(factor)
    turned[1], turned[0, 1:] = factor[0], factor[1, :-1]
    back = solve_banded((0, 1), turned, rows, check_finite=False)
    after = np.cumsum(back[::-1], axis=0)[::-1]
    return np.asarray(rho * back + (1.0 - rho) * after)


def _norms(count: int, rho: float, factor: Array) -> Array:
    """Return (n - 1,) the squares of whitened steps at the rows from the second on: those of a long record, cut."""
    step = _whitened(np.ones((count, 1)), rho, np.repeat(factor[:, -2:-1], count, axis=1))[:, 0]
    return np.asarray(np.cumsum(step**2)[:-1][::-1])
