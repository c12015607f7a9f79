"""Operating points: found, refused, bounded, continued, with the margins to their limits."""

import numpy as np
import pytest

from hvdc_ident.errors import ModelError, SteadyStateError, UnknownNameError
from hvdc_ident.expression import parse
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize import continuation, find_operating_point, linearize, point_at
from hvdc_ident.model import Model, Output, State
from hvdc_ident.models import load_model
from hvdc_ident.parameters import Input, Parameter


@pytest.fixture(scope="module")
def link():
    return load_model("vsc-hvdc-link")


def test_an_input_for_a_given_output(link):
    point = find_operating_point(link, {"P1": -0.7}, free=["Pref2"])
    assert point.outputs["P1"] == pytest.approx(-0.7, abs=1e-14)
    assert point.inputs["Pref2"] == pytest.approx(point.outputs["P2"], abs=1e-12)
    again = find_operating_point(link, {"Pref2": point.inputs["Pref2"]})
    assert again.outputs["P1"] == pytest.approx(-0.7, abs=1e-12)


def test_a_parameter_for_a_given_output(link):
    point = find_operating_point(link, {"Vac1": 1.001}, free=["Zg"])
    assert point.outputs["Vac1"] == pytest.approx(1.001, abs=1e-13)
    assert point.parameters["Zg"] != link.parameters["Zg"].value


def test_a_signal_may_be_fixed(link):
    point = find_operating_point(link, {"Irorder2": 0.5}, free=["Pref2"])
    assert point.outputs["Irorder2"] == pytest.approx(0.5, abs=1e-13)


def test_bounds_hold_or_the_error_names_them(link):
    inside = find_operating_point(link, {"P1": -0.7}, ["Pref2"], {"Pref2": (0.0, 0.8), "Vac1": (0.9, 1.1)})
    assert 0.0 <= inside.inputs["Pref2"] <= 0.8
    with pytest.raises(SteadyStateError, match="on its bound: Pref2"):
        find_operating_point(link, {"P1": -0.7}, ["Pref2"], {"Pref2": (0.0, 0.5)})


def test_more_freedom_than_equations_takes_the_nearest(link):
    point = find_operating_point(link, {"P1": -0.7}, free=["Pref2", "Vdcref1"], guess={"Vdcref1": 1.0})
    assert "least norm" in point.method
    assert point.outputs["P1"] == pytest.approx(-0.7, abs=1e-12)


def test_no_such_point_names_the_worst_equation():
    model = Model(
        name="runaway", inputs=FrozenMap({"u": Input(1.0)}),
        states=FrozenMap({"x": State(parse("x**2 + u")), "y": State(parse("x - y"))}),
        outputs=FrozenMap({"x": Output(parse("x"))}),
    )  # fmt: skip
    with pytest.raises(SteadyStateError, match=r"d\(x\)/dt left with.*Try"):
        find_operating_point(model)
    assert find_operating_point(model, {"u": -4.0}).states["x"] ** 2 == pytest.approx(4.0)


def test_too_much_fixed_is_said(link):
    with pytest.raises(SteadyStateError, match="free 1 more"):
        find_operating_point(link, {"P1": -0.7})


def test_names_and_values_are_checked(link):
    with pytest.raises(UnknownNameError, match="Pref2"):
        find_operating_point(link, {"Pref": 1.0})
    with pytest.raises(UnknownNameError):
        find_operating_point(link, free=["nothing"])
    with pytest.raises(ModelError, match="not finite"):
        find_operating_point(link, {"Pref2": float("nan")})
    with pytest.raises(ModelError, match="wrong way round"):
        find_operating_point(link, {}, ["Pref2"], {"Pref2": (1.0, 0.0)})
    with pytest.raises(ModelError, match="not free"):
        find_operating_point(link, {}, [], {"Pref2": (0.0, 1.0)})


