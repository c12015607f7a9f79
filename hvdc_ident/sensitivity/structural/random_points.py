"""Random points over a prime field at which given equations hold, found step by step without general elimination.

Every named signal and every root is a variable with an equation of its own, so that the system is large and sparse.
An equation with one variable left is solved for it; a variable left in one equation only is solved from it, last; where
neither is to be had, one variable is chosen at random, and if an equation then contradicts, it becomes a root of that
equation: a polynomial in one unknown.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from random import Random
from typing import Any

from hvdc_ident.sensitivity.structural.finite_field import (
    NoSuchNumber,
    NotRational,
    OutOfTime,
    PrimeField,
    numerator,
    roots,
)
from hvdc_ident.sensitivity.structural.observability import Base, PointRows, Question, affected, rows
from hvdc_ident.sensitivity.structural.taylor_series import Equations
from hvdc_ident.simulate import Graph

FIXED = -1


@dataclass(frozen=True)
class Solve:
    """The variable is the root of the equation, of degree 1 or 2 in it."""

    equation: int
    variable: int
    degree: int


@dataclass(frozen=True)
class Draw:
    """The variable is random."""

    variable: int


@dataclass(frozen=True)
class Tear:
    """The variable is such that the steps, taken from it, leave 0 in the equation."""

    variable: int
    steps: tuple[Solve, ...]
    equation: int


@dataclass(frozen=True)
class Check:
    """The equation has nothing left to solve for and must hold by itself."""

    equation: int


Step = Solve | Draw | Tear | Check


class Sparse:
    """Polynomial equations in leaves, signals and roots, from nodes of a model's graph.

    known: leaves that have a value; null: leaves that are 0. Every other leaf and every signal or root is a variable.
    """

    def __init__(self, equations: Equations, zeros: Sequence[int], known: Sequence[int], null: Collection[int]) -> None:
        self.source, self.graph, self.null = equations.graph, Graph(), null
        self.signals = {n for n in equations.signals if self.source.nodes[n][0] not in ("leaf", "const")}
        self.constants: dict[int, float] = {}
        self.leaf_of: dict[int, int] = {}
        self._fractions: dict[int, tuple[int, int]] = {}
        self._products: dict[int, int] = {}
        self.equations: list[int] = []
        self.fixed = {self._variable(n) for n in known if self.source.nodes[n][0] == "leaf"}
        same = [self._same(z) for z in zeros]  # all before any expression is read
        for z, alike in zip(zeros, same, strict=True):
            if alike:
                self._fraction(self.source.nodes[z][1])
            else:
                self.equations.append(self._fraction(z)[0])
        self.equations = [self._with_products(e) for e in self.equations]
        self.fixed |= set(self.constants)
        self._slopes: dict[int, dict[int, int]] = {e: self.graph.gradient(e) for e in self.equations}

    def _same(self, zero: int) -> bool:
        """True where an equation only says that an unknown is a signal: both are one variable from here on."""
        op, *a = self.source.nodes[zero]
        if (
            op != "sub"
            or a[0] not in self.signals
            or a[1] in self.leaf_of
            or self.source.nodes[a[1]][:2] != ("leaf", "y")
        ):
            return False
        self.leaf_of[a[1]] = self._variable(a[0])
        return True

    def _variable(self, node: int) -> int:
        if node not in self.leaf_of:
            self.leaf_of[node] = self.graph.leaf("v", node)
        return self.leaf_of[node]

    def _fraction(self, node: int) -> tuple[int, int]:
        """Numerator and denominator of a node of the source in the variables."""
        for n in self.source.reachable([node]):
            if n not in self._fractions:
                self._fractions[n] = self._define(n)
        return self._fractions[node]

    def _define(self, n: int) -> tuple[int, int]:
        g = self.graph
        op, *a = self.source.nodes[n]
        if n in self.null:
            return g.zero, g.one
        if op in ("leaf", "const"):
            v = self._variable(n)
            if op == "const":
                if a[0] in (0.0, 1.0):
                    return g.constant(a[0]), g.one
                self.constants[v] = a[0]
            return v, g.one
        top, bottom = self._operate(n, op, [self._fractions[k] for k in a])
        if n not in self.signals:
            return top, bottom
        v = self._variable(n)
        if bottom == g.one:
            self._products.setdefault(top, v)
        self.equations.append(g.sub(g.mul(v, bottom), top))
        return v, g.one

    def _operate(self, n: int, op: str, x: list[tuple[int, int]]) -> tuple[int, int]:
        g = self.graph
        if op in ("add", "sub"):
            join = g.add if op == "add" else g.sub
            (a, b), (c, d) = x
            return (join(a, c), b) if b == d else (join(g.mul(a, d), g.mul(c, b)), g.mul(b, d))
        if op == "neg":
            return g.neg(x[0][0]), x[0][1]
        if op == "mul":
            return g.mul(x[0][0], x[1][0]), g.mul(x[0][1], x[1][1])
        if op == "div":
            return g.mul(x[0][0], x[1][1]), g.mul(x[0][1], x[1][0])
        if op == "sqrt":
            v = self._variable(n)
            self.equations.append(g.sub(g.mul(g.mul(v, v), x[0][1]), x[0][0]))
            return v, g.one
        raise NotRational(f"'{op}' in the equations of the start")

    def _with_products(self, equation: int) -> int:
        """The equation with products that are a signal's definition written as that signal."""
        g, new = self.graph, {}
        for n in g.reachable([equation]):
            op, *a = g.nodes[n]
            if n in self._products and g.nodes[n][0] == "mul" and g.nodes[equation] != ("sub", self._products[n], n):
                new[n] = self._products[n]
            else:
                new[n] = n if op in ("leaf", "const") else getattr(g, op)(*(new[k] for k in a))
        return new[equation]

    def variables(self, equation: int) -> set[int]:
        """The variables an equation depends on."""
        return set(self._slopes[equation]) - self.fixed

    def degree(self, equation: int, variable: int) -> int:
        """1 or 2: the equation's degree in a variable; 3 stands for more."""
        slope = self._slopes[equation][variable]
        if variable not in self.graph.reachable([slope]):
            return 1
        second = self.graph.gradient(slope)[variable]
        return 2 if variable not in self.graph.reachable([second]) else 3


