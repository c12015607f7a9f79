"""Taylor series in time of a model's outputs, with exact derivatives by its start and its parameters, over any ring.

A coefficient is a row: its value, then its derivatives. Order by order, each node of the graph costs one convolution.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from fractions import Fraction
from random import Random
from typing import Any

import numpy as np

from hvdc_ident.sensitivity.rank.arithmetic import Coefficients
from hvdc_ident.sensitivity.rank.equations import Equations
from hvdc_ident.sensitivity.rank.prime_field import Array, NoSuchNumber, NotRational
from hvdc_ident.sensitivity.rank.ring import OutOfTime, Ring

FUNCTIONS = ("exp", "log", "sin", "cos", "tan", "tanh", "atan")


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
        loop = self._downstream() if self.nz else []
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

    def _downstream(self) -> list[int]:
        return [n for n in self.equations.graph.reachable(self.equations.residuals) if n in set(self.moving)]

    def _unknowns(self, k: int) -> None:
        """Sets the unknowns' coefficients of order k, in which the equations are linear."""
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
        """Refuses functions whose values over a prime field could contradict one another."""
        if not self.ring.p:
            return
        g = self.equations.graph
        used = {
            (("sin" if g.nodes[n][0] == "cos" else g.nodes[n][0]), g.nodes[n][1])
            for n in nodes
            if g.nodes[n][0] in FUNCTIONS
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
