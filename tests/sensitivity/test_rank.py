"""The arithmetic behind structural identifiability: fields, polynomials and Taylor series against closed forms."""

from __future__ import annotations

import math
from decimal import Decimal
from fractions import Fraction
from random import Random
from time import thread_time
from typing import Any

import mpmath
import numpy as np
import pytest
import sympy as sp

from hvdc_ident.expression import parse
from hvdc_ident.model import Algebraic, Model, Output, State
from hvdc_ident.sensitivity.structural.finite_field import (
    PRIMES,
    HighPrecision,
    NoSuchNumber,
    PrimeField,
    context,
    numerator,
    roots,
)
from hvdc_ident.sensitivity.structural.observability import EquationSource
from hvdc_ident.sensitivity.structural.taylor_series import Equations, Taylor

FIELD = PrimeField()


@pytest.mark.parametrize("p", PRIMES)
def test_the_primes_are_primes_with_simple_roots(p: int) -> None:
    assert sp.isprime(p) and p % 4 == 3 and p < 2**31


def test_numbers_of_a_field() -> None:
    half = FIELD.number(Fraction(1, 2))
    assert 2 * half % FIELD.p == 1
    assert FIELD.fraction(FIELD.number(Fraction(-7, 12))) == Fraction(-7, 12)
    assert FIELD.fraction(123456789) is None
    root = FIELD.sqrt(FIELD.number(Fraction(9, 4)))
    assert root * root % FIELD.p == FIELD.number(Fraction(9, 4))
    with pytest.raises(NoSuchNumber):
        FIELD.sqrt(FIELD.p - 1)
    with pytest.raises(NoSuchNumber):
        FIELD.inverse(0)


def test_rows_are_reduced() -> None:
    reduced, pivots = FIELD.rref(np.array([[0, 2, 4], [0, 1, 2], [3, 0, 3]]))
    assert pivots == [0, 1]
    assert reduced.tolist() == [[1, 0, 1], [0, 1, 2]]
    with context():
        real = HighPrecision()
        rows = np.array([[real.number(Fraction(x)) for x in row] for row in ([0, 2, 4], [0, 1, 2], [3, 0, 3])])
        reduced, pivots = real.rref(rows)
        assert pivots == [0, 1] and reduced.astype(float).tolist() == [[1, 0, 1], [0, 1, 2]]
        with pytest.raises(NoSuchNumber, match="not clear"):
            real.rref(np.array([[Decimal(1), Decimal(1)], [Decimal(1), 1 + Decimal("1e-60")]]))


def test_roots_of_polynomials() -> None:
    p, random = FIELD.p, Random(0)
    wanted = sorted(random.randrange(p) for _ in range(4))
    x = sp.Symbol("x")
    product = sp.Poly(sp.prod([x - w for w in wanted]) * (x**2 + 1), x)
    assert roots([int(c) % p for c in reversed(product.all_coeffs())], p) == wanted
    assert roots([1, 0, 1], p) == []


def test_the_numerator_of_a_function_known_by_values() -> None:
    p, random = FIELD.p, Random(1)

    def function(v: int) -> int:
        return (v - 5) * (v - 9) * FIELD.inverse((v * v * v + 2) % p) % p

    assert roots(numerator(function, p, random), p) == [5, 9]


def _series(derivative: str, start: float, order: int, algebraic: dict[str, Algebraic] | None = None) -> Any:
    model = Model(
        name="m",
        parameters={"a": 1.0},
        states={"x": State(parse(derivative))},
        outputs={"y": Output(parse("x"))},
        algebraic=algebraic or {},
    )
    source = EquationSource(model, ["y"], {"x": "free"})
    e: Equations = source.equations({})
    taylor = Taylor(e, HighPrecision(), [Decimal(1)], [0], 0, thread_time() + 60)
    y = [Decimal(repr(start)), *(Decimal(repr(z.start)) for z in (algebraic or {}).values())]
    return taylor.run(y, [[Decimal(0)]], order, e.outputs)[e.outputs[0]]


