"""Values and exact derivatives of a model as machine code, which linearisation and operating points are made of.

The same graph is also evaluated in complex numbers: an independent check of the derivatives taken on it.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.expression import FUNCTIONS
from hvdc_ident.linearize.limits import Condition, Limit, conditions, limits
from hvdc_ident.model import Model
from hvdc_ident.simulate import ACCURACY, Code, Function, Graph, ModelEquations, by_structure, check_times

Array = NDArray[Any]


def evaluate(graph: Graph, roots: Iterable[int], leaves: Mapping[int, Any], size: int) -> list[Any]:
    """Return the roots' values, (size,) complex arrays; conditions are decided by the real parts. leaves: {node: array}."""
    wanted = list(roots)
    values: dict[int, Any] = {}
    with np.errstate(all="ignore"):
        for n in graph.reachable(wanted):
            values[n] = _node(graph, n, values, leaves)
    return [np.broadcast_to(np.asarray(values[r], dtype=complex), (size,)) for r in wanted]


def _node(graph: Graph, n: int, values: dict[int, Any], leaves: Mapping[int, Any]) -> Any:
    op, *a = graph.nodes[n]
    if op in ("const", "bool"):
        return a[0]
    if op == "leaf":
        return leaves[n]
    if op == "switch":
        source = graph.switches[a[0]]
        if source not in values:  # a condition inside a condition may stand before the value that decides it
            for k in graph.reachable([source]):
                if k not in values:
                    values[k] = _node(graph, k, values, leaves)
        return np.real(values[source]) < 0.0
    operation = _OPERATIONS[op] if op in _OPERATIONS else _complex(FUNCTIONS[op].array)
    return operation(*(values[k] for k in a))


def _cut_root(x: Any) -> Any:
    return np.where(np.real(x) > 0.0, np.sqrt(np.where(np.real(x) > 0.0, x, 1.0) + 0j), 0.0)


def _power(x: Any, y: Any) -> Any:
    return np.asarray(x, dtype=complex) ** y


def _atan2(y: Any, x: Any) -> Any:
    a, b = np.real(y), np.real(x)
    square = a * a + b * b
    return np.arctan2(a, b) + 1j * (np.imag(y) * b - np.imag(x) * a) / np.where(square > 0, square, 1.0)


def _complex(function: Any) -> Any:
    return lambda *x: function(*(np.asarray(v, dtype=complex) for v in x))


_OPERATIONS: dict[str, Any] = {
    "add": lambda x, y: x + y,
    "sub": lambda x, y: x - y,
    "mul": lambda x, y: x * y,
    "div": lambda x, y: np.asarray(x, dtype=complex) / y,
    "neg": lambda x: -x,
    "pow": _power,
    "atan2": _atan2,
    "inverse": lambda x: np.where(np.real(x) == 0.0, 0.0, 1.0 / np.where(np.real(x) == 0.0, 1.0, x)),
    "sqrt0": _cut_root,
    "select": lambda c, x, y: np.where(c, x, y),
    "and": np.logical_and,
    "or": np.logical_or,
    "not": np.logical_not,
}


_SIGNATURE = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 7)


@dataclass(frozen=True)
class Layout:
    """Layout of rows and columns: counts of states, unknowns, inputs, delays and sampled values, outputs, parameters."""

    nx: int
    nz: int
    nu: int
    ne: int
    no: int
    np: int
    n_rest: int
    n_start: int

    @property
    def n(self) -> int:
        """States and unknowns."""
        return self.nx + self.nz

    @property
    def rows(self) -> int:
        """All rows."""
        return self.n + self.ne + self.no + self.n_rest + self.n_start

    @property
    def main(self) -> int:
        """Rows of f, g, sources and outputs."""
        return self.n + self.ne + self.no

    @property
    def columns(self) -> int:
        """States, unknowns, inputs, delays and sampled values."""
        return self.n + self.nu + self.ne


