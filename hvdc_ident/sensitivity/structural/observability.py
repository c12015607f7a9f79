"""Rows of the observability-identifiability matrix of a model in one regime at random points.

The unknowns are the start of the states and the parameters. Rows: the derivatives of the outputs' Taylor coefficients in
every stretch of the experiment, and of the equations the start obeys, so that a steady start needs no solution formula.
In a regime every limiter is on a chosen branch, so that only smooth functions stay.
After A. Sedoglavic, "A probabilistic algorithm to test local algebraic observability in polynomial time", J. Symbolic
Computation 33 (2002) 735-755.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from random import Random
from typing import Any, Literal

import numpy as np

from hvdc_ident.errors import InputError, SteadyStateError, unknown_name
from hvdc_ident.expression import FUNCTIONS
from hvdc_ident.model import Model
from hvdc_ident.sensitivity.structural.finite_field import (
    Array,
    HighPrecision,
    NoSuchNumber,
    NotRational,
    Ring,
    context,
)
from hvdc_ident.sensitivity.structural.taylor_series import Equations, Taylor, inverse
from hvdc_ident.simulate import Graph, ModelEquations, engine_of

InputClass = Literal["constant", "step", "ramp", "free"]
JUMPS = 8  # step sizes tried from one start before another start is drawn


@dataclass(frozen=True)
class Question:
    """Question of structural identifiability: equations at rest and after the event, parameters, and moved inputs.

    moved: (position in w, class). parameters: positions in p. rested: every state starts at rest. highest: the
    Taylor order if it is not to be the usual one.
    """

    source: EquationSource
    rest: Equations
    move: Equations
    parameters: tuple[int, ...]
    moved: tuple[tuple[int, InputClass], ...]
    rested: bool
    highest: int = 0

    @property
    def order(self) -> int:
        """The Taylor order: enough for a linear model's outputs and their derivatives, and for a nonlinear one's in general."""
        n = len(self.rest.derivatives)
        return self.highest or max(n + len(self.parameters) + 2, 2 * n + 3)

    @property
    def start(self) -> list[int]:
        """The nodes that are 0 at the start."""
        zero = self.rest.graph.zero
        return [n for n in (*(s for s in self.rest.starts if s is not None), *self.rest.residuals) if n != zero]


@dataclass(frozen=True)
class PointRows:
    """Reduced rows over the parameters alone at one point, and the parameters' values there."""

    ring: Ring
    matrix: Array
    pivots: tuple[int, ...]
    theta: tuple[Any, ...]

    @property
    def seen(self) -> tuple[int, ...]:
        """Positions of the parameters that are seen: their unit row is among the rows."""
        return tuple(c for r, c in zip(self.matrix, self.pivots, strict=True) if np.count_nonzero(r) == 1)


@dataclass(frozen=True)
class Base:
    """A point: parameters, start [states, unknowns], inputs with time first, and the values of roots already chosen."""

    p: list[Any]
    y: list[Any]
    w: list[Any]
    known: dict[tuple[str, Any], Any]
    nonzero: frozenset[int] = frozenset()  # nodes that are not 0 at the start


Jump = Callable[[Base, list[Any], "set[int]", Random], list[Any]]


def rows(question: Question, ring: Ring, base: Base, jump: Jump, random: Random, deadline: float) -> PointRows:
    """The rows at one base point. jump: the unknowns right after the inputs have jumped to the given values."""
    q, nx = question, len(question.rest.derivatives)
    found: list[Array] = []
    theta = [base.p[k] for k in q.parameters]

    def series(
        e: Equations, y: list[Any], w: Sequence[Sequence[Any]], order: int, roots: Sequence[int]
    ) -> Mapping[int, Array]:
        t = Taylor(e, ring, base.p, q.parameters, random.randrange(2**31), deadline)
        t.known = base.known
        return t.run(y, w, order, roots)

    def watch(e: Equations, y: list[Any], w: Sequence[Sequence[Any]], order: int) -> None:
        result = series(e, y, w, order, e.outputs)
        found.extend(result[n][:, 1:] for n in e.outputs)

    still = [[v] for v in base.w]
    uses_time = [[base.w[0], 1], *still[1:]]
    watch(q.rest, base.y, still if q.rested else uses_time, 0 if q.rested else q.order)
    constraint = series(q.rest, base.y, still, 0, q.start)
    for n in q.start:
        if ring.p and int(constraint[n][0, 0]) % ring.p:
            raise NoSuchNumber("the start does not hold")
        found.append(constraint[n][:, 1:])
    for group in stretches(q):
        y, w = _after(q, ring, base, jump, group, random)
        watch(q.move, y, w, q.order)
    reduced, pivots = ring.rref(np.concatenate(found))
    first = sum(c < nx for c in pivots)
    return PointRows(ring, reduced[first:, nx:], tuple(c - nx for c in pivots[first:]), tuple(theta))


