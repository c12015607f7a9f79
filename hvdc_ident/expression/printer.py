"""Sympy to the text of model cards, so that reading the text gives the same expression."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import sympy as sp
from sympy.logic.boolalg import And, Not, Or

from hvdc_ident.errors import ExpressionError
from hvdc_ident.expression.functions import function_of
from hvdc_ident.expression.grammar import IDENTIFIER, is_reserved
from hvdc_ident.expression.parser import EXACT

SUM, PRODUCT, POWER, ATOM = range(4)
"""Ranks of a text by its outermost operation: one of a lower rank than its surroundings is put in parentheses."""

_RELATIONS = {sp.Lt: "<", sp.Le: "<=", sp.Gt: ">", sp.Ge: ">=", sp.Eq: "==", sp.Ne: "!="}

Text = tuple[str, int]


def to_text(expression: sp.Expr) -> str:
    """Return the text of an expression in the grammar of model cards: `parse(to_text(e)) == e`.

    Numbers lose nothing: floats are written as the shortest text of the same double. A condition joined by `&` is
    written as nested where, which has the same value. Raises ExpressionError that names the function, for an
    expression that the grammar has no words for.
    """
    if not isinstance(expression, sp.Expr):
        raise ExpressionError("only a sympy expression can be written", got=type(expression).__name__)
    try:
        return _text(expression)[0]
    except RecursionError:
        raise ExpressionError("the expression is nested too deeply", hint="name parts of it as signals") from None


def _text(e: Any) -> Text:
    if isinstance(e, sp.Symbol):
        return _name(e.name), ATOM
    if e.is_Rational or e.is_Float:
        return _number(e)
    for kind, write in _WRITERS:
        if isinstance(e, kind):
            return write(e)
    if e is sp.pi:
        return "pi", ATOM
    if e is sp.E:
        return "exp(1)", ATOM
    if function := function_of(e.func):
        return _call(function.name, e.args)
    kind_name = getattr(e.func, "__name__", str(e.func)) if e.args else str(e)
    raise ExpressionError(
        f"model cards have no word for '{kind_name}'", hint="write it with the functions of the grammar"
    )


def _inside(e: Any, at_least: int) -> str:
    text, binds = _text(e)
    return text if binds >= at_least else f"({text})"


def _name(name: str) -> str:
    if IDENTIFIER.fullmatch(name) is None or (is_reserved(name) and name != "time"):
        raise ExpressionError(
            f"the symbol {name!r} cannot be written", expected="letters, digits and _, no function's name"
        )
    return name


def _number(e: Any) -> Text:
    if e.is_Integer and abs(e.p) <= EXACT:
        return str(e.p), ATOM if e.p >= 0 else SUM
    if e.is_Rational and not e.is_Integer and max(abs(e.p), e.q) <= EXACT:
        return f"{e.p}/{e.q}", PRODUCT if e.p >= 0 else SUM
    try:
        value = float(e)
    except OverflowError:
        value = math.inf
    if not math.isfinite(value):
        raise ExpressionError(f"the number {str(e)[:30]} cannot be written", expected="a number that a double can hold")
    return repr(value), ATOM if math.copysign(1, value) > 0 else SUM


def _call(name: str, arguments: Sequence[Any]) -> Text:
    return f"{name}({', '.join(_text(a)[0] for a in arguments)})", ATOM


def _sum(e: Any) -> Text:
    terms = [_signed(a) for a in e.args]
    first = next((i for i, (negative, _) in enumerate(terms) if not negative), 0)
    terms.insert(0, terms.pop(first))
    text = ("-" if terms[0][0] else "") + terms[0][1]
    return text + "".join(f" {'-' if negative else '+'} {t}" for negative, t in terms[1:]), SUM


def _signed(e: Any) -> tuple[bool, str]:
    """Return (True where a minus stands before the term, the term without it)."""
    text, binds = _product(e) if e.is_Mul else _text(e)
    if text.startswith("-"):
        return True, text[1:]
    return False, text if binds > SUM else f"({text})"


def _product(e: Any) -> Text:
    above: list[Any] = []
    below: list[Any] = []
    sign = ""
    for factor in e.args:
        if factor.is_Number and factor.is_negative and not sign and factor is e.args[0]:
            sign, factor = "-", -factor
        if factor.is_Rational and not factor.is_Integer:
            above += [sp.Integer(factor.p)] * (factor.p != 1)
            below.append(sp.Integer(factor.q))
        elif _divides(factor):
            below.append(_reciprocal(factor))
        elif factor != 1:
            above.append(factor)
    text = "*".join(_inside(f, POWER) for f in above) or "1"
    return sign + text + _denominator(below), SUM if sign else PRODUCT


def _denominator(factors: list[Any]) -> str:
    if not factors:
        return ""
    texts = [_inside(f, POWER) for f in factors]
    if len(texts) == 1 or (len(texts) == 2 and factors[0].is_Number and factors[1].is_Add):
        return "".join(f"/{t}" for t in texts)  # a number times a sum would be multiplied out when read
    return f"/({'*'.join(texts)})"


def _power(e: Any) -> Text:
    base, exponent = e.base, e.exp
    if exponent == sp.Rational(1, 2):
        return _call("sqrt", [base])
    if _divides(e):
        return f"1/{_inside(_reciprocal(e), POWER)}", PRODUCT
    return f"{_inside(base, ATOM)}**{_inside(exponent, ATOM)}", POWER


def _divides(e: Any) -> bool:
    """True for a power that is written as a division; one of constants is not, as its reciprocal may be no double."""
    if not e.is_Pow or not (e.exp.is_Rational and e.exp.is_negative) or e.base.is_Number:
        return False
    return bool(e.exp == -1 or not e.base.is_number)


def _reciprocal(e: Any) -> Any:
    return e.base if e.exp == -1 else sp.Pow(e.base, -e.exp, evaluate=False)


def _choice(e: Any) -> Text:
    if e.args[-1].cond != True:  # noqa: E712 - a sympy condition, not a bool
        raise ExpressionError(
            "a Piecewise has no value where none of its conditions holds", hint="end it with (value, True)"
        )
    text = _text(e.args[-1].expr)[0]
    for value, condition in reversed(e.args[:-1]):
        text = _where(condition, _text(value)[0], text)
    return text, ATOM


def _where(condition: Any, yes: str, no: str) -> str:
    if isinstance(condition, Or):
        for part in reversed(condition.args):
            no = _where(part, yes, no)
        return no
    if isinstance(condition, And):
        for part in reversed(condition.args):
            yes = _where(part, yes, no)
        return yes
    if isinstance(condition, Not):
        return _where(condition.args[0], no, yes)
    if condition.func not in _RELATIONS:
        raise ExpressionError(f"model cards have no word for the condition '{condition}'", expected="a comparison")
    left, right = (_text(side)[0] for side in condition.args)
    return f"where({left} {_RELATIONS[condition.func]} {right}, {yes}, {no})"


def _step(e: Any) -> Text:
    x, at_zero = _text(e.args[0])[0], _text(e.args[1])[0]
    return f"where({x} < 0, 0, where({x} > 0, 1, {at_zero}))", ATOM


def _cotangent(e: Any) -> Text:
    return f"1/{_call('tan', e.args)[0]}", PRODUCT


_WRITERS: list[tuple[Any, Callable[[Any], Text]]] = [
    (sp.Add, _sum),
    (sp.Mul, _product),
    (sp.Pow, _power),
    (sp.Piecewise, _choice),
    (sp.Heaviside, _step),
    (sp.cot, _cotangent),
]
