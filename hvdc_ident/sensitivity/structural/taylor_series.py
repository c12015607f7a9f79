"""Taylor series in time of every node of a model's graph over any ring, order by order: one convolution a node.

A coefficient is a row: its value, then its derivatives.
"""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from random import Random
from typing import Any

import numpy as np

from hvdc_ident.sensitivity.structural.finite_field import Array, NoSuchNumber, NotRational, OutOfTime, Ring
from hvdc_ident.simulate import Graph


class Coefficients:
    """The coefficients (order + 1, width) of the nodes in `c`; nodes in `static` have only the first.

    known: {(function, argument): value} of the functions that have several values, chosen once for a point.
    """

    def __init__(
        self,
        graph: Graph,
        ring: Ring,
        nodes: Sequence[int],
        static: Collection[int],
        order: int,
        width: int,
        known: dict[tuple[str, Any], Any],
        random: Random,
    ) -> None:
        self.graph, self.ring, self.static = graph, ring, static
        self.order, self.width, self.known, self.random = order, width, known, random
        self.c = {n: ring.zeros(order + 1, width) for n in nodes}
        self.aux: dict[int, Any] = {}

    def compute(self, nodes: Sequence[int], k: int) -> None:
        """Set coefficient k of the nodes, which are in an order of evaluation."""
        for n in nodes:
            op, *a = self.graph.nodes[n]
            self.c[n][k] = getattr(self, f"_{op}")(n, k, *a)

    def _times(self, a: Array, b: Array) -> Array:
        """The product of two rows."""
        reduce = self.ring.reduce
        out = reduce(a[0] * b)
        out[1:] += reduce(a[1:] * b[0])
        return reduce(out)

    def _sum(self, a: Array, b: Array) -> Array:
        """The sum of the products of the rows of two blocks."""
        reduce = self.ring.reduce
        out = reduce(a[:, :1] * b).sum(axis=0)
        out[1:] += reduce(a[:, 1:] * b[:, :1]).sum(axis=0)
        return reduce(out)

    def _convolve(self, a: Array, b: Array, k: int, first: int = 0, last: int | None = None) -> Array:
        """The sum of a_i b_(k-i) over first <= i <= last."""
        last = k if last is None else last
        if last < first:
            return self.ring.zeros(self.width)
        stop = k - last - 1
        return self._sum(a[first : last + 1], b[k - first : stop if stop >= 0 else None : -1])

    def _invert(self, a: Array) -> Array:
        """1/a for a row."""
        i = self.ring.inverse(a[0])
        out = self.ring.reduce(self.ring.reduce(-a * i) * i)
        out[0] = i
        return out

    def _add(self, n: int, k: int, a: int, b: int) -> Array:
        return self.ring.reduce(self.c[a][k] + self.c[b][k])

    def _sub(self, n: int, k: int, a: int, b: int) -> Array:
        return self.ring.reduce(self.c[a][k] - self.c[b][k])

    def _neg(self, n: int, k: int, a: int) -> Array:
        return self.ring.reduce(-self.c[a][k])

    def _mul(self, n: int, k: int, a: int, b: int) -> Array:
        if a in self.static:
            return self._times(self.c[a][0], self.c[b][k])
        if b in self.static:
            return self._times(self.c[b][0], self.c[a][k])
        return self._convolve(self.c[a], self.c[b], k)

    def _div(self, n: int, k: int, a: int, b: int) -> Array:
        if k == 0:
            self.aux[n] = self._invert(self.c[b][0])
        rest = self.c[a][k]
        if b not in self.static:
            rest = self.ring.reduce(rest - self._convolve(self.c[n], self.c[b], k, 0, k - 1))
        return self._times(rest, self.aux[n])

    def _inverse(self, n: int, k: int, a: int) -> Array:
        if k == 0:
            self.aux[n] = self._invert(self.c[a][0])
            return self.aux[n]
        return self._times(self.ring.reduce(-self._convolve(self.c[n], self.c[a], k, 0, k - 1)), self.aux[n])

    def _sqrt(self, n: int, k: int, a: int) -> Array:
        ring = self.ring
        if k == 0:
            root = self._value("sqrt", self.c[a][0, 0])
            out = ring.reduce(self.c[a][0] * ring.inverse(ring.reduce(2 * root)))
            out[0] = root
            self.aux[n] = self._invert(ring.reduce(2 * out))
            return out
        return self._times(ring.reduce(self.c[a][k] - self._convolve(self.c[n], self.c[n], k, 1, k - 1)), self.aux[n])

    # --- functions with a differential equation of their own ---

    def _value(self, name: str, argument: Any) -> Any:
        key = (name, argument)
        if key not in self.known:
            made = self.ring.sqrt(argument) if name == "sqrt" else self._transcendental(name, argument)
            self.known[key] = made
        return self.known[key]

    def _transcendental(self, name: str, argument: Any) -> Any:
        if not self.ring.p or name not in ("sin", "cos"):
            return self.ring.transcendental(name, argument, self.random)
        p = self.ring.p
        if int(argument) % p == 0:
            return int(name == "cos")
        t = self.random.randrange(2, p - 1)  # both lie on the unit circle
        inverse = self.ring.inverse(1 + t * t)
        self.known["sin", argument], self.known["cos", argument] = 2 * t * inverse % p, (1 - t * t) * inverse % p
        return self.known[name, argument]

    def _weighted(self, a: Array, k: int, first: int = 1) -> Array:
        """The rows a_1..a_k times their order: the coefficients of the derivative."""
        orders = np.array([self.ring.number(Fraction(i)) for i in range(first, k + 1)], a.dtype)
        return self.ring.reduce(a[first : k + 1] * orders[:, None])

    def _integrate(self, slope: Array, a: int, k: int) -> Array:
        """Coefficient k of the function whose derivative is slope times the argument's derivative."""
        total = self._sum(self._weighted(self.c[a], k), slope[k - 1 :: -1][:k])
        return self.ring.reduce(total * self.ring.number(Fraction(1, k)))

    def _start(self, name: str, a: int, slope: Array) -> Array:
        out = self.ring.reduce(self.c[a][0] * slope[0])
        out[0] = self._value(name, self.c[a][0, 0])
        return out

    def _exp(self, n: int, k: int, a: int) -> Array:
        if k == 0:
            value = self.ring.zeros(self.width)
            value[0] = self._value("exp", self.c[a][0, 0])
            return self._start("exp", a, value)
        return self._integrate(self.c[n], a, k)

    def _log(self, n: int, k: int, a: int) -> Array:
        return self._by_quotient(n, k, a, self.c[a])

    def _by_quotient(self, n: int, k: int, a: int, bottom: Array) -> Array:
        """Coefficient k of the function with n' bottom = a'."""
        if k == 0:
            self.aux[-n] = self._invert(bottom[0])
            return self._start(self.graph.nodes[n][0], a, self.aux[-n])
        ring = self.ring
        rest = ring.reduce(self.c[a][k] * ring.number(Fraction(k)))
        if k > 1:
            rest = ring.reduce(rest - self._sum(self._weighted(self.c[n], k - 1), bottom[k - 1 : 0 : -1]))
        return ring.reduce(self._times(rest, self.aux[-n]) * ring.number(Fraction(1, k)))

    def _atan(self, n: int, k: int, a: int) -> Array:
        square = self._helper(n)
        square[k] = self._convolve(self.c[a], self.c[a], k)
        if k == 0:
            square[0, 0] = self.ring.reduce(square[0, 0] + 1)
        return self._by_quotient(n, k, a, square)

    def _helper(self, n: int) -> Array:
        if n not in self.aux:
            self.aux[n] = self.ring.zeros(self.order + 1, self.width)
        return self.aux[n]

    def _tan(self, n: int, k: int, a: int, sign: int = 1) -> Array:
        slope, ring = self._helper(n), self.ring
        if k == 0:
            name = self.graph.nodes[n][0]
            value = self._value(name, self.c[a][0, 0])
            slope[0, 0] = ring.reduce(1 + sign * ring.reduce(value * value))
            out = self._start(name, a, slope[0])
        else:
            out = self._integrate(slope, a, k)
        self.c[n][k] = out
        slope[k] = ring.reduce(sign * self._convolve(self.c[n], self.c[n], k))
        if k == 0:
            slope[0, 0] = ring.reduce(slope[0, 0] + 1)
        return out

    def _tanh(self, n: int, k: int, a: int) -> Array:
        return self._tan(n, k, a, -1)

    def _sin(self, n: int, k: int, a: int) -> Array:
        return self._circle(n, k, a, "sin", "cos", 1)

    def _cos(self, n: int, k: int, a: int) -> Array:
        return self._circle(n, k, a, "cos", "sin", -1)

    def _circle(self, n: int, k: int, a: int, name: str, other: str, sign: int) -> Array:
        partner = self._helper(n)
        if k == 0:
            value, partner_value = (self._value(f, self.c[a][0, 0]) for f in (name, other))
            out = self.ring.reduce(sign * self.c[a][0] * partner_value)
            partner[0] = self.ring.reduce(-sign * self.c[a][0] * value)
            out[0], partner[0, 0] = value, partner_value
            return out
        out = self.ring.reduce(sign * self._integrate(partner, a, k))
        partner[k] = self.ring.reduce(-sign * self._integrate(self.c[n], a, k))
        return out


