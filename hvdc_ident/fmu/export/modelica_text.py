"""Sympy expressions as Modelica text."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import sympy as sp
from sympy.logic.boolalg import And, Not, Or

from hvdc_ident.errors import ExpressionError
from hvdc_ident.expression import clip, elementary

KEYWORDS = frozenset(
    """algorithm and annotation assert block break class connect connector constant constrainedby der discrete each else
    elseif elsewhen encapsulated end enumeration equation expandable extends external false final flow for function if
    import impure in initial inner input loop model not operator or outer output package parameter partial protected
    public pure record redeclare replaceable return stream then true type when while within
    abs sign sqrt div mod rem ceil floor integer sin cos tan asin acos atan atan2 sinh cosh tanh exp log log10 semiLinear
    homotopy delay cardinality terminal smooth noEvent sample pre edge change reinit time max min sum product Real Integer
    Boolean String""".split()  # noqa: SIM905 - one list of words, read as such
)


def identifier(name: str) -> str:
    """A variable's name in Modelica: itself, or quoted where Modelica has another use for the word."""
    return f"'{name}'" if name in KEYWORDS else name


class Printer:
    """Writes expressions; what a choice needs more than once becomes a variable of its own, kept in `helpers`."""

    def __init__(self, fresh: Callable[[], str]) -> None:
        self._fresh = fresh
        self._named: dict[Any, str] = {}
        self.helpers: dict[str, str] = {}

    def __call__(self, e: Any) -> str:
        """The text of an expression, in parentheses unless it is an atom or a call."""
        if isinstance(e, sp.Symbol):
            return "time" if e.name == "time" else identifier(e.name)
        if e.is_Rational and not e.is_Integer:
            return f"({e.p}/{e.q})"
        if e.is_Number or e is sp.pi or e is sp.E:
            return _number(e)
        if isinstance(e, sp.Add):
            return f"({' + '.join(map(self, e.args))})"
        if isinstance(e, sp.Mul):
            return self._product(e)
        if isinstance(e, sp.Pow):
            return self._power(e)
        if function := elementary(e.func):
            return f"{function.name}({', '.join(map(self, e.args))})"
        return self._choice(e)

    def _product(self, e: Any) -> str:
        top, bottom = [], []
        for f in e.args:
            if f.is_Pow and f.exp.is_number and f.exp.is_negative:
                bottom.append(self(sp.Pow(f.base, -f.exp, evaluate=False) if f.exp != -1 else f.base))
            else:
                top.append(self(f))
        text = "*".join(top) or "1"
        return f"({text})" if not bottom else f"({text}/({'*'.join(bottom)}))"

    def _power(self, e: Any) -> str:
        if e.base is sp.E:
            return f"exp({self(e.exp)})"
        if e.exp == sp.Rational(1, 2):
            return f"sqrt({self(e.base)})"
        if e.exp.is_number and e.exp.is_negative:
            rest = e.base if e.exp == -1 else sp.Pow(e.base, -e.exp, evaluate=False)
            return f"(1/{self(rest)})"
        return f"({self(e.base)}^{self(e.exp)})"

    def _choice(self, e: Any) -> str:
        kind = e.func
        if kind is sp.Abs:
            x = self._name(e.args[0])
            return f"(if {x} < 0 then -{x} else {x})"
        if kind is sp.sign:
            x = self._name(e.args[0])
            return f"(if {x} < 0 then -1 elseif {x} > 0 then 1 else 0)"
        if kind is clip:
            x, low, high = map(self._name, e.args)
            return f"(if {x} < {low} then {low} elseif {x} > {high} then {high} else {x})"
        if kind in (sp.Min, sp.Max):
            return self._extremum(e)
        if kind is sp.Piecewise and e.args[-1].cond == True:  # noqa: E712 - a sympy condition
            pieces = [f"if {self._condition(c)} then {self(v)}" for v, c in e.args[:-1]]
            return f"({' else'.join(pieces)} else {self(e.args[-1].expr)})"
        raise ExpressionError(
            f"Modelica text has no word for '{getattr(kind, '__name__', kind)}'",
            hint="write it with the functions of the grammar",
        )

    def _extremum(self, e: Any) -> str:
        sign = "<" if e.func is sp.Min else ">"
        text = self._name(e.args[0])
        for k, argument in enumerate(e.args[1:]):
            first = text if k == 0 else self._helper(text)
            second = self._name(argument)
            text = f"(if {first} {sign} {second} then {first} else {second})"
        return text

    def _condition(self, c: Any) -> str:
        if isinstance(c, And | Or):
            return f"({(' and ' if isinstance(c, And) else ' or ').join(map(self._condition, c.args))})"
        if isinstance(c, Not):
            return f"(not {self._condition(c.args[0])})"
        word = {sp.Lt: "<", sp.Le: "<=", sp.Gt: ">", sp.Ge: ">="}.get(c.func)
        if word:
            return f"{self(c.args[0])} {word} {self(c.args[1])}"
        if c.func in (sp.Eq, sp.Ne):  # two Reals are not compared for equality in Modelica
            a, b = map(self._name, c.args)
            return f"({a} <= {b} and {a} >= {b})" if c.func is sp.Eq else f"({a} < {b} or {a} > {b})"
        raise ExpressionError(f"Modelica text has no word for the condition '{c}'", expected="a comparison")

    def _name(self, e: Any) -> str:
        """The text of an expression that is used several times: an atom, or the name of a helper."""
        if isinstance(e, sp.Symbol) or e.is_Number:
            return self(e)
        if e not in self._named:
            self._named[e] = self._helper(self(e))
        return self._named[e]

    def _helper(self, text: str) -> str:
        name = self._fresh()
        self.helpers[name] = text
        return name


def _number(e: Any) -> str:
    text = str(e.p) if e.is_Integer and abs(e.p) < 2**31 else repr(float(e))
    return f"({text})" if text.startswith("-") else text