def stretches(q: Question) -> list[dict[int, InputClass]]:
    """The moves that are watched: each moved input on its own, then all together."""
    groups: list[dict[int, InputClass]] = [{k: kind} for k, kind in q.moved]
    return groups + ([dict(q.moved)] if len(groups) > 1 else [] if groups or q.move is q.rest else [{}])


def _after(
    q: Question, ring: Ring, base: Base, jump: Jump, group: Mapping[int, InputClass], random: Random
) -> tuple[list[Any], list[list[Any]]]:
    """The start and the inputs' series right after the inputs of a group have begun to move."""
    for _ in range(JUMPS):
        w = [_move(group[k], ring, v, random, q.order) if k in group else [v] for k, v in enumerate(base.w)]
        w[0] = [base.w[0], 1]
        jumped = {k for k in range(len(w)) if w[k][0] != base.w[k]}
        if not (q.move.residuals and (jumped or q.move is not q.rest)):
            return base.y, w
        try:
            return [*base.y[: len(q.rest.derivatives)], *jump(base, [v[0] for v in w], jumped, random)], w
        except NoSuchNumber:
            continue
    raise NoSuchNumber("no jump was found")


def _move(kind: InputClass, ring: Ring, level: Any, random: Random, order: int) -> list[Any]:
    def size() -> Any:
        return ring.number(Fraction(random.randrange(2, 10**6) if ring.p else random.randrange(5000, 20000), 10**6))

    if kind == "step":
        return [ring.reduce(level + size())]
    return [level, *(size() for _ in range(1 if kind == "ramp" else order))]


def affected(q: Question, jumped: set[int]) -> set[int]:
    """Positions of the unknowns that jump when inputs do, or when a limiter's branch changes."""
    g, nx = q.move.graph, len(q.move.derivatives)
    leaves = [{g.nodes[n][1:] for n in g.reachable([r]) if g.nodes[n][0] == "leaf"} for r in q.move.residuals]
    found = {i for i, (a, b) in enumerate(zip(q.rest.residuals, q.move.residuals, strict=True)) if a != b}
    found |= {i for i, used in enumerate(leaves) if any(("w", k) in used for k in jumped)}
    while True:
        more = {i for i, used in enumerate(leaves) if any(("y", nx + j) in used for j in found)} - found
        if not more:
            return found
        found |= more


class RealPoints:
    """Random points near the operating point, in real numbers of 120 decimals."""

    def __init__(self, question: Question, random: Random, deadline: float) -> None:
        self.q, self.ring, self.random, self.deadline = question, HighPrecision(), random, deadline

    def __call__(self) -> PointRows:
        """Return the rows at one more point."""
        with context():
            for spread in (0.2, 0.1, 0.05, 0.02, 0.01):
                try:
                    return rows(self.q, self.ring, self._base(spread), self._jump, self.random, self.deadline)
                except ArithmeticError:
                    continue
        raise NotRational("no start was found near the operating point")

    def _near(self, value: float, spread: float) -> Decimal:
        share = Decimal(self.random.randrange(-(10**6), 10**6)) / 10**6
        return Decimal(repr(float(value))) * (1 + Decimal(str(spread)) * share)

    def _base(self, spread: float) -> Base:
        m, q = self.q.source.model, self.q
        p = [
            self._near(x.value or 0.05 * x.size, spread) if k in q.parameters else Decimal(repr(x.value))
            for k, x in enumerate(m.parameters.values())
        ]
        w = [Decimal(0), *(Decimal(repr(float(v))) for v in q.source.u)]
        y = [Decimal(repr(float(v))) for v in q.source.point]
        free = [k for k, s in enumerate(q.rest.starts) if s is None]
        for k in free:
            y[k] = self._near(float(y[k]) or 0.1, spread)
        zeros = [s for s in q.rest.starts if s is not None] + list(q.rest.residuals)
        unknown = [k for k in range(len(y)) if k not in free]
        return Base(p, self._newton(zeros, unknown, p, y, w), w, {})

    def _newton(self, zeros: list[int], unknown: list[int], p: list[Any], y: list[Any], w: list[Any]) -> list[Any]:
        if not zeros:
            return y
        q = self.q
        flat = Equations(q.rest.graph, (q.rest.graph.zero,) * len(y), (), (), (), ())
        for _ in range(60):
            t = Taylor(flat, self.ring, p, (), 0, self.deadline)
            result = t.run(y, [[v] for v in w], 0, zeros)
            block = np.array([result[n][0] for n in zeros])
            step = self.ring.product(inverse(self.ring, block[:, [1 + k for k in unknown]]), block[:, :1])[:, 0]
            y = list(y)
            for k, d in zip(unknown, step, strict=True):
                y[k] = y[k] - d
            if all(abs(d) < Decimal("1e-100") * (1 + abs(y[k])) for k, d in zip(unknown, step, strict=True)):
                return y
        raise NoSuchNumber("no start was found")

    def _jump(self, base: Base, w: list[Any], jumped: set[int], random: Random) -> list[Any]:
        nx = len(self.q.rest.derivatives)
        unknown = [nx + k for k in sorted(affected(self.q, jumped))]
        zeros = [self.q.move.residuals[k - nx] for k in unknown]
        return self._newton(zeros, unknown, base.p, base.y, w)[nx:] if unknown else base.y[nx:]


