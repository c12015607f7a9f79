"""Random points over a prime field: values found step by step, and the rows there."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from random import Random
from typing import Any

from hvdc_ident.sensitivity.rank.equations import Equations
from hvdc_ident.sensitivity.rank.field_point import Draw, Solve, Sparse, Step, Tear, plan
from hvdc_ident.sensitivity.rank.points import Base, Question, Rows, affected, rows
from hvdc_ident.sensitivity.rank.prime_field import NoSuchNumber, NotRational, PrimeField, numerator, roots
from hvdc_ident.sensitivity.rank.ring import OutOfTime

TRIES = 300


class Values:
    """Values of the variables over a field, found step by step. roots: {("sqrt", x): root} already chosen elsewhere.

    chose: whether one of several solutions was taken that may lie on different branches.
    """

    def __init__(
        self,
        s: Sparse,
        ring: PrimeField,
        given: Mapping[int, int],
        roots: Mapping[tuple[str, int], int],
        random: Random,
    ) -> None:
        self.s, self.ring, self.roots, self.random = s, ring, roots, random
        self.chose = False
        self.of = dict(given) | {v: ring.number(Equations.fraction(c)) for v, c in s.constants.items()}

    def take(self, steps: Sequence[Step]) -> None:
        """Takes the steps; NoSuchNumber where a root or a quotient does not exist."""
        for step in steps:
            if isinstance(step, Draw):
                self.of[step.variable] = self.ring.random(self.random)
            elif isinstance(step, Solve):
                self._solve(step)
            elif isinstance(step, Tear):
                self._tear(step)
            elif self._evaluate([step.equation])[0]:
                raise NoSuchNumber("an equation contradicts the others")

    def _solve(self, step: Solve) -> None:
        g, p, v = self.s.graph, self.ring.p, step.variable
        slope = g.gradient(step.equation)[v]
        self.of[v] = 0
        constant, linear = self._evaluate([step.equation, slope])
        if step.degree == 1:
            self.of[v] = -constant * self.ring.inverse(linear) % p
            return
        square = self._evaluate([g.gradient(slope)[v]])[0] * self.ring.inverse(2) % p
        half = linear * self.ring.inverse(2 * square) % p
        rest = (half * half - constant * self.ring.inverse(square)) % p
        self.chose |= linear != 0
        root = self.roots.get(("sqrt", rest)) if linear == 0 else None
        self.of[v] = ((self.ring.sqrt(rest) if root is None else root) - half) % p

    def _tear(self, step: Tear) -> None:
        def residual(value: int) -> int:
            self.of[step.variable] = value
            self.take(step.steps)
            return self._evaluate([step.equation])[0]

        self.chose = True
        polynomial = numerator(residual, self.ring.p, self.random)
        if not polynomial:  # the equation follows from the others: the variable is as free as it looked
            residual(self.ring.random(self.random))
            return
        found = roots(polynomial, self.ring.p, self.random)
        for value in found:
            try:
                if residual(value) == 0:
                    return
            except NoSuchNumber:
                continue
        raise NoSuchNumber("no root in the field")

    def _evaluate(self, nodes: Sequence[int]) -> list[int]:
        g, p = self.s.graph, self.ring.p
        value: dict[int, int] = {}
        for n in g.reachable(nodes):
            op, *a = g.nodes[n]
            if op == "leaf":
                value[n] = self.of.get(n, 1)  # one that cancels may have no value
            elif op == "const":
                value[n] = int(a[0]) % p
            elif op == "neg":
                value[n] = -value[a[0]] % p
            else:
                x, y = value[a[0]], value[a[1]]
                value[n] = (x + y if op == "add" else x - y if op == "sub" else x * y) % p
        return [value[n] for n in nodes]


class FieldPoints:
    """Random points over one prime field; NotRational where they cannot be found.

    chose: whether a point took one of several solutions that may lie on different branches.
    """

    def __init__(self, question: Question, ring: PrimeField, random: Random, deadline: float) -> None:
        self.q, self.ring, self.random, self.deadline = question, ring, random, deadline
        self.chose = False
        self._plans: dict[frozenset[int], tuple[Sparse, list[Step]]] = {}
        self._prepare()

    def _prepare(self) -> None:
        q, g, m = self.q, self.q.rest.graph, self.q.source.model
        held = {k: v.value for k, v in enumerate(m.parameters.values()) if k not in q.parameters}
        null = [g.leaf("p", k) for k, v in held.items() if v == 0.0]
        null += [g.leaf("w", 1 + k) for k, v in enumerate(m.inputs.values()) if v.value == 0.0]
        self.leaves = {
            "p": [g.leaf("p", k) for k in range(len(m.parameters))],
            "y": [g.leaf("y", k) for k in range(len(q.rest.derivatives) + len(q.rest.residuals))],
            "w": [g.leaf("w", k) for k in range(1 + len(m.inputs))],
        }
        self.null = set(null)
        self.sparse = Sparse(q.rest, q.start, (), self.null)
        p = {self.sparse.leaf_of[n] for n in self.leaves["p"] if n in self.sparse.leaf_of}
        free = {self.sparse.leaf_of[n] for n in (*self.leaves["w"], *self.leaves["y"]) if n in self.sparse.leaf_of}
        self.steps = plan(self.sparse, free, p)

    def __call__(self) -> Rows:
        """The rows at one more point."""
        for _ in range(TRIES):
            if time.thread_time() > self.deadline:
                raise OutOfTime
            try:
                return rows(self.q, self.ring, self._base(), self._jump, self.random, self.deadline)
            except NoSuchNumber:
                continue
        raise NotRational("no point of the prime field was found")

    def _base(self) -> Base:
        values = Values(self.sparse, self.ring, {}, {}, self.random)
        values.take(self.steps)
        of, known = values.of, self.sparse.leaf_of

        def value(n: int) -> int:
            if n in self.null:
                return 0
            return of[known[n]] if n in known and known[n] in of else self.ring.random(self.random)

        p, y, w = ([value(n) for n in self.leaves[group]] for group in ("p", "y", "w"))
        self.chose |= values.chose
        self._same_branch(y)
        return Base(p, y, w, self._roots(self.sparse, of), frozenset(n for n, v in known.items() if of.get(v)))

    def _same_branch(self, y: list[Any]) -> None:
        """Refuses a start at which something is 0 that is not 0 at the operating point: it solves other equations."""
        q = self.q
        if not (q.rested and (q.rest.residuals or q.source.graph.switches)):
            return
        if any(v == 0 and abs(x) > 1e-6 for v, x in zip(y, q.source.point, strict=True)):
            raise NoSuchNumber("another branch")

    def _roots(self, s: Sparse, of: Mapping[int, int]) -> dict[tuple[str, Any], Any]:
        chosen = [of[v] for n, v in s.leaf_of.items() if s.source.nodes[n][0] == "sqrt" and v in of]
        return {("sqrt", v * v % self.ring.p): v for v in chosen}

    def _jump(self, base: Base, w: list[Any], jumped: set[int], random: Random) -> list[Any]:
        q, nx = self.q, len(self.q.rest.derivatives)
        unknown = affected(q, jumped)
        if not unknown:
            return base.y[nx:]
        key = frozenset(unknown)
        given = dict(zip(self.leaves["p"], base.p, strict=True)) | dict(zip(self.leaves["w"], w, strict=True))
        given |= {n: v for k, (n, v) in enumerate(zip(self.leaves["y"], base.y, strict=True)) if k - nx not in unknown}
        if key not in self._plans:
            zeros = [q.move.residuals[i] for i in sorted(unknown)]
            s = Sparse(q.move, zeros, list(given), ())
            self._plans[key] = (s, plan(s, set(), set()))
        s, steps = self._plans[key]
        values = Values(s, self.ring, {v: given[n] for n, v in s.leaf_of.items() if n in given}, base.known, random)
        try:
            values.take(steps)
            if any(values.of.get(v) == 0 and n in base.nonzero for n, v in s.leaf_of.items()):
                raise NoSuchNumber("a branch that does not join the start")
        except NoSuchNumber:
            self._plans[key] = (s, plan(s, set(), set(), random))
            raise
        self.chose |= values.chose
        base.known.update(self._roots(s, values.of))
        unknowns = enumerate(self.leaves["y"][nx:])
        return [values.of[s.leaf_of[n]] if k in unknown else base.y[nx + k] for k, n in unknowns]
