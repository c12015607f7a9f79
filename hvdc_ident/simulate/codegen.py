"""LLVM IR written straight from the graph: the functions that an integrator calls, and the elimination of its linear systems.

Every function has the one signature `void f(y, yd, w, wd, p, m, out)` of pointers to doubles (`ARGUMENTS`), so that an
integrator compiled once can call the functions of any model by address. A matrix row over the sensitivity parameters is
one LLVM vector, which the compiler turns into the machine's own vector instructions.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from hvdc_ident.expression import FUNCTIONS
from hvdc_ident.simulate.core import NUMBERS
from hvdc_ident.simulate.graph import Graph

# Names of the generated functions, in the order in which the integrators take their addresses.
NAMES = (
    "f", "fs", "jac", "hess", "ft", "sw", "sws", "swd", "modes", "out", "outs", "rows", "src", "srcs", "srcd",
    "rest", "rest_jac", "rest_p", "const", "lu", "solve", "surface",
)  # fmt: skip
ARGUMENTS = ("y", "yd", "w", "wd", "p", "m", "out")
LANES = int(NUMBERS["LANES"])  # instants that a function over several of them takes at once
BLOCK = 300  # instructions of a block of a long function
LONG = 4000  # instructions; a shorter function is one block


@dataclass(frozen=True)
class Row:
    """One row of a matrix product over the sensitivity parameters.

    scalars: {column: node}. products: [(node, argument name, offset of the row it multiplies in doubles)].
    """

    scalars: Mapping[int, int] = field(default_factory=dict)
    products: Sequence[tuple[int, str, int]] = ()


@dataclass(frozen=True)
class Function:
    """Contents of one generated function: nodes at places in `out`, and rows of `width` doubles."""

    name: str
    nodes: Sequence[tuple[int, int]] = ()  # (place, node)
    rows: Sequence[tuple[int, Row]] = ()  # (place, row)
    live: bool = False  # conditions by comparison instead of by frozen mode
    stride: tuple[int, int] | None = None  # of y and out between instants, doubles: all four of them in one call
    hot: bool = False  # called in every step: worth the compiler's full effort


def arguments(graph: Graph, node: int, live: bool) -> tuple[int, ...]:
    """Return the nodes that a generated function computes a node from. live: conditions by comparison, not by frozen mode."""
    key = graph.nodes[node]
    if key[0] == "switch":
        return (graph.switches[key[1]],) if live else ()
    return graph.arguments(node)


def declarations() -> list[str]:
    lines = ["declare double @llvm.fabs.f64(double)", "declare double @llvm.pow.f64(double, double)"]
    lines += [f"declare <{LANES} x double> @llvm.sqrt.v{LANES}f64(<{LANES} x double>)"]
    for function in FUNCTIONS.values():
        if function.slopes is not None:
            arguments = ", ".join(["double"] * function.arity[0])
            lines.append(f"declare double @{_linked(function.name)}({arguments})")
    return lines


def _linked(op: str) -> str:
    """Name that an operation of the graph has for the linker: an instruction of LLVM, or a function of the C library."""
    return f"llvm.{op}.f64" if op in ("pow", "fabs") or FUNCTIONS[op].intrinsic else op


def body(lines: Sequence[str]) -> str:
    """The text of a function's instructions; a long one in blocks, for the compiler's effort grows with a block's square."""
    if len(lines) <= LONG:
        return "\n".join(lines)
    pieces = ["\n".join(lines[k : k + BLOCK]) for k in range(0, len(lines), BLOCK)]
    joined = (f"{piece}\n  br label %block{k}\nblock{k}:" for k, piece in enumerate(pieces[:-1]))
    return "\n".join([*joined, pieces[-1]])


def _number(value: float) -> str:
    return f"0x{struct.unpack('<Q', struct.pack('<d', value))[0]:016X}"


def function_text(graph: Graph, function: Function, symbol: str, width: int) -> str:
    """LLVM IR of one function of the graph under the given symbol."""
    emitter = _LanesEmitter if function.stride else _Emitter
    return emitter(graph, function, symbol, width).text()


