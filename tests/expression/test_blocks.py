"""Blocks of the grammar against numpy, their own definition points, and a simulation by scipy."""

from __future__ import annotations

import math

import numpy as np
import pytest
import sympy as sp
from scipy.integrate import solve_ivp

import hvdc_ident as hi
from hvdc_ident.data import InputSignal
from hvdc_ident.expression import parse, to_text


def value(text: str, **names: float) -> float:
    return float(parse(text).subs({sp.Symbol(n, real=True): v for n, v in names.items()}).evalf())


def test_a_table_is_linear_between_its_points_and_constant_beyond() -> None:
    at, values = [0.0, 0.3, 0.5, 1.0], [0.1, 0.4, -0.2, 1.0]
    for x in np.linspace(-0.5, 1.5, 41):
        found = value(f"table(x, {at}, {values})", x=float(x))
        assert found == pytest.approx(np.interp(x, at, values), abs=1e-12)


def test_points_of_a_table_may_be_parameters() -> None:
    text = "table(x, [0, a, 1], [0, b, 1])"
    assert value(text, x=0.25, a=0.5, b=0.8) == pytest.approx(0.4)
    assert value(text, x=0.75, a=0.5, b=0.8) == pytest.approx(0.9)


@pytest.mark.parametrize(
    ("x1", "s1", "x2", "s2"), [(1.0, 0.03, 1.2, 0.4), (2.8, 0.04, 3.73, 0.33), (1.0, 0.0, 1.2, 0.3)]
)
def test_saturation_passes_through_its_points(x1: float, s1: float, x2: float, s2: float) -> None:
    text = f"saturation(x, {x1}, {s1}, {x2}, {s2})"
    assert value(text, x=x1) == pytest.approx(s1, abs=1e-12)
    assert value(text, x=x2) == pytest.approx(s2)
    assert value(text, x=0.3 * x1) == 0.0
    given = {"a": x1, "b": s1, "c": x2, "d": s2}
    assert value("saturation(x, a, b, c, d)", x=1.1 * x2, **given) == pytest.approx(value(text, x=1.1 * x2))


def test_exponential_saturation_is_a_power() -> None:
    text = "saturation_exponential(x, 1, 0.1, 1.2, 0.4)"
    assert value(text, x=1.0) == pytest.approx(0.1) and value(text, x=1.2) == pytest.approx(0.4)
    assert value(text, x=1.44) == pytest.approx(1.6)  # a factor of 4 for each factor of 1.2


@pytest.mark.parametrize("text", ["saturation(x, 1, S1, 1.2, S2)", "saturation_exponential(x, 1, S1, 1.2, S2)"])
def test_no_saturation_where_its_points_are_0(text: str) -> None:
    assert value(text, x=1.5, S1=0.0, S2=0.0) == 0.0
    assert parse(text.replace("S1", "0").replace("S2", "0")) == 0


def test_a_first_point_at_0_is_no_saturation() -> None:
    """Data have E1 = 0, SE1 = 0, E2 = 1, SE2 = 1 where there is none."""
    assert value("saturation(x, E1, S1, E2, S2)", x=2.0, E1=0.0, S1=0.0, E2=1.0, S2=1.0) == 0.0
    assert parse("saturation(x, 0, 0, 1, 1)") == 0


def test_dead_bands_of_both_types() -> None:
    assert [value("deadband(u, 0.1)", u=u) for u in (-0.3, -0.05, 0.0, 0.1, 0.4)] == pytest.approx([-0.2, 0, 0, 0, 0.3])
    assert [value("deadband_step(u, 0.1)", u=u) for u in (-0.3, -0.05, 0.0, 0.4)] == pytest.approx([-0.3, 0, 0, 0.4])
    assert value("deadband_step(u, w)", u=0.2, w=0.0) == 0.2


@pytest.mark.parametrize(
    "text",
    ["table(gen.x, [0, 0.5, 1], [0, 0.6, p])", "nonwindup((u - x)/T, x, low, high)", "saturation(x, 1, a, 1.2, b)"],
)
def test_what_is_written_is_read_as_the_same(text: str) -> None:
    assert parse(to_text(parse(text))) == parse(text)


def test_a_lag_without_windup_leaves_its_limit_at_once(tmp_path) -> None:
    """x' = (u - x)/T, held at 0.5: it follows u again the moment u falls below, and scipy finds the same."""
    card = tmp_path / "lag.toml"
    card.write_text(
        """schema = 1
name = "lag"
parameters = {T = {value = 0.3}, high = {value = 0.5}}
inputs = {u = {value = 0.0}}
states = {x = {derivative = "nonwindup((u - x)/T, x, -high, high)", rest = "clip(u, -high, high)"}}
outputs = {x = "x"}
""",
        encoding="utf-8",
    )
    times = np.linspace(0.0, 6.0, 601)
    signal = InputSignal.corners([(1.0, 0.0), (1.0, 2.0), (4.0, 2.0), (4.0, -0.2)])
    run = hi.simulate(card, times, inputs={"u": signal})
    reach = 1.0 - 0.3 * math.log(1.0 - 0.25)  # 2 (1 - exp(-t/T)) = 0.5
    after = solve_ivp(lambda t, x: (-0.2 - x) / 0.3, (4.0, 6.0), [0.5], rtol=1e-10, atol=1e-12, dense_output=True).sol
    expected = [
        0.0 if t <= 1 else 2 * (1 - math.exp(-(t - 1) / 0.3)) if t <= reach else 0.5 if t <= 4 else after(t)[0]
        for t in times
    ]
    assert np.abs(run["x"] - expected).max() < 1e-5
    held = hi.linearize(hi.load_model(card).with_values({"u": 2.0}))
    assert held.x0[held.state_names.index("x")] == pytest.approx(0.5)
