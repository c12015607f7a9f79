"""Delays of 0 and delays far below a step, against closed forms; continuity in the delay from 0 on."""

from math import factorial

import numpy as np
import pytest

from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.effects import EffectUse, apply_effects
from hvdc_ident.errors import ModelError, TimingError
from hvdc_ident.fit import FitParameter
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Delay, Model, State
from hvdc_ident.models import load_model
from hvdc_ident.simulate import simulate
from hvdc_ident.simulate.short_delays import COARSEST

TIME = np.linspace(0.0, 8.0, 161) + 0.0125
STEP = experiment("step", TIME, {"u": InputSignal.step(1.0, 0.0, 1.0)})
SEAM = float(np.ptp(TIME)) / COARSEST
SHORT = [0.0, 1e-14, 1e-9, 0.3 * SEAM, 0.9 * SEAM, 1.1 * SEAM, 3.0 * SEAM]


def plant(time="T", **parameters):
    """x' = a (u(t - T) - x)."""
    return Model(
        "plant",
        parameters={"a": 1.3, **(parameters or {"T": 0.1})},
        inputs={"u": 0.0},
        states={"x": "a*(late - x)"},
        delays={"late": Delay("u", time)},
        outputs={"x": "x", "late": "late"},
    )


@pytest.mark.parametrize("delay", SHORT)
def test_a_plant_behind_a_short_delay_is_the_closed_form_with_its_derivatives(delay):
    run = simulate(plant(), STEP, {"T": delay}, ("T", "a"))
    since = np.maximum(TIME - 1.0 - delay, 0.0)
    left = np.exp(-1.3 * since)
    np.testing.assert_allclose(run["x"], 1.0 - left, atol=2e-9)
    np.testing.assert_allclose(run.gradient("x")[:, 0], np.where(since > 0, -1.3 * left, 0.0), atol=2e-5)
    np.testing.assert_allclose(run.gradient("x")[:, 1], since * left, atol=4e-6)
    np.testing.assert_allclose(run["late"], TIME > 1.0, atol=1e-12)


def test_values_and_derivatives_are_continuous_where_the_delay_begins_to_be_simulated():
    below, above = (simulate(plant(), STEP, {"T": SEAM * (1.0 + d)}, ("T", "a")) for d in (-1e-9, 0.0))
    np.testing.assert_allclose(below["x"], above["x"], atol=1e-11)
    np.testing.assert_allclose(below.gradient("x"), above.gradient("x"), atol=1e-7)


@pytest.mark.parametrize("delay", SHORT)
def test_a_short_delay_in_a_loop_is_the_series_of_its_steps(delay):
    """x' = -k x(t - T), x = 1 before 0: sum of (-k)^n (t - (n - 1) T)^n/n! over t >= (n - 1) T (Bellman and Cooke 1963)."""
    k, time = 0.9, np.linspace(0.0, 3.0, 31)
    model = Model(
        "loop",
        parameters={"k": k, "T": 0.1},
        states={"x": State("-k*late", start=1)},
        delays={"late": Delay("x", "T")},
        outputs={"x": "x"},
    )
    run = simulate(model, experiment("free", time), {"T": delay}, ("T", "k"))

    def series(k, delay):
        terms = [(-k) ** n * np.maximum(time - (n - 1) * delay, 0.0) ** n / factorial(n) for n in range(40)]
        return np.sum(terms, axis=0)

    h = 1e-4
    by_delay = (-3 * series(k, delay) + 4 * series(k, delay + h) - series(k, delay + 2 * h)) / (2 * h)
    by_gain = (series(k + h, delay) - series(k - h, delay)) / (2 * h)
    np.testing.assert_allclose(run["x"], series(k, delay), atol=3e-8)
    # The first delay is not there for a row within it, at 0: the series begins with its second term.
    np.testing.assert_allclose(run.gradient("x")[1:, 0], by_delay[1:], atol=2e-4)
    np.testing.assert_allclose(run.gradient("x")[:, 1], by_gain, atol=2e-6)