@pytest.mark.parametrize(
    ("derivative", "start", "solution"),
    [
        ("a*x", 1.0, lambda t, a: mpmath.exp(a * t)),
        ("a + a*x**2", 0.0, lambda t, a: mpmath.tan(a * t)),
        ("a/(2*x)", 1.0, lambda t, a: mpmath.sqrt(1 + a * t)),
        ("a*sqrt(x)", 1.0, lambda t, a: (1 + a * t / 2) ** 2),
        ("a*exp(-x)", 0.0, lambda t, a: mpmath.log(1 + a * t)),
        ("a*cos(x)**2", 0.0, lambda t, a: mpmath.atan(a * t)),
        ("a/cos(x)", 0.0, lambda t, a: mpmath.asin(a * t)),
        ("a - a*tanh(x)*0 - a*x**2", 0.0, lambda t, a: mpmath.tanh(a * t)),
        ("a/(1 + tan(x)**2)", 0.0, lambda t, a: mpmath.atan(a * t)),
        ("a*(1 - sin(x)**2)", 0.0, lambda t, a: mpmath.atan(a * t)),
        ("a*exp(-log(x))/2", 1.0, lambda t, a: mpmath.sqrt(1 + a * t)),
        ("a*x*(1 + 0*atan(x))", 1.0, lambda t, a: mpmath.exp(a * t)),
    ],
)
def test_series_against_closed_forms(derivative: str, start: float, solution: Any) -> None:
    with context():
        found = _series(derivative, start, 8)
    expected = mpmath.taylor(lambda t: solution(t, 1), 0, 8)
    by_a = [k * c for k, c in enumerate(expected)]  # of a function of a*t
    assert [float(v) for v in found[:, 0]] == pytest.approx([float(v) for v in expected], abs=1e-10)
    assert [float(v) for v in found[:, 2]] == pytest.approx([float(v) for v in by_a], abs=1e-10)


@pytest.mark.parametrize("function", ["tanh", "atan", "tan", "log", "exp", "sin", "cos"])
def test_functions_of_time_against_closed_forms(function: str) -> None:
    """x' = f(1/2 + a t) as the derivative of x: its coefficients are those of f, one order up."""
    model = Model(
        name="m",
        parameters={"a": 1.0},
        states={"x": State(parse("a*time*0 + 1")), "s": State(parse("a"))},
        outputs={"y": Output(parse(f"{function}(s)"))},
    )
    source = EquationSource(model, ["y"], {"x": "free", "s": "free"})
    e = source.equations({})
    with context():
        taylor = Taylor(e, HighPrecision(), [Decimal(1)], [0], 0, thread_time() + 60)
        found = taylor.run([Decimal(0), Decimal("0.5")], [[Decimal(0), Decimal(1)]], 7, e.outputs)[e.outputs[0]]
    expected = mpmath.taylor(getattr(mpmath, function), 0.5, 8)
    assert [float(v) for v in found[:, 0]] == pytest.approx([float(v) for v in expected[:8]], abs=1e-10)
    by_start = [(k + 1) * expected[k + 1] for k in range(8)]
    assert [float(v) for v in found[:, 2]] == pytest.approx([float(v) for v in by_start], abs=1e-10)
    by_a = [k * expected[k] for k in range(8)]
    assert [float(v) for v in found[:, 3]] == pytest.approx([float(v) for v in by_a], abs=1e-10)


def test_an_unknown_follows_its_equation() -> None:
    """z = x**2 - z**3 with z(0) = 1, x' = -a z: against differences of the implicit solution."""
    start = math.sqrt(2.0)
    with context():
        z = {"z": Algebraic(parse("x**2 - z**3"), start=1.0)}
        found = _series("-a*z", start, 6, z)
    assert float(found[1, 0]) == -1.0
    slope = 2 * start * -1.0 / (1 + 3)  # z' = 2 x x' / (1 + 3 z**2)
    assert float(found[2, 0]) == pytest.approx(-slope / 2)
    assert float(found[2, 2]) == pytest.approx(-slope)  # both factors scale with a
    assert float(found[1, 1]) == pytest.approx(-2 * start / 4)


def test_fractions_behind_floats() -> None:
    assert Equations.fraction(1 / 3) == Fraction(1, 3)
    assert Equations.fraction(0.1) == Fraction(1, 10)
    assert Equations.fraction(math.pi) == Fraction(repr(math.pi))
