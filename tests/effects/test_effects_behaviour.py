"""What each effect does to a signal, against answers from elsewhere: closed forms, numpy, scipy's linear systems, play operators."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest
from scipy import integrate, signal

from hvdc_ident import load_study
from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.effects import EffectUse, apply_effects, effect_model, effects
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize import find_operating_point, linearize
from hvdc_ident.model import Model
from hvdc_ident.models import load_model
from hvdc_ident.simulate import simulate

T = np.linspace(0.0, 1.0, 2001)
# Corners at rows: nothing but ramps, a jump and rest, through 0 and both signs.
U = InputSignal.corners([(0.1, 0.3), (0.25, 0.9), (0.3, 0.9), (0.3, 0.2), (0.45, -0.7), (0.6, -0.1), (0.8, 0.5)])
SOURCE = InputSignal.corners([(0.2, 1.0), (0.5, 1.8), (0.7, -0.4)])
u, s = U(T), SOURCE(T)
AFTER_JUMP = T != 0.3


def passed(name, values, source=False, expression="", time=T, **options):
    """y of the effect on its own, driven by U (and SOURCE)."""
    use = EffectUse(name, ("u",), FrozenMap(values), source="source" if source else "", expression=expression)
    inputs = {"u": U} | ({"source": SOURCE} if source else {})
    run = simulate(effect_model(use, source), experiment("bench", time, inputs), rtol=1e-10, **options)
    return run["y"]


def linear(numerator, denominator):
    """scipy's response to U minus its start, with the start put back: every system here has gain 1."""
    order = np.argsort(np.r_[T, 0.3], kind="stable")  # the jump as two rows
    time = np.r_[T, 0.3][order]
    values = np.r_[u, 0.9][order]
    first = np.flatnonzero(time == 0.3)[0]
    values[first : first + 2] = [0.9, 0.2]
    y = []
    state = None
    for part in (slice(0, first + 1), slice(first + 1, None)):
        t, v = time[part], values[part] - 0.3
        system = signal.TransferFunction(numerator, denominator).to_ss()
        _, out, states = signal.lsim(system, v, t - t[0], X0=state)
        state = np.atleast_2d(states)[-1] if states.ndim > 1 else states[-1:]
        y.append(np.squeeze(out) + 0.3)
    return np.concatenate([y[0][:-1], y[1]])


@pytest.mark.parametrize(
    ("name", "values", "numerator", "denominator"),
    [
        ("lag", {"T": 0.03}, [1.0], [0.03, 1.0]),
        ("inductance", {"L": 0.02, "R": 0.5}, [1.0], [0.04, 1.0]),
        ("second-order", {"wn": 60.0, "zeta": 0.3}, [60.0**2], [1.0, 36.0, 60.0**2]),
        ("second-order", {"wn": 60.0, "zeta": 1.4}, [60.0**2], [1.0, 168.0, 60.0**2]),
        ("inner-loop", {"wn": 60.0, "zeta": 0.3}, [36.0, 60.0**2], [1.0, 36.0, 60.0**2]),
        ("inner-loop", {"wn": 60.0, "zeta": 1.4}, [168.0, 60.0**2], [1.0, 168.0, 60.0**2]),
        ("lead-lag", {"T1": 0.05, "T2": 0.02}, [0.05, 1.0], [0.02, 1.0]),
        ("lead-lag", {"T1": 0.005, "T2": 0.02}, [0.005, 1.0], [0.02, 1.0]),
    ],
)
def test_linear_ones_are_scipys(name, values, numerator, denominator):
    np.testing.assert_allclose(passed(name, values)[AFTER_JUMP], linear(numerator, denominator)[AFTER_JUMP], atol=1e-8)


