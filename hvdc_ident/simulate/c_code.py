"""C written from the graph: the same functions as the machine code has, for a program that is compiled elsewhere.

Every function has the signature `void f(y, yd, w, wd, p, m, out)` of the core (`ARGUMENTS`), and is static.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import partial

from hvdc_ident.simulate.codegen import ARGUMENTS, Elimination, Function, arguments
from hvdc_ident.simulate.graph import Graph

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
    return f"static const {kind} {name}[{max(len(listed), 1)}] = {{{', '.join(listed) or filler}}};"


def c_function(graph: Graph, function: Function, symbol: str) -> str:
    """Return the C of a function without rows.

    Everything is computed before anything is stored, so that `out` may be one of the arguments.
    """
    live = function.live
    needed = graph.reachable([n for _, n in function.nodes], arguments=partial(arguments, graph, live=live))
    lines = [line for n in needed if (line := _line(graph, n, live))]
    stores = [f"out[{place}] = {_name(graph, node)};" for place, node in function.nodes]
    read = {graph.nodes[n][1] for n in needed if graph.nodes[n][0] == "leaf"}
    read |= {"m" for n in needed if graph.nodes[n][0] == "switch" and not live}
    return _definition(symbol, read | ({"out"} if stores else set()), [*lines, *stores])


def c_solve(elimination: Elimination, symbol: str) -> str:
    """Return the C that solves in place for the vector in `out`, after `y` is added to it, with the factors in `p`."""
    e = elimination
    lines = [f"double x{k} = out[{k}] + y[{k}];" for k in e.order]
    lines += [f"x{i} -= p[{e.places[i, k]}] * x{k};" for k in e.order for i in e.lower[k]]
    for k in reversed(e.order):
        lines += [f"x{k} -= p[{e.places[k, j]}] * x{j};" for j in e.upper[k]]
        lines.append(f"out[{k}] = x{k} *= p[{e.places[k, k]}];")
    return _definition(symbol, {"y", "p", "out"}, lines)


def _definition(symbol: str, read: set[str], lines: list[str]) -> str:
    """Return the definition of a function. read: the arguments that its lines use."""
    parameters = ", ".join(f"double *{a}" if a == "out" else f"const double *{a}" for a in ARGUMENTS)
    unused = ", ".join(f"(void){a}" for a in ARGUMENTS if a not in read)
    body = [f"{unused};", *lines] if unused else lines
    return f"static void {symbol}({parameters})\n{{\n" + "\n".join(f"    {line}" for line in body) + "\n}\n"


def _name(graph: Graph, node: int) -> str:
    key = graph.nodes[node]
    if key[0] == "const":
        return c_number(key[1])
    if key[0] == "bool":
        return "1" if key[1] else "0"
    if key[0] == "leaf":
        return f"{key[1]}[{key[2]}]"
    return f"v{node}"


def _line(graph: Graph, node: int, live: bool) -> str:
    """Return the statement that computes a node; none for what stands in an argument or is a number."""
    op, *a = graph.nodes[node]
    if op in ("const", "bool", "leaf"):
        return ""
    if op == "switch":
        value = f"{_name(graph, graph.switches[a[0]])} < 0.0" if live else f"m[{a[0]}] > 0.5"
        return f"const int v{node} = {value};"
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
