"""A model as C for the core: `model.h` with its sizes, `model.c` with values, names, equations and their derivatives."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.errors import SteadyStateError
from hvdc_ident.model import Model
from hvdc_ident.simulate import Function, ModelEquations, c_array, c_function, c_number, c_solve, c_string, engine_of

TOLERANCE = 1e-8
"""Relative tolerance of co-simulation where the importer names none; the absolute one is a hundredth of it."""

_IN_A_RUN = ("f", "jac", "ft", "sw", "swd", "out", "src", "srcd")
"""Functions that the core calls in every run, as `ModelEquations` names them."""
_ALIASES = {"rhs": "f", "observe": "out", "sources": "src"}
"""Further functions of the core's head, and which of those they are where there are no sensitivities."""


@dataclass(frozen=True, eq=False)
class CModel:
    """The model's equations as C text, with the numbers that its files and its description share."""

    model: Model
    along: tuple[int, ...] = ()
    """The switches along whose surfaces it can slide: each takes as much code as the whole model, and more."""

    @cached_property
    def structure(self) -> ModelEquations:
        """Graph, equations and order of the variables; its graph gains the tangents."""
        return ModelEquations(self.model)

    @cached_property
    def rest(self) -> Array:
        """[states, unknowns, delays, sampled] at the steady state of the model's values; the guesses where there is none."""
        m = self.model
        p = np.array([q.value for q in m.parameters.values()])
        u = np.array([i.value for i in m.inputs.values()])
        code = engine_of(m)
        s = code.structure.sizes
        try:
            y, w = code.start(p, u, model=m)
        except SteadyStateError:
            return self.guesses
        return np.concatenate([y[: s.nx + s.nz], w[1 + s.nu : 1 + s.nu + s.nd + s.nq]])

    @cached_property
    def guesses(self) -> Array:
        """Start of the search for the steady state where that of the model's own values does not help."""
        m, s = self.model, self.structure
        states = [0.0 if q.guess is None else q.guess for q in m.states.values()]
        unknowns = [m.algebraic[n].start for n in s.unknowns]
        return np.array([*states, *unknowns, *(0.0 for _ in (*m.delays, *m.sampled))])

    @cached_property
    def nominals(self) -> Array:
        """(states,) typical sizes: the value at the steady start, 1 where that is near 0."""
        size = np.abs(self.rest[: len(self.model.states)])
        return np.where(size >= 1e-3, size, 1.0)

    @cached_property
    def fixed(self) -> frozenset[str]:
        """Parameters of delay times and sampling, which cannot change after initialisation."""
        names = list(self.model.parameters)
        return frozenset(names[i] for v in self.structure.timing for i in self.structure.partial(v, "p"))

    @cached_property
    def slides(self) -> dict[int, ModelEquations]:
        """The equations of each slide, by its switch."""
        return {k: ModelEquations(self.model, switch=k) for k in self.along}

    def header(self, token: str, version: str) -> str:
        """Return the text of model.h. token: what an importer has to name to get an instance. version: of FMI."""
        s = self.structure.sizes
        sizes = {"NX": s.nx, "NZ": s.nz, "NU": s.nu, "ND": s.nd, "NQ": s.nq, "NS": s.ns, "NO": s.no}
        sizes |= {"NP": len(self.model.parameters)}
        return "\n".join(
            [
                f"/* {_comment(self.model.name)}: sizes; generated. */",
                "#ifndef HVDC_MODEL_H",
                "#define HVDC_MODEL_H",
                f"#define FMI_VERSION {version[0]}",
                *(f"#define {n} {v}" for n, v in sizes.items()),
                f"#define MODEL_TOKEN {c_string(token)}",
                f"#define DEFAULT_TOLERANCE {c_number(TOLERANCE)}",
                "#endif",
                "",
            ]
        )

    @cached_property
    def source(self) -> str:
        """The text of model.c: values, names, equations."""
        head = f"/* {_comment(self.model.name)}: values, names and equations; generated. */\n#include <math.h>\n"
        return "\n".join([head, *self._tables, "", *self._functions(), *self._heads()])

    @property
    def _tables(self) -> list[str]:
        m, s = self.model, self.structure
        names = [*s.states, *s.unknowns, *m.delays, *m.sampled]
        fixed = self.fixed
        return [
            c_array("double", "model_parameter_values", (c_number(q.value) for q in m.parameters.values())),
            c_array("double", "model_input_values", (c_number(q.value) for q in m.inputs.values())),
            c_array("double", "model_rest_values", map(c_number, self.rest)),
            c_array("double", "model_guesses", map(c_number, self.guesses)),
            c_array("double", "model_nominals", map(c_number, self.nominals)),
            c_array("int", "model_parameter_fixed", (str(int(n in fixed)) for n in m.parameters)),
            c_array("int", "model_state_searched", (str(int(q.start is None)) for q in m.states.values())),
            c_array("char *const", "model_rest_names", map(c_string, names)),
            c_array("char *const", "model_memory_names", map(c_string, [*m.delays, *m.sampled])),
        ]

    def _functions(self) -> Iterator[str]:
        s = self.structure
        known = {f.name: f for f in s.functions}
        rest = [node for _, node in known["rest"].nodes]
        observed = [*s.rhs, *s.observed, *s.graph.switches]
        made = [known[name] for name in ("modes", "const", "rest", "rest_jac")]
        made += [self._tangents("tangent", observed), self._tangents("rest_tangent", rest)]
        for function in made:
            yield c_function(s.graph, function, f"model_{function.name}")
        yield from _of_a_run(s, "model")
        for switch, equations in self.slides.items():
            yield from _of_a_run(equations, f"slide{switch}")

    def _heads(self) -> Iterator[str]:
        """The core's heads: of the slide on each switch, zeros where there is none, then of the model without a slide."""
        yield "static const head model_heads[NS + 1] = {"
        for switch, equations in self.slides.items():
            yield f"    [{switch}] = {_head(equations, f'slide{switch}', ('surface',))},"
        yield f"    [NS] = {_head(self.structure, 'model', ('modes',))},"
        yield "};\n"

    def _tangents(self, name: str, nodes: Sequence[int]) -> Function:
        """Return the function of nodes' derivatives along directions: in yd, in wd, and in p behind the parameters' values."""
        g, behind = self.structure.graph, len(self.model.parameters)

        def along(node: int) -> int:
            total = g.zero
            for group, direction, first in (("y", "yd", 0), ("w", "wd", 0), ("p", "p", behind)):
                for index, slope in sorted(self.structure.partial(node, group).items()):
                    total = g.add(total, g.mul(slope, g.leaf(direction, first + index)))
            return total

        return Function(name, [(k, along(n)) for k, n in enumerate(nodes)])


def _of_a_run(equations: ModelEquations, prefix: str) -> Iterator[str]:
    """Return the functions that the core calls of one set of equations, named after the prefix."""
    for function in equations.functions:
        if function.name in (*_IN_A_RUN, "surface"):
            yield c_function(equations.graph, function, f"{prefix}_{function.name}")
    if e := equations.elimination:
        yield c_function(e.graph, e.function, f"{prefix}_lu")
        yield c_solve(e, f"{prefix}_solve")


def _head(equations: ModelEquations, prefix: str, more: Sequence[str]) -> str:
    """Return the core's head of one set of equations, as an initialiser. more: functions beside those of every run."""
    numbers = {name: str(int(value)) for name, value in equations.head(rosenbrock=True).items()}
    late = ("lu", "solve") if equations.elimination else ()
    functions = {name: name for name in (*_IN_A_RUN, *more, *late)} | _ALIASES
    fields = numbers | {f"do_{name}": f"{prefix}_{same}" for name, same in functions.items()}
    return "{" + ", ".join(f".{name} = {value}" for name, value in fields.items()) + "}"


def _comment(name: str) -> str:
    return "".join(c if c.isalnum() or c in " -_." else "_" for c in name)
