"""Runs against answers in closed form."""

from __future__ import annotations

import pickle
from dataclasses import replace

import fmpy
import numpy as np
import pytest
from scipy.signal import lsim

from hvdc_ident import load_model, simulate
from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.fmu import Limits, read_fmu
from tests.fmu.c_fmu import build, needs_compiler
from tests.fmu.c_models import BALL, COUNTER, DECAY, FAULTY, TRIANGLE, response, spring

pytestmark = needs_compiler

TIME = np.linspace(0.0, 5.0, 251)
STEP = experiment("step", TIME, {"u": InputSignal.step(1.0, 0.0, 1.0)})
BOTH = ["model-exchange", "co-simulation"]
STEP_OF_FMPY = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (5.0, 1.0)], dtype=[("time", float), ("u", float)])


@pytest.mark.parametrize("interface", BOTH)
@pytest.mark.parametrize("version", [2, 3])
def test_the_step_response(fmu, version, interface):
    model = fmu(spring(), version, interface)
    found = simulate(model, STEP)
    assert np.abs(found["y"] - response(TIME)).max() < 2e-7
    moved = simulate(model, STEP, {"m": 1.0, "d": 0.2, "k": 9.0})
    assert np.abs(moved["y"] - response(TIME, 1.0, 0.2, 9.0)).max() < 2e-7
    assert np.array_equal(simulate(model, STEP)["y"], found["y"])


@pytest.mark.parametrize("version", [2, 3])
def test_what_is_taken_over(fmu, version):
    model = fmu(spring(), version)
    assert model.values == {"m": 2.0, "d": 0.5, "k": 8.0, "b": 0.25}  # k has no start: it is read from the FMU
    assert model.parameters["m"].min == 0.1 and model.parameters["m"].unit == "kg"
    assert model.parameters["k"].description == "(also stiffness)"
    assert list(model.states) == ["x", "v"] and model.states["x"].nominal == 1.0  # 0 as it is given
    assert model.insertion_points == ("u", "y", "twice")
    with pytest.raises(Exception, match="'stiffness' is another name of 'k'"):
        model.with_values({"stiffness": 1.0})


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("name", ["two-lag", "9 springs", "spring.1"])
def test_an_identifier_that_is_none_of_c_is_run_as_fmpy_runs_it(tmp_path, name, version):
    path = build(spring(name, own=False), tmp_path, version)
    free = {"stop_time": 5.0, "output_interval": 0.02, "input": STEP_OF_FMPY, "output": ["y"]}
    wanted = fmpy.simulate_fmu(str(path), validate=False, fmi_type="CoSimulation", **free)
    model = read_fmu(path, interface="co-simulation")
    found = simulate(model, STEP)["y"]
    model.pool.close()
    assert wanted["time"] == pytest.approx(TIME) and np.abs(found[51:] - wanted["y"][51:]).max() < 2e-7


@pytest.mark.parametrize("interface", BOTH)
def test_inputs_that_ramp_and_jump(fmu, interface):
    """Against scipy's linear simulation on a grid of the same lines."""
    model = fmu(spring(), 2, interface)
    corners = [(0.0, 0.5), (1.0, 0.5), (2.0, 1.5), (2.5, 1.5), (2.5, -0.5), (4.0, -0.5)]
    u = InputSignal.corners(corners)
    found = simulate(model, experiment("corners", TIME, {"u": u}))
    a, b = np.array([[0.0, 1.0], [-4.0, -0.25]]), np.array([[0.0], [4.0]])
    state, rows = np.array([0.5, 0.0]), np.empty(TIME.size)
    rows[0] = 0.5
    for i in range(1, TIME.size):  # a jump lies on a row: each interval has one line
        ends = np.array([u(TIME[i - 1]), u(np.nextafter(TIME[i], 0))], dtype=float)
        state = lsim((a, b, np.eye(2), np.zeros((2, 1))), ends[:, None], TIME[i - 1 : i + 1] - TIME[i - 1], state)[2][
            -1
        ]
        rows[i] = state[0]
    assert np.abs(found["y"] - rows).max() < (1e-7 if interface == "model-exchange" else 1e-4)


@pytest.mark.parametrize("interface", BOTH)
def test_two_rows_at_one_instant_are_before_and_after_a_jump(fmu, interface):
    model = fmu(FAULTY, 2, interface)
    time = np.array([0.0, 0.1, 0.1, 0.3])
    u = InputSignal.step(0.1, 0.0, 1.0)
    found = simulate(model, experiment("jump", time, {"u": u}), outputs=["out"])
    assert found["out"] == pytest.approx([0.0, 0.0, 0.0, 1 - np.exp(-2.0)], abs=1e-6)
    start = simulate(model, experiment("at once", np.array([0.1, 0.2]), {"u": u}))
    assert start["out"] == pytest.approx([0.0, 1 - np.exp(-1.0)], abs=1e-6)  # begins as before the jump


