"""Rings that series and ranks are computed in: a prime field and decimals of 120 digits.

The prime is near 2**31: a product of two residues fits a 64-bit integer, so numpy does the work. The decimals serve models
whose functions or operating points have no exact counterpart.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from decimal import Context, Decimal, localcontext
from fractions import Fraction
from random import Random
from typing import Any, Protocol, TypeAlias

import mpmath  # type: ignore[import-untyped]
import numpy as np
from sympy import ZZ
from sympy.polys.galoistools import (
    gf_add,
    gf_div,
    gf_edf_zassenhaus,
    gf_eval,
    gf_gcd,
    gf_monic,
    gf_mul,
    gf_mul_ground,
    gf_pow_mod,
    gf_sub,
    gf_trunc,
)

Array: TypeAlias = np.ndarray[Any, Any]


class OutOfTime(Exception):
    """The time limit was reached."""


class Ring(Protocol):
    """Numbers a series can be made of."""

    @property
    def p(self) -> int: ...
    def zeros(self, *shape: int) -> Array: ...
    def reduce(self, a: Any) -> Any: ...
    def number(self, value: Fraction) -> Any: ...
    def inverse(self, a: Any) -> Any: ...
    def sqrt(self, a: Any) -> Any: ...
    def transcendental(self, name: str, value: Any, random: Random) -> Any: ...
    def rref(self, matrix: Array) -> tuple[Array, list[int]]: ...
    def fraction(self, a: Any) -> Fraction | None: ...
    def product(self, a: Array, b: Array) -> Array: ...


Polynomial: TypeAlias = list[int]

PRIMES = (2147483647, 2147483587, 2147483579, 2147483563)  # each 3 modulo 4: square roots are one power


class NoSuchNumber(ArithmeticError):
    """A division by zero or a root that the ring lacks: another random point may have it."""


class NotRational(ArithmeticError):
    """An expression that has no exact counterpart in the ring."""


@dataclass(frozen=True)
class PrimeField:
    """The integers modulo a prime p = 3 (mod 4), p < 2**31."""

    p: int = PRIMES[0]

    def zeros(self, *shape: int) -> Array:
        """An array of zeros."""
        return np.zeros(shape, np.int64)

    def reduce(self, a: Any) -> Any:
        """The number, or the array, with every entry in 0..p-1."""
        return a % self.p

    def number(self, value: Fraction) -> int:
        """The residue of a fraction."""
        return value.numerator % self.p * self.inverse(value.denominator) % self.p

    def inverse(self, a: int) -> int:
        """1/a; NoSuchNumber for 0."""
        if int(a) % self.p == 0:
            raise NoSuchNumber("division by zero")
        return pow(int(a), -1, self.p)

    def sqrt(self, a: int) -> int:
        """One of the two roots of a; NoSuchNumber where a is no square or 0."""
        a = int(a) % self.p
        root = pow(a, (self.p + 1) // 4, self.p)
        if a == 0 or root * root % self.p != a:
            raise NoSuchNumber("no square root")
        return root

    def random(self, random: Random) -> int:
        """A number that is neither 0 nor 1 nor -1."""
        return random.randrange(2, self.p - 1)

    def transcendental(self, name: str, value: int, random: Random) -> int:
        """The value of a function that no polynomial gives: exact at 0, else random, for it is independent of its argument."""
        if int(value) % self.p == 0:
            if name == "log":
                raise NoSuchNumber("logarithm of zero")
            return int(name in ("exp", "cos"))
        return self.random(random)

    def rref(self, matrix: Array) -> tuple[Array, list[int]]:
        """The reduced row echelon form without its zero rows, and its pivots' columns."""
        a = np.array(matrix, np.int64) % self.p
        pivots: list[int] = []
        for column in range(a.shape[1]):
            row = len(pivots)
            below = np.flatnonzero(a[row:, column])
            if not below.size:
                continue
            k = row + int(below[0])
            a[[row, k]] = a[[k, row]]
            a[row] = a[row] * self.inverse(int(a[row, column])) % self.p
            others = np.flatnonzero(a[:, column])
            others = others[others != row]
            a[others] = (a[others] - a[others, column][:, None] * a[row] % self.p) % self.p
            pivots.append(column)
            if len(pivots) == len(a):
                break
        return a[: len(pivots)], pivots

    def fraction(self, a: int, bound: int = 64) -> Fraction | None:
        """The fraction of terms up to the bound that a residue stands for, or None."""
        high, low, s, t = self.p, int(a) % self.p, 0, 1
        while low > bound:
            q = high // low
            high, low, s, t = low, high - q * low, t, s - q * t
        return Fraction(low, t) if t and abs(t) <= bound else None

    def product(self, a: Array, b: Array) -> Array:
        """The matrix product."""
        result = self.zeros(a.shape[0], b.shape[1])
        for k in range(a.shape[1]):
            result = (result + a[:, k, None] * b[None, k] % self.p) % self.p
        return result


# --- polynomials in one unknown, as coefficients from the constant upwards; sympy has them from the highest downwards ---


def roots(a: Polynomial, p: int) -> list[int]:
    """Return the distinct roots of a polynomial modulo p (Cantor and Zassenhaus)."""
    f = gf_trunc(a[::-1], p)
    if len(f) < 2:
        return []
    all_elements = gf_sub(gf_pow_mod([1, 0], p, f, p, ZZ), [1, 0], p, ZZ)  # x^p - x modulo f
    linear_part = gf_gcd(f, all_elements, p, ZZ) if len(f) > 2 else gf_monic(f, p, ZZ)[1]
    return (
        sorted(int(-factor[1]) % p for factor in gf_edf_zassenhaus(linear_part, 1, p, ZZ)) if linear_part != [1] else []
    )


def numerator(function: Callable[[int], int], p: int, random: Random, samples: int = 40) -> Polynomial:
    """Return the numerator of a rational function known by its values (Cauchy interpolation).

    Raises NoSuchNumber where the degree is above samples/2.
    """
    points: dict[int, int] = {}
    for _ in range(2 * samples):
        x = random.randrange(p)
        try:
            points.setdefault(x, function(x))
        except NoSuchNumber:
            continue
        if len(points) == samples + 2:
            break
    else:
        raise NoSuchNumber("the function has too few values")
    modulus: Polynomial = [1]
    interpolant: Polynomial = []
    for x, y in [*points.items()][:samples]:
        step = (y - gf_eval(interpolant, x, p, ZZ)) * pow(int(gf_eval(modulus, x, p, ZZ)), -1, p) % p
        interpolant = gf_add(interpolant, gf_mul_ground(modulus, step, p, ZZ), p, ZZ)
        modulus = gf_mul(modulus, [1, -x % p], p, ZZ)
    a, b = modulus, interpolant
    s, t = [], [1]
    while len(b) > samples // 2:
        quotient, rest = gf_div(a, b, p, ZZ)
        a, b, s, t = b, rest, t, gf_sub(s, gf_mul(quotient, t, p, ZZ), p, ZZ)
    for x, y in [*points.items()][samples:]:
        if (gf_eval(b, x, p, ZZ) - y * gf_eval(t, x, p, ZZ)) % p:
            raise NoSuchNumber("the degree is too high")
    return [int(c) for c in reversed(b)]


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
