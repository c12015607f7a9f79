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
from typing import Any

import numpy as np

from hvdc_ident.sensitivity.structural.finite_field import Array, Ring
from hvdc_ident.sensitivity.structural.observability import PointRows
from hvdc_ident.text import listed


@dataclass(frozen=True)
class StructuralCombination:
    """Parameters of which only combinations are seen.

    members: their names. seen: the combinations that hold all that is seen of them; empty where none is simple, or where
    nothing is seen of them at all. words: the sentence for the report. free: how many of the members can be given any
    value, the others then following. directions: (free, members) null directions at the model's values, the largest entry
    1: of the relative changes where `relative`, else of the changes themselves; empty where they are not known.
    """

    members: tuple[str, ...]
    seen: tuple[str, ...]
    words: str
    free: int
    directions: tuple[tuple[float, ...], ...] = ()
    relative: bool = False

    def to_dict(self) -> dict[str, Any]:
        """The combination as plain values."""
        return {
            "members": list(self.members),
            "seen": list(self.seen),
            "words": self.words,
            "free": self.free,
            "directions": [list(d) for d in self.directions],
            "relative": self.relative,
        }


def tied(names: Sequence[str], free: int) -> str:
    """The plain sentence for parameters whose combinations have no simple form."""
    k = len(names) - free
    number = "one combination" if k == 1 else f"{k} combinations"
    return f"only {number} of {listed(names)} {'is' if k == 1 else 'are'} seen"


MOST = 2000  # subsets tried when a simpler basis is looked for
SPARE = 2  # conditions beyond the number of coefficients
LARGEST = 12  # the largest exponent or coefficient that counts as simple
Exponents = tuple[int, ...]


@dataclass(frozen=True)
class Invariant:
    """A sum of terms, each a coefficient and the exponents of the members."""

    terms: tuple[tuple[Fraction, Exponents], ...]

    @property
    def cost(self) -> tuple[int, ...]:
        """Simpler comes first; among equals the one whose members are listed last."""
        used = [k for k in range(len(self.terms[0][1])) if any(e[k] for _, e in self.terms)]
        size = sum(sum(map(abs, e)) for _, e in self.terms) + sum(
            abs(c.numerator) + c.denominator - 2 for c, _ in self.terms
        )
        negative = sum(x < 0 for _, e in self.terms for x in e) + sum(c < 0 for c, _ in self.terms)
        return (size + len(self.terms) - 1, negative, *(-k for k in reversed(used)))

    def gradient(self, theta: Sequence[Any], ring: Ring) -> list[Any]:
        """Its derivatives by the members, as numbers of the ring."""
        inverses = [ring.inverse(t) for t in theta]
        result = [ring.number(Fraction(0))] * len(theta)
        for c, e in self.terms:
            value = ring.number(c)
            for t, i, x in zip(theta, inverses, e, strict=True):
                for _ in range(abs(x)):
                    value = ring.reduce(value * (t if x > 0 else i))
            for k, x in enumerate(e):
                result[k] = ring.reduce(result[k] + ring.reduce(value * x) * inverses[k])
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


def nulls(rows: PointRows) -> Array:
    """A basis (rows) of the null directions at a point."""
    return _null_space(rows.ring, rows.matrix, rows.pivots, len(rows.theta))


def _null_space(ring: Ring, reduced: Array, pivots: Sequence[int], columns: int) -> Array:
    """A basis (rows) of what a reduced matrix sends to zero."""
    free = [c for c in range(columns) if c not in pivots]
    basis = ring.zeros(len(free), columns)
    for i, c in enumerate(free):
        basis[i, c] = ring.number(Fraction(1))
        for row, pivot in enumerate(pivots):
            basis[i, pivot] = ring.reduce(-reduced[row, c])
    return basis


