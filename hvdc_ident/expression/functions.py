"""The table of the grammar's functions, which every back end reads, and the one kind of symbol that models are made of.

A new function is one entry of `FUNCTIONS`: cards read and write it, models run in machine code with its derivatives,
and linearisation, Modelica export and structural identifiability know it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import sympy as sp
from sympy.core.sorting import ordered


def symbol(name: str) -> sp.Symbol:
    """Symbol of a model variable: real, so that sympy may simplify as engineers do."""
    return sp.Symbol(name, real=True)


TIME = symbol("time")


class clip(sp.Function):
    """clip(x, low, high): the hard limiter, low where x < low, high where x > high, else x."""

    nargs = 3
    is_real = True

    @classmethod
    def eval(cls, x: Any, low: Any, high: Any) -> Any:
        if x.is_number and low.is_number and high.is_number:
            return sp.Min(sp.Max(x, low), high)
        return None

    def fdiff(self, argindex: int = 1) -> Any:
        x, low, high = self.args
        inside = sp.Piecewise((0, x < low), (0, x > high), (1, True))
        return {1: inside, 2: sp.Piecewise((1, x < low), (0, True)), 3: sp.Piecewise((1, x > high), (0, True))}[
            argindex
        ]


class _Extremum:
    """Applications of min and max that stand as they are written: flat, their numbers joined, each argument once.

    sympy compares every two arguments to leave out one that is never the extremum, in ms for each pair whenever the expression is
    rebuilt. The value is the same.
    """

    def __new__(cls, *arguments: Any, **_options: Any) -> Any:
        of_sympy: Any = next(kind for kind in (sp.Min, sp.Max) if issubclass(cls, kind))
        flat = [part for a in map(sp.sympify, arguments) for part in (a.args if isinstance(a, of_sympy) else (a,))]
        kept = dict.fromkeys(a for a in flat if not a.is_number)
        numbers = [a for a in flat if a.is_number]
        if numbers:
            number = of_sympy(*numbers)
            if number == of_sympy.zero:
                return number
            if number != of_sympy.identity or not kept:
                kept |= dict.fromkeys(number.args if isinstance(number, of_sympy) else (number,))
        if len(kept) < 2:
            return next(iter(kept), of_sympy.identity)
        made = sp.Expr.__new__(cls, *ordered(kept))
        made._argset = frozenset(kept)
        return made

    def __eq__(self, other: object) -> bool:
        """Return True for the same arguments, in an application of sympy's class too."""
        return own(type(other)) is type(self) and self.args == other.args  # type: ignore[attr-defined]  # sympy has no types, so that args is unknown to mypy

    def __hash__(self) -> int:
        return super().__hash__()  # of the class's name and the arguments: that of sympy's


class Min(_Extremum, sp.Min):
    """min of the grammar."""


class Max(_Extremum, sp.Max):
    """max of the grammar."""


def own(head: Any) -> Any:
    """Return the class whose applications models hold in place of those of a class of sympy."""
    return {sp.Min: Min, sp.Max: Max}.get(head, head)


def where(condition: Any, a: Any, b: Any) -> sp.Expr:
    """Expression that is a where the condition holds, else b."""
    return sp.Piecewise((a, condition), (b, True))


def at_values(e: sp.Expr, values: Mapping[sp.Symbol, sp.Expr]) -> sp.Expr:
    """Return an expression at values of symbols; of a choice the branches that these leave, with `xreplace` all of them.

    A branch that is not taken may give no number there, as a saturation of zeros. A comparison with what is no number stays as it is.
    """
    return _at_values(e, values)


def _at_values(e: Any, values: Mapping[sp.Symbol, sp.Expr]) -> Any:
    if not e.args:
        return values.get(e, e)
    if not isinstance(e, sp.Piecewise):
        try:
            return e.func(*(_at_values(a, values) for a in e.args))
        except TypeError:
            return e
    left = []
    for value, condition in e.args:
        holds = _at_values(condition, values)
        if holds != sp.false:
            left.append((_at_values(value, values), holds))
        if holds == sp.true:
            break
    return sp.Piecewise(*left)


class Algebra(Protocol):
    """Arithmetic on the nodes of a graph, in which derivatives are written."""

    one: int

    def constant(self, value: float) -> int: ...
    def add(self, a: int, b: int) -> int: ...
    def sub(self, a: int, b: int) -> int: ...
    def mul(self, a: int, b: int) -> int: ...
    def div(self, a: int, b: int) -> int: ...
    def neg(self, a: int) -> int: ...
    def call(self, name: str, *arguments: int) -> int: ...


