"""The directions in parameters that outputs do not show, at random points near a model's values.

The unknowns are the start of the states and the parameters. A direction is shown where the start's equations do not allow it, or
where a Taylor coefficient of an output changes along it in any stretch of the experiment: at rest, and after the inputs have
begun to move. So a steady start needs no solution formula. The rank is that of the observability-identifiability matrix of
A. Sedoglavic, "A probabilistic algorithm to test local algebraic observability in polynomial time", J. Symbolic Computation
33 (2002) 735-755, here in real numbers.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal, getcontext
from functools import partial
from itertools import chain
from random import Random
from typing import Any, Literal

import numpy as np

from hvdc_ident.sensitivity.structural.combinations import Point
from hvdc_ident.sensitivity.structural.regime import Equations, EquationSource
from hvdc_ident.sensitivity.structural.taylor_series import (
    ZERO,
    Array,
    TaylorSeries,
    Unclear,
    digits,
    eliminate,
    solve,
    values,
)

InputClass = Literal["constant", "step", "ramp", "free"]
SPREADS = ("0.2", "0.1", "0.05", "0.02", "0.01")
"""Shares of the values that points are drawn within: nearer where none is found further away."""
DIGITS = ((40, 60), (80, 120), (160, 240), (320, 480))
"""Few digits and more, then as many again where they do not tell rounding from information."""
MANY = 10**6 + 3
"""A prime: its fractions fill all digits, so that every operation rounds."""
TINY = 1e-9
"""A free start below this is one of rest at 0, and taken elsewhere."""
STEPS = 60
"""Newton steps; they double the digits once they are near."""
Series = list[Decimal]


class OutOfTime(Exception):
    """The time limit was reached."""


class NotReached(Exception):
    """A model that the method does not reach."""


@dataclass(frozen=True)
class Question:
    """Question of structural identifiability: equations at rest and after the event, parameters, and moved inputs.

    parameters: positions in p. moved: (position in w, class). rested: every state starts at rest. deadline: in the thread's time.
    """

    source: EquationSource
    rest: Equations
    move: Equations
    parameters: tuple[int, ...]
    moved: tuple[tuple[int, InputClass], ...]
    rested: bool
    deadline: float

    @property
    def order(self) -> int:
        """The Taylor order: enough for a linear model's outputs and their derivatives, and for a nonlinear one's in general."""
        n = len(self.rest.derivatives)
        return max(n + len(self.parameters) + 2, 2 * n + 3)

    @property
    def stretches(self) -> list[dict[int, InputClass]]:
        """The moves that are watched: each moved input on its own, then all together."""
        groups: list[dict[int, InputClass]] = [{k: kind} for k, kind in self.moved]
        if len(groups) > 1:
            return [*groups, dict(self.moved)]
        return groups or ([{}] if self.move is not self.rest else [])


def unseen_at_random(question: Question, seed: int) -> Point:
    """Return the directions that the outputs do not show at a random point.

    Everything is computed twice, in few digits and in more: what only rounding gives falls with the digits (J. Vignes, "Discrete
    stochastic arithmetic for validating results of numerical software", Numerical Algorithms 37 (2004) 377-390). What is 40 decades
    smaller than the terms it stands beside is below the last digit, and not reliably counted.
    Raises OutOfTime; NotReached where no start is found near the operating point, or no number of digits makes it clear.
    """
    why = ""
    for spread in SPREADS:
        for precisions in DIGITS:
            try:
                return _Pair(question, seed, Decimal(spread), precisions).unseen()
            except Unclear as e:
                why = str(e)
            except ArithmeticError:
                why = "no start was found near the operating point"
                break
    raise NotReached(why)


class _Start:
    """A random start in so many digits: parameters p, start y of states and unknowns, inputs w, time first.

    The same seed gives the same point in any number of digits.
    """

    def __init__(self, question: Question, seed: int, spread: Decimal) -> None:
        self.q, self.random = question, Random(seed)
        source = question.source

        def near(value: float | Decimal) -> Decimal:
            return Decimal(repr(float(value))) * (1 + spread * self.random.randrange(-MANY, MANY) / MANY)

        self.p = [
            near(x.value or 0.05 * x.size) if k in question.parameters else Decimal(repr(float(x.value)))
            for k, x in enumerate(source.model.parameters.values())
        ]
        self.w = [ZERO, *(Decimal(repr(float(v))) for v in source.u)]
        self.y = [Decimal(repr(float(v))) for v in source.point]
        free = [k for k, s in enumerate(question.rest.starts) if s is None]
        for k in free:
            self.y[k] = near(self.y[k] if abs(self.y[k]) > TINY else 0.1)
        self.fixed = [s for s in question.rest.starts if s is not None]
        unknown = [k for k in range(len(self.y)) if k not in free]
        self._newton(question.rest, [*self.fixed, *question.rest.residuals], unknown, self.y, self.w)

    def _leaves(self, equations: Equations, y: Sequence[Decimal], w: Sequence[Series]) -> dict[int, Series]:
        leaf = equations.graph.leaf
        leaves = {leaf("p", k): [v] for k, v in enumerate(self.p)} | {leaf("y", k): [v] for k, v in enumerate(y)}
        return leaves | {leaf("w", k): v for k, v in enumerate(w)}

    def _newton(self, e: Equations, zeros: Sequence[int], unknown: Sequence[int], y: Series, w: Series) -> None:
        """Move the unknown elements of y so that the nodes are 0."""
        if not zeros:
            return
        g = e.graph
        slopes = [[g.gradient(z).get(g.leaf("y", k), g.zero) for k in unknown] for z in zeros]
        nodes = e.behind([*zeros, *chain(*slopes)])
        close = Decimal(1).scaleb(-(getcontext().prec // 2) - 2)  # the step after it would be below the last digit
        for _ in range(STEPS):
            at = values(e, nodes, {n: v[0] for n, v in self._leaves(e, y, [[v] for v in w]).items()})
            matrix, right = np.array([[at[d] for d in row] for row in slopes]), [[at[z]] for z in zeros]
            step = solve(matrix, np.array(right))[:, 0]
            for k, d in zip(unknown, step, strict=True):
                y[k] -= d
            if all(abs(d) < close * (1 + abs(y[k])) for k, d in zip(unknown, step, strict=True)):
                return
        raise ArithmeticError("no start was found")

    def moved(self, group: Mapping[int, InputClass]) -> tuple[Series, list[Series]]:
        """The start and the inputs' series right after the inputs of a group have begun to move."""
        q, y = self.q, [*self.y]
        w = [self._move(group[k], v) if k in group else [v] for k, v in enumerate(self.w)]
        w[0] = [ZERO, Decimal(1)]
        if q.move.residuals:
            unknown = range(len(q.move.derivatives), len(y))
            self._newton(q.move, q.move.residuals, unknown, y, [v[0] for v in w])
        return y, w

    def _move(self, kind: InputClass, level: Decimal) -> Series:
        def size() -> Decimal:
            return Decimal(self.random.randrange(5000, 20000)) / MANY

        if kind == "step":
            return [level + size()]
        return [level, *(size() for _ in range(1 if kind == "ramp" else self.q.order))]

    def series(
        self, e: Equations, y: Series, w: list[Series], directions: Array, order: int, watched: Sequence[int]
    ) -> TaylorSeries:
        """The series of some equations from a start, along directions of the states' start and of the parameters."""
        leaf = e.graph.leaf
        names = [*(leaf("y", k) for k in range(len(e.derivatives))), *(leaf("p", k) for k in self.q.parameters)]
        return TaylorSeries(e, self._leaves(e, y, w), dict(zip(names, directions, strict=True)), order, watched)


class _Pair:
    """A random start in few and in more digits, and what is left of the directions, (2, states and parameters, k)."""

    def __init__(self, question: Question, seed: int, spread: Decimal, precisions: tuple[int, int]) -> None:
        self.q, self.precisions = question, precisions
        self.starts = []
        for precision in precisions:
            with digits(precision):
                self.starts.append(_Start(question, seed, spread))
        # of parameters the logarithms; a state may rest at 0, which rounding makes almost 0
        states, p = [Decimal(1)] * len(question.rest.derivatives), self.starts[0].p
        self.scales = np.array([*states, *(p[k] for k in question.parameters)])
        self.directions = np.array([np.diag(self.scales)] * 2)
        self.directions[self.directions == 0] = ZERO

    def unseen(self) -> Point:
        """The directions that nothing shows."""
        q = self.q
        self._watch(q.rest, lambda s: (s.y, [[v] for v in s.w]), 0, self.starts[0].fixed)
        if q.rested:
            self._watch(q.rest, lambda s: (s.y, [[v] for v in s.w]), 0)
        else:
            self._watch(q.rest, lambda s: (s.y, [[ZERO, Decimal(1)], *([v] for v in s.w[1:])]), q.order)
        for group in q.stretches:
            self._watch(q.move, partial(_Start.moved, group=group), q.order)
        nx, theta = len(q.rest.derivatives), [float(self.starts[1].p[k]) for k in q.parameters]
        relative = np.swapaxes(self.directions / self.scales[:, None], 1, 2)
        rounding = _largest(relative[1] - relative[0], axis=1)
        pivots, others, block = eliminate(relative[..., nx:], rounding[:, None])
        basis = np.zeros((len(pivots), len(theta)))
        basis[:, pivots] = np.eye(len(pivots))
        basis[:, others] = block[1].astype(float)
        return Point(np.array(theta), basis)

    def _watch(
        self,
        equations: Equations,
        start: Callable[[_Start], tuple[Series, list[Series]]],
        order: int,
        watched: Sequence[int] | None = None,
    ) -> None:
        """Take out the directions that the outputs (or the nodes watched) show up to an order."""
        nodes = equations.outputs if watched is None else watched
        if not nodes or not self.directions.shape[2]:
            return
        both: list[TaylorSeries] = []
        for precision, s, directions in zip(self.precisions, self.starts, self.directions, strict=True):
            with digits(precision):
                both.append(s.series(equations, *start(s), directions, order, watched or ()))
        for _ in range(order + 1):
            if time.thread_time() > self.q.deadline:
                raise OutOfTime
            for precision, series in zip(self.precisions, both, strict=True):
                with digits(precision):
                    series.advance()
            with digits(self.precisions[1]):
                rounding = _largest(both[1].derivatives() - both[0].derivatives(), axis=0)
                shown, left, block = eliminate(np.array([series.derivatives(nodes) for series in both]), rounding)
                if not shown:
                    continue
                turns = [partial(_turned, left, shown, part) for part in block]
                self.directions = np.array([turn(d) for turn, d in zip(turns, self.directions, strict=True)])
                for series, turn in zip(both, turns, strict=True):
                    series.turn(turn)
            if not left:
                return


def _largest(a: Array, axis: int) -> Any:
    """The largest magnitudes along an axis."""
    return np.abs(a).max(axis=axis)


def _turned(left: Sequence[int], shown: Sequence[int], block: Array, columns: Array) -> Array:
    """Columns, one a direction, as those of the directions that are left."""
    return columns[..., left] - columns[..., shown] @ block
