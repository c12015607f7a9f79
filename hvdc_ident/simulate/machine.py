"""Machine code from graph nodes: LLVM IR written straight from the graph, compiled in a fraction of a second.

Every function has the one signature `void f(y, yd, w, wd, p, m, out)` of pointers to doubles (`ARGUMENTS`), so that an
integrator compiled once can call the functions of any model by address. A matrix row over the sensitivity parameters is
one LLVM vector, which the compiler turns into the machine's own vector instructions.
"""

from __future__ import annotations

import ctypes
import struct
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import llvmlite.binding as llvm
import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.expression import FUNCTIONS
from hvdc_ident.simulate.graph import Graph
from hvdc_ident.simulate.objects import compiled, kept, loaded

ARGUMENTS = ("y", "yd", "w", "wd", "p", "m", "out")
LANES = 4  # instants that a function over several of them takes at once
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


class Code:
    """Compiled functions of one module: `address[name]`. The code lives as long as this object."""

    def __init__(
        self,
        graph: Graph,
        functions: Sequence[Function],
        width: int,
        written: Mapping[str, Callable[[str], str]] | None = None,
    ) -> None:
        """written: further hot functions as text, by name; each is called with the symbol it has to define."""
        self._engines: list[llvm.ExecutionEngine] = []
        self.address: dict[str, int] = {}
        for hot in (True, False):
            texts = {f.name: function_text(graph, f, _symbol(f.name), width) for f in functions if f.hot == hot}
            if hot:
                texts |= {n: text(_symbol(n)) for n, text in (written or {}).items()}
            if texts:
                engine = _engine("\n".join([*_declarations(), *texts.values()]), hot)
                self._engines.append(engine)
                self.address |= {n: engine.get_function_address(_symbol(n)) for n in texts}
        # Freed with this object, but not at the end of the process, when LLVM may be gone before it.
        weakref.finalize(self, _close, self._engines).atexit = False


def _close(engines: list[llvm.ExecutionEngine]) -> None:
    for engine in engines:
        engine.close()


def _symbol(name: str) -> str:
    return f"hvdcident_{name}"


def _engine(text: str, hot: bool) -> llvm.ExecutionEngine:
    """The engine of a module; a cold one is compiled quickly instead of well, which halves the time of a new structure."""
    # The graph is free of common parts and its rows are vectors already: little is left for the optimiser.
    return loaded(kept(f"{hot}\0{text}", lambda: compiled(text, effort=2 if hot else 0, combine=hot)))


def _declarations() -> list[str]:
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
    """Writes one function."""

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
        """Stores a node's value."""
        self._store("double", value, place)

    def _row(self, place: int, row: Row) -> None:
        """Stores a row."""
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
            missing = [a for a in self._arguments(n) if a not in names]
            if missing:
                stack.extend(reversed(missing))
            else:
                names[n] = self._instruction(n)
                stack.pop()
        return names[node]

    def _arguments(self, n: int) -> tuple[int, ...]:
        key = self.graph.nodes[n]
        if key[0] == "switch":
            return (self.graph.switches[key[1]],) if self.function.live else ()
        return self.graph.arguments(n)

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
    """Writes a function of plain nodes that works on several instants at once, one a lane.

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


_GENERATED = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 7)


def evaluate(address: int, y: Array, w: Array, p: Array, m: Array, out: Array) -> None:
    """Calls one generated function from Python."""
    arrays = [np.ascontiguousarray(a, dtype=float) for a in (y, y, w, np.zeros_like(w), p, m)]
    _GENERATED(int(address))(*(a.ctypes.data for a in arrays), out.ctypes.data)