@pytest.mark.parametrize(
    ("name", "values", "expected"),
    [
        ("limit", {"level": 0.4}, np.maximum(-0.4, np.minimum(0.4, u))),
        ("saturation", {"level": 0.5}, 0.5 * (1 - 2 / (np.exp(4 * u) + 1))),
        ("deadband", {"width": 0.15}, np.sign(u) * np.maximum(np.abs(u) - 0.15, 0.0)),
        ("gain", {"k": -1.3}, u * -1.3),
        ("offset", {"c": -0.2}, u - 0.2),
        ("polynomial", {"b": 0.3, "c": -0.2}, np.polyval([-0.2, 0.3, 1.0, 0.0], u)),
        ("drift", {"c": 0.1, "g": -0.4}, u + 0.1 * T - 0.4 * T * u),
        # Slope 1 beyond the ends, 0.5 in the first piece from -1 to -0.75, 3 in the last one, and a level of 0.1 more.
        (
            "lookup",
            {"low": -1.0, "high": 1.0, "c": 0.1, "s1": 0.5, "s8": 3.0},
            u + np.interp(u, [-1.0, -0.75, 0.75, 1.0], [0.1, -0.025, -0.025, 0.475]),
        ),
    ],
)
def test_curves(name, values, expected):
    np.testing.assert_allclose(passed(name, values), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "values", "expected"),
    [
        ("loss", {"a": 0.01, "b": 0.2, "c": 0.05}, u - np.polyval([0.05, 0.2, 0.01], np.abs(s))),
        ("loss", {"c": 0.05}, u - 0.05 * s * s),
        ("conductance", {"g": 0.1}, u - 0.1 * s),
        ("product", {"g": -0.05, "k": 0.2}, u * (0.95 + 0.2 * s)),
        ("dry-friction", {"F": 0.1, "v": 0.3}, u - 0.1 * (1 - 2 / (np.exp(2 * s / 0.3) + 1))),
        (
            "curve",
            {"low": 0.0, "high": 2.0, "v1": -0.1, "v4": 0.2, "v9": 0.05},
            u + np.interp(s, np.linspace(0, 2, 9), [-0.1, 0, 0, 0.2, 0, 0, 0, 0, 0.05]),
        ),
        ("coupling", {"k": -0.3}, u - 0.3 * (s - 1.0)),
        ("droop", {"k": 0.3}, u - 0.3 * (s - 1.0)),
        ("droop", {"k": 0.3, "deadband": 0.25}, u - 0.3 * np.sign(s - 1) * np.maximum(np.abs(s - 1) - 0.25, 0.0)),
    ],
)
def test_what_another_signal_brings(name, values, expected):
    np.testing.assert_allclose(passed(name, values, source=True), expected, atol=1e-12)


def test_delay_shifts():
    late = passed("delay", {"T": 0.0375})
    beside = np.abs(T - 0.3375) > 1e-9
    np.testing.assert_allclose(late[beside], U(T - 0.0375)[beside], atol=1e-10)


def test_window_mean_is_the_difference_of_integrals():
    fine = np.linspace(-0.1, 1.0, 1_100_001)  # with every corner: the midpoint rule is exact
    area = np.concatenate([[0.0], np.cumsum(U((fine[1:] + fine[:-1]) / 2) * np.diff(fine))])
    expected = (np.interp(T, fine, area) - np.interp(T - 0.0375, fine, area)) / 0.0375
    np.testing.assert_allclose(passed("window-mean", {"T": 0.0375}), expected, atol=1e-8)


def test_rate_limit_follows_its_definition_and_the_ideal_one():
    y = passed("rate-limit", {"rate": 5.0})
    found = [np.array([0.3])]
    for t0, t1 in ((0.0, 0.3), (0.3, 1.0)):  # one stretch on each side of the jump

        def rate(t, y, end=t1):
            return np.maximum(-5.0, np.minimum(5.0, (U(t if t < end else np.nextafter(end, 0)) - y) * 5000.0))

        rows = T[(t0 < T) & (t1 >= T)]
        run = integrate.solve_ivp(rate, (t0, t1), found[-1][-1:], "LSODA", rows, rtol=1e-9, atol=1e-11, max_step=1e-3)
        found.append(run.y[0])
    np.testing.assert_allclose(y, np.concatenate(found), atol=2e-6)
    ideal = u.copy()
    for k in range(1, T.size):
        ideal[k] = ideal[k - 1] + np.clip(u[k] - ideal[k - 1], -5.0 * (T[k] - T[k - 1]), 5.0 * (T[k] - T[k - 1]))
    np.testing.assert_allclose(y, ideal, atol=5.0 * (2e-4 + 5e-4))


