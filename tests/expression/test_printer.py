"""Sympy to text and back: nothing is lost."""

from __future__ import annotations

import random
import struct

import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from hvdc_ident.errors import ExpressionError
from hvdc_ident.expression import TIME, clip, parse, symbol, to_text, where

x, y, z = symbol("x"), symbol("y"), symbol("z")

BY_HAND = {
    "x - y": x - y,
    "-x - y": -x - y,
    "x/y": x / y,
    "x/(y*z)": x / (y * z),
    "(x + y)/(2*z)": (x + y) / (2 * z),
    "2*x/3": sp.Rational(2, 3) * x,
    "-x/2": -x / 2,
    "1/2": sp.Rational(1, 2),
    "sqrt(x)": sp.sqrt(x),
    "1/sqrt(x)": 1 / sp.sqrt(x),
    "x**(3/2)": x ** sp.Rational(3, 2),
    "1/x**2": x**-2,
    "x**(-y)": x ** (-y),
    "x**0.5": x**0.5,
    "x**(-0.5)": x**-0.5,
    "exp(-x)": sp.exp(-x),
    "abs(x)*sign(y)": sp.Abs(x) * sp.sign(y),
    "min(x, y)": sp.Min(x, y),
    "max(3, x, y)": sp.Max(x, y, 3),
    "clip(x, -1, 1)": clip(x, -1, 1),
    "where(x > 0, 1, where(y > 0, 2, 3))": sp.Piecewise((1, x > 0), (2, y > 0), (3, True)),
    "where(x > 0, 1, where(y > 0, 1, 3))": sp.Piecewise((1, (x > 0) | (y > 0)), (3, True)),
    "sin(2*pi*time)": sp.sin(2 * sp.pi * TIME),
    "exp(1)*x": sp.E * x,
    "atan2(y, x)": sp.atan2(y, x),
    "1e-05*x": 1e-5 * x,
    "2**x": 2**x,
    "x/2/(y + z)": x / (y + z) / 2,
}


@pytest.mark.parametrize("text", list(BY_HAND))
def test_an_expression_made_by_hand_is_written_readably_and_read_back(text: str) -> None:
    expression = BY_HAND[text]
    written = to_text(expression)
    assert parse(written) == expression
    if "/2/(" not in text and "> 0, 1, where(y > 0, 1" not in text:
        assert sorted(written) == sorted(text)  # the order of factors and terms is sympy's


@pytest.mark.parametrize(
    "text", ["x - y", "-x - y", "x/y", "sqrt(x)", "1/sqrt(x)", "x**(-y)", "clip(x, -1, 1)", "1e-05*x"]
)
def test_short_texts_come_out_as_an_engineer_writes_them(text: str) -> None:
    assert to_text(parse(text)) == text


@pytest.mark.parametrize(
    ("expression", "word"),
    [
        (sp.gamma(x), "gamma"),
        (sp.Function("f")(x), "f"),
        (sp.floor(x), "floor"),
        (sp.I * x, "ImaginaryUnit|I"),
        (sp.oo, "cannot be written|word"),
        (sp.Piecewise((x, x > 0)), "no value where none"),
        (sp.Symbol("a b"), "a b"),
        (sp.Symbol("sin"), "sin"),
    ],
)
def test_what_the_grammar_cannot_say_is_refused_by_name(expression: sp.Expr, word: str) -> None:
    with pytest.raises(ExpressionError, match=word):
        to_text(expression)


def test_joined_conditions_keep_their_value() -> None:
    both = sp.Piecewise((1, (x > 0) & (y > 0)), (2, x > 5), (3, True))
    again = parse(to_text(both))
    for a in (-1, 1, 6):
        for b in (-1, 1):
            assert again.subs({x: a, y: b}) == both.subs({x: a, y: b})


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_a_double_keeps_every_bit(value: float) -> None:
    again = float(parse(to_text(sp.Float(value) if value else sp.Float(0.0))))
    assert struct.pack("d", again) == struct.pack("d", value + 0.0 if value else 0.0)


_NUMBERS = ("0", "1", "2", "3", "10", "0.5", "0.1", "2.0", "1e-3", "314.159", "9007199254740992", "1e300", "1e-310")
_EXPONENTS = ("2", "3", "0.5", "(1/2)", "(-1)", "(-2)", "(1/3)", "y", "(-x)", "(2/3)", "(-0.5)")
_ONE = ("abs", "sign", "sqrt", "exp", "log", "sin", "cos", "tan", "tanh", "asin", "acos", "atan")
_FORMS = (
    *("({0} + {1})", "({0} - {1})", "{0}*{1}", "{0}/({1})", "(-{0})", "({0} + {1})", "{0}*{1}*{2}", "-({0})*({1})"),
    *("where({0} {R} {1}, {1}, {2})", "clip({0}, {1}, {2})", "min({0}, {1}, {2})", "max({0}, {1})", "atan2({0}, {1})"),
    *("({0})**{E}", "{F}({0})", "{F}({0})"),
)


def _text(r: random.Random, depth: int) -> str:
    if depth == 0:
        return r.choice((*_NUMBERS, repr(r.random()), *("x", "y", "z", "time", "pi") * 3))
    parts = [_text(r, r.randint(0, depth - 1)) for _ in range(3)]
    relation = r.choice(("<", "<=", ">", ">=", "==", "!="))
    return r.choice(_FORMS).format(*parts, R=relation, E=r.choice(_EXPONENTS), F=r.choice(_ONE))


@settings(max_examples=400)
@given(st.integers(0, 2**32), st.integers(1, 5))
def test_what_the_parser_gives_is_written_and_read_back_the_same(seed: int, depth: int) -> None:
    try:
        expression = parse(_text(random.Random(seed), depth))
    except ExpressionError:
        return
    assert parse(to_text(expression)) == expression


def test_most_random_texts_are_expressions() -> None:
    """The property above would say nothing if the texts were refused."""
    taken = 0
    for seed in range(100):
        try:
            parse(_text(random.Random(seed), 3))
        except ExpressionError:
            continue
        taken += 1
    assert taken > 70


def test_where_and_clip_of_the_package_are_those_of_the_cards() -> None:
    assert to_text(where(x > 0, clip(x, y, z), 0)) == "where(x > 0, clip(x, y, z), 0)"