def test_margins_and_active_limits(link):
    point = find_operating_point(link)
    assert point.active_limits == ()
    upper = next(x for x in point.limits if x.signal == "yp" and x.kind == "upper")
    assert upper.margin == pytest.approx(1.2 - 0.4)
    limited = find_operating_point(link, {"Qref2": 0.7})
    named = {x.signal for x in limited.active_limits}
    assert "yq2" in named
    assert all(x.margin < 0 for x in limited.active_limits)
    text = limited.to_dict()["active_limits"][0]
    assert {"signal", "limit", "level", "margin"} <= set(text)


def test_start_values_are_guesses_at_rest_and_held_at_start():
    model = Model(
        name="m", parameters=FrozenMap({"a": Parameter(2.0)}), inputs=FrozenMap({"u": Input(1.0)}),
        states=FrozenMap({"x": State(parse("u - x"), start=parse("3*a")), "y": State(parse("x - a*y"))}),
        outputs=FrozenMap({"y": Output(parse("y"))}),
    )  # fmt: skip
    assert dict(find_operating_point(model).states) == pytest.approx({"x": 1.0, "y": 0.5})
    held = find_operating_point(model, at="start")
    assert dict(held.states) == pytest.approx({"x": 6.0, "y": 3.0})


def test_two_rests_are_reached_from_their_guesses():
    model = Model(
        name="double", states=FrozenMap({"x": State(parse("x - x**3"))}), outputs=FrozenMap({"x": Output(parse("x"))})
    )
    for guess in (-0.9, 0.9):
        assert find_operating_point(model, guess={"x": guess}).states["x"] == pytest.approx(np.sign(guess))


def test_following_the_model_finds_what_newton_does_not():
    """arctan's Newton iteration diverges from 3; following the flow does not."""
    model = Model(
        name="atan", inputs=FrozenMap({"u": Input(1.0)}),
        states=FrozenMap({"x": State(parse("-atan(1000*(x - u))"), guess=500.0)}),
        outputs=FrozenMap({"x": Output(parse("x"))}),
    )  # fmt: skip
    assert find_operating_point(model).states["x"] == pytest.approx(1.0, abs=1e-9)


def test_continuation_follows_a_parameter(link):
    values = np.linspace(0.1, 0.9, 9)
    points = continuation(link, "Pref2", values)
    assert [p.inputs["Pref2"] for p in points] == pytest.approx(list(values))
    assert all(p.residual < 1e-12 for p in points)
    with pytest.raises(UnknownNameError):
        continuation(link, "nothing", [1.0])


def test_a_point_away_from_rest_solves_its_unknowns(link):
    states = {**find_operating_point(link).states, "xp": 0.6}
    point = point_at(link, states)
    assert point.states["xp"] == 0.6
    assert point.outputs["P2"] == pytest.approx(0.6, abs=1e-12)
    with pytest.raises(UnknownNameError):
        point_at(link, {"Vdc1": 1.0})


@pytest.mark.parametrize("place", ["signals", "algebraic"])
def test_an_integrator_whose_terms_cancel_to_rounding_is_at_the_limit(place):
    """x' = 3 a x - b x + u with 3 a = b: in floating point 0.3 - 3 * 0.1 is -6e-17, and of the other sign as often as not."""
    table = {"v": "3*a*x"} if place == "signals" else {"v": {"equation": "3*a*x + 0*v"}}

    def linear(b):
        states = {"x": {"derivative": "v - b*x + u", "start": "0"}}
        return linearize(
            Model(
                "cancels",
                parameters={"a": 0.1, "b": b},
                inputs={"u": 0.0},
                states=states,
                outputs={"y": "x"},
                **{place: table},
            )
        )

    assert 3 * 0.1 - 0.3 > 0
    found = linear(0.3)
    assert found.stability().verdict == "on the limit of stability" and found.point.stable and not found.point.notes
    assert found.A.tolist() == [[0.0]]
    # What is no rounding stays.
    grows = linear(0.3 - 1e-13)
    assert grows.stability().verdict == "unstable" and grows.A[0, 0] == pytest.approx(1e-13, rel=1e-2)
