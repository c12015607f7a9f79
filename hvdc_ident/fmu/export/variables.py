"""The variables of an exported FMU: names, value references, starts, units, and what depends on what."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

from hvdc_ident.expression import symbol
from hvdc_ident.fmu.export.program import Program


@dataclass(frozen=True)
class Variable:
    """One scalar variable; all are of type Real. derivative: reference of the state it is the derivative of."""

    name: str
    reference: int
    causality: str
    variability: str
    initial: str = ""
    start: float | None = None
    unit: str = ""
    description: str = ""
    min: float | None = None
    max: float | None = None
    nominal: float | None = None
    derivative: int | None = None


@dataclass(frozen=True, eq=False)
class Variables:
    """All variables in the ranges of value references that internal.h names.

    A name stands once in an FMU. An output that is a state or an input of its name is that variable where it is a state;
    any other output whose name is taken becomes outputs.NAME, as slots are named.
    """

    program: Program

    @cached_property
    def all(self) -> tuple[Variable, ...]:
        """Every variable as listed: time, inputs, outputs in the model's order, other states, derivatives, parameters."""
        states, outputs = list(self._states()), list(self._outputs())
        shown = {v.name: v for v in states if v.causality == "output"} | {v.name: v for v in outputs}
        ordered = [shown[self._output_name(n)] for n in self.program.model.outputs]
        inner = [v for v in states if v.causality != "output"]
        return (*self._time(), *self._inputs(), *ordered, *inner, *self._rates(), *self._parameters())

    @cached_property
    def first(self) -> dict[str, int]:
        """The first value reference of each range."""
        m, s = self.program.model, self.program.structure.sizes
        counts = {
            "time": 1,
            "inputs": len(m.inputs),
            "states": s.nx,
            "rates": s.nx,
            "outputs": s.no,
            "parameters": len(m.parameters),
            "indicators": s.ns,
        }
        starts, total = {}, 0
        for name, count in counts.items():
            starts[name] = total
            total += count
        return starts

    @property
    def derivatives(self) -> tuple[Variable, ...]:
        """The states' derivatives, in order."""
        return tuple(v for v in self.all if v.derivative is not None)

    @property
    def outputs(self) -> tuple[Variable, ...]:
        """The outputs, in the model's order."""
        return tuple(v for v in self.all if v.causality == "output")

    @property
    def unknown_at_start(self) -> tuple[Variable, ...]:
        """Variables that initialisation computes: outputs, states and derivatives."""
        states = range(self.first["states"], self.first["outputs"])
        return tuple(v for v in self.all if v.causality == "output" or v.reference in states)

    @cached_property
    def output_states(self) -> dict[str, str]:
        """{output: state} of outputs that are the state of their own name."""
        m = self.program.model
        return {n: n for n, o in m.outputs.items() if n in m.states and o.value == symbol(n)}

    def dependencies(self, variable: Variable) -> tuple[int, ...]:
        """References of the time, inputs and states that an output or a derivative may depend on, ascending."""
        s, first = self.program.structure, self.first
        if first["states"] <= variable.reference < first["rates"]:
            return (variable.reference,)
        node = (
            s.derivatives[variable.reference - first["rates"]]
            if variable.derivative is not None
            else s.observed[variable.reference - first["outputs"]]
        )
        return self._known(node)

    def indicator_dependencies(self, index: int) -> tuple[int, ...]:
        """References of the time, inputs and states that an event indicator may depend on, ascending."""
        return self._known(self.program.structure.graph.switches[index])

    def _known(self, node: int) -> tuple[int, ...]:
        found, unknowns = self._leaves(node)
        if unknowns:
            found = found | self._behind_unknowns
        return tuple(sorted(found))

    @cached_property
    def _behind_unknowns(self) -> frozenset[int]:
        return frozenset().union(*(self._leaves(r)[0] for r in self.program.structure.residuals))

    def _leaves(self, node: int) -> tuple[frozenset[int], bool]:
        """References reached from a node, conditions included; and whether an algebraic unknown is among what is reached."""
        s, first = self.program.structure, self.first
        graph, nx, nu = s.graph, s.sizes.nx, s.sizes.nu
        seen: set[int] = set()
        stack, found, unknowns = [node], set(), False
        while stack:
            n = stack.pop()
            if n in seen:
                continue
            seen.add(n)
            key = graph.nodes[n]
            stack.extend((graph.switches[key[1]],) if key[0] == "switch" else graph.arguments(n))
            if key[0] == "leaf" and key[1] == "y":
                unknowns = unknowns or key[2] >= nx
                found |= {first["states"] + key[2]} if key[2] < nx else set()
            elif key[0] == "leaf" and key[1] == "w":
                found.add(key[2] if key[2] <= nu else 0)  # what is remembered changes with time
        return frozenset(found), unknowns

    # --- the ranges ---

    def _time(self) -> Iterator[Variable]:
        yield Variable("time", 0, "independent", "continuous", unit="s", description="simulation time")

    def _inputs(self) -> Iterator[Variable]:
        for k, (name, i) in enumerate(self.program.model.inputs.items()):
            yield Variable(
                name, self.first["inputs"] + k, "input", "continuous", "", i.value, i.unit, i.description
            )  # fmt: skip

    def _state_name(self, name: str) -> str:
        m = self.program.model
        return f"states.{name}" if name in m.outputs and name not in self.output_states else name

    def _output_name(self, name: str) -> str:
        m = self.program.model
        return f"outputs.{name}" if name in m.inputs or name in m.parameters else name

    def _states(self) -> Iterator[Variable]:
        for k, (name, state) in enumerate(self.program.model.states.items()):
            searched = state.start is None
            yield Variable(
                self._state_name(name),
                self.first["states"] + k,
                "output" if name in self.output_states else "local",
                "continuous",
                "approx" if searched else "calculated",
                float(self.program.rest[k]) if searched else None,
                state.unit,
                state.description,
                nominal=float(self.program.nominals[k]),
            )

    def _rates(self) -> Iterator[Variable]:
        for k, (name, state) in enumerate(self.program.model.states.items()):
            unit = f"{state.unit}/s" if state.unit and "/" not in state.unit else ""
            yield Variable(
                f"der({self._state_name(name)})",
                self.first["rates"] + k,
                "local",
                "continuous",
                "calculated",
                unit=unit,
                derivative=self.first["states"] + k,
            )

    def _outputs(self) -> Iterator[Variable]:
        m = self.program.model
        for k, (name, output) in enumerate(m.outputs.items()):
            if name in self.output_states:
                continue
            yield Variable(
                self._output_name(name),
                self.first["outputs"] + k,
                "output",
                "continuous",
                "calculated",
                None,
                output.unit,
                output.description,
            )

    def _parameters(self) -> Iterator[Variable]:
        fixed = self.program.fixed
        for k, (name, q) in enumerate(self.program.model.parameters.items()):
            yield Variable(
                name,
                self.first["parameters"] + k,
                "parameter",
                "fixed" if name in fixed else "tunable",
                "exact",
                q.value,
                q.unit,
                q.description,
                q.min if abs(q.min) < float("inf") else None,
                q.max if abs(q.max) < float("inf") else None,
            )