class CompiledSystem:
    """Compiled values and derivatives of one model structure for one list of outputs; reusable for any values."""

    accuracy = ACCURACY
    """Largest scaled residual that counts as a solution of its equations."""

    def __init__(self, model: Model, outputs: Sequence[str]) -> None:
        self.structure = s = ModelEquations(model, (), outputs)
        g, m = s.graph, model
        self.outputs = s.outputs
        self.states, self.unknowns = s.states, s.unknowns
        self.inputs, self.extras = tuple(m.inputs), (*m.delays, *m.sampled)
        self.parameters = tuple(m.parameters)
        self.conditions: tuple[Condition, ...] = conditions(s)
        self.with_rest = tuple(i for i, r in enumerate(s.rests) if r is not None)
        self.with_start = tuple(i for i, r in enumerate(s.starts) if r is not None)
        rest = [g.sub(g.leaf("y", i), r) for i, r in enumerate(s.rests) if r is not None]
        start = [g.sub(g.leaf("y", i), r) for i, r in enumerate(s.starts) if r is not None]
        self.nodes = [*s.rhs, *s.sources, *s.observed, *rest, *start]
        self.layout = Layout(
            len(s.states), len(s.unknowns), len(m.inputs), len(self.extras), len(s.observed), len(m.parameters),
            len(rest), len(start),
        )  # fmt: skip
        self._compile()

    def _entries(self) -> list[tuple[int, int, int]]:
        """Return (row, column, node) of every derivative over y and w that is not 0 by structure."""
        n = self.layout.n
        entries = []
        for i, v in enumerate(self.nodes):
            entries += [(i, j, d) for j, d in self.structure.partial(v, "y").items()]
            entries += [(i, n + j - 1, d) for j, d in self.structure.partial(v, "w").items() if j > 0]
        return entries

    def _compile(self) -> None:
        s, g, size = self.structure, self.structure.graph, self.layout
        self._by_yw = self._entries()
        by_p = [(i * size.np + j, d) for i, v in enumerate(self.nodes) for j, d in s.partial(v, "p").items()]
        switches = [g.select(g.negative(v), g.one, g.zero) for v in list(g.switches)]
        reached = g.reachable(self.nodes)
        self.roots = [(n, g.nodes[n][1]) for n in reached if g.nodes[n][0] in ("sqrt", "sqrt0")]
        timing = [(i * size.np + j, d) for i, v in enumerate(s.timing) for j, d in s.partial(v, "p").items()]
        functions = [
            Function("timing_p", timing),
            Function("values", list(enumerate(self.nodes))),
            Function("jac", [(i * size.columns + j, d) for i, j, d in self._by_yw]),
            Function("jac_p", by_p),
            Function("modes", list(enumerate(switches)), live=True),
            Function("switches", list(enumerate(g.switches)), live=True),
            Function("timing", list(enumerate(s.timing))),
            Function("roots", [(k, a) for k, (_, a) in enumerate(self.roots)]),
        ]
        self._code = Code(g, functions, 1)
        self._call = {f.name: _SIGNATURE(self._code.address[f.name]) for f in functions}
        self._zero = np.zeros(size.n + size.nu + size.ne + 2)
        self.n_switches = len(g.switches)

    def _run(self, name: str, length: int, y: Array, w: Array, p: Array, m: Array) -> Array:
        out = np.zeros(max(length, 1))
        at = (y.ctypes.data, y.ctypes.data, w.ctypes.data, self._zero.ctypes.data, p.ctypes.data, m.ctypes.data)
        self._call[name](*at, out.ctypes.data)
        return out[:length]

    # --- values and derivatives ---

    def flat_roots(self, y: Array, w: Array, p: Array, m: Array) -> list[int]:
        """Return the nodes of the square roots whose argument is 0 at the point, where they have no slope."""
        at = self._run("roots", len(self.roots), y, w, p, m)
        return [n for (n, _), value in zip(self.roots, at, strict=True) if value == 0.0]

    def modes(self, y: Array, w: Array, p: Array) -> Array:
        """Return (switches,) numbers: 1 where the switch is negative at the point, else 0."""
        return self._run("modes", self.n_switches, y, w, p, self._zero)

    def switches(self, y: Array, w: Array, p: Array) -> Array:
        """Return the values whose signs decide the switches."""
        return self._run("switches", self.n_switches, y, w, p, self._zero)

    def values(self, y: Array, w: Array, p: Array, m: Array) -> Array:
        """Return (rows,) values of every row."""
        return self._run("values", self.layout.rows, y, w, p, m)

    def jacobian(self, y: Array, w: Array, p: Array, m: Array) -> Array:
        """Return (rows, columns) derivatives over [x, z, inputs, delays, sampled]."""
        size = self.layout
        return self._run("jac", size.rows * size.columns, y, w, p, m).reshape(size.rows, size.columns)

    def evaluate(self, y: Array, w: Array, p: Array, parameters: Sequence[int] = ()) -> tuple[Array, Array]:
        """Return values (rows,) and Jacobian (rows, columns + parameters) by some parameters too, switches as at the point."""
        m = self.modes(y, w, p)
        jac = self.jacobian(y, w, p, m)
        if len(parameters):
            jac = np.concatenate([jac, self.by_parameters(y, w, p, m)[:, list(parameters)]], axis=1)
        return self.values(y, w, p, m), jac

    def limits(self, y: Array, w: Array, p: Array) -> tuple[Limit, ...]:
        """Return every limiter that matters at the point, with its margin."""
        return limits(self.structure, self.conditions, self.switches(y, w, p))

    def by_parameters(self, y: Array, w: Array, p: Array, m: Array) -> Array:
        """Return (rows, parameters) partial derivatives over the parameters."""
        size = self.layout
        return self._run("jac_p", size.rows * size.np, y, w, p, m).reshape(size.rows, size.np)

    @cached_property
    def _second(self) -> tuple[Code, Any, Any, Any, Any]:
        """Code of the second derivatives, and the row, column and variable each of them belongs to."""
        s, size = self.structure, self.layout
        variables = {"y": 0, "w": size.n - 1, "p": size.columns}
        entries = []
        for i, j, d in self._by_yw:
            if i >= size.main:
                continue
            for leaf, slope in s.graph.gradient(d).items():
                _, group, index = s.graph.nodes[leaf]
                if not (group == "w" and index == 0):
                    entries.append((i, j, variables[group] + index, slope))
        code = Code(s.graph, [Function("hess", [(k, e[3]) for k, e in enumerate(entries)])], 1)
        rows, columns, over = (np.array([e[k] for e in entries], dtype=np.intp) for k in range(3))
        return code, _SIGNATURE(code.address["hess"]), rows, columns, over

    def jacobian_along(self, y: Array, w: Array, p: Array, m: Array, directions: Array) -> Array:
        """Return (directions, main rows, columns) derivatives of the Jacobian along given directions.

        directions: (columns + parameters, k), in the order [x, z, inputs, delays, sampled, parameters].
        """
        _, call, rows, columns, over = self._second
        size = self.layout
        out = np.zeros(max(rows.size, 1))
        zero = self._zero.ctypes.data
        call(y.ctypes.data, y.ctypes.data, w.ctypes.data, zero, p.ctypes.data, m.ctypes.data, out.ctypes.data)
        result = np.zeros((directions.shape[1], size.main, size.columns))
        contribution = out[: rows.size, None] * directions[over]
        for k in range(directions.shape[1]):
            np.add.at(result[k], (rows, columns), contribution[:, k])
        return result

    def timing(self, p: Array) -> Array:
        """Delay times, then sampling periods, then compute times, s. Raises TimingError where one is not usable."""
        model = self.structure.model
        nd, nq = len(model.delays), len(model.sampled)
        if nd + nq == 0:
            return np.zeros(0)
        zero = self._zero
        t = self._run("timing", nd + 2 * nq, zero, zero, p, zero)
        check_times(model, t[: nd + nq])
        return t

    def timing_by_parameters(self, p: Array) -> Array:
        """Return (times, parameters) derivatives of the delay times, periods and compute times."""
        count = len(self.structure.timing)
        zero = self._zero
        return self._run("timing_p", count * p.size, zero, zero, p, zero).reshape(count, p.size)

    def start_values(self, p: Array) -> dict[int, float]:
        """Return the states' given start values by their place; they may depend on parameters."""
        size = self.layout
        if not self.with_start:
            return {}
        y, w = np.zeros(size.n + 1), np.zeros(1 + size.nu + size.ne)
        tail = self.values(y, w, p, self.modes(y, w, p))[size.rows - size.n_start :]
        return {i: -float(v) for i, v in zip(self.with_start, tail, strict=True)}

    def complex_step(self, y: Array, w: Array, p: Array) -> Array:
        """Return (main rows, columns) the Jacobian once more, by complex steps of 1e-30 through the values alone: a check."""
        size, g = self.layout, self.structure.graph
        eye = 1e-30j * np.eye(size.columns)
        leaves: dict[int, Any] = {g.leaf("w", 0): np.full(size.columns, w[0], dtype=complex)}
        leaves |= {g.leaf("y", k): y[k] + eye[k] for k in range(size.n)}
        leaves |= {g.leaf("w", k + 1): w[k + 1] + eye[size.n + k] for k in range(size.nu + size.ne)}
        leaves |= {g.leaf("p", k): np.full(size.columns, v, dtype=complex) for k, v in enumerate(p)}
        values = evaluate(g, self.nodes[: size.main], leaves, size.columns)
        return np.array([v.imag for v in values]).reshape(size.main, size.columns) / 1e-30


_system = by_structure(CompiledSystem, room=32)
_by_identity = lru_cache(maxsize=64)(_system)


def system(model: Model, outputs: Sequence[str] | None = None) -> CompiledSystem:
    """Return the compiled system of a model for a list of outputs or signals (default all outputs), kept for later calls."""
    return _by_identity(model, tuple(model.outputs if outputs is None else outputs))
