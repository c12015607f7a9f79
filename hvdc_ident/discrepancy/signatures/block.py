"""Output of an effect driven by given signals, many at once, on a grid of instants: its own equations, without the plant.

The equations are those of the catalogue (`effects.effect_model`); states are stepped by an exponential form that is exact for
a linear effect of a signal of straight pieces. What the steps cannot take (a delay of a state) goes to the simulator.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, Experiment, InputSignal
from hvdc_ident.discrepancy.signatures.march import hold, march
from hvdc_ident.effects import Effect, EffectUse, effect_model
from hvdc_ident.expression import FUNCTIONS, symbol
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model, ordered_signals
from hvdc_ident.simulate import Code, Function, Graph, simulate

FINE = 2.5e-4
"""s: an effect with corners in its derivative is stepped no more coarsely than this, in so many parts of a grid interval as it may take."""
PARTS = 8
"""The most that it takes where nothing else is said."""
_NUMPY: dict[str, Any] = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "neg": np.negative, "pow": np.power, "not": np.logical_not,
    "and": np.logical_and, "or": np.logical_or, "select": np.where,
    "sqrt0": lambda x: np.sqrt(np.maximum(x, 0.0)),
    "inverse": lambda x: np.where(x == 0.0, 0.0, 1.0 / np.where(x == 0.0, 1.0, x)),
}  # fmt: skip


Quick = Callable[[Array, Mapping[str, Array]], Array]
"""Y, (K, nc), of u, (K, nc), and parameters, (1, nc) each."""


class EffectBlock:
    """One effect's equations, from the signals u and source (K, nc) to y (K, nc)."""

    def __init__(self, model: Model, quick: Quick | None = None) -> None:
        self.model, self.quick = model, quick
        g = self.graph = Graph()
        self._orders: dict[tuple[int, ...], list[int]] = {}
        self.states = tuple(model.states)
        self.leaves = (*self.states, *model.delays, *model.sampled, *model.inputs, "time", *model.parameters)
        nodes = {n: g.leaf("y", k) for k, n in enumerate(self.leaves)}
        memo: dict = {}
        for name in ordered_signals(model):
            nodes[name] = g.expression(model.signals[name].value, nodes, memo)
        new = lambda e: g.expression(e, nodes, memo)  # noqa: E731
        self.output = new(model.outputs["y"].value)
        self.derivatives = [new(s.derivative) for s in model.states.values()]
        self.rests = [
            new(symbol(n) - s.rest) if s.rest is not None else new(s.derivative) for n, s in model.states.items()
        ]
        self.sources = [new(d.of) for d in model.delays.values()] + [new(s.value) for s in model.sampled.values()]
        self.times = [new(d.time) for d in model.delays.values()]
        self.periods = [(new(s.period), new(s.compute)) for s in model.sampled.values()]
        self.moving = [k for k, d in enumerate(self.derivatives) if g.value(d) != 0.0]
        self._leaf_nodes = tuple(nodes[n] for n in self.leaves)
        leaf = {nodes[n]: k for k, n in enumerate(self.leaves)}
        self.jacobian = [self._by(d, leaf) for d in self.derivatives]
        self.rest_jacobian = [self._by(d, leaf) for d in self.rests]
        reads = {leaf[n] for v in self.sources for n in g.gradient(v) if n in leaf}
        self.steps = not any(k < len(self.states) for k in reads)
        self.cornered = bool(g.switches)

    def linear(self, switching: tuple[str, ...]) -> bool:
        """Return True where y is linear in these parameters, those that make the effect vanish, and answers at once."""
        own = {k for k, n in enumerate(self.leaves) if n in switching}
        leaf = dict(zip(self._leaf_nodes, range(len(self.leaves)), strict=True))
        first = self._by(self.output, leaf)
        if any(own & set(row) for row in (*self.jacobian, *self.rest_jacobian)):
            return False
        if any(own & set(self._by(v, leaf)) for v in (*self.sources, *self.times)):
            return False
        if any(own & set(self._by(self.graph.switches[s], leaf)) for s in range(len(self.graph.switches))):
            return False
        return not any(own & set(self._by(first[k], leaf)) for k in own if k in first)

    def _by(self, node: int, leaf: Mapping[int, int]) -> dict[int, int]:
        return {leaf[n]: d for n, d in self.graph.gradient(node).items() if n in leaf}

    def value(self, nodes: list[int], at: list[Any]) -> list[Any]:
        """The nodes' values, `at` giving one array for each leaf."""
        g = self.graph
        known: dict[int, Any] = {}
        key = tuple(nodes)
        if key not in self._orders:
            self._orders[key] = _order(g, nodes)
        for n in self._orders[key]:
            op, *a = g.nodes[n]
            if op in ("const", "bool"):
                known[n] = a[0]
            elif op == "leaf":
                known[n] = at[a[1]]
            elif op == "switch":
                known[n] = known[g.switches[a[0]]] < 0.0
            else:
                operation: Any = _NUMPY[op] if op in _NUMPY else FUNCTIONS[op].array
                known[n] = operation(*(known[k] for k in a))
        return [known[n] for n in nodes]

    def run(
        self, parameters: Mapping[str, Array], time: Array, u: Array, source: Array | None, parts: int = PARTS
    ) -> Array:
        """Y, (K, nc), of u and source, (K, nc), at instants (K,), with each parameter (nc,).

        parts: of an interval at most, where the effect has corners.
        """
        if self.quick is not None:
            return self.quick(u, {n: v[None] for n, v in parameters.items()})
        if not self.steps:
            return self._simulated(parameters, time, u, source)
        with np.errstate(all="ignore"):
            return self._stepped(parameters, time, u, source, parts)

    def _stepped(
        self, parameters: Mapping[str, Array], time: Array, u: Array, source: Array | None, parts: int
    ) -> Array:
        n, m = len(self.states), len(self.model.delays) + len(self.model.sampled)
        inputs = [u] if source is None else [u, source]
        own = [parameters[p] for p in self.model.parameters]
        nothing: list[Any] = [np.broadcast_to(0.0, u.shape)] * (n + m)
        whole = [*nothing, *inputs, np.broadcast_to(time[:, None], u.shape), *own]
        memory = self._memory(whole, time, u)
        whole[n : n + m] = memory
        if n:
            whole[:n] = self._states(whole, time, own, parts)
        return np.asarray(np.broadcast_to(self.value([self.output], whole)[0], u.shape), dtype=float)

    def _memory(self, whole: list[Any], time: Array, u: Array) -> list[Array]:
        """Delayed and sampled values, (K, nc) each."""
        signals = [np.broadcast_to(v, u.shape) for v in self.value(self.sources, whole)]
        found = []
        for q, signal in enumerate(signals):
            if q < len(self.times):
                when = time[:, None] - self.value([self.times[q]], whole)[0]
                found.append(_at(signal, time, np.broadcast_to(when, u.shape)))
            else:
                period, compute = self.value(list(self.periods[q - len(self.times)]), whole)
                found.append(_held(signal, time, period, compute))
        return found

    def _states(self, whole: list[Any], time: Array, own: list[Array], parts: int) -> list[Array]:
        n = len(self.states)
        first = [v[0] if k < len(whole) - len(own) else v for k, v in enumerate(whole)]
        x = self._rest(first)
        path = np.repeat(x[:, None, :], time.size, axis=1)
        if self.moving:
            driven = np.ascontiguousarray(np.array(whole[n : len(whole) - len(own)]).transpose(2, 0, 1))
            constants = np.ascontiguousarray(np.array([np.broadcast_to(v, x.shape[1:]) for v in own]).T)
            fine = FINE if self.cornered else np.inf
            march(self._address, time, driven, constants, np.ascontiguousarray(x.T), fine, parts, path)
        return list(path)

    @cached_property
    def _code(self) -> Code:
        """Derivatives, then their rows over the leaves up to time, as one machine function of the leaves."""
        n, count = len(self.states), len(self.leaves) - len(self.model.parameters)
        places = [(i, d) for i, d in enumerate(self.derivatives)]
        places += [(n + i * count + k, d) for i, row in enumerate(self.jacobian) for k, d in row.items() if k < count]
        return Code(self.graph, [Function("step", places, live=True)], 1)

    @property
    def _address(self) -> int:
        return self._code.address["step"]

    def _rest(self, first: list[Any]) -> Array:
        """The states at rest, (n, nc): Newton from the slot's own value."""
        n = len(self.states)
        u = first[n + len(self.model.delays) + len(self.model.sampled)]
        x = np.array([u if k == 0 else np.zeros_like(u) for k in range(n)], dtype=float)
        for _ in range(4):
            at = [*x, *first[n:]]
            r = np.array([np.broadcast_to(v, u.shape) for v in self.value(self.rests, at)])
            j = self._matrix(self.rest_jacobian, at, u.shape)
            x = x - _solved(j, r)
        return x

    def _matrix(self, rows: list[dict[int, int]], at: list[Any], shape: tuple[int, ...]) -> Array:
        n = len(self.states)
        j = np.zeros((n, n, *shape))
        for i, row in enumerate(rows):
            for k, value in zip(row, self.value(list(row.values()), at), strict=True):
                if k < n:
                    j[i, k] = value
        return j

    def _simulated(self, parameters: Mapping[str, Array], time: Array, u: Array, source: Array | None) -> Array:
        y = np.empty_like(u)
        for c in range(u.shape[1]):
            signals = {"u": _signal(time, u[:, c])}
            if source is not None:
                signals["source"] = _signal(time, source[:, c])
            values = {n: float(v[c]) for n, v in parameters.items()}
            run = simulate(self.model, Experiment(time, "alone", inputs=FrozenMap(signals)), values, rtol=1e-5)
            y[:, c] = run["y"]
        return y