class _Emitter:
    """Writer of one function."""

    kind, bit = "double", "i1"

    def __init__(self, graph: Graph, function: Function, symbol: str, width: int) -> None:
        self.graph, self.function, self.symbol, self.width = graph, function, symbol, width
        self.lines: list[str] = []
        self.names: dict[int, str] = {}
        self.vectors: dict[tuple[str, int], str] = {}
        self.count = 0

    def text(self) -> str:
        f = self.function
        for place, node in f.nodes:
            self._node(place, self._value(node))
        for place, row in f.rows:
            self._row(place, row)
        arguments = ", ".join(f"ptr noalias %{a}" if a == "out" else f"ptr readonly %{a}" for a in ARGUMENTS)
        return f"define void @{self.symbol}({arguments}) nounwind {{\n" + body(self.lines) + "\n  ret void\n}"

    def _emit(self, instruction: str) -> str:
        self.count += 1
        name = f"%v{self.count}"
        self.lines.append(f"  {name} = {instruction}")
        return name

    def _pointer(self, argument: str, offset: int) -> str:
        return f"%{argument}" if offset == 0 else self._emit(f"getelementptr double, ptr %{argument}, i64 {offset}")

    def _store(self, kind: str, value: str, place: int) -> None:
        pointer = self._pointer("out", place)
        self.lines.append(f"  store {kind} {value}, ptr {pointer}, align 8")

    def _node(self, place: int, value: str) -> None:
        """Store a node's value."""
        self._store("double", value, place)

    def _row(self, place: int, row: Row) -> None:
        """Store a row."""
        kind = f"<{self.width} x double>"
        total = "zeroinitializer"
        for column, node in row.scalars.items():
            total = self._emit(f"insertelement {kind} {total}, double {self._value(node)}, i32 {column}")
        for node, argument, offset in row.products:
            vector, factor = self._vector(argument, offset), self._value(node)
            product = vector
            if self.graph.value(node) != 1.0:
                one = self._emit(f"insertelement {kind} undef, double {factor}, i32 0")
                splat = self._emit(f"shufflevector {kind} {one}, {kind} undef, <{self.width} x i32> zeroinitializer")
                product = self._emit(f"fmul contract {kind} {splat}, {vector}")
            total = product if total == "zeroinitializer" else self._emit(f"fadd contract {kind} {total}, {product}")
        self._store(kind, total, place)

    def _vector(self, argument: str, offset: int) -> str:
        """The register of a row of an argument."""
        key = (argument, offset)
        if key not in self.vectors:
            pointer = self._pointer(argument, offset)
            self.vectors[key] = self._emit(f"load <{self.width} x double>, ptr {pointer}, align 8")
        return self.vectors[key]

    def _value(self, node: int) -> str:
        """The register or constant of a node, whatever it needs emitted first: iterative, for deep graphs."""
        names = self.names
        if node in names:
            return names[node]
        stack = [node]
        while stack:
            n = stack[-1]
            if n in names:
                stack.pop()
                continue
            missing = [a for a in arguments(self.graph, n, self.function.live) if a not in names]
            if missing:
                stack.extend(reversed(missing))
            else:
                names[n] = self._instruction(n)
                stack.pop()
        return names[node]

    def _constant(self, value: float) -> str:
        return _number(value)

    def _leaf(self, argument: str, index: int) -> str:
        return self._emit(f"load double, ptr {self._pointer(argument, index)}, align 8")

    def _function(self, op: str, x: list[str]) -> str:
        return self._emit(f"call double @{_linked(op)}(" + ", ".join(f"double {v}" for v in x) + ")")

    def _instruction(self, n: int) -> str:
        op, *a = self.graph.nodes[n]
        kind, bit = self.kind, self.bit
        if op in ("add", "sub", "mul", "div"):
            return self._emit(f"f{op} contract {kind} {self.names[a[0]]}, {self.names[a[1]]}")
        if op == "const":
            return self._constant(a[0])
        if op == "bool":
            return self._truth(bool(a[0]))
        if op == "leaf":
            return self._leaf(a[0], a[1])
        if op == "switch":
            if self.function.live:
                return self._emit(f"fcmp olt {kind} {self.names[self.graph.switches[a[0]]]}, {self._constant(0.0)}")
            return self._emit(f"fcmp ogt {kind} {self._leaf('m', a[0])}, {self._constant(0.5)}")
        x = [self.names[k] for k in a]
        if op == "inverse":  # 1/x, and 0 where x is 0
            quotient = self._emit(f"fdiv {kind} {self._constant(1.0)}, {x[0]}")
            zero = self._emit(f"fcmp oeq {kind} {x[0]}, {self._constant(0.0)}")
            return self._emit(f"select {bit} {zero}, {kind} {self._constant(0.0)}, {kind} {quotient}")
        if op == "sqrt0":  # the root of max(x, 0)
            positive = self._emit(f"fcmp ogt {kind} {x[0]}, {self._constant(0.0)}")
            cut = self._emit(f"select {bit} {positive}, {kind} {x[0]}, {kind} {self._constant(0.0)}")
            return self._function("sqrt", [cut])
        if op == "neg":
            return self._emit(f"fneg {kind} {x[0]}")
        if op == "select":
            return self._emit(f"select {bit} {x[0]}, {kind} {x[1]}, {kind} {x[2]}")
        if op == "not":
            return self._emit(f"xor {bit} {x[0]}, {self._truth(True)}")
        if op in ("and", "or"):
            return self._emit(f"{op} {bit} {x[0]}, {x[1]}")
        return self._function(op, x)

    def _truth(self, value: bool) -> str:
        return "true" if value else "false"


