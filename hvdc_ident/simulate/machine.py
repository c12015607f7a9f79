"""Machine code from graph nodes: LLVM IR written straight from the graph, compiled in a fraction of a second.

Every function has the one signature `void f(y, w, wd, p, m, out)` of pointers to doubles (`ARGUMENTS`), so that an
integrator compiled once can call the functions of any model by address. A matrix row over the sensitivity parameters is
one LLVM vector, which the compiler turns into the machine's own vector instructions.
"""

from __future__ import annotations

import ctypes
import itertools
import struct
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import llvmlite.binding as llvm
import numpy as np

from hvdc_ident.simulate.graph import Graph
from hvdc_ident.trajectory import Array

ARGUMENTS = ("y", "yd", "w", "wd", "p", "m", "out")
_LIBM = ("tan", "tanh", "asin", "acos", "atan", "atan2")
_INTRINSIC = ("sqrt", "exp", "log", "sin", "cos")
_serial = itertools.count()


@dataclass(frozen=True)
class Row:
    """One row of a matrix product over the sensitivity parameters.

    scalars: {column: node}. products: [(node, argument name, offset of the row it multiplies in doubles)].
    """

    scalars: Mapping[int, int] = field(default_factory=dict)
    products: Sequence[tuple[int, str, int]] = ()


@dataclass(frozen=True)
class Function:
    """What one generated function stores: nodes at places in `out`, and rows of `width` doubles."""

    name: str
    nodes: Sequence[tuple[int, int]] = ()  # (place, node)
    rows: Sequence[tuple[int, Row]] = ()  # (place, row)
    live: bool = False  # conditions by comparison instead of by frozen mode
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
        serial = next(_serial)
        written = written or {}
        names = {n: f"hvdcident_{serial}_{n}" for n in (*(f.name for f in functions), *written)}
        self._engines: list[llvm.ExecutionEngine] = []
        self.address: dict[str, int] = {}
        for hot in (True, False):
            chosen = [f for f in functions if f.hot == hot]
            text = "\n".join(
                [
                    *_declarations(),
                    *(_Emitter(graph, f, names[f.name], width).text() for f in chosen),
                    *(t(names[n]) for n, t in written.items() if hot),
                ]
            )
            engine = _compiled(text, hot)
            self._engines.append(engine)
            kept = [f.name for f in chosen] + (list(written) if hot else [])
            self.address |= {n: engine.get_function_address(names[n]) for n in kept}
        # Freed with this object, but not at the end of the process, when LLVM may be gone before it.
        weakref.finalize(self, _close, self._engines).atexit = False


def _close(engines: list[llvm.ExecutionEngine]) -> None:
    for engine in engines:
        engine.close()


def _declarations() -> list[str]:
    lines = [f"declare double @llvm.{f}.f64(double)" for f in _INTRINSIC]
    lines += ["declare double @llvm.pow.f64(double, double)", "declare double @atan2(double, double)"]
    return lines + [f"declare double @{f}(double)" for f in _LIBM if f != "atan2"]


