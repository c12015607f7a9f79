"""Limits of a model: the signal that each switch of its graph limits, the level, and the margin to it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import sympy as sp
from numpy.typing import NDArray

from hvdc_ident.codec import Coded, stored_as
from hvdc_ident.expression import symbol, to_text
from hvdc_ident.simulate import ModelEquations


@dataclass(frozen=True)
class Condition:
    """A switch of the model's graph and what it stands for.

    index: of the switch. signal: the name whose definition holds it. kind: "lower", "upper" (a limiter's ends) or
    "branch" (min or max of two signals, abs, sign, where). expression: what is compared; level: with what.
    sign: what the switch's value is multiplied by to be the margin, which is positive where a limit is not reached.
    """

    index: int
    signal: str
    kind: str
    expression: str
    level: str
    sign: float = 1.0


Node = Callable[[sp.Basic], int]
Note = Callable[..., None]


@dataclass(frozen=True)
class Limit(Coded):
    """A limit at a point. margin: from the expression to the level, in the signal's unit, negative when past it.

    active: whether the limiter holds the signal, so that small changes do not pass.
    """

    signal: str
    kind: str = field(metadata=stored_as("limit"))
    expression: str
    level: str
    margin: float
    active: bool

    @property
    def text(self) -> str:
        """The limit in one line of text."""
        side = {"lower": "at least", "upper": "at most", "branch": "against"}[self.kind]
        return f"{self.signal}: {self.expression} {side} {self.level}, margin {self.margin:.6g}"


def conditions(structure: ModelEquations) -> tuple[Condition, ...]:
    """Return the meaning of every switch of a structure, in the order of the switches; made before its code is compiled."""
    g = structure.graph
    memo: dict[sp.Basic, int] = {}
    known = {v: k for k, v in enumerate(g.switches)}
    by_switch: dict[int, Condition] = {}

    def node(e: sp.Basic) -> int:
        return g.expression(e, structure.nodes, memo)

    def note(value: int, signal: str, kind: str, expression: object, level: object, sign: float = 1.0) -> None:
        if value in known and known[value] not in by_switch:
            by_switch[known[value]] = Condition(known[value], signal, kind, _text(expression), _text(level), sign)

    for name, definition in _definitions(structure).items():
        for e in sp.preorder_traversal(definition):
            kind = getattr(e.func, "__name__", "")
            if kind == "clip":
                x, low, high = e.args
                note(g.sub(node(x), node(low)), name, "lower", x, low)
                note(g.sub(node(high), node(x)), name, "upper", x, high)
            elif isinstance(e, (sp.Min, sp.Max)):
                _extremum(e, name, structure, _limiters(definition), node, note)
            elif isinstance(e, (sp.Abs, sp.sign)):
                note(node(e.args[0]), name, "branch", e.args[0], 0)
                note(g.neg(node(e.args[0])), name, "branch", e.args[0], 0)
            elif getattr(e, "is_Relational", False):
                a, b = e.args
                note(g.sub(node(a), node(b)), name, "branch", a, b)
                note(g.sub(node(b), node(a)), name, "branch", b, a)
    rest = (
        Condition(k, "model", "branch", f"condition {k}", "0") for k in range(len(g.switches)) if k not in by_switch
    )
    return tuple(sorted((*by_switch.values(), *rest), key=lambda c: c.index))


def _text(e: Any) -> str:
    """Return the expression as engineers write it: numbers short."""
    if isinstance(e, (int, float)) or getattr(e, "is_number", False):
        return f"{float(e):g}"
    return to_text(e)


def _extremum(
    e: sp.Expr, name: str, structure: ModelEquations, limiters: frozenset[sp.Basic], node: Node, note: Note
) -> None:
    """Note the pairwise comparisons of a min or max; a min with a max inside (or the reverse) is a limiter's two ends.

    A single min or max is a choice: which of two signals is the limit nobody can tell; a number or parameter beside a signal is.
    """

    def fixed(term: sp.Basic) -> bool:
        return all(str(s) in structure.model.parameters for s in term.free_symbols)

    g = structure.graph
    values = [node(a) for a in e.args]
    smallest = isinstance(e, sp.Min)
    limiter = e in limiters
    result, so_far = values[0], e.args[0]
    for v, a in zip(values[1:], e.args[1:], strict=True):
        difference = g.sub(result, v)
        first = g.negative(difference)
        if (so_far.is_number or a.is_number) and limiter:
            moving, level = (a, so_far) if so_far.is_number else (so_far, a)
            # The switch's value is so_far - a; the margin is level - moving for min, moving - level for max.
            sign = 1.0 if (level is so_far) == smallest else -1.0
            note(difference, name, "upper" if smallest else "lower", moving, level, sign)
        elif fixed(so_far) and not fixed(a):
            note(difference, name, "branch", a, so_far, -1.0)
        else:
            note(difference, name, "branch", so_far, a, 1.0)
        result = g.select(first, result, v) if smallest else g.select(first, v, result)
        so_far = e.func(so_far, a)


def _limiters(definition: sp.Basic) -> frozenset[sp.Basic]:
    """Every min that holds a max against a number, or is held by one, and the reverse."""
    limiters = set()
    for e in definition.atoms(sp.Min, sp.Max):
        other = sp.Max if isinstance(e, sp.Min) else sp.Min
        for inner in e.args:
            if isinstance(inner, other) and any(a.is_number for a in e.args) and any(a.is_number for a in inner.args):
                limiters |= {e, inner}
    return frozenset(limiters)


def _definitions(structure: ModelEquations) -> dict[str, sp.Basic]:
    m = structure.model
    definitions: dict[str, sp.Basic] = {n: s.value for n, s in m.signals.items()}
    definitions |= {n: a.equation for n, a in m.algebraic.items()}
    definitions |= {n: s.derivative for n, s in m.states.items()}
    definitions |= {f"outputs.{n}" if n in definitions else n: o.value for n, o in m.outputs.items()}
    definitions |= {n: d.of for n, d in m.delays.items()} | {n: s.value for n, s in m.sampled.items()}
    definitions |= {n: symbol(n) for n in structure.outputs if n not in definitions}
    return definitions


def limits(structure: ModelEquations, known: tuple[Condition, ...], values: NDArray[np.float64]) -> tuple[Limit, ...]:
    """Return every limiter that matters at a point, with its margin, from the switches' values.

    A limiter inside a branch that another condition has switched off does not matter and is left out; conditions that
    are no limiters (kind "branch") are listed with their distance and are never active.
    """
    _, used = in_use(structure, structure_roots(structure), values < 0.0)
    limiters = []
    for c in known:
        if c.index in used:
            margin = c.sign * float(values[c.index])
            active = c.kind != "branch" and margin < 0.0
            limiters.append(Limit(c.signal, c.kind, c.expression, c.level, margin, active))
    return tuple(limiters)


def structure_roots(structure: ModelEquations) -> list[int]:
    """Return the nodes whose values the model shows or integrates."""
    return [*structure.rhs, *structure.sources, *structure.observed]


def in_use(
    structure: ModelEquations, roots: list[int], negative: NDArray[np.bool_]
) -> tuple[frozenset[int], frozenset[int]]:
    """Return the nodes which the roots' values come from, and the switches that decide on the branches they come through.

    negative: the switches' modes. Branches that are switched off are left out.
    """
    nodes = structure.graph.nodes
    used: set[int] = set()

    def holds(condition: int) -> bool:
        op, *a = nodes[condition]
        if op == "switch":
            used.add(a[0])
            return bool(negative[a[0]])
        if op == "bool":
            return bool(a[0])
        results = [holds(k) for k in a]
        return not results[0] if op == "not" else all(results) if op == "and" else any(results)

    seen: set[int] = set()
    stack = list(roots)
    while stack:
        n = stack.pop()
        if n in seen:
            continue
        seen.add(n)
        key = nodes[n]
        if key[0] == "select":
            stack.append(key[2] if holds(key[1]) else key[3])
        elif key[0] not in ("const", "leaf", "bool", "switch"):
            stack.extend(key[1:])
    return frozenset(seen), frozenset(used)
