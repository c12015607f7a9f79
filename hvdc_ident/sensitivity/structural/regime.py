"""A model's equations in one regime: every limiter and every other switch on a chosen branch, so that only smooth functions stay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hvdc_ident.errors import InputError, SteadyStateError, unknown_name
from hvdc_ident.model import Model
from hvdc_ident.simulate import Graph, ModelEquations, engine_of

Start = Literal["steady", "free", "given"]


@dataclass(frozen=True)
class Equations:
    """Nodes of one graph: derivatives, residuals of the algebraic unknowns, outputs, and what is 0 at the start.

    starts: per state the node that is 0 at the start, or None where the start is free.
    """

    graph: Graph
    derivatives: tuple[int, ...]
    residuals: tuple[int, ...]
    outputs: tuple[int, ...]
    starts: tuple[int | None, ...]


class EquationSource:
    """The model's graph with its limiters, and the point at which each limiter's branch is read.

    start: per state "steady", "free" or "given". point: (states + unknowns,) of the operating point; guesses where nothing rests.
    """

    def __init__(self, model: Model, outputs: Sequence[str], start: Mapping[str, Start]) -> None:
        self.model, self.start = model, dict(start)
        self.structure = ModelEquations(model, (), outputs)
        self.graph = self.structure.graph
        self.p = np.array([x.value for x in model.parameters.values()])
        self.u = np.array([x.value for x in model.inputs.values()])
        self.smooth = Graph()  # of every regime, so that equal parts are equal nodes
        try:
            n = len(self.structure.states) + len(self.structure.unknowns)
            self.point = engine_of(model).start(self.p, self.u, model=model)[0][:n]
        except SteadyStateError:
            if "steady" in self.start.values():
                raise
            guesses = [1.0 if s.guess is None else s.guess for s in model.states.values()]
            self.point = np.array([*guesses, *(model.algebraic[n].start for n in self.structure.unknowns)])

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
        return Equations(
            branch.graph,
            tuple(derivatives),
            tuple(take(n) for n in s.residuals),
            tuple(take(n) for n in s.observed),
            tuple(starts),
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
    """A graph made again with one branch of every limiter."""

    def __init__(self, source: EquationSource, holds: Mapping[int, bool], forced: Mapping[int, int]) -> None:
        self.source, self.graph = source.graph, source.smooth
        self.holds, self.forced = holds, forced
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
        return g.call("sqrt" if op == "sqrt0" else op, *x)