def _signal(time: Array, values: Array) -> InputSignal:
    doubled = time[1:][np.diff(time) == 0]
    return InputSignal(time, values, doubled)


def _solved(matrix: Array, right: Array) -> Array:
    """The solutions of many small systems: matrix (n, n, nc), right (n, nc)."""
    if matrix.shape[0] == 1:
        return np.asarray(right / np.where(matrix[0] == 0.0, 1.0, matrix[0]))
    m = np.moveaxis(matrix, (0, 1), (-2, -1))
    found: Array = np.asarray(np.linalg.solve(m, np.moveaxis(right, 0, -1)[..., None])[..., 0], dtype=float)
    return np.moveaxis(found, -1, 0)


def _at(signal: Array, time: Array, when: Array) -> Array:
    """The signal (K, nc) at earlier instants (K, nc); before the first its first value."""
    low = np.clip(np.searchsorted(time, when.ravel(), "right") - 1, 0, time.size - 2).reshape(when.shape)
    width = time[low + 1] - time[low]
    share = np.clip((when - time[low]) / np.where(width > 0, width, 1.0), 0.0, 1.0)
    columns: NDArray[np.intp] = np.broadcast_to(np.arange(signal.shape[1]), when.shape)
    below = signal[low, columns]
    return np.asarray(below + share * (signal[low + 1, columns] - below))


