"""Parameters that set the instant of a jump: derivatives across it, and searches and intervals between the rows of a record."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import hvdc_ident as hi
from hvdc_ident.fit import FitParameter, Problem
from hvdc_ident.fit.jump_instants import moving_parameters, stretch
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.simulate import ModelSimulator

METHODS = ("explicit", "rosenbrock")


def breaker():
    """A coil of L at 1 V through R; a breaker opens at t0 and leaves R + Rarc: the current goes on, its slope jumps."""
    return hi.Model(
        "breaker",
        parameters={"t0": 0.305, "R": 1.0, "Rarc": 2.0, "L": 0.2},
        states={"i": "(1 - (R + where(time < t0, 0, Rarc))*i)/L"},
        outputs={"i": "i"},
    )


def pulse():
    """An RC circuit at a source that is switched on at t1 and off at t2; the current jumps at both."""
    return hi.Model(
        "pulse",
        parameters={"t1": 0.203, "t2": 0.507, "R": 2.0, "C": 0.05},
        signals={"source": "where(time > t1, 1, 0) - where(time > t2, 1, 0)", "i": "(source - v)/R"},
        states={"v": "i/C"},
        outputs={"v": "v", "i": "i"},
    )


def pulse_current(time, t1, t2, R, C):
    """exp(-(t - t1)/RC)/R from t1 on, less the same from t2 on."""
    after = [np.where(time > t, np.exp(-np.maximum(time - t, 0.0) / (R * C)), 0.0) / R for t in (t1, t2)]
    return after[0] - after[1]


def control():
    """A current controller with a PI law whose order steps at t0: its voltage jumps, the current has a corner."""
    return hi.Model(
        "control",
        parameters={"t0": 0.1, "kp": 3.0, "ki": 40.0, "L": 0.1, "R": 0.5},
        inputs={"order": 0.4},
        signals={"wanted": "order + where(time > t0, 0.3, 0)", "v": "kp*(wanted - i) + x"},
        states={"i": "(v - R*i)/L", "x": "ki*(wanted - i)"},
        outputs={"i": "i", "v": "v"},
    )


def control_run(time, t0, kp=3.0, ki=40.0, L=0.1, R=0.5):
    """(i, v) by SciPy, integrated in two parts with the order constant in each."""

    def part(order, start, span, at):
        def right(t, y):
            return [(kp * (order - y[0]) + y[1] - R * y[0]) / L, ki * (order - y[0])]

        return solve_ivp(right, span, start, t_eval=at, rtol=1e-12, atol=1e-14, method="DOP853").y

    rest = [0.4, 0.4 * R]
    inside = time > t0
    i = np.concatenate([np.full((~inside).sum(), 0.4), part(0.7, rest, (t0, time[-1]), time[inside])[0]])
    x = np.concatenate([np.full((~inside).sum(), rest[1]), part(0.7, rest, (t0, time[-1]), time[inside])[1]])
    return i, kp * (np.where(inside, 0.7, 0.4) - i) + x


@pytest.mark.parametrize("method", METHODS)
def test_a_continuous_state_jumps_in_its_sensitivity_where_its_slope_jumps(method):
    time = np.linspace(0.0, 1.0, 101)
    run = hi.simulate(breaker(), time, sensitivities=("t0", "Rarc"), method=method)
    since = np.maximum(time - 0.305, 0.0)
    left = np.exp(-15.0 * since)
    np.testing.assert_allclose(run["i"], (1.0 + 2.0 * left) / 3.0, atol=1e-8)
    by_t0 = np.where(since > 0, 10.0 * left, 0.0)
    by_arc = -(1.0 - left) / 9.0 - 10.0 / 3.0 * since * left
    np.testing.assert_allclose(run.gradient("i"), np.column_stack([by_t0, by_arc]), atol=1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_two_switchings_of_a_circuit_are_differentiated_each(method):
    time = np.linspace(0.0, 1.0, 100)
    run = hi.simulate(pulse(), time, sensitivities=("t1", "t2", "R", "C"), method=method)
    at, h = np.array([0.203, 0.507, 2.0, 0.05]), 1e-6
    columns = [(pulse_current(time, *(at + h * e)) - pulse_current(time, *(at - h * e))) / (2 * h) for e in np.eye(4)]
    np.testing.assert_allclose(run["i"], pulse_current(time, *at), atol=1e-8)
    np.testing.assert_allclose(run.gradient("i"), np.column_stack(columns), atol=1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_the_instant_of_a_step_of_an_order_is_differentiated_through_the_control(method):
    time = np.linspace(0.0, 0.5, 98)
    run = hi.simulate(control(), time, sensitivities=("t0",), method=method)
    h = 1e-6
    beside = [control_run(time, 0.1 + d) for d in (-h, h)]
    for output, k in (("i", 0), ("v", 1)):
        np.testing.assert_allclose(run[output], control_run(time, 0.1)[k], atol=1e-8)
        np.testing.assert_allclose(run.gradient(output)[:, 0], (beside[1][k] - beside[0][k]) / (2 * h), atol=2e-5)


# --- searches and intervals ---


def decay(power="A*exp(-k*(time - t0))", **t0):
    return hi.Model(
        "decay",
        parameters={
            "t0": {"value": 4.0, "min": 0.0, "max": 30.0, "unit": "s", **t0},
            "k": {"value": 0.2, "min": 1e-3, "max": 2.0},
            "A": {"value": 0.7, "min": 0.1, "max": 10.0},
        },
        outputs={"y": f"where(time < t0, 0, {power})"},
    )


ROWS = np.arange(0.0, 30.0, 0.4)


def decay_record(t0=11.13, k=0.07, A=1.6):
    y = np.where(t0 > ROWS, 0.0, A * np.exp(-k * (ROWS - t0))) + 0.01 * np.random.default_rng(8).standard_normal(
        ROWS.size
    )
    return hi.Experiment(ROWS, outputs={"y": y}, noise={"y": 0.01}, role="fit")


def problem_of(model, record, names):
    free = [FitParameter.of(n, model.parameters[n]) for n in names]
    return Problem(ModelSimulator(model), (record,), tuple(free), held=FrozenMap())


def test_the_parameters_that_move_jumps_of_the_outputs_are_known():
    decaying = problem_of(decay(), decay_record(), ("t0", "k", "A"))
    assert moving_parameters(decaying) == ("t0",)
    assert stretch(decaying, np.array([11.13, 0.07, 1.6]), 0) == pytest.approx((10.8, 11.2))
    coil = hi.Experiment(ROWS, outputs={"i": 0.0 * ROWS}, noise={"i": 0.01}, role="fit")
    assert moving_parameters(problem_of(breaker(), coil, ("t0", "R"))) == ()  # its current has no jump
    circuit = hi.Experiment(ROWS, outputs={"i": 0.0 * ROWS}, noise={"i": 0.01}, role="fit")
    assert moving_parameters(problem_of(pulse(), circuit, ("t1", "R", "t2"))) == ("t1", "t2")


@pytest.mark.parametrize("start", [4.0, 11.0, 27.0])
def test_the_begin_of_a_decay_is_found_between_two_rows_from_anywhere(start):
    found = hi.fit(decay(value=start), decay_record(), ["t0", "k", "A"])
    estimates = found.estimates
    assert found.status == "converged" and found.adequacy.verdict == "fits"
    assert estimates["t0"].ci95 == pytest.approx((10.8, 11.2)) and estimates["t0"].value == pytest.approx(11.0)
    # A at t0 anywhere between the rows: what the records tell is A exp(k t0).
    low, high = estimates["A"].ci95
    assert low < 1.6 * np.exp(-0.07 * 0.07) and 1.6 * np.exp(0.07 * 0.33) < high and high - low < 0.1
    low, high = estimates["k"].ci95
    assert low < 0.07 < high and high - low < 0.003


def test_the_begin_of_a_decay_is_judged_by_the_rows_on_either_side():
    report = hi.identify(decay(), decay_record(), ["t0", "k", "A"])
    t0, scale = report.parameters["t0"], report.parameters["A"]
    assert report.identifiable == ("t0", "k", "A") and t0.verdict == "identifiable"
    assert t0.ci95 == pytest.approx((10.8, 11.2))
    assert "passes a row, at 10.8 and at 11.2" in t0.reason
    low, high = scale.ci95
    assert low < 1.6 * np.exp(-0.07 * 0.07) and 1.6 * np.exp(0.07 * 0.33) < high and high - low < 0.1


def test_an_instant_that_the_slope_after_it_tells_is_known_better_than_the_rows():
    """y = B + A (t - t0) from t0 on, with B known: A t0 shows in the level, to about 2 noise/(A sqrt(rows))."""
    model = decay("2 + A*(time - t0)")
    y = np.where(ROWS < 11.13, 0.0, 2.0 + 0.5 * (ROWS - 11.13)) + 0.01 * np.random.default_rng(3).standard_normal(
        ROWS.size
    )
    found = hi.fit(model, hi.Experiment(ROWS, outputs={"y": y}, noise={"y": 0.01}), ["t0", "A"])
    low, high = found.estimates["t0"].ci95
    since = ROWS[ROWS > 11.13] - 11.13
    columns = np.column_stack([np.full(since.size, -0.5), since]) / 0.01
    std = float(np.sqrt(np.linalg.inv(columns.T @ columns)[0, 0]))
    assert low < 11.13 < high and high - low == pytest.approx(2 * 1.96 * std, rel=0.05)


def test_the_begin_of_a_ramp_is_no_jump_and_is_judged_like_any_parameter():
    """y = A (t - t0) from t0 on: the derivative by t0 is -A there, and all is smooth."""
    model = decay("A*(time - t0)")
    y = np.where(ROWS < 11.13, 0.0, 0.5 * (ROWS - 11.13)) + 0.01 * np.random.default_rng(3).standard_normal(ROWS.size)
    report = hi.identify(model, hi.Experiment(ROWS, outputs={"y": y}, noise={"y": 0.01}), ["t0", "A"])
    verdict = report.parameters["t0"]
    low, high = verdict.ci95
    since = ROWS[ROWS > 11.13] - 11.13
    columns = np.column_stack([np.full(since.size, -0.5), since]) / 0.01
    std = float(np.sqrt(np.linalg.inv(columns.T @ columns)[0, 0]))
    assert verdict.verdict == "identifiable" and "row" not in verdict.reason
    assert low < 11.13 < high and high - low == pytest.approx(2 * 1.96 * std, rel=0.1)


def test_a_jump_that_the_noise_hides_leaves_the_instant_to_the_other_verdicts():
    y = 0.01 * np.random.default_rng(5).standard_normal(ROWS.size)
    model = hi.Model(
        "faint",
        parameters={"t0": {"value": 4.0, "min": 0.0, "max": 30.0}, "c": 1.0},
        outputs={"y": "0.001*where(time < t0, 0, 1) + c - 1"},
    )
    record = hi.Experiment(ROWS, outputs={"y": y}, noise={"y": 0.01})
    report = hi.identify(model, record, {"t0": {}, "c": (0.0, 2.0)})
    assert report.parameters["t0"].verdict == "insensitive" and report.identifiable == ("c",)


def test_two_switchings_are_found_together():
    time = np.arange(0.0, 1.0, 0.01)
    at = {"t1": 0.634, "t2": 0.787, "R": 1.5, "C": 0.08}
    current = pulse_current(time, **at) + 0.005 * np.random.default_rng(2).standard_normal(time.size)
    record = hi.Experiment(time, outputs={"i": current}, noise={"i": 0.005})
    found = hi.fit(pulse(), record, {"t1": (0.0, 1.0), "t2": (0.0, 1.0), "R": (0.5, 5.0), "C": (0.01, 0.5)})
    for name, value in at.items():
        low, high = found.estimates[name].ci95
        assert low < value < high
    assert found.adequacy.verdict == "fits"
    for name in ("t1", "t2"):
        low, high = found.estimates[name].ci95
        assert high - low < 0.0101


def test_a_delay_of_a_jump_that_is_recorded_itself_lies_between_rows():
    model = hi.Model(
        "wire",
        parameters={"T": {"value": 0.5, "unit": "s"}, "gain": 1.0},
        inputs={"u": 0.0},
        outputs={"y": "gain*late"},
        delays={"late": {"of": "u", "time": "T"}},
    )
    y = 1.2 * (ROWS >= 5.0 + 7.3) + 0.01 * np.random.default_rng(6).standard_normal(ROWS.size)
    record = hi.Experiment(ROWS, inputs={"u": hi.step(0.0, 1.0, at=5.0)}, outputs={"y": y}, noise={"y": 0.01})
    found = hi.fit(model, record, {"T": (0.0, 20.0), "gain": (0.1, 5.0)})
    assert found.estimates["T"].ci95 == pytest.approx((7.0, 7.4))
    low, high = found.estimates["gain"].ci95
    assert low < 1.2 < high and high - low < 0.01


def test_the_stretches_follow_an_instant_through_an_expression_beside_switches_of_states():
    """The output steps at 3/f, and is clipped where the state is."""
    model = hi.Model(
        "clipped",
        parameters={"f": {"value": 0.5, "min": 0.2, "max": 2.0}, "top": 0.4},
        states={"x": "where(f*time > 3, 1, 0) - x"},
        outputs={"y": "clip(x, -top, top) + where(f*time > 3, 1, 0)"},
    )
    record = hi.Experiment(ROWS, outputs={"y": 0.0 * ROWS}, noise={"y": 0.01}, role="fit")
    problem = problem_of(model, record, ("f", "top"))
    assert moving_parameters(problem) == ("f",)
    assert stretch(problem, np.array([0.5, 0.4]), 0) == pytest.approx((3.0 / 6.4, 0.5), rel=1e-9)
    assert stretch(problem, np.array([0.51, 0.4]), 0) == pytest.approx((0.5, 3.0 / 5.6), rel=1e-9)
