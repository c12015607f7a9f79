"""The expression graph evaluated in complex numbers: an independent check of the derivatives taken on it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from hvdc_ident.simulate.graph import Graph


def evaluate(graph: Graph, roots: Iterable[int], leaves: Mapping[int, Any], size: int) -> list[Any]:
    """The roots' values, (size,) complex arrays; conditions are decided by the real parts. leaves: {node: array}."""
    wanted = list(roots)
    values: dict[int, Any] = {}
    with np.errstate(all="ignore"):
        for n in graph.reachable([*wanted, *graph.switches]):
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
    return _OPERATIONS[op](*(values[k] for k in a))


def _cut_root(x: Any) -> Any:
    return np.where(np.real(x) > 0.0, np.sqrt(np.where(np.real(x) > 0.0, x, 1.0) + 0j), 0.0)


def _power(x: Any, y: Any) -> Any:
    return np.asarray(x, dtype=complex) ** y


def _atan2(y: Any, x: Any) -> Any:
    a, b = np.real(y), np.real(x)
    square = a * a + b * b
    return np.arctan2(a, b) + 1j * (np.imag(y) * b - np.imag(x) * a) / np.where(square > 0, square, 1.0)


def _complex(function: Any) -> Any:
    return lambda x: function(np.asarray(x, dtype=complex))


_OPERATIONS: dict[str, Any] = {
    "add": lambda x, y: x + y,
    "sub": lambda x, y: x - y,
    "mul": lambda x, y: x * y,
    "div": lambda x, y: np.asarray(x, dtype=complex) / y,
    "neg": lambda x: -x,
    "pow": _power,
    "atan2": _atan2,
    "inverse": lambda x: np.where(np.real(x) == 0.0, 0.0, 1.0 / np.where(np.real(x) == 0.0, 1.0, x)),
    "sqrt": _complex(np.sqrt),
    "sqrt0": _cut_root,
    "select": lambda c, x, y: np.where(c, x, y),
    "and": np.logical_and,
    "or": np.logical_or,
    "not": np.logical_not,
    "exp": _complex(np.exp),
    "log": _complex(np.log),
    "sin": _complex(np.sin),
    "cos": _complex(np.cos),
    "tan": _complex(np.tan),
    "tanh": _complex(np.tanh),
    "asin": _complex(np.arcsin),
    "acos": _complex(np.arccos),
    "atan": _complex(np.arctan),
}
