"""Text to sympy: values against Python's own arithmetic, and errors that show the place."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import sympy as sp
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from hvdc_ident.errors import ExpressionError
from hvdc_ident.expression import TIME, clip, parse, symbol, where

x, y, z = symbol("x"), symbol("y"), symbol("z")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("x", x),
        ("time", TIME),
        ("pi", sp.pi),
        ("(x - y)/z", (x - y) / z),
        ("-x**2", -(x**2)),
        ("2**-x", 2 ** (-x)),
        ("x**y**2", x ** (y**2)),
        ("(x**y)**2", (x**y) ** 2),
        ("x - y - z", x - y - z),
        ("x/y/z", x / y / z),
        ("x/y*z", x * z / y),
        ("x*-y", -x * y),
        ("--x", x),
        ("+x", x),
        ("1/3", sp.Rational(1, 3)),
        ("0.1", sp.Float(0.1)),
        ("1e-3*x", sp.Float(1e-3) * x),
        (".5", sp.Float(0.5)),
        ("5.", sp.Float(5.0)),
        ("9007199254740992", sp.Integer(2**53)),
        ("9007199254740993", sp.Float(9007199254740993.0)),
        ("sqrt(8)", 2 * sp.sqrt(2)),
        ("exp(1)", sp.E),
        ("abs(x)", sp.Abs(x)),
        ("sign(x)", sp.sign(x)),
        ("min(x, y, 3)", sp.Min(x, y, 3)),
        ("max(x)", x),
        ("clip(x, -1, 1)", clip(x, -1, 1)),
        ("atan2(y, x)", sp.atan2(y, x)),
        ("where(x >= 0, y, z)", where(x >= 0, y, z)),
        ("where(x != y, 1, 0)", where(sp.Ne(x, y), 1, 0)),
        ("where(2 == 2.0, x, y)", x),
        ("where(x > 0, 1, where(y > 0, 2, 3))", sp.Piecewise((1, x > 0), (2, y > 0), (3, True))),
        ("\n x\t+ 1 ", x + 1),
    ],
)
def test_text_means_what_the_same_sympy_expression_means(text: str, expected: sp.Expr) -> None:
    assert parse(text) == expected


def test_symbols_are_real_and_numbers_are_the_doubles_of_python() -> None:
    assert all(s.is_real for s in parse("a + b*time").free_symbols)
    for text in ("0.1", "1e300", "5e-324", "3.141592653589793", "123456.789e-7"):
        assert float(parse(text)) == float(text)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "empty"),
        ("x +", "expected a number, a name or '(', at character 4"),
        ("(x", "expected ')', at character 3"),
        ("x y", "unexpected 'y'"),
        ("cosh(x)", "did you mean 'cos'"),
        ("sin", "'sin' is a function"),
        ("sin(x, y)", "'sin' takes 1 arguments, got 2"),
        ("where(x > 0, 1)", "'where' takes 3 arguments, got 2"),
        ("where(x, 1, 2)", "must be a comparison"),
        ("where(0 < x < 1, 1, 2)", "cannot be chained"),
        ("where(where(x > 0, 1, 2) > y, 1, 2)", "cannot contain a where"),
        ("x > 1", "a comparison is no value"),
        ("sin(x > 1)", "only be the condition"),
        ("x^2", "a power is written **"),
        ("x if x > 0 else -x", "'if' is no part of an expression; write where(x > 0, x, -x), at character 3"),
        ("max(x, y) if x > y else 2*y", "write where(x > y, max(x, y), 2*y)"),
        ("x > 0 ? x : 0", "'?' is no part of an expression; write where(x > 0, x, 0)"),
        ("2*(x if x > 0 else y if y > 0 else 0)", "a if c else b is written where(c, a, b)"),
        ("where(x > 0 and y > 0, x, y)", "where(c and d, a, b) is written where(c, where(d, a, b), b)"),
        ("where(x > 0 || y > 0, x, y)", "where(c or d, a, b) is written where(c, a, where(d, a, b))"),
        ("where(not x > 0, x, y)", "where(not c, a, b) is written where(c, b, a)"),
        ("x.1", "expected an operator or the end"),
        ("x..y", "between the parts of a name only, as in gen.H"),
        ("[1, 2]", "a list stands in table only"),
        ("min([1, 2], 3)", "a list stands in table only"),
        ("table(x, [1, 2)", "expected ',' or ']'"),
        ("table(x, 1, 2)", "'table' takes table(x, [x1, x2, ...], [y1, y2, ...])"),
        ("table(x, [1, 2], [1])", "a table has 2 to 64 points, got 2 arguments and 1 values"),
        ("table(x, [1, 1], [0, 1])", "the arguments of a table rise; 1 follows 1"),
        ("deadband(x)", "'deadband' takes deadband(u, width)"),
        ("2x", "cannot follow the number 2"),
        ("1/0", "not a finite real number"),
        ("sqrt(-x**2)", "not a finite real number"),
        ("1e999", "not finite"),
    ],
)
def test_an_error_says_what_is_wrong(text: str, words: str) -> None:
    with pytest.raises(ExpressionError) as caught:
        parse(text, where="model 'm', signal 's'")
    assert words in str(caught.value)
    assert str(caught.value).startswith("model 'm', signal 's': ")


@pytest.mark.parametrize("x", [-1.5, 0.0, 2.0])
@pytest.mark.parametrize("text", ["x if x > 0 else -x", "x**2 - 1 if x < 1 else 3 * x"])
def test_what_is_written_instead_of_a_choice_is_that_choice(text: str, x: float) -> None:
    with pytest.raises(ExpressionError) as caught:
        parse(text)
    instead = str(caught.value).partition("write ")[2].rpartition(", at character")[0]
    assert float(parse(instead).subs(sp.Symbol("x", real=True), x)) == eval(text, {"x": x})


def test_the_caret_stands_below_the_wrong_character_and_the_excerpt_is_short() -> None:
    text = "abc + " * 50 + "?" + " + abc" * 50
    with pytest.raises(ExpressionError) as caught:
        parse(text)
    _, excerpt, caret = str(caught.value).split("\n")
    assert excerpt[len(caret) - 1] == "?"
    assert caret.strip() == "^"
    assert len(excerpt.strip()) <= 61


def test_the_limits_of_depth_stand_where_they_are_said() -> None:
    assert parse("(" * 100 + "x" + ")" * 100) == x
    assert parse("tanh(" * 32 + "x" + ")" * 32).has(sp.tanh)
    for text in ("(" * 101 + "x" + ")" * 101, "tanh(" * 33 + "x" + ")" * 33, "-" * 101 + "x"):
        with pytest.raises(ExpressionError, match="deep"):
            parse(text)


# A random tree gives the text and, apart from the parser, its value by Python's arithmetic.
Tree = tuple[str, Callable[[dict[str, float]], float]]
AT = {"x": 0.7368, "y": 1.4142, "z": -2.1113, "time": 0.25}
UNIT = {"one": 1.0}  # scales the numbers of the text, to tell how much rounding may matter


def _leaf() -> st.SearchStrategy[Tree]:
    numbers = st.one_of(st.integers(0, 50).map(str), st.floats(0.01, 100, allow_nan=False).map(repr))
    number = numbers.map(lambda t: (t, lambda at, v=float(t): v * at["one"]))
    name = st.sampled_from([*AT, "pi"]).map(lambda n: (n, lambda at, n=n: math.pi * at["one"] if n == "pi" else at[n]))
    return st.one_of(number, name)


_ONE: dict[str, Callable[[float], float]] = {
    "abs": abs,
    "sign": lambda v: float((v > 0) - (v < 0)),
    **{n: getattr(math, n) for n in ("sqrt", "exp", "log", "sin", "cos", "tan", "tanh", "asin", "acos", "atan")},
}
_TWO: dict[str, Callable[[float, float], float]] = {
    "{} + {}": lambda a, b: a + b,
    "{} - {}": lambda a, b: a - b,
    "{}*{}": lambda a, b: a * b,
    "{}/{}": lambda a, b: a / b,
    "{}**{}": math.pow,
    "atan2({}, {})": lambda a, b: math.atan2(a, b) if a else 1 / 0,
    "min({}, {})": min,
    "max({}, {})": max,
    "where({0} < {1}, {1}, 2*{0})": lambda a, b: b if a < b else 2 * a,
    "clip({0}, -1, {1}*{1})": lambda a, b: min(max(a, -1), b * b),
}


def _moderate(value: float) -> float:
    """The value; one so large or small that rounding decides what becomes of it raises."""
    if value and not 1e-4 < abs(value) < 1e4:
        raise OverflowError
    return value


def _grown(inner: st.SearchStrategy[Tree]) -> st.SearchStrategy[Tree]:
    def one(name: str, a: Tree) -> Tree:
        return f"{name}({a[0]})", lambda at: _moderate(_ONE[name](a[1](at) * at["one"]))

    def two(form: str, a: Tree, b: Tree) -> Tree:
        return form.format(f"({a[0]})", f"({b[0]})"), lambda at: _moderate(
            _TWO[form](a[1](at) * at["one"], b[1](at) * at["one"])
        )

    def minus(a: Tree) -> Tree:
        return f"-({a[0]})", lambda at: -a[1](at)

    return st.one_of(
        st.builds(one, st.sampled_from(list(_ONE)), inner),
        st.builds(two, st.sampled_from(list(_TWO)), inner, inner),
        st.builds(minus, inner),
    )


trees: st.SearchStrategy[Tree] = st.recursive(_leaf(), _grown, max_leaves=10)


@settings(max_examples=300)
@given(trees)
def test_a_text_has_the_value_that_python_gives_it(tree: Tree) -> None:
    text, by_python = tree
    try:
        expected = by_python(AT | UNIT)
        slope = max(abs(by_python({n: v * (1 + 1e-9) for n, v in (AT | UNIT).items()}) - expected), 0.0)
    except (ValueError, OverflowError, ZeroDivisionError):
        assume(False)
    assume(expected != 0)
    assume(slope < 1e-3 * abs(expected))  # a value on the edge of a jump tells nothing
    try:
        expression = parse(text)
    except ExpressionError:
        if "where" not in text:  # with it: a where in a condition, or a branch that is never taken
            raise
        assume(False)
    value: Any = expression.evalf(30, subs={symbol(n): sp.Float(v, 30) for n, v in AT.items()})
    assert float(value) == pytest.approx(expected, rel=1e-9 + 10 * slope / abs(expected), abs=1e-12)
