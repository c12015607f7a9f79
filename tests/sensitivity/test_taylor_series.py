"""The arithmetic behind structural identifiability: Taylor series, ranks in decimals and words, against closed forms."""

from __future__ import annotations

import math
from collections.abc import Callable
from decimal import Decimal, localcontext
from typing import Any

import mpmath
import numpy as np
import pytest

from hvdc_ident.expression import parse
from hvdc_ident.model import Algebraic, Model, Output, State
from hvdc_ident.sensitivity.structural.combinations import Point, combinations_seen
from hvdc_ident.sensitivity.structural.regime import EquationSource
from hvdc_ident.sensitivity.structural.taylor_series import TaylorSeries, Unclear, digits, eliminate, solve

DIGITS = 50


def series(model: Model, y: list[float], order: int) -> Any:
    """(order + 1, 1 + states + parameters): an output's coefficients from a start at time 0, each with its derivatives."""
    source = EquationSource(model, ["y"], dict.fromkeys(model.states, "free"))
    e = source.equations({})
    leaf, nx, p = e.graph.leaf, len(model.states), list(model.values.values())
    point = {leaf("w", 0): [Decimal(0), Decimal(1)]}
    point |= {leaf("p", k): [Decimal(repr(v))] for k, v in enumerate(p)}
    point |= {leaf("y", k): [Decimal(repr(v))] for k, v in enumerate(y)}
    names = [*(leaf("y", k) for k in range(nx)), *(leaf("p", k) for k in range(len(p)))]
    unit = np.vectorize(Decimal, otypes=[object])(np.eye(len(names), dtype=int))
    with digits(DIGITS):
        found = TaylorSeries(e, point, dict(zip(names, unit, strict=True)), order)
        for _ in range(order + 1):
            found.advance()
    return found.c[found.at[e.outputs[0]]].astype(float)


def one_state(derivative: str, **rest: Any) -> Model:
    """x' of the parameter a = 1, seen as it is."""
    states, outputs = {"x": State(parse(derivative))}, {"y": Output(parse("x"))}
    return Model(name="m", parameters={"a": 1.0}, states=states, outputs=outputs, **rest)


@pytest.mark.parametrize(
    ("derivative", "start", "solution"),
    [
        ("a*x", 1.0, lambda t, a: mpmath.exp(a * t)),
        ("a + a*x**2", 0.0, lambda t, a: mpmath.tan(a * t)),
        ("a/(2*x)", 1.0, lambda t, a: mpmath.sqrt(1 + a * t)),
        ("a*sqrt(x)", 1.0, lambda t, a: (1 + a * t / 2) ** 2),
        ("a*x**1.5", 1.0, lambda t, a: (1 - a * t / 2) ** -2),
        ("a*exp(-x)", 0.0, lambda t, a: mpmath.log(1 + a * t)),
        ("a*cos(x)**2", 0.0, lambda t, a: mpmath.atan(a * t)),
        ("a/cos(x)", 0.0, lambda t, a: mpmath.asin(a * t)),
        ("a - a*x**2", 0.0, lambda t, a: mpmath.tanh(a * t)),
        ("a/(1 + tan(x)**2)", 0.0, lambda t, a: mpmath.atan(a * t)),
        ("a*(1 - sin(x)**2)", 0.0, lambda t, a: mpmath.atan(a * t)),
        ("a*exp(-log(x))/2", 1.0, lambda t, a: mpmath.sqrt(1 + a * t)),
    ],
)
def test_series_against_closed_forms(derivative: str, start: float, solution: Callable[..., Any]) -> None:
    found = series(one_state(derivative), [start], 8)
    expected = [float(v) for v in mpmath.taylor(lambda t: solution(t, 1), 0, 8)]
    assert found[:, 0] == pytest.approx(expected, abs=1e-10)
    assert found[:, 2] == pytest.approx([k * c for k, c in enumerate(expected)], abs=1e-10)  # of a function of a*t


@pytest.mark.parametrize("function", ["tanh", "atan", "tan", "log", "exp", "sin", "cos", "asin", "acos", "sqrt"])
def test_functions_of_time_against_closed_forms(function: str) -> None:
    """f(s) with s = 1/2 + a t."""
    states, outputs = {"s": State(parse("a"))}, {"y": Output(parse(f"{function}(s)"))}
    found = series(Model(name="m", parameters={"a": 1.0}, states=states, outputs=outputs), [0.5], 7)
    expected = [float(v) for v in mpmath.taylor(getattr(mpmath, function), 0.5, 8)]
    assert found[:, 0] == pytest.approx(expected[:8], abs=1e-10)
    assert found[:, 1] == pytest.approx([(k + 1) * expected[k + 1] for k in range(8)], abs=1e-10)
    assert found[:, 2] == pytest.approx([k * expected[k] for k in range(8)], abs=1e-10)


