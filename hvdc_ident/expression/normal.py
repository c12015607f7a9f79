"""The one form of an expression that models hold: real symbols, doubles, and what sympy makes of it by itself."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import sympy as sp
from sympy.core.function import AppliedUndef
from sympy.logic.boolalg import And

from hvdc_ident.expression.functions import symbol

EXACT = 2**53
"""Integers up to here are exact, as in a double; beyond it numbers are floats."""

_NOT_REAL = (sp.zoo, sp.nan, sp.oo, -sp.oo, sp.I)
_OUTSIDE = (AppliedUndef, sp.Derivative, sp.Integral)


@lru_cache(maxsize=50_000)
def normal(value: sp.Expr) -> sp.Expr | None:
    """The expression in the form that models hold, None where no model can hold it; doing it twice changes nothing.

    Symbols are the models' real ones, numbers are doubles or integers that a double holds exactly, factors that were
    kept apart are multiplied out as sympy does, and a choice in the last branch of a choice is part of it.
    """
    if not value.args:
        result: Any = _atom(value)
    else:
        parts = [normal(a) if isinstance(a, sp.Expr) else _condition(a) for a in value.args]
        if isinstance(value, _OUTSIDE) or any(p is None for p in parts):
            return None
        done = isinstance(value, (sp.Max, sp.Min)) and all(p is a for p, a in zip(parts, value.args, strict=True))
        result = value if done else _rebuilt(value, parts)  # sympy compares the values of max and min slowly
    if result == value:
        result = value
    return result if isinstance(result, sp.Expr) and not result.has(*_NOT_REAL) else None


def _atom(value: sp.Expr) -> sp.Expr:
    if isinstance(value, sp.Symbol):
        return symbol(value.name)
    return value if is_double(value) else sp.Float(to_double(value))


def is_double(value: sp.Expr) -> bool:
    """True but for a number that a double cannot hold."""
    if value.is_Rational:
        return bool(max(abs(value.p), value.q) <= EXACT)
    return bool(not value.is_Float or (value._prec == 53 and sp.Float(to_double(value)) == value))


def to_double(value: sp.Expr) -> float:
    """The nearest double of a number, infinite where it is too large."""
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _condition(part: Any) -> Any:
    if not part.args:
        return part
    parts = [normal(a) if isinstance(a, sp.Expr) else _condition(a) for a in part.args]
    if any(p is None for p in parts):
        return None
    return part if all(p is a for p, a in zip(parts, part.args, strict=True)) else part.func(*parts)


def _rebuilt(value: sp.Expr, parts: list[Any]) -> Any:
    if not isinstance(value, sp.Piecewise):
        return value.func(*parts)
    last = parts[-1].args[0]
    if isinstance(last, sp.Piecewise) and parts[-1].args[1] == True:  # noqa: E712 - a sympy condition
        parts = [*parts[:-1], *last.args]
    return _without_and(sp.Piecewise(*parts))


def _without_and(value: sp.Expr) -> sp.Expr:
    """The choice with conditions joined by `&` as choices inside choices, which the grammar has words for."""
    if not isinstance(value, sp.Piecewise) or not any(c.has(And) for _, c in value.args):
        return value
    (yes, condition), rest = value.args[0], value.args[1:]
    no = _without_and(sp.Piecewise(*rest)) if rest else sp.nan
    return _chosen(condition, yes, no)


def _chosen(condition: Any, yes: Any, no: Any) -> Any:
    if not condition.has(And):
        return choose(condition, yes, no)
    for part in reversed(condition.args):
        if isinstance(condition, And):
            yes = _chosen(part, yes, no)
        else:
            no = _chosen(part, yes, no)
    return yes if isinstance(condition, And) else no


def choose(condition: Any, yes: Any, no: Any) -> Any:
    """`yes` where the condition holds, else `no`; a choice in the else branch becomes further pieces of this one."""
    rest = no.args if isinstance(no, sp.Piecewise) else ((no, True),)
    return sp.Piecewise((yes, condition), *rest)
