"""A model as C: `model.h` with sizes and names, `model.c` with its equations and their derivatives."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.errors import SteadyStateError
from hvdc_ident.model import Model
from hvdc_ident.simulate import Elimination, Graph, ModelEquations, engine_of

TOLERANCE = 1e-8
"""Relative tolerance of co-simulation where the importer names none; the absolute one is a hundredth of it."""

# C functions, and the model's functions that they contain.
_FUNCTIONS = {
    "model_f": "f",
    "model_jac": "jac",
    "model_ft": "ft",
    "model_switches": "sw",
    "model_modes": "modes",
    "model_outputs": "out",
    "model_sources": "src",
    "model_source_rates": "srcd",
    "model_timing": "const",
    "model_rest": "rest",
    "model_rest_jac": "rest_jac",
}
_TANGENTS = ("model_tangent", "model_rest_tangent")


@dataclass(frozen=True, eq=False)
class CModel:
    """The model's equations as C text, with the numbers that its files and its description share."""

    model: Model

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

    def header(self, token: str, version: str) -> str:
        """Return the text of model.h. token: what an importer has to name to get an instance. version: of FMI."""
        s = self.structure.sizes
        sizes = {"NX": s.nx, "NZ": s.nz, "NU": s.nu, "ND": s.nd, "NQ": s.nq, "NS": s.ns, "NO": s.no}
        sizes |= {"NP": len(self.model.parameters), "FACTORS": self._elimination.count if self._elimination else 0}
        lines = [
            f"/* {_comment(self.model.name)}: sizes, names and equations; generated. */",
            "#ifndef HVDC_MODEL_H",
            "#define HVDC_MODEL_H",
            f"#define FMI_VERSION {version[0]}",
            *(f"#define {n} {v}" for n, v in sizes.items()),
            f"#define MODEL_TOKEN {c_string(token)}",
            f"#define DEFAULT_TOLERANCE {c_number(TOLERANCE)}",
            "typedef struct {",
            "    const double *y, *yd, *w, *wd, *p, *dp, *m;",
            "} Args;",
            *(f"extern {declaration.split(' = ')[0]};" for declaration in self._tables),
            *(f"void {n}(const Args *a, double *out);" for n in (*_FUNCTIONS, *_TANGENTS)),
        ]
        if self._elimination:
            lines += [
                "void model_factorise(const double *jac, double shift, double *out);",
                "void model_solve(const double *factors, double *x);",
            ]
        return "\n".join([*lines, "#endif", ""])

    @cached_property
    def source(self) -> str:
        """The text of model.c."""
        head = f'/* {_comment(self.model.name)}; generated. */\n#include <math.h>\n#include <stddef.h>\n\n#include "model.h"\n'
        return "\n".join([head, *self._tables, "", *self._functions()])

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
        for name, same in _FUNCTIONS.items():
            f = known[same]
            yield c_function(s.graph, name, f.nodes, f.live)
        roots = [*s.rhs, *s.observed, *s.graph.switches]
        yield c_function(s.graph, "model_tangent", [(k, self._tangent(n)) for k, n in enumerate(roots)])
        rest = [node for _, node in known["rest"].nodes]
        yield c_function(s.graph, "model_rest_tangent", [(k, self._tangent(n)) for k, n in enumerate(rest)])
        if self._elimination:
            yield from _elimination_text(self._elimination)

    def _tangent(self, node: int) -> int:
        """Return the node of a node's derivative along the directions in yd, wd and dp."""
        g = self.structure.graph
        total = g.zero
        for group, direction in (("y", "yd"), ("w", "wd"), ("p", "dp")):
            for index, slope in sorted(self.structure.partial(node, group).items()):
                total = g.add(total, g.mul(slope, g.leaf(direction, index)))
        return total

    @cached_property
    def _elimination(self) -> Elimination | None:
        return self.structure.elimination


def _comment(name: str) -> str:
    return "".join(c if c.isalnum() or c in " -_." else "_" for c in name)


def _elimination_text(e: Elimination) -> Iterator[str]:
    """Straight-line elimination of the integrator's matrix, and the solution with its factors."""
    body = c_function(e.graph, "model_factorise", e.function.nodes)
    signature = (
        "void model_factorise(const double *jac, double shift, double *out) {\n    const double *y = jac, *w = &shift;"
    )
    # The elimination's graph names the Jacobian y and the shift w[0].
    lines = [line for line in body.splitlines()[1:] if "= a->" not in line and "(void)a" not in line]
    yield "\n".join([signature, "    (void)y, (void)w;", *lines, ""])
    yield "\n".join(["void model_solve(const double *factors, double *x) {", *_solution(e), "}", ""])