def test_an_angle_of_two_arguments() -> None:
    """The point (-cos a t, -sin a t) turns evenly, in the half-plane where atan2 is not atan of the quotient."""
    states = {"c": State(parse("-a*s")), "s": State(parse("a*c"))}
    model = Model(name="m", parameters={"a": 2.0}, states=states, outputs={"y": Output(parse("atan2(s, c)"))})
    found = series(model, [-0.6, 0.8], 5)
    assert found[:, 0] == pytest.approx([math.atan2(0.8, -0.6), 2.0, 0, 0, 0, 0], abs=1e-12)
    assert found[:, 3] == pytest.approx([0, 1.0, 0, 0, 0, 0], abs=1e-12)


def test_an_unknown_follows_its_equation() -> None:
    """z = x**2 - z**3 with z(0) = 1, x' = -a z: against the derivatives of the implicit solution."""
    start = math.sqrt(2.0)
    found = series(one_state("-a*z", algebraic={"z": Algebraic(parse("x**2 - z**3"), start=1.0)}), [start, 1.0], 6)
    slope = 2 * start * -1.0 / (1 + 3)  # z' = 2 x x' / (1 + 3 z**2)
    assert found[1, 0] == -1.0
    assert found[2, 0] == pytest.approx(-slope / 2)
    assert found[2, 2] == pytest.approx(-slope)  # both factors scale with a
    assert found[1, 1] == pytest.approx(-2 * start / 4)


# --- ranks ---


def in_few_and_more(make: Callable[[], list[list[Decimal]]]) -> Any:
    """A matrix computed in 40 and in 60 digits."""
    both = []
    for count in (40, 60):
        with digits(count):
            both.append(np.array(make()))
    return np.array(both)


def test_what_only_rounding_gives_is_no_rank() -> None:
    third, seventh = Decimal(1) / 3, Decimal(1) / 7

    def dependent() -> list[list[Decimal]]:
        row = [Decimal(2) / 3, Decimal(5) / 7, Decimal(1) / 11]
        return [row, [x / 13 for x in row], [x / 17 + x / 19 for x in row]]

    def independent() -> list[list[Decimal]]:
        rows = dependent()
        rows[2][2] += Decimal("1e-25")
        return rows

    with digits(60):
        assert len(eliminate(in_few_and_more(dependent), np.array(Decimal("1e-40")))[0]) == 1
        pivots, others, block = eliminate(in_few_and_more(independent), np.array(Decimal("1e-40")))
        assert len(pivots) == 2 and len(others) == 1 and block.shape == (2, 2, 1)
        with pytest.raises(Unclear, match="not told apart"):
            eliminate(np.array([[[third + Decimal("1e-6")]], [[third]]]), np.array(seventh))


def test_a_linear_system_may_leave_unknowns_open_but_not_contradict_itself() -> None:
    matrix = np.array([[Decimal(1), Decimal(2)], [Decimal(2), Decimal(4)]])
    with localcontext() as c:
        c.prec = 40
        found = solve(matrix, np.array([[Decimal(3)], [Decimal(6)]]))
        assert (matrix @ found)[:, 0].tolist() == [3, 6]
        with pytest.raises(ArithmeticError, match="contradict"):
            solve(matrix, np.array([[Decimal(3)], [Decimal(7)]]))


# --- words ---


def points_with(
    gradients: Callable[..., list[list[float]]], count: int, members: int, error: float = 0.0
) -> list[Point]:
    """Points whose unseen directions are orthogonal to functions with the given derivatives by the logarithms."""
    rng, found = np.random.default_rng(0), []
    for theta in rng.uniform(0.5, 2.0, (count, members)):
        rows = np.atleast_2d(gradients(*theta))
        null = np.linalg.svd(rows)[2][len(rows) :]
        found.append(Point(theta, null * (1 + error * rng.standard_normal(null.shape))))
    return found


@pytest.mark.parametrize(
    ("gradients", "members", "seen"),
    [
        (lambda a, b: [[a, b]], 2, ("a + b",)),
        (lambda a, b: [[a, -b]], 2, ("a - b",)),
        (lambda a, b: [[1, -2]], 2, ("a/b**2",)),
        (lambda a, b, c: [[a * b, a * b, c]], 3, ("c + a*b",)),
        (lambda a, b, c: [[a, 2 * b, 3 * c]], 3, ("a + 2*b + 3*c",)),
        (lambda a, b, c: [[1, 1, 0], [1, 0, 1]], 3, ("a*b", "a*c")),
        (lambda a, b: [[a, 3 * b**3]], 2, ()),
    ],
)
def test_the_simpler_of_a_product_and_a_sum_is_named(gradients: Any, members: int, seen: tuple[str, ...]) -> None:
    for count, error in ((14, 0.0), (14, 1e-5)):
        points = points_with(gradients, count, members, error)
        (found,) = combinations_seen("abc"[:members], points, points[0].theta, error=1e-3 if error else 1e-9)
        assert found.seen == seen