def play(u, width):
    """The play operator of Krasnosel'skii: the least movement that keeps |u - y| within half of the width."""
    y = np.empty_like(u)
    y[0] = u[0]
    for k in range(1, u.size):
        y[k] = min(max(y[k - 1], u[k] - width / 2), u[k] + width / 2)
    return y


def test_backlash_is_the_play_operator():
    fine = np.linspace(0.0, 1.0, 200_001)
    ideal = np.interp(T, fine, play(U(fine), 0.2))
    away = np.abs(T - 0.3) > 1e-9  # at the jump both of its sides are right
    np.testing.assert_allclose(passed("backlash", {"width": 0.2})[away], ideal[away], atol=3e-5)


@pytest.mark.parametrize("period", [0.005, 1.0, 3600.0])
@pytest.mark.parametrize("rtol", [1e-6, 1e-8])
def test_backlash_lets_go_where_a_signal_turns_however_slow_it_is(period, rtol):
    """A sine that swells, without a corner that an integrator would be told of."""
    speed = 2 * np.pi / period
    states = {
        "a": {"derivative": f"{speed} * b", "start": 0.0},
        "b": {"derivative": f"-{speed} * a", "start": 1.0},
    }
    model = Model("m", states=states, signals={"u": f"a * (1 + 0.3 * time / {period})"}, outputs={"y": "u"})
    model = apply_effects(model, [{"effect": "backlash", "at": "u", "parameters": {"width": 0.2}}])
    fine = np.linspace(0.0, 2.2 * period, 200_001)
    expected = play(np.sin(2 * np.pi * fine / period) * (1 + 0.3 * fine / period), 0.2)[::1000]
    found = simulate(model, experiment("e", fine[::1000]), rtol=rtol)["y"]
    np.testing.assert_allclose(found, expected, atol=1e-7 * speed * 1.7 + 100 * rtol)


ONE_SINE, TWO_SINES = (lambda t: np.sin(9 * t) * (1 - 0.3 * t)), (lambda t: np.sin(9 * t) + 0.3 * np.sin(31 * t))


@pytest.mark.parametrize(("signal", "rtol"), [(ONE_SINE, 1e-6), (ONE_SINE, 1e-8), (TWO_SINES, 1e-8)])
def test_backlash_lets_go_where_a_recorded_signal_turns(signal, rtol):
    """A recording's corners are no breaks, so that it turns within steps."""
    rows = np.linspace(0.0, 1.0, 801)
    polygon = InputSignal(rows, signal(rows), np.empty(0))
    fine = np.linspace(0.0, 1.0, 160_001)
    expected = play(polygon(fine), 0.2)[::80]
    stands = np.abs(np.diff(expected)) < 1e-12
    resting = np.r_[False, stands] & np.r_[stands, False]
    use = EffectUse("backlash", ("u",), FrozenMap({"width": 0.2}))
    y = simulate(effect_model(use, False), experiment("bench", T, {"u": polygon}), rtol=rtol)["y"]
    np.testing.assert_allclose(y[resting], expected[resting], rtol=0, atol=20 * rtol)


def test_quantisation_rounds():
    step = 0.037
    expected = step * np.round(u / step)
    edge = np.abs(u / step - np.floor(u / step) - 0.5) < 1.1e-3
    assert edge.mean() < 0.01
    mine = passed("quantisation", {"step": step})
    np.testing.assert_allclose(mine[~edge], expected[~edge], atol=1e-12)
    assert np.abs(mine - expected).max() <= step * (1 + 1e-9)
    recorded = apply_effects(
        Model("r", inputs={"u": 0.0}, outputs={"y": "u"}),
        [{"effect": "quantisation", "at": "outputs.y", "parameters": {"step": step}}],
    )
    y = simulate(recorded, experiment("bench", T, {"u": U}))["y"]
    tie = np.abs(u / step - np.floor(u / step) - 0.5) < 1e-9
    np.testing.assert_allclose(y[~tie], expected[~tie], atol=1e-12)
    assert np.unique(np.round(y / step)).size > 40