def _solution(e: Elimination) -> Sequence[str]:
    lines = [f"    double x{k} = x[{k}];" for k in e.order]
    lines += [f"    x{i} -= factors[{e.places[i, k]}] * x{k};" for k in e.order for i in e.lower[k]]
    for k in reversed(e.order):
        lines += [f"    x{k} -= factors[{e.places[k, j]}] * x{j};" for j in e.upper[k]]
        lines.append(f"    x[{k}] = x{k} *= factors[{e.places[k, k]}];")
    return lines


GROUPS = ("y", "yd", "w", "wd", "p", "dp", "m")
_BINARY = {"add": "+", "sub": "-", "mul": "*", "div": "/"}


def c_number(value: float) -> str:
    """Return a C constant of exactly this double."""
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "INFINITY" if value > 0 else "(-INFINITY)"
    text = repr(float(value))
    return f"({text})" if text.startswith("-") else text


def c_string(text: str) -> str:
    """Return a C string literal in ASCII."""
    escaped = "".join(
        c if " " <= c <= "~" and c not in '\\"?' else "".join(f"\\{b:03o}" for b in c.encode("utf-8")) for c in text
    )
    return f'"{escaped}"'


def c_array(kind: str, name: str, items: Iterable[str]) -> str:
    """Return a constant array; it has one element that is never read where there are no items."""
    listed = list(items)
    filler = "0" if "*" not in kind else '""'
    return f"const {kind} {name}[{max(len(listed), 1)}] = {{{', '.join(listed) or filler}}};"


def c_function(graph: Graph, name: str, stores: Sequence[tuple[int, int]], live: bool = False) -> str:
    """Return the function `void name(const Args *a, double *out)` that stores nodes in elements of `out`.

    stores: pairs of an index and a node. live: conditions by comparison instead of by frozen mode. Everything is computed
    before anything is stored, so that `out` may be one of the arguments.
    """
    lines: dict[int, str] = {}
    groups: set[str] = set()
    for node in _order(graph, [n for _, n in stores], live):
        lines[node] = _line(graph, node, live, groups)
    body = [f"    const double *{g} = a->{g};" for g in GROUPS if g in groups]
    body += [f"    {text}" for text in lines.values() if text]
    body += [f"    out[{place}] = {_name(graph, node)};" for place, node in stores]
    if not groups:
        body.insert(0, "    (void)a;")
    if not stores:
        body.append("    (void)out;")
    return f"void {name}(const Args *a, double *out) {{\n" + "\n".join(body) + "\n}\n"


def _arguments(graph: Graph, node: int, live: bool) -> tuple[int, ...]:
    key = graph.nodes[node]
    if key[0] == "switch":
        return (graph.switches[key[1]],) if live else ()
    return graph.arguments(node)


def _order(graph: Graph, roots: Sequence[int], live: bool) -> list[int]:
    """Return the nodes needed, each after its arguments."""
    done: dict[int, None] = {}
    stack = list(reversed(roots))
    while stack:
        node = stack[-1]
        if node in done:
            stack.pop()
            continue
        missing = [n for n in _arguments(graph, node, live) if n not in done]
        if missing:
            stack.extend(reversed(missing))
        else:
            done[node] = None
            stack.pop()
    return list(done)


def _name(graph: Graph, node: int) -> str:
    key = graph.nodes[node]
    if key[0] == "const":
        return c_number(key[1])
    if key[0] == "bool":
        return "1" if key[1] else "0"
    if key[0] == "leaf":
        return f"{key[1]}[{key[2]}]"
    return f"v{node}"


def _line(graph: Graph, node: int, live: bool, groups: set[str]) -> str:
    op, *a = graph.nodes[node]
    if op in ("const", "bool"):
        return ""
    if op == "leaf":
        groups.add(a[0])
        return ""
    if op == "switch":
        if live:
            return f"const int v{node} = {_name(graph, graph.switches[a[0]])} < 0.0;"
        groups.add("m")
        return f"const int v{node} = m[{a[0]}] > 0.5;"
    x = [_name(graph, n) for n in a]
    if op in ("and", "or", "not"):
        text = f"!{x[0]}" if op == "not" else f"{x[0]} {'&&' if op == 'and' else '||'} {x[1]}"
        return f"const int v{node} = {text};"
    return f"const double v{node} = {_value(op, x)};"


def _value(op: str, x: list[str]) -> str:
    if op in _BINARY:
        return f"{x[0]} {_BINARY[op]} {x[1]}"
    if op == "neg":
        return f"-{x[0]}"
    if op == "inverse":  # 1/x, and 0 where x is 0
        return f"{x[0]} != 0.0 ? 1.0 / {x[0]} : 0.0"
    if op == "sqrt0":  # the root of max(x, 0)
        return f"sqrt({x[0]} > 0.0 ? {x[0]} : 0.0)"
    if op == "select":
        return f"{x[0]} ? {x[1]} : {x[2]}"
    return f"{op}({', '.join(x)})"
