"""Exact arithmetic modulo a prime near 2**31: arrays, square roots, row reduction and roots of polynomials.

A product of two residues fits a 64-bit integer, so numpy does the work.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from random import Random
from typing import Any, TypeAlias

import numpy as np

Array: TypeAlias = np.ndarray[Any, Any]
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


# --- polynomials in one unknown, as coefficients from the constant upwards ---


def _trim(a: Polynomial) -> Polynomial:
    while a and a[-1] == 0:
        a.pop()
    return a


def _times(a: Polynomial, b: Polynomial, p: int) -> Polynomial:
    result = [0] * max(len(a) + len(b) - 1, 0)
    for i, x in enumerate(a):
        for j, y in enumerate(b):
            result[i + j] = (result[i + j] + x * y) % p
    return _trim(result)


def _minus(a: Polynomial, b: Polynomial, p: int) -> Polynomial:
    n = max(len(a), len(b))
    return _trim([((a[i] if i < len(a) else 0) - (b[i] if i < len(b) else 0)) % p for i in range(n)])


def _divide(a: Polynomial, b: Polynomial, p: int) -> tuple[Polynomial, Polynomial]:
    rest, quotient = list(a), [0] * max(len(a) - len(b) + 1, 0)
    lead = pow(b[-1], -1, p)
    while len(rest) >= len(b):
        shift, factor = len(rest) - len(b), rest[-1] * lead % p
        quotient[shift] = factor
        for i, x in enumerate(b):
            rest[shift + i] = (rest[shift + i] - factor * x) % p
        _trim(rest)
    return _trim(quotient), rest


def _gcd(a: Polynomial, b: Polynomial, p: int) -> Polynomial:
    while b:
        a, b = b, _divide(a, b, p)[1]
    return a


def _power(a: Polynomial, n: int, modulus: Polynomial, p: int) -> Polynomial:
    result: Polynomial = [1]
    while n:
        if n & 1:
            result = _divide(_times(result, a, p), modulus, p)[1]
        n >>= 1
        a = _divide(_times(a, a, p), modulus, p)[1]
    return result


def roots(a: Polynomial, p: int, random: Random) -> list[int]:
    """The distinct roots of a polynomial modulo p (Cantor and Zassenhaus)."""
    a = _trim([x % p for x in a])
    if len(a) < 2:
        return []
    if len(a) > 2:
        a = _gcd(a, _minus(_power([0, 1], p, a, p), [0, 1], p), p)
    stack, found = [a], []
    while stack:
        f = stack.pop()
        if len(f) < 2:
            continue
        if len(f) == 2:
            found.append(-f[0] * pow(f[1], -1, p) % p)
            continue
        half = _gcd(f, _minus(_power([random.randrange(p), 1], (p - 1) // 2, f, p), [1], p), p)
        stack += [half, _divide(f, half, p)[0]] if 1 < len(half) < len(f) else [f]
    return sorted(found)


def numerator(function: Callable[[int], int], p: int, random: Random, samples: int = 40) -> Polynomial:
    """The numerator of a rational function known by its values (Cauchy interpolation); NoSuchNumber above the degree bound."""
    points: list[int] = []
    values: list[int] = []
    for _ in range(2 * samples):
        x = random.randrange(p)
        try:
            y = function(x)
        except NoSuchNumber:
            continue
        if x not in points:
            points.append(x)
            values.append(y)
        if len(points) == samples + 2:
            break
    else:
        raise NoSuchNumber("the function has too few values")
    modulus: Polynomial = [1]
    interpolant: Polynomial = []
    for x, y in zip(points[:samples], values[:samples], strict=True):
        step = (y - _at(interpolant, x, p)) * pow(_at(modulus, x, p), -1, p) % p
        interpolant = _minus(interpolant, [-step * c % p for c in modulus], p)
        modulus = _times(modulus, [-x % p, 1], p)
    a, b = modulus, interpolant
    s, t = [], [1]
    while len(b) > samples // 2:
        q, rest = _divide(a, b, p)
        a, b, s, t = b, rest, t, _minus(s, _times(q, t, p), p)
    for x, y in zip(points[samples:], values[samples:], strict=True):
        if (_at(b, x, p) - y * _at(t, x, p)) % p:
            raise NoSuchNumber("the degree is too high")
    return b


def _at(a: Polynomial, x: int, p: int) -> int:
    value = 0
    for c in reversed(a):
        value = (value * x + c) % p
    return value
