"""Combinations of parameters that are seen, found from the rows at several points, and put in words.

A product a**i b**j is seen where the exponents, as a row over the logarithms, are among the rows at every point; a sum
where its coefficients are. What neither finds is looked for among polynomials of degree 2.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import combinations, combinations_with_replacement

import numpy as np

from hvdc_ident.sensitivity.points import Rows
from hvdc_ident.sensitivity.prime_field import Array, PrimeField, as_fraction, null_space

MOST = 2000  # subsets tried when a simpler basis is looked for
Exponents = tuple[int, ...]


@dataclass(frozen=True)
class Invariant:
    """A sum of terms, each a coefficient and the exponents of the members."""

    terms: tuple[tuple[Fraction, Exponents], ...]

    @property
    def cost(self) -> tuple[int, ...]:
        """Simpler comes first; among equals the one whose members are listed last."""
        used = [k for k in range(len(self.terms[0][1])) if any(e[k] for _, e in self.terms)]
        size = sum(sum(map(abs, e)) for _, e in self.terms) + sum(abs(c.numerator) + c.denominator - 2 for c, _ in self.terms)
        negative = sum(x < 0 for _, e in self.terms for x in e) + sum(c < 0 for c, _ in self.terms)
        return (size + len(self.terms) - 1, negative, *(-k for k in reversed(used)))

    def gradient(self, theta: Sequence[int], p: int) -> list[int]:
        """Its derivatives by the members modulo p."""
        inverses = [pow(int(t), -1, p) for t in theta]
        result = [0] * len(theta)
        for c, e in self.terms:
            value = c.numerator * pow(c.denominator, -1, p) % p
            for t, i, x in zip(theta, inverses, e, strict=True):
                value = value * pow(int(t) if x > 0 else i, abs(x), p) % p
            for k, x in enumerate(e):
                result[k] = (result[k] + value * x * inverses[k]) % p
        return result

    def slopes(self, theta: Sequence[float]) -> list[float]:
        """Its derivatives by the members."""
        result = [0.0] * len(theta)
        for c, e in self.terms:
            for k, x in enumerate(e):
                if x:
                    rest = [t ** (y - (j == k)) for j, (t, y) in enumerate(zip(theta, e, strict=True)) if y - (j == k)]
                    result[k] += float(c) * x * math.prod(rest)
        return result

    def text(self, names: Sequence[str]) -> str:
        """The invariant as an engineer writes it: b*kp, k2/k6, a01 + a12 + a21."""
        parts: list[str] = []
        for c, e in self.terms:
            top = "*".join(_power(n, x) for n, x in zip(names, e, strict=True) if x > 0)
            below = [_power(n, -x) for n, x in zip(names, e, strict=True) if x < 0]
            bottom = "*".join(below) if len(below) < 2 else f"({'*'.join(below)})"
            size = "" if abs(c) == 1 else f"{abs(c)}*" if c.denominator == 1 else f"({abs(c)})*"
            body = size + (top or "1") + (f"/{bottom}" if bottom else "")
            parts.append((f" {'-' if c < 0 else '+'} " if parts else "-" if c < 0 else "") + body)
        return "".join(parts)


def _power(name: str, exponent: int) -> str:
    return name if exponent == 1 else f"{name}**{exponent}"


def components(null: Array) -> list[tuple[int, ...]]:
    """The parameters that null directions tie together, group by group: columns joined by a common row."""
    groups: list[set[int]] = []
    for row in null:
        merged = {int(k) for k in np.flatnonzero(row)}
        apart = [g for g in groups if not g & merged]
        for g in groups:
            if g & merged:
                merged |= g
        groups = [*apart, merged]
    return sorted(tuple(sorted(g)) for g in groups if g)


def nulls(rows: Rows) -> Array:
    """The null directions of the rows at a point of a prime field."""
    return null_space(rows.matrix, rows.pivots, len(rows.theta), rows.ring.p)


def invariants(points: Sequence[Rows], members: Sequence[int]) -> tuple[Invariant, ...] | None:
    """Independent combinations of the members that hold all that is seen of them; None where they are not found.

    points: rows at points of one prime field, more than there are unknown coefficients.
    """
    p, last = points[0].ring.p, points[-1]
    theta = [int(last.theta[k]) for k in members]
    directions = [nulls(r)[:, members] for r in points]
    directions = [d[np.any(d, axis=1)] for d in directions]
    needed = len(members) - len(directions[-1])
    chosen: list[Invariant] = []
    for candidates in (_products, _sums, _polynomials):
        found = sorted(candidates(points, members, directions), key=lambda i: i.cost)
        chosen = _independent([*chosen, *found], theta, p)
        if len(chosen) == needed:
            return tuple(sorted(chosen, key=lambda i: i.cost[:1] + tuple(reversed([-c for c in i.cost[2:]]))))
    return None


def _independent(found: Iterable[Invariant], theta: Sequence[int], p: int) -> list[Invariant]:
    chosen: list[Invariant] = []
    gradients: list[list[int]] = []
    for i in found:
        rank = len(PrimeField(p).rref(np.array([*gradients, i.gradient(theta, p)]))[1])
        if rank > len(gradients):
            chosen.append(i)
            gradients.append(i.gradient(theta, p))
    return chosen


def _products(points: Sequence[Rows], members: Sequence[int], directions: Sequence[Array]) -> list[Invariant]:
    p = points[0].ring.p
    stacked = []
    for r, d in zip(points, directions, strict=True):
        inverse = np.array([pow(int(r.theta[k]), -1, p) for k in members], np.int64)
        stacked.append(d * inverse % p)
    vectors = _constant(np.concatenate(stacked), p)
    return [Invariant(((Fraction(1), e),)) for e in vectors]


def _sums(points: Sequence[Rows], members: Sequence[int], directions: Sequence[Array]) -> list[Invariant]:
    p, n = points[0].ring.p, len(members)
    units = [tuple(int(j == k) for j in range(n)) for k in range(n)]
    return [_sum_of(units, v) for v in _constant(np.concatenate(directions), p)]


def _polynomials(points: Sequence[Rows], members: Sequence[int], directions: Sequence[Array]) -> list[Invariant]:
    p, n = points[0].ring.p, len(members)
    sets = [*combinations_with_replacement(range(n), 1), *combinations_with_replacement(range(n), 2)]
    terms = [tuple(s.count(k) for k in range(n)) for s in sets]
    if len(terms) > sum(len(d) for d in directions) - 2:
        return []
    stacked = []
    for r, d in zip(points, directions, strict=True):
        theta = [int(r.theta[k]) for k in members]
        slopes = np.array([Invariant(((Fraction(1), e),)).gradient(theta, p) for e in terms])
        stacked.append(PrimeField(p).product(d, slopes.T))
    return [_sum_of(terms, v) for v in _constant(np.concatenate(stacked), p)]


def _sum_of(terms: Sequence[Exponents], vector: Exponents) -> Invariant:
    return Invariant(tuple((Fraction(c), e) for e, c in zip(terms, vector, strict=True) if c))


def _constant(conditions: Array, p: int) -> list[Exponents]:
    """Simple integer vectors that every condition sends to 0: those of fewest entries in their space."""
    field = PrimeField(p)
    n = conditions.shape[1]
    reduced, pivots = field.rref(conditions)
    if len(pivots) == n:
        return []
    space = field.rref(null_space(reduced, pivots, n, p))[0]
    found = [_whole(row, p) for row in space]
    k = len(space)
    if k > 1 and math.comb(n, k - 1) <= MOST:
        for zero in combinations(range(n), k - 1):
            part, where = field.rref(space[:, zero].T)
            for row in null_space(part, where, k, p) if len(where) == k - 1 else ():
                found.append(_whole(field.product(row[None], space)[0], p))
    return sorted({v for v in found if v is not None})


def _whole(row: Array, p: int) -> Exponents | None:
    """The row times what makes it small whole numbers with a positive first entry; None where they are not small."""
    lead = int(row[np.flatnonzero(row)[0]])
    parts = [as_fraction(int(x) * pow(lead, -1, p) % p, p) for x in row]
    if any(x is None for x in parts):
        return None
    fractions = [x for x in parts if x is not None]
    scale = math.lcm(*(x.denominator for x in fractions))
    whole = [int(x * scale) for x in fractions]
    whole = [x // math.gcd(*whole) for x in whole]
    return tuple(whole) if max(map(abs, whole)) <= 12 else None