def test_a_deadband_with_a_step_lets_all_through_beyond_its_edge():
    width = 0.1503
    away = np.abs(np.abs(u) / width - 1) > 3e-4
    assert away.mean() > 0.999
    expected = np.where(np.abs(u) > width, u, 0.0)
    np.testing.assert_allclose(passed("deadband-step", {"width": width})[away], expected[away], atol=1e-12)
    recorded = apply_effects(
        Model("r", inputs={"u": 0.0}, outputs={"y": "u"}),
        [{"effect": "deadband-step", "at": "outputs.y", "parameters": {"width": width}}],
    )
    y = simulate(recorded, experiment("bench", T, {"u": U}))["y"]
    np.testing.assert_allclose(y, expected, atol=1e-12)


def test_a_loop_slides_along_the_edge_of_a_deadband_with_a_step():
    """w' = d - K w beyond the band and d inside: for 0 < d < K width the loop can neither leave nor stay (Filippov)."""
    loop = Model("m", {"K": 50.0}, inputs={"d": 0.0}, states={"w": "d - K*e"}, signals={"e": "w"}, outputs={"w": "w"})
    loop = apply_effects(loop, [{"effect": "deadband-step", "at": "e", "parameters": {"width": 0.1}}])
    record = experiment("e", np.linspace(0.0, 1.0, 101), {"d": InputSignal.step(0.105, 0.0, 1.0)})
    run = simulate(loop, record, sensitivities=["deadband_step_e_width"])
    np.testing.assert_allclose(run["w"], np.clip(record.time - 0.105, 0.0, 0.1), atol=0.1 * 2e-4)
    np.testing.assert_allclose(run.gradient("w")[record.time > 0.22, 0], 1.0, atol=1e-3)
    assert find_operating_point(loop, {"d": 1.0}).states["w"] == pytest.approx(0.1, rel=2e-4)


def test_a_servo_runs_at_its_rates_and_then_as_a_lag():
    """Behind a step from 0 to 1 it moves at its rate until 1 - y is the rate times T, then exponentially: in closed form."""
    step = InputSignal.corners([(0.1003, 0.0), (0.1003, 1.0), (0.6003, 1.0), (0.6003, 0.0)])
    use = EffectUse("servo", ("u",), FrozenMap({"T": 0.05, "up": 4.0, "down": 5.0}))
    y = simulate(effect_model(use), experiment("bench", T, {"u": step}), rtol=1e-10)["y"]

    def answer(t, rate):
        gone = np.maximum(t, 0.0)
        end = (1.0 - 0.05 * rate) / rate
        return np.where(gone < end, rate * gone, 1.0 - 0.05 * rate * np.exp(-(gone - end) / 0.05))

    top = answer(0.5, 4.0)
    np.testing.assert_allclose(y[T < 0.6], answer(T[T < 0.6] - 0.1003, 4.0), atol=1e-8)
    end = (top - 0.25) / 5.0
    late = T[T > 0.6003] - 0.6003
    np.testing.assert_allclose(
        y[T > 0.6003], np.where(late < end, top - 5.0 * late, 0.25 * np.exp(-(late - end) / 0.05)), atol=1e-8
    )


def test_sample_hold_holds_what_it_took():
    period, compute = 0.01371, 0.004
    y = passed("sample-hold", {"Ts": period, "compute": compute})
    taken = np.floor((T - compute) / period) * period
    expected = np.where(taken < 0, 0.3, U(np.maximum(taken, 0.0)))
    np.testing.assert_allclose(y, expected, atol=1e-9)