TRANSCENDENTAL = ("exp", "log", "sin", "cos", "tan", "tanh", "atan")


class Taylor:
    """The series of one stretch of an experiment: equations, parameters and inputs are given, the start varies.

    p: every parameter's value. inputs: for each element of `w` its coefficients from order 0; one coefficient: constant.
    unknown: positions in p of the parameters derivatives are taken by. Columns: value, start of each state, each unknown
    parameter, each algebraic unknown (used at order 0 only).
    """

    def __init__(
        self,
        equations: Equations,
        ring: Ring,
        p: Sequence[Any],
        unknown: Sequence[int],
        seed: int,
        deadline: float,
    ) -> None:
        self.equations, self.ring, self.p, self.unknown = equations, ring, p, list(unknown)
        self.nx, self.nz = len(equations.derivatives), len(equations.residuals)
        self.width = 1 + self.nx + len(self.unknown) + self.nz
        self.kept = self.width - self.nz
        self.deadline, self.random = deadline, Random(seed)
        self.known: dict[tuple[str, Any], Any] = {}

    def run(
        self, y: Sequence[Any], w: Sequence[Sequence[Any]], order: int, roots: Sequence[int]
    ) -> Mapping[int, Array]:
        """{node: (order + 1, columns) coefficients} of the roots, from the start y = [states, unknowns]."""
        g, e = self.equations.graph, self.equations
        self._in_time()
        slopes = [d for r in e.residuals for _, d in e.unknown_slopes(r)]
        self.nodes = g.reachable([*roots, *e.derivatives, *e.residuals, *slopes])
        self.order = order
        self._check(self.nodes)
        static = self._static(w)
        self.moving = [n for n in self.nodes if n not in static and g.nodes[n][0] != "leaf"]
        self.series = Coefficients(g, self.ring, self.nodes, static, order, self.width, self.known, self.random)
        self.c = self.series.c
        self._leaves(y, w)
        self._first()
        moving = set(self.moving)
        loop = [n for n in g.reachable(e.residuals) if n in moving] if self.nz else []
        for k in range(1, order + 1):
            self._in_time()
            step = self.ring.number(Fraction(1, k))
            for i, d in enumerate(e.derivatives):
                self._set(("y", i), k, self.ring.reduce(self.c[d][k - 1] * step))
            if self.nz:
                self.series.compute(loop, k)
                self._unknowns(k)
            self.series.compute(self.moving, k)
        return {r: self.c[r][:, : self.kept] for r in roots}

    def _in_time(self) -> None:
        if time.thread_time() > self.deadline:
            raise OutOfTime

    # --- start ---

    def _static(self, w: Sequence[Sequence[Any]]) -> set[int]:
        """The nodes that do not change in time."""
        static: set[int] = set()
        g = self.equations.graph
        for n in self.nodes:
            key = g.nodes[n]
            if key[0] == "leaf":
                still = key[1] == "p" or (key[1] == "w" and len(w[key[2]]) == 1)
            else:
                still = all(a in static for a in g.arguments(n))
            if still:
                static.add(n)
        return static

    def _leaves(self, y: Sequence[Any], w: Sequence[Sequence[Any]]) -> None:
        for n in self.nodes:
            key = self.equations.graph.nodes[n]
            if key[0] == "const":
                self.c[n][0, 0] = self.ring.number(self.equations.fraction(key[1]))
            elif key[0] == "leaf":
                self._leaf(n, key[1], key[2], y, w)

    def _leaf(self, n: int, group: str, index: int, y: Sequence[Any], w: Sequence[Sequence[Any]]) -> None:
        c = self.c[n]
        if group == "p":
            c[0, 0] = self.p[index]
            if index in self.unknown:
                c[0, 1 + self.nx + self.unknown.index(index)] += 1
        elif group == "w":
            for k, value in enumerate(w[index][: self.order + 1]):
                c[k, 0] = value
        else:
            c[0, 0] = y[index]
            c[0, 1 + index if index < self.nx else self.kept + index - self.nx] += 1

    def _set(self, leaf: tuple[str, int], k: int, row: Array) -> None:
        n = self.equations.graph.leaf(*leaf)
        if n in self.c:
            self.c[n][k] = row

    def _first(self) -> None:
        g, e, ring = self.equations.graph, self.equations, self.ring
        inner = [n for n in self.nodes if g.nodes[n][0] not in ("const", "leaf")]
        self.series.compute(inner, 0)
        if not self.nz:
            return
        jacobian = np.array([self.c[r][0, self.kept :] for r in e.residuals])
        self._by_unknowns = inverse(ring, jacobian)
        right = np.array([self.c[r][0, : self.kept] for r in e.residuals])
        rows = ring.reduce(-ring.product(self._by_unknowns, right))
        for j in range(self.nz):
            n = g.leaf("y", self.nx + j)
            if n in self.c:
                self.c[n][0, 1 : self.kept] = rows[j, 1:]
                self.c[n][0, self.kept :] = ring.zeros(self.nz)
        self.series.compute(inner, 0)

    def _unknowns(self, k: int) -> None:
        """Set the unknowns' coefficients of order k, in which the equations are linear."""
        e, g, ring = self.equations, self.equations.graph, self.ring
        right = np.array([self.c[r][k, : self.kept] for r in e.residuals])
        z = ring.reduce(-ring.product(self._by_unknowns, right[:, :1]))[:, 0]
        for i, r in enumerate(e.residuals):
            for j, d in e.unknown_slopes(r):
                right[i, 1:] = ring.reduce(right[i, 1:] + ring.reduce(self.c[d][0, 1 : self.kept] * z[j]))
        rows = ring.reduce(-ring.product(self._by_unknowns, right))
        for j in range(self.nz):
            n = g.leaf("y", self.nx + j)
            if n in self.c:
                self.c[n][k, : self.kept] = rows[j]

    def _check(self, nodes: Sequence[int]) -> None:
        """Raise NotRational for functions whose values over a prime field could contradict one another."""
        if not self.ring.p:
            return
        g = self.equations.graph
        used = {
            (("sin" if g.nodes[n][0] == "cos" else g.nodes[n][0]), g.nodes[n][1])
            for n in nodes
            if g.nodes[n][0] in TRANSCENDENTAL
        }
        if len(used) > 1:
            raise NotRational("several functions beyond roots and fractions")