@pytest.mark.parametrize("delay", [0.0, 1e-12])
def test_a_loop_that_only_the_delay_opens_is_solved_at_0(delay):
    """v = u - v(t - T)/2 settles at v = u/1.5 within some delays."""
    model = Model(
        "circle",
        parameters={"T": 0.1},
        inputs={"u": 0.0},
        signals={"v": "u - 0.5*late"},
        delays={"late": Delay("v", "T")},
        states={"x": "v - x"},
        outputs={"x": "x", "v": "v"},
    )
    run = simulate(model, STEP, {"T": delay})
    since = np.maximum(TIME - 1.0, 0.0)
    np.testing.assert_allclose(run["v"], (TIME > 1.0) / 1.5, atol=1e-9)
    np.testing.assert_allclose(run["x"], (1.0 - np.exp(-since)) / 1.5, atol=1e-8)


@pytest.mark.parametrize("length", [0.0, 1e-6, 2.0])
def test_a_time_by_an_expression_is_differentiated_by_what_is_in_it(length):
    """T = length/speed."""
    model = plant("length/speed", length=1.0, speed=20.0)
    run = simulate(model, STEP, {"length": length}, ("length", "speed"))
    since = np.maximum(TIME - 1.0 - length / 20.0, 0.0)
    by_time = np.where(since > 0, -1.3 * np.exp(-1.3 * since), 0.0)
    np.testing.assert_allclose(run["x"], 1.0 - np.exp(-1.3 * since), atol=2e-9)
    np.testing.assert_allclose(run.gradient("x")[:, 0], by_time / 20.0, atol=1e-6)
    np.testing.assert_allclose(run.gradient("x")[:, 1], -by_time * length / 400.0, atol=1e-6)


def test_two_short_delays_after_each_other_are_one_of_their_sum():
    model = Model(
        "chain",
        parameters={"a": 1.3, "T1": 0.1, "T2": 0.1},
        inputs={"u": 0.0},
        states={"x": "a*(second - x)"},
        delays={"first": Delay("u", "T1"), "second": Delay("first", "T2")},
        outputs={"x": "x"},
    )
    run = simulate(model, STEP, {"T1": 0.4 * SEAM, "T2": 0.0}, ("T1", "T2"))
    since = np.maximum(TIME - 1.0 - 0.4 * SEAM, 0.0)
    by_time = np.where(since > 0, -1.3 * np.exp(-1.3 * since), 0.0)
    np.testing.assert_allclose(run["x"], 1.0 - np.exp(-1.3 * since), atol=2e-9)
    # Their joint effect beyond the sum of each is not in the derivatives: a^2 T1 of them.
    np.testing.assert_allclose(run.gradient("x"), np.column_stack([by_time, by_time]), atol=2.0 * 1.3**2 * 0.4 * SEAM)


def test_a_delay_effect_of_0_leaves_the_link_as_it_is():
    link = load_model("vsc-hvdc-link")
    delayed = apply_effects(link, [EffectUse("delay", ("P2",), FrozenMap({"T": 1e-3}))])
    (parameter,) = set(delayed.parameters) - set(link.parameters)
    run = experiment("order", np.linspace(0.0, 0.5, 101), {"Pref2": InputSignal.step(0.1, 0.4, 0.6)})
    plain, at_zero = simulate(link, run), simulate(delayed, run, {parameter: 0.0})
    for name in link.outputs:
        np.testing.assert_allclose(at_zero[name], plain[name], atol=1e-7, rtol=1e-7)


def test_a_delay_time_has_0_as_its_physical_bound_and_is_refused_below():
    model = plant()
    assert model.parameters["T"].min == 0.0
    assert FitParameter.of("T", model.parameters["T"]).min == 0.0
    with pytest.raises(ModelError, match="parameter 'T': the time of a delay is negative"):
        plant(T=-0.1)
    with pytest.raises(TimingError, match="the delay of 'late' is negative"):
        simulate(plant("length/speed", length=1.0, speed=1.0), STEP, {"length": -1e-3})
