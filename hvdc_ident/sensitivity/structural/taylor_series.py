"""Taylor series in time of the nodes of a model's graph in decimals of any length, each with derivatives along directions.

The directions are changes of the start and of the parameters. Those that a watched quantity shows are taken out order by order,
so that the work falls with what is left to decide.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from decimal import Context, Decimal, InvalidOperation, getcontext, localcontext
from fractions import Fraction
from itertools import chain
from typing import Any, TypeAlias

import mpmath  # type: ignore[import-untyped]  # it has no type hints
import numpy as np

from hvdc_ident.sensitivity.structural.regime import Equations

Array: TypeAlias = np.ndarray[Any, Any]
ZERO, ONE = Decimal(0), Decimal(1)
AGREEING = Decimal("1e-8")
"""Share of itself by which a number differs at most when it is computed in more digits."""
LEFT = Decimal("1e-15")
"""Share of the rounding in few digits that may be left in more, of which there are at least 20 more."""
ARITHMETIC: Mapping[str, Callable[..., Decimal]] = {
    "add": operator.add,
    "sub": operator.sub,
    "neg": operator.neg,
    "mul": operator.mul,
    "div": operator.truediv,
    "inverse": lambda x: ONE / x,
    "select": lambda x: x,
}
CALLED = {"sqrt0": "sqrt", "pow": "power"}
"""Names of functions of the graph where they are others."""


class Unclear(ArithmeticError):
    """A number that is neither sure nor rounding: more digits may tell."""


def digits(count: int) -> Any:
    """A context manager in which decimals carry so many digits."""
    return localcontext(Context(prec=count))


def zeros(*shape: int) -> Array:
    """An array of the decimal 0."""
    return np.full(shape, ZERO, object)


def _significant(pair: Array, rounding: Array) -> Array:
    """Where numbers, (2, m, n) computed in few and in more digits, are not 0. Raises Unclear.

    rounding: (m, n) the error of those in few digits. A number that is not 0 agrees. What is left of one that is 0 is far smaller
    than the rounding, for it falls by as many decades as there are digits more, unless the few digits happen to cancel.
    """
    few, more = pair
    size = np.abs(more)
    agree = (size > 0) & (np.abs(more - few) <= size * AGREEING)
    if not np.all(agree | (size <= rounding * LEFT) | (np.abs(few) <= size * AGREEING)):
        raise Unclear("rounding and information are not told apart")
    return np.asarray(agree, bool)


def eliminate(pair: Array, rounding: Array) -> tuple[list[int], list[int], Array]:
    """Return (pivots, others, block): a matrix, (2, m, n) in few and in more digits, reduced to 1 in each pivot's column.

    Its null space is v[pivots] = -block @ v[others], block: (2, pivots, others). Gauss and Jordan with the largest pivot, which
    no rounding in its row may hide. rounding: the error of the numbers in few digits, for each column or each element.
    """
    a, error, pivots = pair.copy(), np.broadcast_to(rounding, pair.shape[1:]).copy(), list[int]()
    while len(pivots) < min(a.shape[1:]):
        row = len(pivots)
        sure = _significant(a[:, row:], error[row:])
        size, rest = np.abs(a[1, row:]) * sure, np.abs(a[1, row:]) * ~sure
        k, column = (int(i) for i in np.unravel_index(np.argmax(size), size.shape))
        if not size[k, column]:
            break
        if size[k, column] <= max(error[row + k].max() * LEFT, rest[k].max()):
            raise Unclear("the rounding of one direction hides what is seen of another")
        a[:, [row, row + k]], error[[row, row + k]] = a[:, [row + k, row]], error[[row + k, row]]
        pivot = a[:, row, column][:, None]
        a[:, row] = a[:, row] / pivot
        error[row] = (error[row] + np.abs(a[1, row]) * error[row, column]) / abs(pivot[1])
        others = np.arange(a.shape[1]) != row
        factor = a[:, others, column][..., None]
        error[others] += np.abs(factor[1]) * error[row] + error[others, column][:, None] * np.abs(a[1, row])
        a[:, others] = a[:, others] - factor * a[:, [row]]
        a[:, others, column] = ZERO
        pivots.append(column)
    left = [c for c in range(a.shape[2]) if c not in pivots]
    block = a[:, : len(pivots)][..., left]
    return pivots, left, block * _significant(block, error[: len(pivots)][:, left])


def solve(matrix: Array, right: Array) -> Array:
    """The solution, (n, k), of a square linear system; unknowns that it leaves open are 0.

    Raises ArithmeticError where it has none. Pivots below the root of the last digit are 0.
    """
    n, least = len(matrix), ONE.scaleb(-(getcontext().prec // 2))
    a = np.hstack([matrix, right])
    size = np.abs(a[:, :n]).max(axis=1)
    a[size > 0] = a[size > 0] / size[size > 0][:, None]
    largest, pivots = np.abs(a[:, n:]).max(), list[int]()
    for i in range(n):
        k, column = (int(j) for j in np.unravel_index(np.argmax(np.abs(a[i:, :n])), (n - i, n)))
        if abs(a[i + k, column]) < least:
            break
        a[[i, i + k]] = a[[i + k, i]]
        a[i] = a[i] / a[i, column]
        others = np.arange(n) != i
        a[others] = a[others] - a[others, column][:, None] * a[i]
        pivots.append(column)
    if len(pivots) < n and np.abs(a[len(pivots) :, n:]).max() > least.sqrt() * largest:
        raise ZeroDivisionError("the equations contradict each other")
    result = zeros(*right.shape)
    result[pivots] = a[: len(pivots), n:]
    return result


def _function(name: str, arguments: Sequence[Decimal]) -> Decimal:
    """The value of an elementary function; ArithmeticError where it has none that is real."""
    prec = getcontext().prec
    with mpmath.workdps(prec + 5):
        try:
            return Decimal(
                mpmath.nstr(getattr(mpmath, CALLED.get(name, name))(*(mpmath.mpf(str(x)) for x in arguments)), prec)
            )
        except ValueError as e:
            raise InvalidOperation(f"{name} has no value: {e}") from None


def _number(value: float) -> Decimal:
    """The fraction that a float stands for: of small terms if there is one, else its decimal text."""
    if not math.isfinite(value):
        raise InvalidOperation("a constant that is not finite")
    near = Fraction(value).limit_denominator(10**6)
    return Decimal(near.numerator) / near.denominator if float(near) == value else Decimal(repr(value))


def values(equations: Equations, nodes: Iterable[int], leaves: Mapping[int, Decimal]) -> dict[int, Decimal]:
    """{node: value} of nodes in an order of evaluation. Raises ArithmeticError where one has none."""
    by_node: dict[int, Decimal] = {}
    for n in nodes:
        op, *a = equations.graph.nodes[n]
        if op == "leaf":
            by_node[n] = leaves[n]
        elif op == "const":
            by_node[n] = _number(a[0])
        else:
            x = [by_node[k] for k in equations.arguments(n)]
            by_node[n] = ARITHMETIC[op](*x) if op in ARITHMETIC else _function(op, x)
    return by_node


class TaylorSeries:
    """Series of the nodes that equations need, from a start, along directions.

    c: (nodes, order + 1, 1 + directions) coefficients, each with its derivatives. point: of each leaf its coefficients from order
    0 on; one coefficient: constant, or the start of a state or unknown. directions: {leaf: row of derivatives} of the starts
    of states and of the parameters. watched: nodes beside the outputs.
    """

    def __init__(
        self,
        equations: Equations,
        point: Mapping[int, Sequence[Decimal]],
        directions: Mapping[int, Array],
        order: int,
        watched: Sequence[int] = (),
    ) -> None:
        self.equations, self.graph = equations, equations.graph
        e, g = equations, equations.graph
        self.unknowns = [g.leaf("y", len(e.derivatives) + j) for j in range(len(e.residuals))]
        self.jacobian = [[g.gradient(r).get(z, g.zero) for z in self.unknowns] for r in e.residuals]
        self.slopes: dict[int, list[tuple[int, int]]] = {}
        self.nodes = self._closed([*e.outputs, *watched, *e.derivatives, *e.residuals, *chain(*self.jacobian)])
        self.at = {n: i for i, n in enumerate(self.nodes)}
        self.static = self._static(point)
        self.moving = [n for n in self.nodes if n not in self.static and g.nodes[n][0] != "leaf"]
        self.loop = [n for n in e.behind(e.residuals) if n in set(self.moving)]
        self.order = -1
        width = next(iter(directions.values())).size if directions else 0
        self.c = zeros(len(self.nodes), order + 1, 1 + width)
        begin = values(e, self.nodes, {n: series[0] for n, series in point.items()})
        self.c[:, 0, 0] = [begin[n] for n in self.nodes]
        for n, series in point.items():
            if n in self.at:
                self.c[self.at[n], : len(series), 0] = series[: order + 1]
        for n, row in directions.items():
            if n in self.at:
                self.c[self.at[n], 0, 1:] = row

    def _closed(self, roots: Sequence[int]) -> list[int]:
        """The nodes behind the roots and behind the derivatives of the functions among them."""
        g, pending, closed = self.graph, list(roots), set[int]()
        while pending:
            new = self.equations.behind(pending, known=closed)
            closed.update(new)
            functions = [n for n in new if g.nodes[n][0] not in (*ARITHMETIC, "leaf", "const")]
            self.slopes |= {n: self._power(n) if g.nodes[n][0] == "pow" else g.slopes(n) for n in functions}
            pending = [slope for n in functions for _, slope in self.slopes[n]]
        return sorted(closed)

    def _power(self, n: int) -> list[tuple[int, int]]:
        """(argument, derivative of n = x**a with respect to it) pairs, written with n itself, so that they come to an end."""
        g, (_, x, a) = self.graph, self.graph.nodes[n]
        by_base = (x, g.div(g.mul(a, n), x))
        return [by_base] if g.value(a) is not None else [by_base, (a, g.mul(n, g.call("log", x)))]

    def _static(self, point: Mapping[int, Sequence[Decimal]]) -> set[int]:
        """The nodes that do not change in time."""
        static: set[int] = set()
        for n in self.nodes:
            op, *a = self.graph.nodes[n]
            if op == "leaf":
                still = a[0] == "p" or (a[0] == "w" and len(point[n]) == 1)
            else:
                still = all(k in static for k in self.equations.arguments(n))
            if still:
                static.add(n)
        return static

    def advance(self) -> None:
        """Compute the coefficients of the next order. Raises ArithmeticError where one has no value."""
        self.order += 1
        k, c, g = self.order, self.c, self.graph
        if k == 0:
            self._compute([n for n in self.nodes if g.nodes[n][0] not in ("leaf", "const")], (slice(1, None),))
            return
        for i, d in enumerate(self.equations.derivatives):
            x = g.leaf("y", i)
            if x in self.at:
                c[self.at[x], k] = c[self.at[d], k - 1] / k
        self._compute(self.moving, (slice(0, 1), slice(1, None)))

    def _compute(self, nodes: Sequence[int], parts: Sequence[slice]) -> None:
        """Set a coefficient of the nodes; before that the unknowns', in which the equations are linear, value first."""
        k, c = self.order, self.c
        if self.unknowns:
            loop = self.loop if k else nodes
            at = [self.at[r] for r in self.equations.residuals]
            for part in parts:
                self._rows(loop)
                jacobian = np.array([[c[self.at[d], 0, 0] for d in row] for row in self.jacobian])
                step = solve(jacobian, c[at, k, part])
                for z, row in zip(self.unknowns, step, strict=True):
                    if z in self.at:
                        c[self.at[z], k, part] = -row
        self._rows(nodes)

    def _rows(self, nodes: Sequence[int]) -> None:
        k, at = self.order, self.at
        for n in nodes:
            op, *a = self.graph.nodes[n]
            if op in ("add", "sub"):
                x, y = self.c[at[a[0]], k], self.c[at[a[1]], k]
                row = x + y if op == "add" else x - y
            elif op == "neg":
                row = -self.c[at[a[0]], k]
            elif op == "select":
                row = self.c[at[self.equations.arguments(n)[0]], k]
            elif op == "mul":
                row = self._product(*a)
            elif op in ("div", "inverse"):
                row = self._quotient(n, *a)
            else:
                row = self._chained(n)
            self.c[at[n], k] = row

    def _product(self, a: int, b: int) -> Array:
        """The coefficient of a product."""
        k, x, y = self.order, self.c[self.at[a]], self.c[self.at[b]]
        if a in self.static:
            return _sum(x[:1], y[k : k + 1])
        if b in self.static:
            return _sum(x[k : k + 1], y[:1])
        return _sum(x[: k + 1], y[k::-1])

    def _quotient(self, n: int, *a: int) -> Array:
        """The coefficient of n = a/b, or of 1/b where there is one argument, from a = n b."""
        k, q, b = self.order, self.c[self.at[n]], self.c[self.at[a[-1]]]
        rest = self.c[self.at[a[0]], k].copy() if len(a) > 1 else zeros(b.shape[1])
        rest[0] += ONE if len(a) == 1 and k == 0 else ZERO
        if a[-1] not in self.static and k:
            rest = rest - _sum(q[:k], b[k:0:-1])
        row = rest / b[0, 0]
        row[1:] -= row[0] / b[0, 0] * b[0, 1:]
        return row

    def _chained(self, n: int) -> Array:
        """The coefficient of a function, from its derivatives by its arguments: k n_k = sum of j a_j slope_(k-j)."""
        k, c = self.order, self.c
        if k == 0:
            row = sum((c[self.at[s], 0, 0] * c[self.at[a], 0] for a, s in self.slopes[n]), zeros(c.shape[2]))
            row[0] = c[self.at[n], 0, 0]
            return row
        orders = np.array([Decimal(j) for j in range(1, k + 1)])[:, None]
        total = zeros(c.shape[2])
        for a, s in self.slopes[n]:
            if a not in self.static:
                total = total + _sum(orders * c[self.at[a], 1 : k + 1], c[self.at[s], k - 1 :: -1][:k])
        return total / k

    def derivatives(self, nodes: Sequence[int] | None = None) -> Array:
        """(nodes, directions) of the newest coefficients; of all nodes unless some are given."""
        newest = self.c[:, self.order, 1:]
        return newest if nodes is None else newest[[self.at[n] for n in nodes]]

    def turn(self, turned: Callable[[Array], Array]) -> None:
        """Go on along other directions: combinations of the present ones, (..., directions) each."""
        past = self.c[:, : self.order + 1]
        along = turned(past[..., 1:])
        self.c = zeros(*self.c.shape[:2], 1 + along.shape[2])
        self.c[:, : self.order + 1] = np.concatenate([past[..., :1], along], axis=2)


def _sum(a: Array, b: Array) -> Array:
    """The sum of the products of the rows of two blocks, each a value and its derivatives."""
    row = a[:, 0] @ b
    row[1:] += b[:, 0] @ a[:, 1:]
    return row