def test_disturbance_is_a_sine_of_the_experiments_time():
    y = passed("disturbance", {"amplitude": 0.2, "frequency": 7.0, "phase": 0.4})
    np.testing.assert_allclose(y - u, 0.2 * np.imag(np.exp(1j * (14 * np.pi * T + 0.4))), atol=1e-10)


def test_term_is_what_it_says():
    y = passed("term", {"k": 0.3, "c": -0.1}, expression="k*u**3 + c*abs(u)")
    np.testing.assert_allclose(y, u + 0.3 * u * u * u - 0.1 * np.abs(u), atol=1e-12)


def test_a_delay_in_a_loop_is_the_method_of_steps():
    """x' = -x(t - 1) from x = 1: polynomials, interval by interval."""
    model = Model("m", states={"x": {"derivative": "-x", "start": 1.0}}, outputs={"seen": "x"})
    late = apply_effects(model, [{"effect": "delay", "at": "x", "parameters": {"T": 1.0}}])
    t = np.linspace(0.0, 3.0, 61)
    expected = np.select(
        [t <= 1, t <= 2, t <= 3],
        [1 - t, 1 - t + (t - 1) ** 2 / 2, 1 - t + (t - 1) ** 2 / 2 - (t - 2) ** 3 / 6],
    )
    np.testing.assert_allclose(simulate(late, experiment("e", t), outputs=("x",), rtol=1e-10)["x"], expected, atol=1e-8)


@pytest.mark.parametrize(
    ("name", "values", "expected"),
    [
        ("lag", {"T": 0.02}, lambda s: 1 / (1 + 0.02 * s)),
        ("inductance", {"L": 0.02, "R": 4.0}, lambda s: 1 / (1 + 0.005 * s)),
        ("second-order", {"wn": 50.0, "zeta": 0.2}, lambda s: 2500 / (s * s + 20 * s + 2500)),
        ("inner-loop", {"wn": 50.0, "zeta": 0.2}, lambda s: (2500 + 20 * s) / (s * s + 20 * s + 2500)),
        ("lead-lag", {"T1": 0.03, "T2": 0.01}, lambda s: (1 + 0.03 * s) / (1 + 0.01 * s)),
        (
            "filter",
            {"k": -0.4, "low": 0.5, "high": -0.2, "wn": 40.0, "zeta": 0.3},
            lambda s: 1 - 0.4 * (0.5 * 1600 + 24 * s - 0.2 * s * s) / (s * s + 24 * s + 1600),
        ),
        ("delay", {"T": 0.01}, lambda s: np.exp(-0.01 * s)),
        ("window-mean", {"T": 0.01}, lambda s: (1 - np.exp(-0.01 * s)) / (0.01 * s)),
        (
            "sample-hold",
            {"Ts": 0.01, "compute": 0.002},
            lambda s: np.exp(-0.002 * s) * (1 - np.exp(-0.01 * s)) / (0.01 * s),
        ),
        ("rate-limit", {"rate": 3.0}, lambda s: 1 / (1 + 2e-4 * s)),
        ("limit", {"level": 0.6}, lambda s: 1 + 0 * s),
        ("limit", {"level": 0.4}, lambda s: 0 * s),
        ("deadband", {"width": 0.1}, lambda s: 1 + 0 * s),
        ("deadband", {"width": 0.6}, lambda s: 0 * s),
        ("deadband-step", {"width": 0.1}, lambda s: 1 + 0 * s),
        ("deadband-step", {"width": 0.6}, lambda s: 0 * s),
        ("servo", {"T": 0.02, "up": 3.0, "down": 1.0}, lambda s: 1 / (1 + 0.02 * s)),
        ("backlash", {"width": 0.1}, lambda s: 0 * s),
        ("quantisation", {"step": 0.1}, lambda s: 0 * s),
        ("saturation", {"level": 0.5}, lambda s: 1 / np.cosh(1.0) ** 2 + 0 * s),
        ("gain", {"k": 1.2}, lambda s: 1.2 + 0 * s),
        ("offset", {"c": 0.2}, lambda s: 1 + 0 * s),
        ("disturbance", {"amplitude": 0.2}, lambda s: 1 + 0 * s),
        ("term", {"k": 0.2}, lambda s: 1 + 0.2 * 3 * 0.25 + 0 * s),
        ("polynomial", {"b": 0.3, "c": 0.2}, lambda s: 1 + 0.3 * 2 * 0.5 + 0.2 * 3 * 0.25 + 0 * s),
        ("lookup", {"low": -0.1, "high": 1.0, "s5": 0.7}, lambda s: 0.7 + 0 * s),
    ],
)
def test_it_linearises(name, values, expected):
    use = EffectUse(name, ("u",), FrozenMap(values), expression="k*u**3" if name == "term" else "")
    model = effect_model(use)
    found = linearize(model, find_operating_point(model, {"u": 0.5}))
    omega = np.array([3.0, 40.0, 200.0])
    np.testing.assert_allclose(found.response(omega).ravel(), expected(1j * omega), atol=1e-7)


