"""Switches that are passed flatly, for a short while, or in states of any size, in time: against closed forms."""

import numpy as np
import pytest

from hvdc_ident.data import experiment
from hvdc_ident.model import Model, State
from hvdc_ident.simulate import simulate

METHODS = ("explicit", "rosenbrock")


def counted(states, condition, time, method, **more):
    """How long a condition has held, s, and the run's statistics."""
    model = Model(
        "counted",
        states={**states, "z": State(f"where({condition}, 1, 0)", start=0)},
        outputs={"z": "z"},
        parameters={},
    )
    run = simulate(model, experiment("counted", time), method=method, **more)
    return run["z"], run.statistics


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e9])
@pytest.mark.parametrize("condition", ["p > 0", "p**3 > 0", "p**9 > 0", "p**3 + p**9 > 0", "tanh(p)*p**2 > 0"])
@pytest.mark.parametrize("method", METHODS)
def test_a_switch_is_passed_when_its_state_is_however_flat_it_is_there(method, condition, scale):
    """p = 3 - 4.9 t^2/2 passes 0 at sqrt(6/4.9), whatever function of p the switch is."""
    states = {"p": State("v", start=3), "v": State("-4.9", start=0)}
    written = (
        condition if scale == 1.0 else condition.replace(" > 0", f"*{scale!r} > 0").replace(" + ", f"*{scale!r} + ")
    )
    time = np.linspace(0.0, 2.0, 9)
    found, _ = counted(states, written, time, method)
    np.testing.assert_allclose(found, np.minimum(time, np.sqrt(6 / 4.9)), atol=1e-9)


@pytest.mark.parametrize("size", [1e-12, 1e-9, 1e-6, 1e6])
@pytest.mark.parametrize("method", METHODS)
def test_a_switch_of_a_small_state_is_passed_in_time(method, size):
    """x = a t passes a/3 at 1/3."""
    found, _ = counted({"x": State(repr(size), start=0)}, f"x < {size!r}/3", np.array([0.0, 1.0]), method)
    assert found[-1] == pytest.approx(1 / 3, abs=1e-7)


@pytest.mark.parametrize("span", [1e-13, 1e-6, 1.0, 1e5])
@pytest.mark.parametrize("method", METHODS)
def test_a_switch_is_passed_in_time_whatever_the_length_of_the_run(method, span):
    """x = (t/T)^2 passes 1/2 at T/sqrt(2)."""
    states = {"x": State("v", start=0), "v": State(repr(2.0 / span**2), start=0)}
    found, _ = counted(states, "x > 0.5", np.array([0.0, span]), method)
    assert found[-1] / span == pytest.approx(1 - np.sqrt(0.5), abs=1e-9)


@pytest.mark.parametrize("half_width", [0.2, 1e-2, 1e-4, 1e-6])
@pytest.mark.parametrize("middle", [0.503, 0.26, 0.07, 0.91])
@pytest.mark.parametrize("method", METHODS)
def test_a_window_that_opens_and_closes_within_a_step_is_found(method, middle, half_width):
    """x' = 1, of which a step may be a tenth of the run: (x - c)^2 < w^2 holds for 2 w."""
    inside = min(half_width, middle, 1 - middle)
    found, statistics = counted(
        {"x": State("1", start=0)}, f"(x - {middle})**2 < {inside!r}**2", np.array([0.0, 1.0]), method
    )
    assert found[-1] == pytest.approx(2 * inside, rel=1e-4)
    assert statistics.events <= 2


@pytest.mark.parametrize("level", [0.5, 0.99, 0.9999, 0.999999])
@pytest.mark.parametrize("method", METHODS)
def test_every_crest_above_a_threshold_is_found(method, level):
    """sin t > c for 2 acos(c) in each of ten periods."""
    states = {"x": State("v", start=0), "v": State("-x", start=1)}
    found, statistics = counted(states, f"x > {level}", np.linspace(0, 20 * np.pi, 2), method, rtol=1e-10)
    assert found[-1] == pytest.approx(20 * np.arccos(level), rel=1e-3)
    assert statistics.events == 20


@pytest.mark.parametrize("level", [1.0001, 1.01])
@pytest.mark.parametrize("method", METHODS)
def test_a_crest_below_a_threshold_is_none(method, level):
    states = {"x": State("v", start=0), "v": State("-x", start=1)}
    found, statistics = counted(states, f"x > {level}", np.linspace(0, 20 * np.pi, 2), method)
    assert found[-1] == 0.0 and statistics.events == 0


@pytest.mark.parametrize("method", METHODS)
def test_the_first_of_two_windows_in_a_step_is_found_before_the_second_is_passed(method):
    """A ramp meets a window of 2e-3 before it passes a threshold for good."""
    both = State("where((x - 0.2)**2 < 1e-6, 1, 0) + where(x > 0.6, 1, 0)", start=0)
    model = Model("two", states={"x": State("1", start=0), "z": both}, outputs={"z": "z"}, parameters={})
    run = simulate(model, experiment("two", np.array([0.0, 1.0])), method=method)
    assert run["z"][-1] == pytest.approx(2e-3 + 0.4, abs=1e-7)


@pytest.mark.parametrize("method", METHODS)
def test_a_short_window_moves_the_sensitivities(method):
    """z counts |x - c| < w with x = a t: 2 w/a, of which the derivatives are 2/a and -2 w/a^2."""
    model = Model(
        "window",
        parameters={"a": 1.3, "w": 1e-3},
        states={"x": State("a", start=0), "z": State("where((x - 0.7)**2 < w**2, 1, 0)", start=0)},
        outputs={"z": "z"},
    )
    run = simulate(model, experiment("window", np.array([0.0, 1.0])), sensitivities=("a", "w"), method=method)
    assert run["z"][-1] == pytest.approx(2e-3 / 1.3, rel=1e-6)
    np.testing.assert_allclose(run.gradient("z")[-1], [-2e-3 / 1.3**2, 2 / 1.3], rtol=1e-4)


@pytest.mark.parametrize("method", METHODS)
def test_what_rests_on_a_switch_is_no_passage(method):
    """A state that goes to the corner of a clip and stays there: the errors of its steps pass it now and then, rounding does not."""
    model = Model(
        "rest",
        states={"x": State("clip(3 - x, -1, 1) + clip(x, 0, 3) - x", start=0)},
        outputs={"x": "x"},
        parameters={},
    )
    run = simulate(model, experiment("rest", np.linspace(0, 50, 6)), method=method)
    assert run["x"][-1] == pytest.approx(3.0, abs=1e-6)
    assert run.statistics.events < run.statistics.accepted / 4
