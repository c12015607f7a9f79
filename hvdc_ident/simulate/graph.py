"""A model's expressions as one graph in which every common part stands once, with exact derivatives taken on the graph.

A node is an integer; its arguments always have smaller numbers, so that walking the numbers upwards evaluates the graph.
Derivatives of a tree grow with every use of a signal; on the graph each node is differentiated once.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Container, Iterable, Mapping

import sympy as sp

from hvdc_ident.errors import ModelError
from hvdc_ident.expression import FUNCTIONS, elementary

Key = tuple
Convert = Callable[[sp.Basic], int]


class Graph:
    """Nodes of arithmetic over named leaves; `switches` holds, for every condition, the node whose sign decides it."""

    def __init__(self) -> None:
        self.nodes: list[Key] = []
        self._known: dict[Key, int] = {}
        self.switches: list[int] = []
        self._switch_of: dict[int, int] = {}
        self._gradients: dict[int, dict[int, int]] = {}
        self._held: frozenset[int] = frozenset()
        self.zero = self.constant(0.0)
        self.one = self.constant(1.0)

    def _node(self, *key: object) -> int:
        if key not in self._known:
            self._known[key] = len(self.nodes)
            self.nodes.append(key)
        return self._known[key]

    def constant(self, value: float) -> int:
        """Return the node of a number."""
        return self._node("const", float(value) + 0.0)

    def leaf(self, group: str, index: int) -> int:
        """The node of element `index` of the argument vector `group`."""
        return self._node("leaf", group, index)

    def value(self, node: int) -> float | None:
        """The node's number where it is a constant."""
        key = self.nodes[node]
        return key[1] if key[0] == "const" else None

    # --- arithmetic, with the simplifications that keep structural zeros zero ---

    def add(self, a: int, b: int) -> int:
        va, vb = self.value(a), self.value(b)
        if va is not None and vb is not None:
            return self.constant(va + vb)
        if va == 0.0:
            return b
        if vb == 0.0:
            return a
        if self.nodes[b][0] == "neg":
            return self.sub(a, self.nodes[b][1])
        if self.nodes[a][0] == "neg":
            return self.sub(b, self.nodes[a][1])
        return self._node("add", *sorted((a, b)))

    def sub(self, a: int, b: int) -> int:
        va, vb = self.value(a), self.value(b)
        if va is not None and vb is not None:
            return self.constant(va - vb)
        if vb == 0.0:
            return a
        if va == 0.0:
            return self.neg(b)
        if a == b:
            return self.zero
        if self.nodes[b][0] == "neg":
            return self.add(a, self.nodes[b][1])
        return self._node("sub", a, b)

    def neg(self, a: int) -> int:
        va = self.value(a)
        if va is not None:
            return self.constant(-va)
        if self.nodes[a][0] == "neg":
            return int(self.nodes[a][1])
        if self.nodes[a][0] == "sub":
            return self.sub(self.nodes[a][2], self.nodes[a][1])
        return self._node("neg", a)

    def mul(self, a: int, b: int) -> int:
        va, vb = self.value(a), self.value(b)
        if va is not None and vb is not None:
            return self.constant(va * vb)
        if va == 0.0 or vb == 0.0:
            return self.zero
        if va == 1.0:
            return b
        if vb == 1.0:
            return a
        if va == -1.0:
            return self.neg(b)
        if vb == -1.0:
            return self.neg(a)
        if self.nodes[a][0] == "neg":
            return self.neg(self.mul(self.nodes[a][1], b))
        if self.nodes[b][0] == "neg":
            return self.neg(self.mul(a, self.nodes[b][1]))
        return self._node("mul", *sorted((a, b)))

    def div(self, a: int, b: int) -> int:
        va, vb = self.value(a), self.value(b)
        if va == 0.0:
            return self.zero
        if vb is not None and vb != 0.0:
            return (
                self.constant(va / vb)
                if va is not None
                else self.mul(a, self.constant(1.0 / vb))
                if math.frexp(vb)[0] in (0.5, -0.5)
                else self._node("div", a, b)
            )
        return self._node("div", a, b)

    def power(self, a: int, b: int) -> int:
        va, vb = self.value(a), self.value(b)
        if va is not None and vb is not None:
            return self.constant(va**vb)
        if vb is not None:
            if vb == 0.5:
                return self.call("sqrt", a)
            if vb == -0.5:
                return self.div(self.one, self.call("sqrt", a))
            if vb == int(vb) and abs(vb) <= 64:
                return self._integer_power(a, int(vb))
        return self._node("pow", a, b)

    def _integer_power(self, a: int, n: int) -> int:
        if n < 0:
            return self.div(self.one, self._integer_power(a, -n))
        result, square = self.one, a
        while n:
            if n & 1:
                result = self.mul(result, square)
            n >>= 1
            if n:
                square = self.mul(square, square)
        return result

    def call(self, name: str, *arguments: int) -> int:
        values = [self.value(a) for a in arguments]
        if len(values) == 1 and values[0] is not None and name in FUNCTIONS:
            try:
                return self.constant(FUNCTIONS[name].number(values[0]))
            except (ValueError, OverflowError):
                return self.constant(math.nan)
        if name == "sqrt" and self._cut_at_zero(arguments[0]):
            name = "sqrt0"
        return self._node(name, *arguments)

    def _cut_at_zero(self, a: int) -> bool:
        """True for a node that is max(0, x): with modes held, x may pass 0 within a step before the switch is found."""
        key = self.nodes[a]
        return key[0] == "select" and self.zero in key[2:]

    # --- conditions ---

    def negative(self, a: int) -> int:
        """The condition a < 0: a switch whose mode an integrator may freeze."""
        value = self.value(a)
        if value is not None:
            return self._node("bool", value < 0.0)
        if a not in self._switch_of:
            self._switch_of[a] = len(self.switches)
            self.switches.append(a)
        return self._node("switch", self._switch_of[a])

    def condition(self, switch: int) -> int:
        """The node of a switch's condition."""
        return self._node("switch", switch)

    def truth(self, value: bool) -> int:
        """The condition that always holds, or never."""
        return self._node("bool", value)

    def logic(self, op: str, *conditions: int) -> int:
        """Return the node of "and", "or" or "not" of conditions."""
        known = [self.nodes[c][1] if self.nodes[c][0] == "bool" else None for c in conditions]
        if op == "not":
            return self._node("bool", not known[0]) if known[0] is not None else self._node("not", conditions[0])
        absorbing = op == "or"
        if absorbing in known:
            return self._node("bool", absorbing)
        rest = [c for c, k in zip(conditions, known, strict=True) if k is None]
        if not rest:
            return self._node("bool", not absorbing)
        result = rest[0]
        for c in rest[1:]:
            result = self._node(op, *sorted((result, c)))
        return result

    def select(self, condition: int, a: int, b: int) -> int:
        """Return a where the condition holds, else b."""
        key = self.nodes[condition]
        if key[0] == "bool":
            return a if key[1] else b
        return a if a == b else self._node("select", condition, a, b)

    # --- copies ---

    def replaced(self, roots: Iterable[int], known: Mapping[int, int]) -> list[int]:
        """The roots with every node of `known` replaced by its partner; what stands behind a switch stays as it is."""
        roots, made = list(roots), dict(known)
        for n in self.reachable(roots, known=known):
            op, *a = self.nodes[n]
            if not self.arguments(n):
                made[n] = n
                continue
            a = [made[k] for k in a]
            if op in ("and", "or", "not"):
                made[n] = self.logic(op, *a)
            elif op in ("add", "sub", "neg", "mul", "div", "select"):  # what a known condition simplifies
                made[n] = getattr(self, op)(*a)
            else:
                made[n] = self._node(op, *a)
        return [made[r] for r in roots]

    # --- from sympy ---

    def expression(self, e: sp.Basic, names: Mapping[str, int], memo: dict[sp.Basic, int]) -> int:
        """The node of a sympy expression whose symbols are the nodes in `names`."""
        if e not in memo:
            memo[e] = self._convert(e, names, memo)
        return memo[e]

    def _convert(self, e: sp.Basic, names: Mapping[str, int], memo: dict[sp.Basic, int]) -> int:
        def sub(x: sp.Basic) -> int:
            return self.expression(x, names, memo)

        if e.is_Symbol:
            return names[e.name]
        if e.is_number:
            return self.constant(float(e))
        if e.is_Add:
            return self._sum(e.args, sub)
        if e.is_Mul:
            return self._product(e.args, sub)
        if e.is_Pow:
            return self.call("exp", sub(e.exp)) if e.base is sp.E else self.power(sub(e.base), sub(e.exp))
        kind = e.func
        if function := elementary(kind):
            return self.call(function.name, *map(sub, e.args))
        if kind is sp.Abs:
            x = sub(e.args[0])
            return self.select(self.negative(x), self.neg(x), x)
        if kind is sp.sign:
            x = sub(e.args[0])
            return self.select(
                self.negative(x), self.constant(-1.0), self.select(self.negative(self.neg(x)), self.one, self.zero)
            )
        if isinstance(e, sp.Min | sp.Max):
            return self._extremum(isinstance(e, sp.Min), [sub(a) for a in e.args])
        if kind.__name__ == "clip":
            x, low, high = map(sub, e.args)
            return self.select(
                self.negative(self.sub(x, low)), low, self.select(self.negative(self.sub(high, x)), high, x)
            )
        if kind is sp.Piecewise:
            pieces = [(sub(value), self._condition(c, sub)) for value, c in e.args]
            result = pieces[-1][0]
            for value, condition in reversed(pieces[:-1]):
                result = self.select(condition, value, result)
            return result
        raise ModelError(
            f"the function '{kind.__name__}' has no machine code",
            expected="a function of the expression grammar",
            hint="write it with the functions that model cards know",
        )

    def _sum(self, terms: Iterable[sp.Basic], sub: Convert) -> int:
        total = self.zero
        for term in terms:
            total = self.add(total, sub(term))
        return total

    def _product(self, factors: Iterable[sp.Basic], sub: Convert) -> int:
        top, bottom = self.one, self.one
        for f in factors:
            if f.is_Pow and f.exp.is_number and f.exp.is_negative:
                bottom = self.mul(bottom, self.power(sub(f.base), self.constant(-float(f.exp))))
            elif f.is_Rational and not f.is_Integer:
                top, bottom = self.mul(top, self.constant(f.p)), self.mul(bottom, self.constant(f.q))
            else:
                top = self.mul(top, sub(f))
        return top if bottom == self.one else self.div(top, bottom)

    def _extremum(self, smallest: bool, values: list[int]) -> int:
        result = values[0]
        for v in values[1:]:
            first = self.negative(self.sub(result, v))
            result = self.select(first, result, v) if smallest else self.select(first, v, result)
        return result

    def _condition(self, c: sp.Basic, sub: Convert) -> int:
        if c in (True, False, sp.true, sp.false):
            return self._node("bool", bool(c))
        if isinstance(c, (sp.And, sp.Or)):
            return self.logic("and" if isinstance(c, sp.And) else "or", *(self._condition(a, sub) for a in c.args))
        if isinstance(c, sp.Not):
            return self.logic("not", self._condition(c.args[0], sub))
        a, b = sub(c.args[0]), sub(c.args[1])
        less, more = (lambda: self.negative(self.sub(a, b))), (lambda: self.negative(self.sub(b, a)))
        if isinstance(c, sp.StrictLessThan):
            return less()
        if isinstance(c, sp.StrictGreaterThan):
            return more()
        if isinstance(c, sp.LessThan):
            return self.logic("not", more())
        if isinstance(c, sp.GreaterThan):
            return self.logic("not", less())
        equal = self.logic("and", self.logic("not", less()), self.logic("not", more()))
        if isinstance(c, sp.Equality):
            return equal
        if isinstance(c, sp.Unequality):
            return self.logic("not", equal)
        raise ModelError(f"the condition '{c}' has no machine code", expected="a comparison")

    # --- derivatives ---

    def hold(self, leaves: Iterable[int]) -> None:
        """Take leaves for constants in derivatives from now on: of hundreds of parameters most runs ask for a few."""
        self._held = frozenset(leaves)
        self._gradients.clear()

    def gradient(self, node: int) -> dict[int, int]:
        """The partial derivatives of a node with respect to every leaf it depends on: {leaf: node}; conditions are held."""
        if node not in self._gradients:
            for n in self.reachable([node], known=self._gradients):
                self._gradients[n] = self._differentiate(n)
        return self._gradients[node]

    def reachable(
        self,
        roots: Iterable[int],
        known: Container[int] = (),
        arguments: Callable[[int], Iterable[int]] | None = None,
    ) -> list[int]:
        """Every node the roots depend on, roots included, in an order of evaluation; not what is known, nor behind it.

        arguments: the nodes that a node is computed from, where these are fewer than the graph's own.
        """
        seen, stack = set[int](), list(roots)
        while stack:
            n = stack.pop()
            if n not in seen and n not in known:
                seen.add(n)
                stack.extend((arguments or self.arguments)(n))
        return sorted(seen)

    def arguments(self, node: int) -> tuple[int, ...]:
        """The nodes a node is computed from; those behind a switch are not among them."""
        key = self.nodes[node]
        return () if key[0] in ("const", "leaf", "bool", "switch") else key[1:]

    def _differentiate(self, n: int) -> dict[int, int]:
        op, *a = self.nodes[n]
        g = self._gradients
        if op in ("const", "bool", "switch", "and", "or", "not"):
            return {}
        if op == "leaf":
            return {} if n in self._held else {n: self.one}
        if op == "neg":
            return {v: self.neg(d) for v, d in g[a[0]].items()}
        if op in ("add", "sub"):
            left, right = g[a[0]], g[a[1]]
            join = self.add if op == "add" else self.sub
            return self._clean({v: join(left.get(v, self.zero), right.get(v, self.zero)) for v in {**left, **right}})
        if op == "select":
            condition, yes, no = a
            both = {**g[yes], **g[no]}
            return self._clean(
                {v: self.select(condition, g[yes].get(v, self.zero), g[no].get(v, self.zero)) for v in both}
            )
        total: dict[int, int] = {}
        for argument, slope in self.slopes(n):
            for v, d in g[argument].items():
                total[v] = self.add(total.get(v, self.zero), self.mul(slope, d))
        return self._clean(total)

    def _clean(self, gradient: dict[int, int]) -> dict[int, int]:
        return {v: d for v, d in gradient.items() if d != self.zero}

    def slopes(self, n: int) -> list[tuple[int, int]]:
        """(argument, derivative of n with respect to it) pairs of a product, a quotient, a power or a function."""
        op, *a = self.nodes[n]
        x = a[0]
        self.mul(x, x)  # before anything else: operands stand in the order in which nodes are made
        if op == "mul":
            return [(a[0], a[1]), (a[1], a[0])]
        if op == "div":
            inverse = self.div(self.one, a[1])
            return [(a[0], inverse), (a[1], self.neg(self.mul(n, inverse)))]
        if op == "pow":
            slope = self.mul(a[1], self.power(x, self.sub(a[1], self.one)))
            if self.value(a[1]) is not None:
                return [(x, slope)]
            # x^a log(x) is 0 at x = 0, not 0 times infinity: the least normal number is lost in any x that is not 0.
            return [(x, slope), (a[1], self.mul(n, self.call("log", self.add(x, self.constant(sys.float_info.min)))))]
        if op == "inverse":
            return [(x, self.neg(self.mul(n, n)))]
        slopes = FUNCTIONS["sqrt" if op == "sqrt0" else op].slopes
        assert slopes is not None
        return list(zip(a, slopes(self, n, *a), strict=True))

    def evaluate(self, roots: Iterable[int], leaves: Mapping[int, float]) -> list[float]:
        """The roots' values for given leaf values, in Python numbers, conditions by comparison: slow, for checks."""
        roots = list(roots)
        values: dict[int, float] = {}
        stack = list(roots)
        while stack:
            n = stack[-1]
            key = self.nodes[n]
            needed = (self.switches[key[1]],) if key[0] == "switch" else self.arguments(n)
            missing = [a for a in needed if a not in values]
            if missing:
                stack.extend(missing)
            else:
                values[n] = values[needed[0]] < 0.0 if key[0] == "switch" else _evaluate(self, n, values, leaves)
                stack.pop()
        return [values[r] for r in roots]


def _evaluate(graph: Graph, n: int, values: dict[int, float], leaves: Mapping[int, float]) -> float:
    op, *a = graph.nodes[n]
    if op in ("const", "bool"):
        return a[0]
    if op == "leaf":
        return leaves[n]
    x = [values[k] for k in a]
    if op == "select":
        return x[1] if x[0] else x[2]
    if op in FUNCTIONS:
        return FUNCTIONS[op].number(*x)
    return {
        "add": lambda: x[0] + x[1], "sub": lambda: x[0] - x[1], "mul": lambda: x[0] * x[1], "div": lambda: x[0] / x[1],
        "neg": lambda: -x[0], "inverse": lambda: 1.0 / x[0] if x[0] else 0.0, "sqrt0": lambda: math.sqrt(max(x[0], 0.0)),
        "pow": lambda: x[0] ** x[1],
        "and": lambda: x[0] and x[1], "or": lambda: x[0] or x[1], "not": lambda: not x[0],
    }[op]()  # fmt: skip