@pytest.mark.parametrize(
    ("name", "values", "gain"),
    [
        ("coupling", {"k": 0.3}, 0.3),
        ("droop", {"k": 0.3}, -0.3),
        ("droop", {"k": 0.3, "deadband": 0.1}, 0.0),
        ("conductance", {"g": 0.3}, -0.3),
        ("loss", {"b": 0.2, "c": 0.1}, -(0.2 + 2 * 0.1 * 2.0)),
        ("curve", {"low": 1.95, "high": 2.75, "v2": 0.3}, 3.0),
        ("dry-friction", {"F": 0.2, "v": 4.0}, -0.2 / 4.0 / np.cosh(0.5) ** 2),
    ],
)
def test_those_with_another_signal_linearise(name, values, gain):
    model = effect_model(EffectUse(name, ("u",), FrozenMap(values), source="source"), source=True)
    found = linearize(model, find_operating_point(model, {"u": 0.5, "source": 2.0}))
    np.testing.assert_allclose(found.response(np.array([40.0])).ravel(), [1.0, gain], atol=1e-12)


def test_a_filter_is_told_by_its_shape_and_a_curve_by_what_is_added():
    notch, lookup, curve = (effects()[n] for n in ("filter", "lookup", "curve"))
    values = {"k": -0.8, "low": 0.0, "high": 0.0, "wn": 40.0, "zeta": 0.3}
    assert notch.words(values) == {
        "shape": "a notch around 40 rad/s", "transfer": "(s^2 + 4.8 s + 1600)/(s^2 + 24 s + 1600)",
    }  # fmt: skip
    assert notch.is_own(values) and not notch.is_own(values | {"zeta": 2.0}), (
        "two lags and two leads are in the catalogue"
    )
    for entry, given in ((lookup, {"c": 0.1, "s2": 0.2, "s7": 2.0}), (curve, {"v2": 0.3, "v8": -0.1})):
        full = {n: q.value for n, q in entry.parameters.items()} | {"low": -0.4, "high": 1.2} | given
        at, added = entry.curve(full)
        source = entry.needs_source
        use = EffectUse(entry.name, ("u",), FrozenMap(full), source="source" if source else "")
        model, moved = effect_model(use, source=source), "source" if source else "u"
        for x, y in zip(at, added, strict=True):
            held = {"u": 0.25, moved: x}
            assert equilibrium(model, held) == pytest.approx(held["u"] + y, abs=1e-12)


def equilibrium(model, inputs):
    """The output of an effect at constant inputs."""
    return find_operating_point(model, inputs).outputs["y"]


STUDY = """
schema = 1
[model]
source = "plant.toml"
"""
PLANT = """
schema = 1
name = "plant"
[parameters]
R = {value = 0.5, min = 0.0}
[inputs]
v = {value = 1.0}
w = {value = 0.2}
[states]
x = {derivative = "i - x"}
[signals]
i = "v/R"
[outputs]
x = "x"
"""