Start = Literal["steady", "free", "given"]
MODES = ("low", "inside", "high", "first", "second")


class EquationSource:
    """The model's graph with its limiters, and the point at which each limiter's branch is read.

    start: per state "steady", "free" or "given". values: parameters, inputs and states by name at the operating point.
    """

    def __init__(self, model: Model, outputs: Sequence[str], start: Mapping[str, Start]) -> None:
        self.model, self.start = model, dict(start)
        self.structure = ModelEquations(model, (), outputs)
        self.graph = self.structure.graph
        self.p = np.array([x.value for x in model.parameters.values()])
        self.u = np.array([x.value for x in model.inputs.values()])
        self.smooth = Graph()  # of every regime, so that equal parts are equal nodes
        self._point: Array | None = None

    @property
    def point(self) -> Array:
        """(states + unknowns,) of the operating point; guesses where nothing rests."""
        if self._point is None:
            try:
                n = len(self.structure.states) + len(self.structure.unknowns)
                self._point = engine_of(self.model).start(self.p, self.u, model=self.model)[0][:n]
            except SteadyStateError:
                if "steady" in self.start.values():
                    raise
                guesses = [1.0 if s.guess is None else s.guess for s in self.model.states.values()]
                self._point = np.array([*guesses, *(self.model.algebraic[n].start for n in self.structure.unknowns)])
        return self._point

    def leaves(self) -> dict[int, float]:
        """{leaf: value} at the operating point."""
        g = self.graph
        y = self.point
        values = {g.leaf("p", k): float(v) for k, v in enumerate(self.p)}
        values |= {g.leaf("y", k): float(v) for k, v in enumerate(y)}
        values |= {g.leaf("w", 1 + k): float(v) for k, v in enumerate(self.u)}
        values[g.leaf("w", 0)] = 0.0
        return values

    def equations(self, regime: Mapping[str, str]) -> Equations:
        """The equations with the limiters of the named signals on the given branches, all others as at the operating point."""
        s = self.structure
        forced = {self._limiter(name): (name, mode) for name, mode in regime.items()}
        conditions = self._conditions()
        branch = _Branches(self, conditions, {n: self._branch(n, *m) for n, m in forced.items()})
        take = branch.take
        derivatives = [take(n) for n in s.derivatives]
        starts = [self._start(k, name, derivatives, branch) for k, name in enumerate(s.states)]
        named = [*self.model.signals, *(n for n in self.model.algebraic if n not in s.unknowns)]
        return Equations(
            branch.graph,
            tuple(derivatives),
            tuple(take(n) for n in s.residuals),
            tuple(take(n) for n in s.observed),
            tuple(starts),
            tuple(take(s.nodes[n]) for n in named),
        )

    def _start(self, k: int, name: str, derivatives: list[int], branch: _Branches) -> int | None:
        g, s = branch.graph, self.structure
        if self.start[name] == "free":
            return None
        given, rest = s.starts[k], s.rests[k]
        fixed = given if self.start[name] == "given" else rest
        return derivatives[k] if fixed is None else g.sub(g.leaf("y", k), branch.take(fixed))

    # --- limiters ---

    def active(self) -> tuple[str, ...]:
        """ "NAME: low | high" for each named signal whose limiter holds it at the operating point."""
        if not self.graph.switches:
            return ()
        conditions, found = self._conditions(), []
        for name in self.model.signals:
            key = self.graph.nodes[self.structure.nodes[name]]
            if key[0] != "select":
                continue
            low = conditions[key[1]]
            inner = self.graph.nodes[key[3]]
            if self._is_clip(key):
                high = not low and conditions[inner[1]]
                found += [f"{name}: {'low' if low else 'high'}"] if low or high else []
        return tuple(found)

    def _conditions(self) -> dict[int, bool]:
        """Return {condition: True where it holds} at the operating point."""
        g = self.graph
        if not g.switches:
            return {}
        signs = [v < 0 for v in g.evaluate(g.switches, self.leaves())]
        holds: dict[int, bool] = {}
        for n, (op, *a) in enumerate(g.nodes):
            if op == "switch":
                holds[n] = signs[a[0]]
            elif op == "bool":
                holds[n] = bool(a[0])
            elif op == "not":
                holds[n] = not holds[a[0]]
            elif op in ("and", "or"):
                holds[n] = all(holds[x] for x in a) if op == "and" else any(holds[x] for x in a)
        return holds

    def _is_clip(self, key: tuple) -> bool:
        inner = self.graph.nodes[key[3]]
        return inner[0] == "select" and key[2] != inner[3]

    def _limiter(self, name: str) -> int:
        if name not in self.structure.nodes:
            raise unknown_name("signal", name, list(self.structure.nodes), where=f"model '{self.model.name}', regime")
        node = self.structure.nodes[name]
        if self.graph.nodes[node][0] != "select":
            raise InputError(
                f"the signal '{name}' is not limited",
                where=f"model '{self.model.name}', regime",
                expected="a signal that is a clip, min or max",
                hint="name the signal whose own expression begins with the limiter",
            )
        return node

    def _branch(self, node: int, name: str, mode: str) -> int:
        key = self.graph.nodes[node]
        choices = {"first": key[2], "second": key[3]}
        if self._is_clip(key):
            inner = self.graph.nodes[key[3]]
            choices = {"low": key[2], "high": inner[2], "inside": inner[3]}
        if mode not in choices:
            raise InputError(
                f"the limiter of '{name}' has no mode '{mode}'",
                where=f"model '{self.model.name}', regime",
                expected=f"one of {', '.join(choices)}",
            )
        return choices[mode]


