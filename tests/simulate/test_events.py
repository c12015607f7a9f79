"""Switches, jumps, delays, samples and statuses against answers worked out by hand."""

import numpy as np
import pytest
import sympy as sp

from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.errors import SimulationError, SteadyStateError
from hvdc_ident.model import Delay, Model, Sampled, State
from hvdc_ident.simulate import Tolerance, simulate

u, x, T, Ts, c = sp.symbols("u x T Ts c")
TIGHT = {"rtol": 1e-10}
METHODS = ("explicit", "rosenbrock")


@pytest.mark.parametrize("method", METHODS)
def test_a_jump_of_the_right_hand_side_jumps_the_sensitivities(method):
    """x' = a below lim, b above: x = lim + b (t - lim/a), dx/dlim = 1 - b/a, dx/da = b lim / a^2."""
    model = Model(
        "jump",
        parameters={"a": 1.2, "b": 0.4, "lim": 0.7},
        states={"x": State("where(x < lim, a, b)", start=0)},
        outputs={"x": "x"},
    )
    run = experiment("jump", np.linspace(0, 2, 41))
    result = simulate(model, run, sensitivities=("a", "b", "lim"), method=method, **TIGHT)
    t = run.time
    after = t > 0.7 / 1.2
    np.testing.assert_allclose(result["x"], np.where(after, 0.7 + 0.4 * (t - 0.7 / 1.2), 1.2 * t), atol=1e-9)
    slopes = np.column_stack(
        [np.where(after, 0.4 * 0.7 / 1.2**2, t), np.where(after, t - 0.7 / 1.2, 0), np.where(after, 1 - 0.4 / 1.2, 0)]
    )
    np.testing.assert_allclose(result.gradient("x"), slopes, atol=1e-8)
    assert result.statistics.events == 1


