"""Arithmetic with 120 decimals: the ring for models whose functions or operating points have no exact counterpart."""

from __future__ import annotations

from decimal import Context, Decimal, localcontext
from fractions import Fraction
from random import Random
from typing import Any, TypeAlias

import mpmath  # type: ignore[import-untyped]
import numpy as np

from hvdc_ident.sensitivity.rank.prime_field import NoSuchNumber

Array: TypeAlias = np.ndarray[Any, Any]
DIGITS = 120
NOTHING = Decimal("1e-50")  # a pivot below this share of its scaled row is rounding
ROUNDING = Decimal("1e-75")  # and rounding is below this: what lies between is neither


def context() -> Any:
    """A context manager in which decimals carry DIGITS digits."""
    return localcontext(Context(prec=DIGITS))


class HighPrecision:
    """Real numbers of DIGITS digits in object arrays; use it inside `context()`."""

    p = 0

    def zeros(self, *shape: int) -> Array:
        """An array of zeros."""
        result = np.empty(shape, object)
        result[...] = Decimal(0)
        return result

    def reduce(self, a: Any) -> Any:
        """The number or array itself."""
        return a

    def number(self, value: Fraction) -> Decimal:
        """The decimal of a fraction."""
        return Decimal(value.numerator) / Decimal(value.denominator)

    def inverse(self, a: Decimal) -> Decimal:
        """1/a; ArithmeticError for 0."""
        return Decimal(1) / a

    def sqrt(self, a: Decimal) -> Decimal:
        """The positive root; ArithmeticError below 0."""
        return a.sqrt()

    def transcendental(self, name: str, value: Decimal, random: Random) -> Decimal:
        """The value of an elementary function."""
        with mpmath.workdps(DIGITS + 5):
            return Decimal(mpmath.nstr(getattr(mpmath, name)(mpmath.mpf(str(value))), DIGITS))

    def rref(self, matrix: Array) -> tuple[Array, list[int]]:
        """The reduced row echelon form without its zero rows, and its pivots' columns; rows are scaled first."""
        a = np.array(matrix, object)
        sizes = np.abs(a).max(axis=1, initial=Decimal(0)) if a.size else np.zeros(len(a))
        a = a[[bool(s) for s in sizes]] / sizes[[bool(s) for s in sizes]][:, None]
        pivots: list[int] = []
        for column in range(matrix.shape[1]):
            row = len(pivots)
            if row == len(a):
                break
            k = row + int(np.argmax(np.abs(a[row:, column])))
            if abs(a[k, column]) < NOTHING:
                if abs(a[k, column]) > ROUNDING:
                    raise NoSuchNumber("the rank is not clear")
                continue
            a[[row, k]] = a[[k, row]]
            a[row] = a[row] / a[row, column]
            for other in range(len(a)):
                if other != row and a[other, column]:
                    a[other] = a[other] - a[other, column] * a[row]
                    a[other, column] = Decimal(0)
            pivots.append(column)
        result = a[: len(pivots)]
        result[np.abs(result) < NOTHING] = Decimal(0)
        return result, pivots

    def fraction(self, a: Decimal, bound: int = 64) -> Fraction | None:
        """The fraction of terms up to the bound that a number stands for, or None."""
        near = Fraction(a).limit_denominator(bound)
        return near if abs(near - Fraction(a)) < Fraction(1, 10**25) and abs(near.numerator) <= bound else None

    def product(self, a: Array, b: Array) -> Array:
        """The matrix product."""
        return a @ b if a.shape[1] else self.zeros(a.shape[0], b.shape[1])