Slopes = Callable[..., tuple[int, ...]]
"""Called with an Algebra, the node of the value and those of the arguments: the derivative with respect to each."""


@dataclass(frozen=True)
class GrammarFunction:
    """One function of the grammar.

    name: in cards, in the graph, in the C library and in Modelica. head: the class of its applications in sympy; None
    where the parser writes the function with others. number: its value in doubles; ValueError or OverflowError where it
    has none. arity: least and largest number of arguments. Without `slopes` the back ends write the function as a
    choice between its arguments; with them it is elementary, and these are needed:
    array: the function of NumPy, real and complex. slopes: its derivatives. intrinsic: True where LLVM has an
    instruction for it; else it is called in the C library.
    """

    name: str
    head: Any
    number: Callable[..., float]
    arity: tuple[int, int] = (1, 1)
    array: Callable[..., Any] | None = None
    slopes: Slopes | None = None
    intrinsic: bool = False


MANY = 32
"""Arguments that min and max take at most."""


def _cosine_of(g: Algebra, sine: int) -> int:
    return g.call("sqrt", g.sub(g.one, g.mul(sine, sine)))


def _sqrt_slopes(g: Algebra, n: int, x: int) -> tuple[int, ...]:
    # sqrt(max(0, x)) is flat where its argument is cut at 0: the slope there must be 0, not 0 times infinity.
    return (g.mul(g.constant(0.5), g.call("inverse", n)),)


def _atan2_slopes(g: Algebra, n: int, y: int, x: int) -> tuple[int, ...]:
    square = g.add(g.mul(y, y), g.mul(x, x))
    return g.div(x, square), g.neg(g.div(y, square))


_TABLE = (
    GrammarFunction("abs", sp.Abs, abs),
    GrammarFunction("sign", sp.sign, lambda x: float((x > 0) - (x < 0))),
    GrammarFunction("sqrt", None, math.sqrt, array=np.sqrt, slopes=_sqrt_slopes, intrinsic=True),
    GrammarFunction("exp", sp.exp, math.exp, array=np.exp, slopes=lambda g, n, x: (n,), intrinsic=True),
    GrammarFunction("log", sp.log, math.log, array=np.log, slopes=lambda g, n, x: (g.div(g.one, x),), intrinsic=True),
    GrammarFunction("sin", sp.sin, math.sin, array=np.sin, slopes=lambda g, n, x: (g.call("cos", x),), intrinsic=True),
    GrammarFunction(
        "cos", sp.cos, math.cos, array=np.cos, slopes=lambda g, n, x: (g.neg(g.call("sin", x)),), intrinsic=True
    ),
    GrammarFunction("tan", sp.tan, math.tan, array=np.tan, slopes=lambda g, n, x: (g.add(g.one, g.mul(n, n)),)),
    GrammarFunction("tanh", sp.tanh, math.tanh, array=np.tanh, slopes=lambda g, n, x: (g.sub(g.one, g.mul(n, n)),)),
    GrammarFunction(
        "asin",
        sp.asin,
        math.asin,
        array=np.arcsin,
        slopes=lambda g, n, x: (g.div(g.one, _cosine_of(g, x)),),
    ),
    GrammarFunction(
        "acos",
        sp.acos,
        math.acos,
        array=np.arccos,
        slopes=lambda g, n, x: (g.neg(g.div(g.one, _cosine_of(g, x))),),
    ),
    GrammarFunction(
        "atan", sp.atan, math.atan, array=np.arctan, slopes=lambda g, n, x: (g.div(g.one, g.add(g.one, g.mul(x, x))),)
    ),
    GrammarFunction("atan2", sp.atan2, math.atan2, (2, 2), array=np.arctan2, slopes=_atan2_slopes),
    GrammarFunction("where", None, lambda condition, a, b: a if condition else b, (3, 3)),
    GrammarFunction("clip", clip, lambda x, low, high: min(max(x, low), high), (3, 3)),
    GrammarFunction("min", Min, min, (1, MANY)),
    GrammarFunction("max", Max, max, (1, MANY)),
)
FUNCTIONS: Mapping[str, GrammarFunction] = {f.name: f for f in _TABLE}


def function_of(head: Any) -> GrammarFunction | None:
    """Function of the grammar whose applications are of a class of sympy; None where there is none."""
    return next((f for f in FUNCTIONS.values() if f.head is own(head)), None)


def elementary(head: Any) -> GrammarFunction | None:
    """Function with derivatives of its own whose applications are of a class of sympy; None where there is none."""
    function = function_of(head)
    return function if function is not None and function.slopes is not None else None
