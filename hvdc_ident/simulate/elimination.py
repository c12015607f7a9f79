"""Gaussian elimination of the Rosenbrock matrix as straight-line code: only the entries that are not 0, no loops.

The matrix is M s - J with s = 1/(h gamma), M = 1 for states and 0 for unknowns. Pivots are taken on the diagonal in an
order chosen once from the pattern (Markowitz 1957); whether they are large enough is for the caller to check, with dense
partial pivoting to fall back on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from hvdc_ident.simulate.graph import Graph
from hvdc_ident.simulate.machine import ARGUMENTS, Function, body

LARGEST = 20_000  # factors beyond which straight-line code no longer pays


@dataclass(frozen=True)
class Elimination:
    """Pivot order, and the place of every factor: (i, j) -> index; (k, k) holds the pivot's inverse, the first n places."""

    order: tuple[int, ...]
    places: Mapping[tuple[int, int], int]
    lower: Mapping[int, tuple[int, ...]]  # column k: rows below it
    upper: Mapping[int, tuple[int, ...]]  # row k: columns right of it
    graph: Graph
    function: Function  # of `graph`: the factors from the Jacobian in y and the shift in w

    @property
    def count(self) -> int:
        """Number of factors. The place after them holds `growth`."""
        return len(self.places)


def eliminate(entries: Mapping[tuple[int, int], float | None], n: int, nx: int) -> Elimination | None:
    """The elimination for a Jacobian with the given entries: a number where one is constant, None where it is read.

    None where the diagonal has a structural zero or the factors would be too many.
    """
    graph = Graph()
    shift = graph.leaf("w", 0)
    matrix: dict[int, dict[int, int]] = {i: {} for i in range(n)}
    for (i, j), constant in entries.items():
        node = graph.leaf("y", i * n + j) if constant is None else graph.constant(constant)
        matrix[i][j] = graph.neg(node)
    for i in range(nx):
        matrix[i][i] = graph.add(shift, matrix[i][i]) if i in matrix[i] else shift
    columns: dict[int, set[int]] = {j: {i for i in range(n) if j in matrix[i]} for j in range(n)}
    left = set(range(n))
    order: list[int] = []
    lower: dict[int, tuple[int, ...]] = {}
    upper: dict[int, tuple[int, ...]] = {}
    factors: dict[tuple[int, int], int] = {}
    while left:
        ready = [k for k in left if k in matrix[k]]
        if not ready:
            return None
        k = min(ready, key=lambda k: ((len([j for j in matrix[k] if j in left]) - 1) * (len(columns[k] & left) - 1), k))
        left.discard(k)
        order.append(k)
        inverse = graph.div(graph.one, matrix[k][k])
        factors[k, k] = inverse
        upper[k] = tuple(sorted(j for j in matrix[k] if j in left))
        lower[k] = tuple(sorted(columns[k] & left))
        for j in upper[k]:
            factors[k, j] = matrix[k][j]
        for i in lower[k]:
            factors[i, k] = graph.mul(matrix[i][k], inverse)
            for j in upper[k]:
                product = graph.mul(factors[i, k], matrix[k][j])
                if j in matrix[i]:
                    matrix[i][j] = graph.sub(matrix[i][j], product)
                else:
                    matrix[i][j] = graph.neg(product)
                    columns[j].add(i)
        if len(factors) > LARGEST:
            return None
    places = {(k, k): k for k in range(n)}
    for key in factors:
        if key[0] != key[1]:
            places[key] = len(places)
    stored = [(places[key], node) for key, node in factors.items()]
    function = Function("lu", [*stored, (len(places), _growth(graph, entries, factors, shift, n, nx))], hot=True)
    return Elimination(tuple(order), places, lower, upper, graph, function)


def _growth(
    graph: Graph,
    entries: Mapping[tuple[int, int], float | None],
    factors: Mapping[tuple[int, int], int],
    shift: int,
    n: int,
    nx: int,
) -> int:
    """The node that tells how small pivots are against their rows: the sum of |row| / |pivot|, not finite where one is 0."""
    total = graph.zero
    for i in range(n):
        size = shift if i < nx else graph.zero
        for (row, j), constant in entries.items():
            if row == i:
                entry = graph.leaf("y", i * n + j) if constant is None else graph.constant(constant)
                size = graph.add(size, graph.call("fabs", entry))
        total = graph.add(total, graph.mul(graph.call("fabs", factors[i, i]), size))
    return total


def solve_text(elimination: Elimination, symbol: str, width: int, second: Sequence[tuple[int, int]] = ()) -> str:
    """LLVM IR of `symbol`: solves in place for the flat vector in `out` with the factors in `p`, rows of `width` included.

    First `y` is added to `out`; after the n leading elements are solved, the rows get second derivatives times these:
    `yd` holds one row for each (equation, unknown) in `second`.
    """
    kind = "double"
    lines: list[str] = []
    count = 0

    def emit(instruction: str) -> str:
        nonlocal count
        count += 1
        lines.append(f"  %v{count} = {instruction}")
        return f"%v{count}"

    def element(argument: str, offset: int) -> str:
        return f"%{argument}" if offset == 0 else emit(f"getelementptr double, ptr %{argument}, i64 {offset}")

    def load(argument: str, offset: int) -> str:
        return emit(f"load {kind}, ptr {element(argument, offset)}, align 8")

    def splat(value: str) -> str:
        if kind == "double":
            return value
        one = emit(f"insertelement {kind} undef, double {value}, i32 0")
        return emit(f"shufflevector {kind} {one}, {kind} undef, <{width} x i32> zeroinitializer")

    def factor(i: int, j: int) -> str:
        return splat(emit(f"load double, ptr {element('p', elimination.places[i, j])}, align 8"))

    def solve(x: dict[int, str], at: int, step: int) -> None:
        for k in elimination.order:
            for i in elimination.lower[k]:
                product = emit(f"fmul contract {kind} {factor(i, k)}, {x[k]}")
                x[i] = emit(f"fsub contract {kind} {x[i]}, {product}")
        for k in reversed(elimination.order):
            for j in elimination.upper[k]:
                product = emit(f"fmul contract {kind} {factor(k, j)}, {x[j]}")
                x[k] = emit(f"fsub contract {kind} {x[k]}, {product}")
            x[k] = emit(f"fmul contract {kind} {x[k]}, {factor(k, k)}")
            lines.append(f"  store {kind} {x[k]}, ptr {element('out', at + step * k)}, align 8")

    def start(at: int, step: int) -> dict[int, str]:
        places = {k: at + step * k for k in elimination.order}
        return {k: emit(f"fadd contract {kind} {load('out', q)}, {load('y', q)}") for k, q in places.items()}

    values = start(0, 1)
    solve(values, 0, 1)
    if width:
        n = len(elimination.order)
        kind = f"<{width} x double>"
        rows = start(n, width)
        for k, (i, j) in enumerate(second):
            product = emit(f"fmul contract {kind} {load('yd', k * width)}, {splat(values[j])}")
            rows[i] = emit(f"fadd contract {kind} {rows[i]}, {product}")
        solve(rows, n, width)
    arguments = ", ".join(f"ptr %{a}" if a != "out" else "ptr noalias %out" for a in ARGUMENTS)
    return f"define void @{symbol}({arguments}) nounwind {{\n" + body(lines) + "\n  ret void\n}"