@pytest.mark.parametrize("method", METHODS)
def test_a_kink_is_located(method):
    """x' = clip(t, 0, 1/2)."""
    model = Model(
        "kink", parameters={"top": 0.5}, states={"x": State("clip(time, 0, top)", start=0)}, outputs={"x": "x"}
    )
    run = experiment("kink", np.linspace(0, 1, 21))
    result = simulate(model, run, sensitivities=("top",), method=method, **TIGHT)
    t = run.time
    np.testing.assert_allclose(result["x"], np.where(t < 0.5, t**2 / 2, 0.125 + (t - 0.5) / 2), atol=1e-10)
    np.testing.assert_allclose(result.gradient("x")[:, 0], np.clip(t - 0.5, 0, None), atol=1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_a_delay_follows_the_method_of_steps(method):
    """x' = u - x(t - T), a step of u from 0 to 1 at 0: 1 - t ... in pieces of length T."""
    model = Model(
        "dde",
        parameters={"T": 0.5},
        inputs={"u": 0.0},
        states={"x": "u - xd"},
        delays={"xd": Delay(x, T)},
        outputs={"x": "x"},
    )
    run = experiment("dde", np.linspace(0, 1.5, 31)[1:], {"u": InputSignal.step(0.0, 0.0, 1.0)})
    start = experiment("dde", np.concatenate([[-0.1], run.time]), run.inputs)
    result = simulate(model, start, sensitivities=("T",), method=method, **TIGHT)
    t = run.time

    def piece(k, power):
        return np.clip(t - 0.5 * k, 0, None) ** power

    np.testing.assert_allclose(result["x"][1:], t - piece(1, 2) / 2 + piece(2, 3) / 6, atol=1e-9)
    np.testing.assert_allclose(result.gradient("x")[1:, 0], piece(1, 1) - 2 * piece(2, 2) / 2, atol=1e-8)


@pytest.mark.parametrize("method", METHODS)
def test_a_delayed_step_moves_with_the_delay(method):
    """x' = u(t - T) - x after a unit step at 0.2: x = 1 - exp(-(t - 0.2 - T)), dx/dT = -exp(...)."""
    model = Model(
        "late",
        parameters={"T": 0.31},
        inputs={"u": 0.0},
        states={"x": "ud - x"},
        delays={"ud": Delay(u, T)},
        outputs={"x": "x"},
    )
    run = experiment("late", np.linspace(0, 2, 21), {"u": InputSignal.step(0.2, 0.0, 1.0)})
    result = simulate(model, run, sensitivities=("T",), method=method, **TIGHT)
    s = run.time - 0.51
    np.testing.assert_allclose(result["x"], np.where(s > 0, 1 - np.exp(-np.abs(s)), 0), atol=1e-9)
    np.testing.assert_allclose(result.gradient("x")[:, 0], np.where(s > 0, -np.exp(-np.abs(s)), 0), atol=1e-8)


@pytest.mark.parametrize("compute", [0.03, 0.1])
@pytest.mark.parametrize("method", METHODS)
def test_a_sampled_ramp_is_a_staircase(method, compute):
    """q holds u = t of the last sample, published c later, be it the whole period: x' = q."""
    model = Model(
        "held",
        parameters={"Ts": 0.1, "c": compute},
        inputs={"u": 0.0},
        states={"x": State("q", start=0)},
        sampled={"q": Sampled(u, Ts, c)},
        outputs={"x": "x", "q": "q"},
    )
    run = experiment("held", np.linspace(0.005, 0.995, 100), {"u": InputSignal.ramp(0.0, 0.0, 2.0, 2.0)})
    start = experiment("held", np.concatenate([[0.0], run.time]), run.inputs)
    result = simulate(model, start, sensitivities=("Ts", "c"), method=method, **TIGHT)
    count = np.floor((run.time - compute) / 0.1 + 1e-9).clip(0)
    np.testing.assert_allclose(result["q"][1:], 0.1 * count, atol=1e-12)

    def area(period, compute):
        ends = [np.clip(run.time - (k * period + compute), 0, None) * period for k in range(1, 12)]
        return np.sum(ends, axis=0)

    np.testing.assert_allclose(result["x"][1:], area(0.1, compute), atol=1e-9)
    h = 1e-6
    for k, (a, b) in enumerate((((0.1 + h, compute), (0.1 - h, compute)), ((0.1, compute + h), (0.1, compute - h)))):
        np.testing.assert_allclose(result.gradient("x")[1:, k], (area(*a) - area(*b)) / 2 / h, atol=1e-8)


@pytest.mark.parametrize("period", [0.1, 0.07, 1 / 3])
def test_a_sample_is_taken_before_what_is_published_at_its_instant(period):
    """q adds u = 1 to itself and shows it a whole period later: each sample sees the sum of two before, u every second time."""
    model = Model(
        "sum",
        parameters={"Ts": period},
        inputs={"u": 0.0},
        states={"x": State("-x", start=0)},
        sampled={"q": Sampled(sp.Symbol("q") + u, Ts, Ts)},
        outputs={"q": "q"},
    )
    middle = period * (np.arange(40) + 0.5)
    run = experiment("sum", np.concatenate([[0.0], middle]), {"u": InputSignal.step(0.25 * period, 0.0, 1.0)})
    # Samples 1, 3, 5 ... and 2, 4, 6 ... are two sums that know nothing of each other: 1, 1, 2, 2, 3, 3 ... from sample 1 on.
    np.testing.assert_allclose(simulate(model, run)["q"][1:], np.arange(40) // 2, atol=1e-12)


def test_both_methods_and_a_closed_form_agree_on_an_oscillator():
    model = Model(
        "osc",
        parameters={"w": 9.0, "z": 0.05},
        states={"x": State("v", start=1), "v": State("-w**2*x - 2*z*w*v", start=0)},
        outputs={"x": "x"},
    )
    run = experiment("osc", np.linspace(0, 2, 201))
    w, z, t = sp.symbols("w z t", positive=True)
    wd = w * sp.sqrt(1 - z**2)
    closed = sp.exp(-z * w * t) * (sp.cos(wd * t) + z * w / wd * sp.sin(wd * t))
    forms = [sp.lambdify(t, e.subs({w: 9.0, z: 0.05})) for e in (closed, sp.diff(closed, w), sp.diff(closed, z))]
    for method in METHODS:
        result = simulate(model, run, sensitivities=("w", "z"), method=method, rtol=1e-9)
        assert result.statistics.method == method
        for found, form in zip((result["x"], *result.gradient("x").T), forms, strict=True):
            np.testing.assert_allclose(found, form(run.time), atol=1e-7 * max(1.0, np.abs(found).max()))


def test_two_rows_at_a_jump_are_before_and_after():
    model = Model("through", inputs={"u": 0.0}, outputs={"y": "2*u"}, parameters={})
    times = [0.0, 0.5, 0.5, 1.0]
    run = experiment("two", times, {"u": InputSignal.step(0.5, 1.0, 3.0)})
    np.testing.assert_array_equal(simulate(model, run)["y"], [2.0, 2.0, 6.0, 6.0])
    one = experiment("one", [0.0, 0.5, 1.0], {"u": InputSignal.step(0.5, 1.0, 3.0)})
    np.testing.assert_array_equal(simulate(model, one)["y"], [2.0, 6.0, 6.0])


def test_a_steady_start_depends_on_the_parameters():
    """0 = r - k x^3: x = (r/k)^(1/3)."""
    model = Model("rest", parameters={"k": 2.0}, inputs={"r": 5.0}, states={"x": "r - k*x**3"}, outputs={"x": "x"})
    result = simulate(model, experiment("rest", [0.0, 1.0]), sensitivities=("k",), **TIGHT)
    np.testing.assert_allclose(result["x"], (5 / 2) ** (1 / 3), rtol=1e-12)
    np.testing.assert_allclose(result.gradient("x")[:, 0], -((5 / 2) ** (1 / 3)) / 6, rtol=1e-9)


@pytest.mark.parametrize(
    ("derivative", "start", "status"),
    [("x**2", 1, "not-finite"), ("sin(1e5*time)", 0, "step-limit")],
)
def test_every_failure_has_a_name(derivative, start, status):
    model = Model("fails", states={"x": State(derivative, start=start)}, outputs={"x": "x"}, parameters={})
    with pytest.raises(SimulationError, match=status) as error:
        simulate(model, experiment("f", np.linspace(0, 2, 11)), tolerance=Tolerance(max_steps=2000))
    assert "t = " in str(error.value) and "Try:" in str(error.value)


def test_no_steady_state_names_the_worst_equation():
    model = Model("none", parameters={"a": 1.0}, states={"x": "a + x**2", "y": "x - y"}, outputs={"x": "x"})
    with pytest.raises(SteadyStateError, match=r"d\(x\)/dt"):
        simulate(model, experiment("none", [0.0, 1.0]))


def test_a_current_limit_closed_by_the_other_axis_is_passed():
    """sqrt(1.1^2 - i^2) has an infinite slope where i meets its limit; the run goes on and says so."""
    from hvdc_ident.models import load_model

    steps = {
        "Pref2": InputSignal.corners([(0.1, 0.4), (0.1, 1.3), (0.3, 1.3), (0.3, 0.4)]),
        "Qref1": InputSignal.step(0.15, 0.0, 0.7),
    }
    result = simulate(
        load_model("vsc-hvdc-link"),
        experiment("deep", np.linspace(0, 0.6, 61), steps),
        {"KPP": 0.2, "KPQ": 0.3},
        ("KIP",),
    )
    assert result["Irorder2"].max() == pytest.approx(1.1) and result.statistics.forced < 50
    assert np.isfinite(result.gradients).all()


@pytest.mark.parametrize("condition", ["time > at", "clock > at"])
def test_a_switch_seen_through_a_delay_alone_moves_what_comes_after_it(condition):
    """x' = (t > at + T) - x: x = 1 - exp(-(t - at - T)), with the same derivative by the instant as by the delay."""
    model = Model(
        "late-switch",
        parameters={"at": 0.305, "T": 0.2},
        states={"clock": State(1, start=0), "x": "late - x"},
        delays={"late": {"of": f"where({condition}, 1, 0)", "time": "T"}},
        outputs={"x": "x"},
    )
    time = np.linspace(0.0, 2.0, 101)
    result = simulate(model, experiment("late", time), sensitivities=("at", "T"))
    since = np.maximum(time - 0.505, 0.0)
    slope = np.where(since > 0, -np.exp(-since), 0.0)
    np.testing.assert_allclose(result["x"], 1.0 - np.exp(-since), atol=1e-8)
    np.testing.assert_allclose(result.gradients[:, 0], np.column_stack([slope, slope]), atol=1e-7)


def test_many_structures_leave_no_memory_behind():
    import gc
    import resource

    from hvdc_ident.simulate import Engine

    def build(count):
        for k in range(count):
            Engine(Model(f"m{k}", parameters={"a": 1.0}, states={"x": f"-a*x + {k}"}, outputs={"x": "x"}), ("a",))
        gc.collect()
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    before = build(60)
    assert build(120) - before < 6_000  # KiB: an engine that stays would cost 100 KiB or more


def test_the_other_side_of_a_switch_need_not_be_defined():
    model = Model("m", states={"x": State("where(x > 0, x**0.3, 0) - (x + 1)", start=-2)}, outputs={"x": "x"})
    run = experiment("root", np.linspace(0, 1, 5))
    np.testing.assert_allclose(simulate(model, run, **TIGHT)["x"], -1 - np.exp(-run.time), atol=1e-9)