def plan(s: Sparse, drawable: set[int], first: set[int], random: Random | None = None) -> list[Step]:
    """Steps that give every variable a value; NotRational where this simple way does not lead through.

    drawable: variables that may be random. first: those that are drawn before anything is solved.
    random: makes another plan where there are several, for one may lead to a branch that another avoids.
    """
    steps: list[Step] = [Draw(v) for v in sorted(first)]
    last: list[Step] = []
    known, unsolved = set(first), list(s.equations)
    while unsolved:
        done = _forward(s, unsolved, known, steps)
        if not unsolved or done or _peel(s, unsolved, known, last):
            continue
        _tear(s, unsolved, known, steps, drawable, random)
    unknown = (
        {v for e in s.equations for v in s.variables(e)} - known - {x.variable for x in last if isinstance(x, Solve)}
    )
    return [*steps, *(Draw(v) for v in sorted(unknown)), *reversed(last)]


def _forward(s: Sparse, unsolved: list[int], known: set[int], steps: list[Step], highest: int = 2) -> bool:
    """Solve the first equation that has one variable left."""
    for e in unsolved:
        rest = s.variables(e) - known
        if len(rest) == 1:
            v = rest.pop()
            if s.degree(e, v) <= highest:
                steps.append(Solve(e, v, s.degree(e, v)))
                known.add(v)
                unsolved.remove(e)
                return True
    return False


def _peel(s: Sparse, unsolved: list[int], known: set[int], last: list[Step]) -> bool:
    """Put aside the equation of a variable that no other equation has."""
    where: dict[int, list[int]] = {}
    for e in unsolved:
        for v in s.variables(e) - known:
            where.setdefault(v, []).append(e)
    alone = [(s.degree(es[0], v), v, es[0]) for v, es in where.items() if len(es) == 1]
    for degree, v, e in sorted(alone):
        if degree <= 2:
            last.append(Solve(e, v, degree))
            unsolved.remove(e)
            return True
    return False


def _tear(
    s: Sparse,
    unsolved: list[int],
    known: set[int],
    steps: list[Step],
    drawable: set[int],
    random: Random | None,
) -> None:
    counts: dict[int, int] = {}
    for e in unsolved:
        for v in s.variables(e) - known:
            counts[v] = counts.get(v, 0) + 1
    if not counts:
        steps.extend(Check(e) for e in unsolved)
        unsolved.clear()
        return
    surplus = len(counts) > len(unsolved)
    order = sorted(counts, key=lambda v: (-counts[v], v))
    if random is not None:
        random.shuffle(order)
    for v in order:
        inner: list[Step] = []
        tried, remaining = known | {v}, list(unsolved)
        while _forward(s, remaining, tried, inner, highest=1):
            closing = next((e for e in remaining if not s.variables(e) - tried), None)
            if closing is not None:
                remaining.remove(closing)
                steps.append(Tear(v, tuple(x for x in inner if isinstance(x, Solve)), closing))
                known |= tried
                unsolved[:] = remaining
                return
    if surplus:
        chosen = next((v for v in order if v in drawable), order[0])
        steps.append(Draw(chosen))
        known.add(chosen)
        return
    raise NotRational("the start's equations are too entangled")


TRIES = 300


class Values:
    """Values of the variables over a field, found step by step. roots: {("sqrt", x): root} already chosen elsewhere.

    chose: True once one of several solutions was taken that may lie on different branches.
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
        """Take the steps. Raises NoSuchNumber where a root or a quotient does not exist."""
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
        found = roots(polynomial, self.ring.p)
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

    chose: True once a point took one of several solutions that may lie on different branches.
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

    def __call__(self) -> PointRows:
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
        """Raise for a start at which a node is 0 that is not 0 at the operating point: it solves other equations."""
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