def _held(signal: Array, time: Array, period: Any, compute: Any) -> Array:
    """The signal (K, nc) as it was sampled, `compute` earlier at least; before the first sample its first value."""
    y = np.empty(signal.shape)
    each = (np.ascontiguousarray(np.broadcast_to(v, signal.shape[1:]), dtype=float) for v in (period, compute))
    hold(time, np.ascontiguousarray(signal), *each, y)
    return y


def _order(graph: Graph, roots: list[int]) -> list[int]:
    """Every node the roots depend on, those behind switches too, arguments first."""
    seen: set[int] = set()
    stack = list(roots)
    while stack:
        n = stack.pop()
        if n in seen:
            continue
        seen.add(n)
        key = graph.nodes[n]
        stack.extend([graph.switches[key[1]]] if key[0] == "switch" else graph.arguments(n))
    found: list[int] = []
    done: set[int] = set()
    for root in sorted(seen):
        pending = [root]
        while pending:
            n = pending[-1]
            key = graph.nodes[n]
            needs = [graph.switches[key[1]]] if key[0] == "switch" else graph.arguments(n)
            missing = [k for k in needs if k not in done]
            if n in done or not missing:
                if n not in done:
                    done.add(n)
                    found.append(n)
                pending.pop()
            else:
                pending.extend(missing)
    return found


@lru_cache(maxsize=128)
def block(effect: str, present: tuple[str, ...], source: bool) -> EffectBlock:
    """The block of an effect with these parameters away from neutral; its parameters keep the effect's own names."""
    return _made(effect, present, source)


def _made(effect: str, present: tuple[str, ...], source: bool) -> EffectBlock:
    from hvdc_ident.effects import effects

    entry = effects()[effect]
    # Any value away from neutral gives the structure; the run takes its own values.
    values = {n: _away(q) if n in present else q.value for n, q in entry.parameters.items()}
    use = EffectUse(effect, ("u",), FrozenMap(values), prefix="own", source="source" if source else "")
    return EffectBlock(effect_model(use, source), _quick(entry))


def _quick(entry: Effect) -> Quick | None:
    """The effect's own short cut, of a block's parameters."""
    short = entry.numpy_form
    return short and (lambda u, p: short(u, {n: p[parameter(n)] for n in entry.parameters}))


def _away(q: Any) -> float:
    low = q.min if np.isfinite(q.min) else -1.0
    high = q.max if np.isfinite(q.max) else low + 4.0
    return float(low + 0.3173 * (high - low))


def parameter(name: str) -> str:
    """Name of an effect's parameter in a block."""
    return f"own_{name}"