@pytest.mark.parametrize("version", [2, 3])
def test_a_ball_bounces(fmu, version):
    time = np.linspace(0.0, 2.0, 401)
    found = simulate(fmu(BALL, version, "model-exchange"), experiment("fall", time))
    t, v, begin, expected = np.sqrt(2 / 9.81), np.sqrt(2 * 9.81), None, np.empty(time.size)
    expected[time <= t] = 1 - 9.81 / 2 * time[time <= t] ** 2
    while t < time[-1]:
        begin, v = t, 0.7 * v
        t = begin + 2 * v / 9.81
        fly = (time > begin) & (time <= t)
        expected[fly] = v * (time[fly] - begin) - 9.81 / 2 * (time[fly] - begin) ** 2
    assert np.abs(found["height"] - expected).max() < 1e-8
    assert found.statistics.events >= 4


def test_five_hundred_events(fmu):
    time = np.linspace(0.0, 1000.0, 2001)
    found = simulate(fmu(TRIANGLE, 2, "model-exchange"), experiment("long", time))
    assert np.abs(found["y"] - 2 / np.pi * np.arcsin(np.sin(np.pi / 2 * time))).max() < 1e-9
    assert found.statistics.events == 500


@pytest.mark.parametrize("version", [2, 3])
def test_time_events_without_a_state(fmu, version):
    time = np.array([0.0, 0.1, 0.25, 0.6, 1.0, 1.1])
    model = fmu(COUNTER, version)
    assert simulate(model, experiment("count", time))["count"].tolist() == [0, 0, 1, 2, 4, 4]
    assert simulate(model, experiment("count", time), {"period": 0.5})["count"].tolist() == [0, 0, 0, 1, 2, 2]


def test_a_point_that_the_fmu_discards_asks_for_shorter_steps(fmu):
    """It takes no point beyond 0.05 s from where the last step was completed."""
    code = "#define AT_SLOPES(r) do { if (M->t > r[5] + 0.05) return 2; } while (0)\n#define STEP_EVENT(r) (r[5] = M->t, 0)\n"
    careful = replace(DECAY, name="careful", code=DECAY.code.replace("#define NR 4", "#define NR 8") + code)
    time = np.linspace(0.0, 10.0, 51)
    found = simulate(fmu(careful, 2, "model-exchange"), experiment("decay", time))
    assert np.abs(found["y"] - np.exp(-time)).max() < 1e-6
    assert 200 <= found.statistics.accepted < 20_000


def test_a_nominal_of_zero_is_floored(fmu):
    found = simulate(fmu(spring("nothing", nominal="0.0"), 2, "model-exchange"), STEP)
    assert np.abs(found["y"] - response(TIME)).max() < 2e-7


def test_a_worker_is_replaced_when_it_is_old_and_results_do_not_change(tmp_path):
    model = read_fmu(build(FAULTY, tmp_path), interface="co-simulation", limits=Limits(runs=3))
    rows, processes = [], []
    for _ in range(7):
        model.pool.cache.clear()  # the last runs are not run again
        rows.append(simulate(model, experiment("s", TIME))["out"])
        processes.append(model.pool._processes.workers[0].process)
    assert model.pool.started == 3 and all(np.array_equal(r, rows[0]) for r in rows)
    assert len({p.guard.pid for p in processes}) == 1, "a replaced worker begins where everything is imported already"


def test_a_model_travels_without_its_worker(fmu):
    model = fmu(spring())
    here = simulate(model, STEP)["y"]
    there = pickle.loads(pickle.dumps(model))
    assert there.pool._processes is None
    assert np.array_equal(simulate(there, STEP)["y"], here)
    there.pool.close()


def test_an_instance_that_forgets_to_reset_is_made_anew(tmp_path):
    """Its reset leaves the parameters as they were set."""
    lazy = replace(spring("lazy"), code=spring().code + "#define AT_RESET return 0\n")
    model = load_model(build(lazy, tmp_path))
    for values in ({"k": 20.0}, {}, {"k": 20.0}, {}):
        k = values.get("k", 8.0)
        assert np.abs(simulate(model, STEP, values)["y"] - response(TIME, k=k)).max() < 2e-7
    model.pool.close()


def test_five_hundred_runs_leave_nothing_behind(fmu):
    model = read_fmu(fmu(FAULTY, 2, "co-simulation").fmu.path, interface="co-simulation")
    run = experiment("s", np.linspace(0.0, 0.2, 21), {"u": InputSignal.step(0.1, 0.0, 1.0)})
    sizes = []
    for k in range(500):
        simulate(model, run, {"T": 0.05 + 1e-4 * k})
        sizes.append(model.pool.memory)
    assert model.pool.started == 1
    assert sizes[-1] - sizes[49] < 2**20
    model.pool.close()