def _compiled(text: str, hot: bool) -> llvm.ExecutionEngine:
    """The engine of a module; a cold one is compiled quickly instead of well, which halves the time of a new structure."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    module = llvm.parse_assembly(text, llvm.create_context())
    module.verify()
    target = llvm.Target.from_default_triple()
    machine = target.create_target_machine(
        opt=2 if hot else 0, cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten()
    )
    module.triple = llvm.get_default_triple()
    # The graph is free of common parts and its rows are vectors already: little is left for the optimiser. The ready-made
    # pipelines would also keep 60 KiB of every module for ever.
    if hot:
        passes = llvm.create_new_module_pass_manager()
        passes.add_instruction_combine_pass()
        passes.run(module, llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=2)))
    engine = llvm.create_mcjit_compiler(module, machine)
    engine.finalize_object()
    return engine


def _number(value: float) -> str:
    return f"0x{struct.unpack('<Q', struct.pack('<d', value))[0]:016X}"


def function_text(graph: Graph, function: Function, symbol: str, width: int) -> str:
    """LLVM IR of one function of the graph under the given symbol."""
    return _Emitter(graph, function, symbol, width).text()


class _Emitter:
    """Writes one function."""

    def __init__(self, graph: Graph, function: Function, symbol: str, width: int) -> None:
        self.graph, self.function, self.symbol, self.width = graph, function, symbol, width
        self.lines: list[str] = []
        self.names: dict[int, str] = {}
        self.vectors: dict[tuple[str, int], str] = {}
        self.count = 0

    def text(self) -> str:
        f = self.function
        for place, node in f.nodes:
            self._store("double", self._value(node), place)
        for place, row in f.rows:
            self._store(f"<{self.width} x double>", self._row(row), place)
        arguments = ", ".join(f"ptr noalias %{a}" if a == "out" else f"ptr readonly %{a}" for a in ARGUMENTS)
        return f"define void @{self.symbol}({arguments}) nounwind {{\n" + "\n".join(self.lines) + "\n  ret void\n}"

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

    def _row(self, row: Row) -> str:
        kind = f"<{self.width} x double>"
        total = "zeroinitializer"
        for column, node in row.scalars.items():
            total = self._emit(f"insertelement {kind} {total}, double {self._value(node)}, i32 {column}")
        for node, argument, offset in row.products:
            key = (argument, offset)
            if key not in self.vectors:
                self.vectors[key] = self._emit(f"load {kind}, ptr {self._pointer(argument, offset)}, align 8")
            factor = self._value(node)
            if self.graph.value(node) == 1.0:
                product = self.vectors[key]
            else:
                one = self._emit(f"insertelement {kind} undef, double {factor}, i32 0")
                splat = self._emit(f"shufflevector {kind} {one}, {kind} undef, <{self.width} x i32> zeroinitializer")
                product = self._emit(f"fmul contract {kind} {splat}, {self.vectors[key]}")
            total = product if total == "zeroinitializer" else self._emit(f"fadd contract {kind} {total}, {product}")
        return total

    def _value(self, node: int) -> str:
        """The register or constant of a node, whatever it needs emitted first: iterative, for deep graphs."""
        stack = [node]
        while stack:
            n = stack[-1]
            if n in self.names:
                stack.pop()
                continue
            missing = [a for a in self._arguments(n) if a not in self.names]
            if missing:
                stack.extend(reversed(missing))
            else:
                self.names[n] = self._instruction(n)
                stack.pop()
        return self.names[node]

    def _arguments(self, n: int) -> tuple[int, ...]:
        key = self.graph.nodes[n]
        if key[0] == "switch":
            return (self.graph.switches[key[1]],) if self.function.live else ()
        return self.graph.arguments(n)

    def _instruction(self, n: int) -> str:
        op, *a = self.graph.nodes[n]
        if op == "const":
            return _number(a[0])
        if op == "bool":
            return "true" if a[0] else "false"
        if op == "leaf":
            return self._emit(f"load double, ptr {self._pointer(a[0], a[1])}, align 8")
        if op == "switch":
            if self.function.live:
                return self._emit(f"fcmp olt double {self.names[self.graph.switches[a[0]]]}, {_number(0.0)}")
            mode = self._emit(f"load double, ptr {self._pointer('m', a[0])}, align 8")
            return self._emit(f"fcmp ogt double {mode}, {_number(0.5)}")
        x = [self.names[k] for k in a]
        if op in ("add", "sub", "mul", "div"):
            return self._emit(f"f{op} contract double {x[0]}, {x[1]}")
        if op == "inverse":  # 1/x, and 0 where x is 0
            quotient = self._emit(f"fdiv double {_number(1.0)}, {x[0]}")
            zero = self._emit(f"fcmp oeq double {x[0]}, {_number(0.0)}")
            return self._emit(f"select i1 {zero}, double {_number(0.0)}, double {quotient}")
        if op == "sqrt0":  # the root of max(x, 0)
            positive = self._emit(f"fcmp ogt double {x[0]}, {_number(0.0)}")
            cut = self._emit(f"select i1 {positive}, double {x[0]}, double {_number(0.0)}")
            return self._emit(f"call double @llvm.sqrt.f64(double {cut})")
        if op == "neg":
            return self._emit(f"fneg double {x[0]}")
        if op == "select":
            return self._emit(f"select i1 {x[0]}, double {x[1]}, double {x[2]}")
        if op == "not":
            return self._emit(f"xor i1 {x[0]}, true")
        if op in ("and", "or"):
            return self._emit(f"{op} i1 {x[0]}, {x[1]}")
        if op == "pow":
            return self._emit(f"call double @llvm.pow.f64(double {x[0]}, double {x[1]})")
        name = f"llvm.{op}.f64" if op in _INTRINSIC else op
        return self._emit(f"call double @{name}(" + ", ".join(f"double {v}" for v in x) + ")")


def evaluate(address: int, y: Array, w: Array, p: Array, m: Array, out: Array) -> None:
    """Calls one generated function from Python."""
    pointer = ctypes.POINTER(ctypes.c_double)
    kind = ctypes.CFUNCTYPE(None, *[pointer] * 7)
    zero = np.zeros_like(w)
    arrays = [np.ascontiguousarray(a, dtype=float) for a in (y, y, w, zero, p, m)]
    kind(int(address))(*(a.ctypes.data_as(pointer) for a in arrays), out.ctypes.data_as(pointer))