def inverse(ring: Ring, matrix: Array) -> Array:
    """The inverse of a square matrix; NoSuchNumber where it is singular."""
    n = len(matrix)
    both = ring.zeros(n, 2 * n)
    both[:, :n] = matrix
    for i in range(n):
        both[i, n + i] += 1
    reduced, pivots = ring.rref(both)
    if pivots[:n] != list(range(n)):
        raise NoSuchNumber("the unknowns are not determined")
    return reduced[:, n:]


@dataclass(frozen=True)
class Equations:
    """Nodes of one graph: derivatives and residuals of the unknowns, outputs, what stands at 0 at the start, named signals.

    starts: per state the node that is 0 at the start, or None where the start is free.
    """

    graph: Graph
    derivatives: tuple[int, ...]
    residuals: tuple[int, ...]
    outputs: tuple[int, ...]
    starts: tuple[int | None, ...]
    signals: tuple[int, ...]
    _slopes: dict[int, list[tuple[int, int]]] = field(default_factory=dict, repr=False, compare=False)

    def unknown_slopes(self, node: int) -> list[tuple[int, int]]:
        """(unknown, node) pairs: the derivatives of a node by the algebraic unknowns."""
        if node not in self._slopes:
            nx = len(self.derivatives)
            keys = ((self.graph.nodes[v], d) for v, d in self.graph.gradient(node).items())
            self._slopes[node] = [(k[2] - nx, d) for k, d in keys if k[1] == "y" and k[2] >= nx]
        return self._slopes[node]

    @staticmethod
    def fraction(value: float) -> Fraction:
        """The fraction a float stands for: of small terms if there is one, else its decimal text."""
        if not math.isfinite(value):
            raise NotRational("a constant that is not finite")
        near = Fraction(value).limit_denominator(10**6)
        return near if float(near) == value else Fraction(repr(value))
