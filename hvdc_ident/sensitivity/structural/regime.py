"""A model's equations in one regime: every limiter and every other switch on a chosen branch, so that only smooth functions stay."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
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

    starts: per state the node that is 0 at the start, or None where the start is free. holds: whether each condition holds.
    """

    graph: Graph
    derivatives: tuple[int, ...]
    residuals: tuple[int, ...]
    outputs: tuple[int, ...]
    starts: tuple[int | None, ...]
    holds: Mapping[int, bool]

    def arguments(self, node: int) -> tuple[int, ...]:
        """The nodes a node is computed from; of a choice the branch that is taken."""
        key = self.graph.nodes[node]
        if key[0] == "select":
            return (key[2] if self.holds[key[1]] else key[3],)
        return self.graph.arguments(node)

    def behind(self, roots: Iterable[int], known: Container[int] = ()) -> list[int]:
        """Every node the roots depend on in this regime, as `Graph.reachable`."""
        return self.graph.reachable(roots, known, self.arguments)


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
        try:
            n = len(self.structure.states) + len(self.structure.unknowns)
            self.point = engine_of(model).start(self.p, self.u, model=model)[0][:n]
        except SteadyStateError:
            if "steady" in self.start.values():
                raise
            guesses = [1.0 if s.guess is None else s.guess for s in model.states.values()]
            self.point = np.array([*guesses, *(model.algebraic[n].start for n in self.structure.unknowns)])

        self.holds = self._conditions()

    def equations(self, regime: Mapping[str, str]) -> Equations:
        """The equations with the limiters of the named signals on the given branches, all others as at the operating point."""
        s, holds = self.structure, dict(self.holds)
        for name, mode in regime.items():
            holds |= self._branch(name, mode)
        starts = tuple(self._start(k, name) for k, name in enumerate(s.states))
        return Equations(s.graph, tuple(s.derivatives), tuple(s.residuals), tuple(s.observed), starts, holds)

    def _start(self, k: int, name: str) -> int | None:
        g, s = self.graph, self.structure
        if self.start[name] == "free":
            return None
        fixed = s.starts[k] if self.start[name] == "given" else s.rests[k]
        return s.derivatives[k] if fixed is None else g.sub(g.leaf("y", k), fixed)

    # --- limiters ---

    def active(self) -> tuple[str, ...]:
        """ "NAME: low | high" for each named signal whose limiter holds it at the operating point."""
        limited = []
        for name in self.model.signals:
            key = self.graph.nodes[self.structure.nodes[name]]
            if key[0] == "select" and self._is_clip(key):
                low, high = self.holds[key[1]], self.holds[self.graph.nodes[key[3]][1]]
                limited += [f"{name}: {'low' if low else 'high'}"] if low or high else []
        return tuple(limited)

    def _conditions(self) -> dict[int, bool]:
        """Return {condition: True where it holds} at the operating point."""
        g = self.graph
        values = {g.leaf("p", k): float(v) for k, v in enumerate(self.p)}
        values |= {g.leaf("y", k): float(v) for k, v in enumerate(self.point)}
        values |= {g.leaf("w", k): float(v) for k, v in enumerate([0.0, *self.u])}
        conditions = {key[1] for key in g.nodes if key[0] == "select"}
        return dict(zip(conditions, map(bool, g.evaluate(conditions, values)), strict=True))

    def _is_clip(self, key: tuple) -> bool:
        inner = self.graph.nodes[key[3]]
        return inner[0] == "select" and key[2] != inner[3]

    def _branch(self, name: str, mode: str) -> dict[int, bool]:
        """Return the conditions that put the limiter of a signal on a branch."""
        where = f"model '{self.model.name}', regime"
        if name not in self.structure.nodes:
            raise unknown_name("signal", name, list(self.structure.nodes), where=where)
        key = self.graph.nodes[self.structure.nodes[name]]
        if key[0] != "select":
            raise InputError(
                f"the signal '{name}' is not limited",
                where=where,
                expected="a signal that is a clip, min or max",
                hint="name the signal whose own expression begins with the limiter",
            )
        choices = {"first": {key[1]: True}, "second": {key[1]: False}}
        if self._is_clip(key):
            low, high = key[1], self.graph.nodes[key[3]][1]
            choices = {"low": {low: True}, "high": {low: False, high: True}, "inside": {low: False, high: False}}
        if mode not in choices:
            expected = f"one of {', '.join(choices)}"
            raise InputError(f"the limiter of '{name}' has no mode '{mode}'", where=where, expected=expected)
        return choices[mode]