def invariants(points: Sequence[PointRows], members: Sequence[int]) -> tuple[Invariant, ...] | None:
    """Independent combinations of the members that hold all that is seen of them; None where they are not found.

    points: rows at points of one ring; the more, the more kinds of combination can be told from chance.
    """
    ring, last = points[0].ring, points[-1]
    theta = [last.theta[k] for k in members]
    directions = [nulls(r)[:, list(members)] for r in points]
    directions = [d[np.any(d != 0, axis=1)] for d in directions]
    needed = len(members) - len(directions[-1])
    selected: list[Invariant] = []
    for candidates in (_products, _sums, _polynomials):
        found = sorted(candidates(points, members, directions), key=lambda i: i.cost)
        selected = _independent([*selected, *found], theta, ring)
        if len(selected) == needed:
            return tuple(sorted(selected, key=lambda i: (i.cost[0], *(-c for c in reversed(i.cost[2:])))))
    return None


def _independent(found: Iterable[Invariant], theta: Sequence[Any], ring: Ring) -> list[Invariant]:
    selected: list[Invariant] = []
    gradients: list[list[Any]] = []
    for i in found:
        row = i.gradient(theta, ring)
        if len(ring.rref(np.array([*gradients, row]))[1]) > len(gradients):
            selected.append(i)
            gradients.append(row)
    return selected


def _products(points: Sequence[PointRows], members: Sequence[int], directions: Sequence[Array]) -> list[Invariant]:
    ring, stacked = points[0].ring, []
    for r, d in zip(points, directions, strict=True):
        inverses = ring.zeros(len(members))
        inverses[:] = [ring.inverse(r.theta[k]) for k in members]
        stacked.append(ring.reduce(d * inverses))
    return [Invariant(((Fraction(1), e),)) for e in _constant(np.concatenate(stacked), ring)]


def _sums(points: Sequence[PointRows], members: Sequence[int], directions: Sequence[Array]) -> list[Invariant]:
    n = len(members)
    units = [tuple(int(j == k) for j in range(n)) for k in range(n)]
    return [_sum_of(units, v) for v in _constant(np.concatenate(directions), points[0].ring)]


def _polynomials(points: Sequence[PointRows], members: Sequence[int], directions: Sequence[Array]) -> list[Invariant]:
    ring, n = points[0].ring, len(members)
    sets = [*combinations_with_replacement(range(n), 1), *combinations_with_replacement(range(n), 2)]
    terms = [tuple(s.count(k) for k in range(n)) for s in sets]
    stacked = []
    for r, d in zip(points, directions, strict=True):
        theta = [r.theta[k] for k in members]
        slopes = np.array([Invariant(((Fraction(1), e),)).gradient(theta, ring) for e in terms])
        stacked.append(ring.product(d, slopes.T))
    return [_sum_of(terms, v) for v in _constant(np.concatenate(stacked), ring)]


def _sum_of(terms: Sequence[Exponents], vector: Exponents) -> Invariant:
    return Invariant(tuple((Fraction(c), e) for e, c in zip(terms, vector, strict=True) if c))


def _constant(conditions: Array, ring: Ring) -> list[Exponents]:
    """Simple integer vectors that every condition sends to 0: those of fewest entries in their space.

    Empty where there are too few conditions to rule out chance.
    """
    n = conditions.shape[1]
    if n > len(conditions) - SPARE:
        return []
    reduced, pivots = ring.rref(conditions)
    if len(pivots) == n:
        return []
    space = ring.rref(_null_space(ring, reduced, pivots, n))[0]
    found = [_whole(row, ring) for row in space]
    k = len(space)
    if k > 1 and math.comb(n, k - 1) <= MOST:
        for zero in combinations(range(n), k - 1):
            part, where = ring.rref(space[:, list(zero)].T)
            for row in _null_space(ring, part, where, k) if len(where) == k - 1 else ():
                found.append(_whole(ring.product(row[None], space)[0], ring))
    return sorted({v for v in found if v is not None})


def _whole(row: Array, ring: Ring) -> Exponents | None:
    """The row times what makes it small whole numbers with a positive first entry; None where they are not small."""
    lead = ring.inverse(row[np.flatnonzero(row)[0]])
    parts = [ring.fraction(ring.reduce(x * lead)) for x in row]
    fractions = [x for x in parts if x is not None]
    if len(fractions) < len(parts):
        return None
    scale = math.lcm(*(x.denominator for x in fractions))
    whole = [int(x * scale) for x in fractions]
    whole = [x // math.gcd(*whole) for x in whole]
    return tuple(whole) if max(map(abs, whole)) <= LARGEST else None