class _Branches:
    """A graph made again with one branch of every limiter, and inverse functions written with those that have series."""

    def __init__(self, source: EquationSource, holds: Mapping[int, bool], forced: Mapping[int, int]) -> None:
        self.origin, self.source, self.graph, self.holds, self.forced = (
            source,
            source.graph,
            source.smooth,
            holds,
            forced,
        )
        self.known: dict[int, int] = {}

    def take(self, node: int) -> int:
        """The node's counterpart."""
        for n in self._needed(node):
            if n not in self.known:
                self.known[n] = self._make(n)
        return self.known[node]

    def _chosen(self, n: int) -> tuple[int, ...]:
        key = self.source.nodes[n]
        if n in self.forced:
            return (self.forced[n],)
        if key[0] == "select":
            return (key[2] if self.holds[key[1]] else key[3],)
        return self.source.arguments(n)

    def _needed(self, root: int) -> list[int]:
        seen, stack = set(), [root]
        while stack:
            n = stack.pop()
            if n not in seen and n not in self.known:
                seen.add(n)
                stack.extend(self._chosen(n))
        return sorted(seen)

    def _make(self, n: int) -> int:
        g, (op, *a) = self.graph, self.source.nodes[n]
        if op == "leaf":
            return g.leaf(*a)
        if op == "const":
            return g.constant(a[0])
        x = [self.known[k] for k in self._chosen(n)]
        if op == "select" or n in self.forced:
            return x[0]
        if op in ("add", "sub", "mul", "div", "neg"):
            return getattr(g, op)(*x)
        if op == "pow":
            return g.call("exp", g.mul(x[1], g.call("log", x[0])))
        if op == "atan2":
            return g.add(g.call("atan", g.div(*x)), g.constant(self._turns(*a)))
        if op in FUNCTIONS and (series := FUNCTIONS[op].series) is not None:
            return series(g, x[0])
        return g.call("sqrt" if op == "sqrt0" else op, *x)

    def _turns(self, y: int, x: int) -> float:
        """Return atan2(y, x) - atan(y/x) at the operating point."""
        top, bottom = self.source.evaluate([y, x], self.origin.leaves())
        return 0.0 if bottom > 0 else math.copysign(math.pi, top)