class _LanesEmitter(_Emitter):
    """Writer of a function of plain nodes that works on several instants at once, one a lane.

    `y` holds a flat vector and `out` a result for every instant, `stride` doubles apart; `yd` holds the instants. All
    else (inputs, delayed and sampled signals, parameters, modes) is the same for all of them.
    """

    kind, bit = f"<{LANES} x double>", f"<{LANES} x i1>"

    def __init__(self, graph: Graph, function: Function, symbol: str, width: int) -> None:
        super().__init__(graph, function, symbol, width)
        assert function.stride is not None
        self.stride = function.stride

    def _node(self, place: int, value: str) -> None:
        for lane in range(LANES):
            self._store("double", self._lane(value, lane), place + lane * self.stride[1])

    def _row(self, place: int, row: Row) -> None:
        raise AssertionError("rows over the parameters fill the lanes themselves")

    def _lane(self, value: str, lane: int) -> str:
        return self._emit(f"extractelement {self.kind} {value}, i32 {lane}")

    def _constant(self, value: float) -> str:
        return "<" + ", ".join([f"double {_number(value)}"] * LANES) + ">"

    def _truth(self, value: bool) -> str:
        return "<" + ", ".join([f"i1 {'true' if value else 'false'}"] * LANES) + ">"

    def _leaf(self, argument: str, index: int) -> str:
        if argument == "w" and index == 0:
            return self._emit(f"load {self.kind}, ptr %yd, align 8")
        if argument == "y":
            return self._gather(
                [super(_LanesEmitter, self)._leaf("y", index + k * self.stride[0]) for k in range(LANES)]
            )
        one = self._emit(f"insertelement {self.kind} undef, double {super()._leaf(argument, index)}, i32 0")
        return self._emit(f"shufflevector {self.kind} {one}, {self.kind} undef, <{LANES} x i32> zeroinitializer")

    def _gather(self, values: list[str]) -> str:
        total = "undef"
        for lane, value in enumerate(values):
            total = self._emit(f"insertelement {self.kind} {total}, double {value}, i32 {lane}")
        return total

    def _function(self, op: str, x: list[str]) -> str:
        if op == "sqrt":
            return self._emit(f"call {self.kind} @llvm.sqrt.v{LANES}f64({self.kind} {x[0]})")
        call = super()._function
        return self._gather([call(op, [self._lane(v, lane) for v in x]) for lane in range(LANES)])


# --- the linear systems of the Rosenbrock method ---

STRAIGHT_FACTORS = 20_000  # factors beyond which straight-line code no longer pays


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
        if len(factors) > STRAIGHT_FACTORS:
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
