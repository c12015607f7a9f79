"""C text of nodes of a model's graph: one function a list of places and nodes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from hvdc_ident.simulate import Graph

GROUPS = ("y", "yd", "w", "wd", "p", "dp", "m")
_BINARY = {"add": "+", "sub": "-", "mul": "*", "div": "/"}


def number(value: float) -> str:
    """A C constant of exactly this double."""
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "INFINITY" if value > 0 else "(-INFINITY)"
    text = repr(float(value))
    return f"({text})" if text.startswith("-") else text


def string(text: str) -> str:
    """A C string literal in ASCII."""
    escaped = "".join(
        c if " " <= c <= "~" and c not in '\\"?' else "".join(f"\\{b:03o}" for b in c.encode("utf-8")) for c in text
    )
    return f'"{escaped}"'


def array(kind: str, name: str, items: Iterable[str]) -> str:
    """A constant array; one element that is never read where there are none."""
    listed = list(items)
    filler = "0" if "*" not in kind else '""'
    return f"const {kind} {name}[{max(len(listed), 1)}] = {{{', '.join(listed) or filler}}};"


def function(graph: Graph, name: str, stores: Sequence[tuple[int, int]], live: bool = False) -> str:
    """The function `void name(const Args *a, double *out)` that stores nodes at places of `out`.

    live: conditions by comparison instead of by frozen mode. Everything is computed before anything is stored, so that
    `out` may be one of the arguments.
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
    """The nodes needed, each after what it is computed from."""
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
        return number(key[1])
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
