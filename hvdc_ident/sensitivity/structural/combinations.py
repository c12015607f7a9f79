"""Combinations of parameters that are seen, found from the directions that are not seen at several points, and put in words.

A product a**i b**j is seen where the exponents are orthogonal to every direction in the logarithms; a sum where its
coefficients are to every direction in the values. What neither finds is looked for among polynomials of degree 2.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import combinations, combinations_with_replacement
from typing import Any, ClassVar, Literal

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.sensitivity.information import leading
from hvdc_ident.text import listed


@dataclass(frozen=True)
class Combination:
    """Parameters of which only combinations are seen.

    members: their names, in the order listed. seen: the combinations that hold all that is seen of them; empty where none is
    simple, or where nothing is seen of them at all. words: the finding as a clause. free: how many of the members can be given
    any value, the others then following. directions: (free, members) null directions at the model's values, the largest entry
    1: of the relative changes where `relative`, else of the changes themselves; empty where they are not known. kind: "structural"
    (no data could tell) or "practical" (these data do not). held: those put at their given value so that the others can be told.
    """

    members: tuple[str, ...]
    seen: tuple[str, ...]
    words: str
    free: int = 1
    directions: tuple[tuple[float, ...], ...] = ()
    relative: bool = False
    kind: Literal["structural", "practical"] = "structural"
    held: tuple[str, ...] = ()
    stored_properties: ClassVar[tuple[str, ...]] = ("direction",)

    @property
    def direction(self) -> FrozenMap[float]:
        """One change of the members that leaves the outputs alone; empty where none is known."""
        return FrozenMap(zip(self.members, self.directions[0], strict=True) if self.directions else ())


def only_seen(members: Sequence[str], seen: Sequence[str]) -> str:
    """Return in words that of some parameters only these combinations are seen; nothing, where there are none."""
    if not seen:
        return f"nothing is seen of {listed(members)}"
    return f"only {listed(seen)} {'is' if len(seen) == 1 else 'are'} seen"


SUBSETS = 2000
"""Subsets tried when a simpler basis is looked for."""
SPARE = 2
"""Conditions beyond the number of coefficients, so that no combination passes by chance."""
SIMPLE_NUMBER = 12
"""The largest exponent or coefficient that counts as simple."""
FEW = 8
"""Members of a combination up to which polynomials are looked for."""
EXACT = 1e-9
"""Relative error of directions that were found in many digits."""
SMALL = 1e-2
"""Parts of a rough direction below this share of its largest are its error."""
Exponents = tuple[int, ...]


@dataclass(frozen=True)
class Point:
    """Values of parameters, (n,), and a sparse basis, (k, n), of the directions in their logarithms that are not seen there."""

    theta: Array
    directions: Array

    @property
    def groups(self) -> list[tuple[int, ...]]:
        """The parameters that directions tie together, group by group: columns joined by a common row."""
        groups: list[set[int]] = []
        for row in self.directions:
            merged = {int(k) for k in np.flatnonzero(row)}
            for g in [g for g in groups if g & merged]:
                merged |= g
                groups.remove(g)
            groups.append(merged)
        return sorted(tuple(sorted(g)) for g in groups)

    @property
    def pattern(self) -> tuple[Any, ...]:
        """The number of directions and the groups: equal at all points but unlucky ones."""
        return len(self.directions), *self.groups

    def among(self, members: Sequence[int]) -> Point:
        """The same of some of the parameters, which are one or more groups."""
        part = self.directions[:, list(members)]
        return Point(self.theta[list(members)], part[np.any(part != 0, axis=1)])


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


def combinations_seen(
    names: Sequence[str],
    points: list[Point],
    values: Sequence[float],
    more: Callable[[], Point | None] = lambda: None,
    error: float = EXACT,
) -> tuple[Combination, ...]:
    """Return what is seen of the parameters that the directions tie together, one combination for each group.

    points: they agree in their groups. values: of the parameters, where the combinations' null directions are given. more:
    makes a further point; None where there are no more. error: of the directions, relative.
    """
    return tuple(_combination(g, names, points, values, more, error) for g in points[0].groups)


def held_of(unseen: Array, least: float = SMALL) -> frozenset[int]:
    """Return the columns to hold so that no direction is left: one a direction, the last that will do.

    unseen: (k, p) independent directions; parts below `least` of the largest count as 0. Any set of columns in which the
    directions stay independent would do; how strongly each parameter is seen makes no difference.
    """
    rest, held = unseen.copy(), set()
    for i in reversed(range(unseen.shape[1])):
        if not rest.shape[0]:
            break
        rest = rest / np.abs(rest[:, : i + 1]).max(axis=1, keepdims=True)
        row = int(np.argmax(np.abs(rest[:, i])))
        if abs(rest[row, i]) > least:
            held.add(i)
            rest = np.delete(rest - np.outer(rest[:, i] / rest[row, i], rest[row]), row, axis=0)
    return frozenset(held)


def _combination(
    members: tuple[int, ...],
    names: Sequence[str],
    points: list[Point],
    values: Sequence[float],
    more: Callable[[], Point | None],
    error: float,
) -> Combination:
    own = tuple(names[k] for k in members)
    if len(members) == 1:
        return Combination(own, (), only_seen(own, ()), 1, ((1.0,),))
    n, free = len(members), len(points[0].among(members).directions)
    invariants = None
    for coefficients in (n, n * (n + 3) // 2) if n <= FEW else (n,):
        while len(points) * free < coefficients + SPARE and (point := more()) is not None:
            points.append(point)
        invariants = _invariants([p.among(members) for p in points], error)
        if invariants is not None:
            break
    if invariants is None:
        number = "one combination" if n - free == 1 else f"{n - free} combinations"
        words = f"only {number} of {listed(own)} {'is' if n - free == 1 else 'are'} seen"
        return Combination(own, (), words, free)
    seen = tuple(i.text(own) for i in invariants)
    directions, relative = _null_directions(invariants, [values[k] for k in members])
    return Combination(own, seen, only_seen(own, seen), free, directions, relative)


def _null_directions(
    invariants: Sequence[Invariant], values: Sequence[float]
) -> tuple[tuple[tuple[float, ...], ...], bool]:
    """The null directions at some values: of the logarithms where only products are seen."""
    relative = all(len(i.terms) == 1 for i in invariants)
    if relative:
        matrix = np.array([i.terms[0][1] for i in invariants], float)
    else:
        with np.errstate(all="ignore"):
            matrix = np.array([i.slopes([np.float64(v) for v in values]) for i in invariants])
        if not np.isfinite(matrix).all():  # a power or a quotient that has no slope at these values
            return (), False
    null = np.linalg.svd(matrix)[2][len(matrix) :]
    scaled = [v / v[leading(v)] for v in null]
    return tuple(tuple(float(round(x, 12)) + 0.0 for x in v) for v in scaled), relative


def _invariants(points: Sequence[Point], error: float) -> tuple[Invariant, ...] | None:
    """Independent combinations that hold all that is seen at the points; None where they are not found."""
    theta = points[-1].theta
    needed = theta.size - len(points[-1].directions)
    selected: list[Invariant] = []
    for candidates in (_products, _sums, _polynomials):
        more = sorted(candidates(points, error), key=lambda i: i.cost)
        selected = _independent([*selected, *more], theta)
        if len(selected) == needed:
            return tuple(sorted(selected, key=lambda i: (i.cost[0], *(-c for c in reversed(i.cost[2:])))))
    return None


def _independent(invariants: Iterable[Invariant], theta: Array) -> list[Invariant]:
    selected: list[Invariant] = []
    gradients: list[Array] = []
    for i in invariants:
        row = np.array(i.slopes(theta.tolist())) * theta
        gradients.append(row / np.linalg.norm(row))
        if np.linalg.matrix_rank(gradients, tol=EXACT) == len(gradients):
            selected.append(i)
        else:
            gradients.pop()
    return selected


def _products(points: Sequence[Point], error: float) -> list[Invariant]:
    exponents = _constant(np.concatenate([p.directions for p in points]), error)
    return [Invariant(((Fraction(1), e),)) for e in exponents]


def _sums(points: Sequence[Point], error: float) -> list[Invariant]:
    return _of_terms(_exponents(points[0].theta.size, 1), points, error)


def _polynomials(points: Sequence[Point], error: float) -> list[Invariant]:
    n = points[0].theta.size
    return _of_terms([*_exponents(n, 1), *_exponents(n, 2)], points, error) if n <= FEW else []


def _exponents(n: int, degree: int) -> list[Exponents]:
    return [tuple(s.count(k) for k in range(n)) for s in combinations_with_replacement(range(n), degree)]


def _of_terms(terms: Sequence[Exponents], points: Sequence[Point], error: float) -> list[Invariant]:
    """Sums of such terms that no direction changes."""
    powers = np.array(terms)
    conditions = [(p.directions @ powers.T) * np.prod(p.theta**powers, axis=1) for p in points]
    coefficients = _constant(np.concatenate(conditions), error)
    return [Invariant(tuple((Fraction(c), e) for e, c in zip(terms, v, strict=True) if c)) for v in coefficients]


def _constant(conditions: Array, error: float) -> list[Exponents]:
    """Simple integer vectors that every condition sends to 0: those of fewest entries in their space.

    Empty where there are too few conditions to rule out chance.
    """
    n = conditions.shape[1]
    if n > len(conditions) - SPARE:
        return []
    rows = conditions / np.abs(conditions).max(axis=1, keepdims=True)
    size = np.linalg.norm(rows, axis=0)
    size[size == 0] = 1.0
    _, s, vt = np.linalg.svd(rows / size)
    space = _reduced(vt[int((s > error * s[0]).sum()) :] / size)
    vectors, k = [_whole(row, error) for row in space], len(space)
    if k > 1 and math.comb(n, k - 1) <= SUBSETS:
        for zero in combinations(range(n), k - 1):
            _, s, vt = np.linalg.svd(space[:, list(zero)].T)
            if s[-1] > np.sqrt(error) * s[0]:
                vectors.append(_whole(vt[-1] @ space, error))
    return sorted({v for v in vectors if v is not None})


def _reduced(rows: Array) -> Array:
    """The reduced row echelon form of independent rows."""
    a, column = rows.copy(), 0
    for row in range(len(a)):
        while np.abs(a[row:, column]).max() <= np.sqrt(EXACT) * np.abs(a[row:]).max():
            column += 1
        k = row + int(np.argmax(np.abs(a[row:, column])))
        a[[row, k]] = a[[k, row]]
        a[row] /= a[row, column]
        others = np.arange(len(a)) != row
        a[others] -= np.outer(a[others, column], a[row])
    return a


def _whole(row: Array, error: float) -> Exponents | None:
    """The row times what makes it small whole numbers with a positive first entry; None where they are not small."""
    near = np.sqrt(error)
    row = np.where(np.abs(row) > near * np.abs(row).max(), row, 0.0)
    row = row / row[np.flatnonzero(row)[0]]
    parts = [Fraction(x).limit_denominator(SIMPLE_NUMBER) for x in row.tolist()]
    if any(abs(float(f) - x) > near * max(1.0, abs(x)) for f, x in zip(parts, row, strict=True)):
        return None
    scale = math.lcm(*(f.denominator for f in parts))
    whole = [int(f * scale) for f in parts]
    whole = [x // math.gcd(*whole) for x in whole]
    return tuple(whole) if max(map(abs, whole)) <= SIMPLE_NUMBER else None
