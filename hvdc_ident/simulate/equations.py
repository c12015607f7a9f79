"""The functions an integrator needs, built from a model: right-hand side, Jacobians, tangents, switches, outputs, rest.

Vectors (all double):
    y   [x (nx), z (nz)] then, where there are sensitivities, its rows over the parameters, `width` doubles each
    w   [time, inputs, delays, sampled] then rows of the delays and sampled values over the parameters
    wd  the time derivative of w, laid out alike
    p   all parameters; m   one mode a switch: 1 where the switch is negative, else 0
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, TypeVar

import sympy as sp

from hvdc_ident.errors import require_known, unknown_name
from hvdc_ident.expression import symbol
from hvdc_ident.model import Model, dependency_order, reached
from hvdc_ident.simulate.codegen import Elimination, Function, Row, eliminate, function_text, solve_text
from hvdc_ident.simulate.core import NUMBERS
from hvdc_ident.simulate.graph import Graph
from hvdc_ident.simulate.machine_code import Code
from hvdc_ident.simulate.sliding_equations import sliding

ACCURACY, SHORTEST, TINY = (NUMBERS[n] for n in ("ACCURACY", "SHORTEST", "TINY"))


def padded(count: int) -> int:
    """The next multiple of four: compiled loops take four doubles at once."""
    return -(-count // 4) * 4


def torn(model: Model) -> tuple[str, ...]:
    """The algebraic unknowns that are needed to break every circle; the others are plain signals."""
    uses = {n: _names(s.value) for n, s in model.signals.items()} | {
        n: _names(a.equation) for n, a in model.algebraic.items()
    }
    keep = set(model.algebraic)
    for name in model.algebraic:
        if not _leads_back(name, uses, keep - {name}):
            keep.discard(name)
    return tuple(n for n in model.algebraic if n in keep)


def _names(e: sp.Expr) -> set[str]:
    return {s.name for s in e.free_symbols}


def _leads_back(start: str, uses: dict[str, set[str]], cut: set[str]) -> bool:
    def onwards(n: str) -> set[str]:
        return set() if n in cut else uses[n] & uses.keys()

    return start in reached(onwards(start), onwards)


@dataclass(frozen=True)
class Sizes:
    """Lengths of the vectors: states, unknowns, inputs, delays, sampled values, switches, outputs, sensitivity parameters, row width."""

    nx: int
    nz: int
    nu: int
    nd: int
    nq: int
    ns: int
    no: int
    np: int
    width: int


class ModelEquations:
    """A model's equations as a graph, and the machine code made from it for the given sensitivity parameters and outputs.

    switch: the one along whose surface the model slides; its equations have no steady state. None: no slide. brief: whether the machine
    code is made quickly instead of well.
    """

    def __init__(
        self,
        model: Model,
        sensitivities: Sequence[str] = (),
        outputs: Sequence[str] | None = None,
        switch: int | None = None,
        *,
        brief: bool = False,
    ) -> None:
        self.model, self.brief = model, brief
        self.sensitivities = tuple(sensitivities)
        self.outputs = tuple(model.outputs if outputs is None else outputs)
        require_known("parameter", self.sensitivities, model.parameters, f"model '{model.name}'")
        self.states = tuple(model.states)
        self.unknowns = torn(model)
        self.graph = Graph()
        self.switch, self.twin, self.surface = switch, -1, list[int]()
        self._define()
        if switch is not None:
            self._slide(switch)

    # --- leaves and equations ---

    def _define(self) -> None:
        g, m = self.graph, self.model
        leaf = g.leaf
        nodes: dict[str, int] = {n: leaf("p", k) for k, n in enumerate(m.parameters)}
        nodes |= {n: leaf("y", k) for k, n in enumerate((*self.states, *self.unknowns))}
        exogenous = ("time", *m.inputs, *m.delays, *m.sampled)
        nodes |= {n: leaf("w", k) for k, n in enumerate(exogenous)}
        memo: dict[sp.Basic, int] = {}
        plain = [n for n in m.algebraic if n not in self.unknowns]
        definitions = {n: s.value for n, s in m.signals.items()} | {n: m.algebraic[n].equation for n in plain}
        for name in dependency_order(m, definitions):
            nodes[name] = g.expression(definitions[name], nodes, memo)

        def node(e: sp.Expr) -> int:
            return g.expression(e, nodes, memo)

        self.nodes = nodes
        self.derivatives = [node(s.derivative) for s in m.states.values()]
        self.residuals = [g.sub(node(m.algebraic[n].equation), nodes[n]) for n in self.unknowns]
        self.observed = [self._observed(n, node) for n in self.outputs]
        self.sources = [node(d.of) for d in m.delays.values()] + [node(s.value) for s in m.sampled.values()]
        timing = (
            [d.time for d in m.delays.values()]
            + [s.period for s in m.sampled.values()]
            + [s.compute for s in m.sampled.values()]
        )
        self.timing = [node(e) for e in timing]
        self.starts = [
            None if s.start is None else node(symbol(f"{n}_start") if s.start == "free" else s.start)
            for n, s in m.states.items()
        ]
        self.rests = [None if s.rest is None else node(s.rest) for s in m.states.values()]
        self.rhs = [*self.derivatives, *self.residuals]

    def _slide(self, switch: int) -> None:
        slide = sliding(
            self.graph, switch, self.derivatives, self.residuals, self.observed, self.sources, self.partial, self.rate
        )
        self.twin, self.surface = slide.twin, slide.surface
        self.derivatives, self.residuals = slide.derivatives, slide.residuals
        self.observed, self.sources = slide.observed, slide.sources
        self.graph.switches[:] = slide.switches
        self.rhs = [*self.derivatives, *self.residuals]

    def _observed(self, name: str, node: Callable[[sp.Expr], int]) -> int:
        if name in self.model.outputs:
            return node(self.model.outputs[name].value)
        if name in self.nodes:
            return self.nodes[name]
        raise unknown_name(
            "output or signal", name, [*self.model.outputs, *self.nodes], where=f"model '{self.model.name}'"
        )

    @cached_property
    def sizes(self) -> Sizes:
        m, n = self.model, len(self.sensitivities)
        width = padded(n)
        return Sizes(
            len(self.states),
            len(self.residuals),
            len(m.inputs),
            len(m.delays),
            len(m.sampled),
            len(self.graph.switches),
            len(self.outputs),
            n,
            width,
        )

    def head(self, rosenbrock: bool) -> dict[str, int]:
        """Return what a run's record states of these equations, but for addresses: {field of the core's head: number}."""
        s, e = self.sizes, self.elimination if rosenbrock else None
        n = s.nx + s.nz
        return {
            **{k: getattr(s, k) for k in ("nx", "nz", "nu", "nd", "nq", "ns", "no", "np", "width")},
            "n": n,
            "size": n * (1 + s.width),
            "stride": padded(n * (1 + s.width)),
            "nw": 1 + s.nu + s.nd + s.nq,
            "hessians": len(self.second) if rosenbrock else 0,
            "factors": e.count if e else 0,
            "timed": self.moves_by_itself,
            "rosenbrock": rosenbrock,
            "sliding": -1 if self.switch is None else self.switch,
            "twin": self.twin,
        }

    # --- derivatives ---

    def partial(self, node: int, group: str) -> dict[int, int]:
        """{index: node} of the derivatives with respect to the leaves of one vector."""
        leaves = ((self.graph.nodes[v], d) for v, d in self.graph.gradient(node).items())
        return {key[2]: d for key, d in leaves if key[1] == group}

    @cached_property
    def second(self) -> list[tuple[int, int, int]]:
        """(row, column, node) of the Jacobian's entries that are not constant: those the sensitivities' own Jacobian needs."""
        entries = [(i, j, d) for i, n in enumerate(self.rhs) for j, d in self.partial(n, "y").items()]
        return [(i, j, d) for i, j, d in entries if self.graph.gradient(d)] if self.sensitivities else []

    @cached_property
    def _columns(self) -> dict[int, int]:
        """{place in p: column} of the sensitivity parameters."""
        places = {n: k for k, n in enumerate(self.model.parameters)}
        return {places[n]: k for k, n in enumerate(self.sensitivities)}

    def _row(self, node: int, with_rates: bool = False) -> Row:
        """The total derivative of a node over the sensitivity parameters, as a row of the product with S and W."""
        m, column = self.model, self._columns
        scalars = {column[i]: d for i, d in self.partial(node, "p").items() if i in column}
        size = len(self.rhs)
        width = self.sizes.width
        products = [(d, "y", size + j * width) for j, d in sorted(self.partial(node, "y").items())]
        first, total = 1 + len(m.inputs), 1 + len(m.inputs) + len(m.delays) + len(m.sampled)
        for group in ("w", "wd"):
            products += [
                (d, group, total + (j - first) * width)
                for j, d in sorted(self.partial(node, group).items())
                if j >= first
            ]
        return Row(scalars, products)

    def rate(self, node: int, states_too: bool) -> int:
        """The node's derivative in time: through w alone, or through the states' rates `yd` too."""
        g = self.graph
        total = g.zero
        for j, d in self.partial(node, "w").items():
            total = g.add(total, d if j == 0 else g.mul(d, g.leaf("wd", j)))
        if states_too:
            for j, d in self.partial(node, "y").items():
                total = g.add(total, g.mul(d, g.leaf("yd", j)))
        return total

    @property
    def moves_by_itself(self) -> bool:
        """True where an equation uses `time`, so that its derivative in time is not 0 between changes of the inputs."""
        return any(0 in self.partial(v, "w") for v in self.rhs)

    # --- functions ---

    @cached_property
    def functions(self) -> list[Function]:
        """The functions of `NAMES` but for those of the Rosenbrock method alone, those without content left out."""
        return self._made([*self._of_every_run(), *(make() for make in self._of_some_runs.values())])

    @cached_property
    def deferred(self) -> tuple[str, ...]:
        """Names of functions that are compiled when a run asks for them: those that not all do, where few runs are to come."""
        return tuple(self._of_some_runs) if self.brief and self.switch is None else ()

    def _of_every_run(self) -> list[Function]:
        s, width = self.sizes, self.sizes.width
        result = [
            self._plain("f", self.rhs, hot=not width),
            self._plain("sw", list(self.graph.switches), hot=True),
            self._plain("out", self.observed, hot=not width),
            self._plain("src", self.sources),
            self._plain("srcd", [self.rate(v, True) for v in self.sources]),
        ]
        result += [make() for name, make in self._of_unknowns.items() if s.nz]
        if self.switch is None:
            result += [self._modes(), self._both("const", self.timing), *self._rest()]
        else:
            surface = list(enumerate(self.surface))
            result.append(Function("surface", surface, self._rows(self.surface[:1], len(surface))))
        if not width:
            stride = (padded(s.nx + s.nz), s.no)
            result.append(Function("rows", list(enumerate(self.observed)), hot=True, stride=stride))
        if width:
            result += [
                self._both("fs", self.rhs, hot=True),
                self._both("sws", list(self.graph.switches)),
                self._both("outs", self.observed, hot=True),
                self._both("srcs", self.sources),
                self._switch_rates(),
            ]
        return result

    @property
    def _of_some_runs(self) -> dict[str, Callable[[], Function]]:
        """By name what makes a function that not every run needs: the Rosenbrock method the Jacobian, a slide the switches' rates."""
        found = {} if self.sizes.nz else self._of_unknowns
        return found if self.sizes.width else found | {"swd": self._switch_rates}

    @property
    def _of_unknowns(self) -> dict[str, Callable[[], Function]]:
        """By name what makes a function that the unknowns are solved with, and a step of the Rosenbrock method."""
        return {"jac": self._jacobian, "ft": lambda: self._both("ft", [self.rate(v, False) for v in self.rhs])}

    def _jacobian(self) -> Function:
        n = len(self.rhs)
        entries = [(i * n + j, d) for i, v in enumerate(self.rhs) for j, d in self.partial(v, "y").items()]
        return Function("jac", entries, hot=True)

    def _switch_rates(self) -> Function:
        return self._plain("swd", [self.rate(v, True) for v in self.graph.switches])

    def _plain(self, name: str, nodes: list[int], hot: bool = False) -> Function:
        return Function(name, list(enumerate(nodes)), hot=hot)

    def _both(self, name: str, nodes: list[int], hot: bool = False) -> Function:
        """Nodes, and their rows."""
        return Function(name, list(enumerate(nodes)), self._rows(nodes, len(nodes)), hot=hot)

    def _rows(self, nodes: Iterable[int], at: int) -> list[tuple[int, Row]]:
        width = self.sizes.width
        return [(at + k * width, self._row(v)) for k, v in enumerate(nodes)] if width else []

    def _made(self, functions: list[Function]) -> list[Function]:
        """Return the functions, whose derivatives hold the model's own conditions only."""
        if len(self.graph.switches) != self.sizes.ns:
            raise AssertionError("a derivative made a new condition")
        return functions

    def _modes(self) -> Function:
        """One value a switch: 1 where it is negative, else 0."""
        g = self.graph
        modes = [(k, g.select(g.condition(k), g.one, g.zero)) for k in range(len(g.switches))]
        return Function("modes", modes, live=True)

    def _rest(self) -> list[Function]:
        """Residual of the steady state over [x, z, delays, sampled], its Jacobian and its derivative by the sensitivity parameters.

        A state with a rest or start runs to it, as others run along their derivatives, where the model is followed.
        """
        g, s = self.graph, self.sizes
        first = 1 + s.nu
        tail = [g.sub(v, g.leaf("w", first + k)) for k, v in enumerate(self.sources)]
        fixed = [rest if start is None else start for start, rest in zip(self.starts, self.rests, strict=True)]
        head = [
            d if value is None else g.sub(value, g.leaf("y", k))
            for k, (d, value) in enumerate(zip(self.derivatives, fixed, strict=True))
        ]
        residual = [*head, *self.residuals, *tail]
        n, inner = len(residual), s.nx + s.nz
        entries = []
        for i, v in enumerate(residual):
            entries += [(i * n + j, d) for j, d in self.partial(v, "y").items()]
            entries += [(i * n + inner + j - first, d) for j, d in self.partial(v, "w").items() if j >= first]
        column = self._columns
        by_p = [
            (i * s.width + column[k], d)
            for i, v in enumerate(residual)
            for k, d in self.partial(v, "p").items()
            if k in column
        ]
        return [Function("rest", list(enumerate(residual))), Function("rest_jac", entries), Function("rest_p", by_p)]

    @cached_property
    def elimination(self) -> Elimination | None:
        """Straight-line code for the linear systems of the Rosenbrock method, where the pattern allows it."""
        n = len(self.rhs)
        constant = {
            (i, j): self.graph.value(d) for i, v in enumerate(self.rhs) for j, d in self.partial(v, "y").items()
        }
        return eliminate(constant, n, len(self.states)) if n else None

    def compile(self) -> Code:
        """The machine code that every run needs; keep it as long as its addresses are used.

        No derivative by another parameter than those of the sensitivities is had from the graph afterwards.
        """
        self.graph.hold(self.nodes[n] for n in self.model.parameters if n not in self.sensitivities)
        functions = self._made(self._of_every_run()) if self.deferred else self.functions
        return Code(self.graph, functions, max(self.sizes.width, 1), brief=self.brief)

    def compile_deferred(self, names: Sequence[str]) -> Code:
        """The machine code of functions that were left out at first."""
        functions = self._made([self._of_some_runs[n]() for n in names])
        return Code(self.graph, functions, max(self.sizes.width, 1), brief=self.brief)

    def compile_rest(self) -> Code:
        """The machine code of the steady state alone."""
        rest = self._rest()  # before the modes: its derivatives stand first in the graph
        functions = [self._modes(), Function("src", list(enumerate(self.sources))), *rest]
        return Code(self.graph, functions, max(self.sizes.width, 1))

    def compile_late(self) -> Code:
        """Compile what only the Rosenbrock method needs: second derivatives and elimination, most of the code of a large model."""
        e, width = self.elimination, self.sizes.width
        written: dict[str, Callable[[str], str]] = {}
        if e is not None:
            written["lu"] = lambda symbol: function_text(e.graph, e.function, symbol, 1)
            second = [(i, j) for i, j, _ in self.second]
            written["solve"] = lambda symbol: solve_text(e, symbol, width, second)
        rows = [(k * width, self._row(d)) for k, (_, _, d) in enumerate(self.second)]
        functions = self._made([Function("hess", (), rows, hot=True)] if width else [])
        return Code(self.graph, functions, max(width, 1), written, brief=self.brief)


T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class _Key:
    """Key of the machine code: the equations and the other arguments, not the values of parameters and inputs."""

    model: Model
    others: tuple[Any, ...]

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _Key) or self.others != other.others:
            return False
        return self.model is other.model or self.model.structure == other.model.structure

    def __hash__(self) -> int:
        return hash((self.model.structure, self.others))


def by_structure(make: Callable[..., T], room: int) -> Callable[..., T]:
    """Return the function `make` of a model and hashable arguments, its last `room` results kept by the model's structure."""

    @lru_cache(maxsize=room)
    def kept(key: _Key) -> T:
        return make(key.model, *key.others)

    return lambda model, *others: kept(_Key(model, others))
