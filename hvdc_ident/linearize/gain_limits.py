"""Factors on a loop's gain at which its closed loop loses stability, and the frequencies of its crossings.

At such a factor k a root of 1 + k L lies on the imaginary axis, so that L = -1/k somewhere on it: at 0 and at infinity too.
Which of these crossings loses stability is decided by counting the roots on either side of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.optimize import brentq

from hvdc_ident.linearize.characteristic import spectral_radius
from hvdc_ident.linearize.stability import Characteristic, Stability, stability
from hvdc_ident.linearize.system import Array
from hvdc_ident.linearize.zeros import zeros


@dataclass(frozen=True)
class Crossing:
    """A frequency in rad/s and the margin there; without limit, both are infinite."""

    omega: float = math.inf
    value: float = math.inf


NONE = Crossing(float("nan"), float("nan"))
"""The margin of a loop that is not stable."""
BESIDE = 1e-4
"""Share of a factor's logarithm by which the roots are counted beside it."""
FAR = (3.0, 30.0, 1e3)
"""Factors beyond the last crossing, either way, at which the roots are counted once more."""
UNLIMITED = 1e9
"""Factors beyond this, and below its inverse, are taken for none: L is then below the rounding errors of its terms."""


@dataclass(frozen=True, eq=False)
class Closing:
    """One of several loops of an open equation, closed by negative feedback with a factor on its gain, the others with 1."""

    open: Characteristic
    place: int

    def at(self, factor: float) -> Stability:
        """Return the stability of the closed loops with a factor on the gain of this one."""
        return stability(self._closed(factor))

    def _closed(self, factor: float) -> Characteristic:
        gains = np.ones(self.open.through.shape[0])
        gains[self.place] = factor
        return self.open.closed(gains)

    def stable(self, factor: float) -> bool:
        """True where the closed loops are certainly stable with this factor."""
        try:
            return self._closed(factor).is_stable()
        except np.linalg.LinAlgError:  # the direct part is -1
            return False

    def ends(self) -> list[Crossing]:
        """Return the crossings at 0 and at infinity, and where a gain around delays alone reaches 1; loops that are stable."""
        closed = self._closed(1.0)
        crossings = []
        for omega, complementary in ((0.0, closed.response(np.zeros(1))[0]), (float("inf"), closed.through)):
            t = float(complementary[self.place, self.place].real)
            factor = (t - 1.0) / t if t else float("inf")  # -1/L with L = T/(1 - T)
            if 1.0 / UNLIMITED < factor < UNLIMITED:
                crossings.append(Crossing(omega, factor))
        return crossings + self._neutral()

    def _neutral(self) -> list[Crossing]:
        n = self.open.nx
        if not (self.open.given[n:, self.place].any() and self.open.read[self.place, n:].any()):
            return []

        def excess(log: float) -> float:
            return spectral_radius(self._closed(float(np.exp(log))).whole.direct) - 1.0

        crossings = []
        for side in (1.0, -1.0):
            logs = side * np.linspace(0.0, np.log(UNLIMITED), 200)
            for low, high in pairwise(logs):
                if excess(low) < 0.0 <= excess(high):
                    crossings.append(Crossing(float("inf"), float(np.exp(brentq(excess, low, high, xtol=1e-14)))))
                    break
        return crossings

    def limit(self, crossings: Sequence[Crossing], side: int) -> Crossing:
        """Return the crossing at which stability is lost first when the gain rises (side 1) or falls (side -1).

        crossings: those of the loop, at any factor. Without one, a factor infinite or 0. Where the count of the roots
        shows that a crossing was missed, the factor is found by bisection on the count.
        """
        logs = [(side * float(np.log(c.value)), c) for c in crossings if 1.0 / UNLIMITED < c.value < UNLIMITED]
        ahead = sorted((x for x in logs if x[0] > 0.0), key=lambda x: x[0])
        passed = 0.0
        for k, (log, crossing) in enumerate(ahead):
            before = log - BESIDE * min(log, log - passed)
            if not self.stable(float(np.exp(side * before))):
                return self._bisected(passed, before, side)
            after = log * (1.0 + BESIDE)
            if k + 1 < len(ahead):
                after = min(after, 0.5 * (log + ahead[k + 1][0]))
            if not self.stable(float(np.exp(side * after))):
                return crossing
            passed = after
        for factor in FAR:
            log = passed + float(np.log(factor))
            judged = self.at(float(np.exp(side * log)))
            if judged.verdict == "not decided":
                break
            if judged.verdict != "stable":
                return self._bisected(passed, log, side)
        return Crossing(float("inf"), float("inf") if side > 0 else 0.0)

    def _bisected(self, low: float, high: float, side: int) -> Crossing:
        """Return the limit between a factor with a stable closed loop and one without, given by their logarithms."""
        for _ in range(60):
            middle = 0.5 * (low + high)
            if middle in (low, high):
                break
            if self.stable(float(np.exp(side * middle))):
                low = middle
            else:
                high = middle
        root = self.at(float(np.exp(side * high))).rightmost
        return Crossing(float("inf") if root is None else abs(root.imag), float(np.exp(side * high)))


# --- where to look for crossings ---


def crossing_frequencies(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Return the frequencies, rad/s, near which one channel without delays is real or has a gain of 1.

    They are the zeros on the imaginary axis of L(s) - L(-s) and of 1 - L(s) L(-s).
    """
    n = a.shape[0]
    if n == 0:
        return np.zeros(0)
    none = np.zeros((n, n))
    odd = zeros(
        np.block([[a, none], [none, -a]]), np.concatenate([b, b]), np.concatenate([c, c], axis=1), np.zeros((1, 1))
    )
    even = zeros(
        np.block([[a, -b @ c], [none, -a]]),
        np.concatenate([b @ d, b]),
        np.concatenate([-c, d @ c], axis=1),
        1.0 - d @ d,
    )
    roots = np.concatenate([odd, even])
    roots = roots[np.isfinite(roots)]
    return np.unique(np.abs(roots[np.abs(roots.real) < 1e-3 * np.abs(roots)].imag))


TURN = 0.3
"""Largest change of a curve's logarithm between two frequencies of a refined grid: gain by 35 %, phase by 17 degrees."""
FLOOR = 1e-3
"""Gain below which a curve need not be followed: it crosses -1 at factors above 1000 only."""
LOCUS_POINTS = 200_000


def refined(values_at: Callable[[Array], Array], grid: Array, values: Array) -> tuple[Array, Array]:
    """Return frequencies and values of a curve, with points added until it moves little from each to the next."""
    while grid.size < LOCUS_POINTS:
        with np.errstate(all="ignore"):
            moved = np.abs(np.log(values[1:] / values[:-1]))
        wide = (moved > TURN) & (np.maximum(np.abs(values[1:]), np.abs(values[:-1])) > FLOOR)
        wide &= np.diff(grid) > 1e-9 * grid[1:]
        if not wide.any():
            break
        middle = 0.5 * (grid[:-1][wide] + grid[1:][wide])
        order = np.argsort(np.concatenate([grid, middle]), kind="stable")
        grid, values = np.concatenate([grid, middle])[order], np.concatenate([values, values_at(middle)])[order]
    return grid, values