def test_study_files_put_effects_on(tmp_path):
    tables = [
        {"effect": "lag", "at": ["v", "w"], "parameters": {"T": 0.0016}},
        {"effect": "droop", "at": "v", "from": "x", "parameters": {"k": 0.1, "deadband": 0.01}},
        {"effect": "inductance", "at": "i", "parameters": {"L": 0.1, "R": "R"}},
        {"effect": "term", "at": "x", "expression": "k*x*abs(w)", "parameters": {"k": 0.02}},
    ]
    text = STUDY
    for table in tables:
        text += "[[model.effect]]\n"
        for key, value in table.items():
            inline = ", ".join(f"{k} = {v!r}" for k, v in value.items()) if isinstance(value, dict) else ""
            text += f"{key} = {{{inline}}}\n" if inline else f"{key} = {value!r}\n"
    assert tomllib.loads(text)["model"]["effect"] == tables
    (tmp_path / "plant.toml").write_text(PLANT)
    (tmp_path / "study.toml").write_text(text)
    model = load_study(tmp_path / "study.toml").model
    added = {"lag_v_T", "droop_v_k", "droop_v_deadband", "inductance_i_L", "term_x_k"}
    assert set(model.parameters) == {"R"} | added
    assert {effects()[t["effect"]].name for t in tables} == {"lag", "droop", "inductance", "term"}
    steady = simulate(model, experiment("e", [0.0, 1.0]))
    assert np.ptp(steady["x"]) < 1e-7


def test_a_disturbance_is_at_rest_in_the_value_it_has_at_the_start():
    model = Model("m", inputs={"u": 0.5}, states={"x": "u - x"}, outputs={"x": "x"})
    shaken = apply_effects(
        model, [{"effect": "disturbance", "at": "u", "parameters": {"amplitude": 0.1, "frequency": 0.2, "phase": 0.3}}]
    )
    run = simulate(shaken, experiment("e", np.linspace(2.0, 3.0, 5)), sensitivities=["disturbance_u_amplitude"])
    sine = np.sin(2 * np.pi * 0.2 * 2.0 + 0.3)
    assert run["x"][0] == pytest.approx(0.5 + 0.1 * sine)
    assert run.gradient("x")[0, 0] == pytest.approx(sine)


LATE = {
    "lag": {"T": 0.02},
    "delay": {"T": 0.02},
    "window-mean": {"T": 0.02},
    "sample-hold": {"Ts": 0.02, "compute": 0.005},
    "second-order": {"wn": 80.0, "zeta": 0.6},
    "inner-loop": {"wn": 80.0, "zeta": 0.6},
    "lead-lag": {"T1": 0.01, "T2": 0.03},
}
"""Values that show their delay better than those of the example."""


@pytest.mark.parametrize("name", [n for n, e in effects().items() if e.equivalent_delay is not None])
def test_how_late_a_slow_signal_comes(name: str) -> None:
    """Behind a ramp of slope 1 the effect's output lags by as much, on average over a sampling period."""
    late = effects()[name].equivalent_delay
    assert late is not None
    values = LATE.get(name, dict(effects()[name].example))
    time = np.linspace(0.0, 1.0, 2001)
    ramp = experiment("ramp", time, {"u": InputSignal.ramp(0.0, 0.0, 1.0, 1.0)})
    y = simulate(effect_model(EffectUse(name, ("u",), FrozenMap(values))), ramp)["y"]
    settled = (time > 0.6) & (time <= 0.8)  # ten sampling periods
    assert np.mean((time - y)[settled]) == pytest.approx(late(values), abs=3e-4)


def test_what_sat_behind_an_effect_sits_where_that_one_did_without_it():
    link = load_model("vsc-hvdc-link")
    first = EffectUse("inner-loop", ("Irorder1",), FrozenMap({"wn": 500.0, "zeta": 0.7}))
    behind = EffectUse("coupling", ("Irorder1_before_inner_loop",), FrozenMap({"k": 0.1}), source="P1")
    both = apply_effects(link, [first, behind])
    assert behind.within(both) == behind
    alone = behind.within(link)
    assert alone.at == ("Irorder1",) and alone.source == "P1"
    assert "Irorder1_before_coupling" in apply_effects(link, [alone]).signals
