"""The first use of an FMU: how it is begun again, and which of its derivatives a whole run confirms."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest

from hvdc_ident import simulate
from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.errors import SimulationError
from hvdc_ident.fmu import at_point, read_fmu
from tests.fmu.c_fmu import build, needs_compiler
from tests.fmu.c_models import CLOCK, begun, response, spring
from tests.fmu.fmu_limits import PATIENT

pytestmark = needs_compiler

BOTH = ["model-exchange", "co-simulation"]
TIME = np.linspace(0.0, 0.5, 51)
FREE = experiment("free", TIME)
STEP = experiment("step", np.linspace(0.0, 5.0, 251), {"u": InputSignal.step(1.0, 0.0, 1.0)})
FROZEN = ("AT_RESET frozen = 1", "AT_INSTANTIATE frozen = 0")
"""A reset that brings the values at the start back, and a second run in which nothing moves."""


@pytest.mark.parametrize("interface", BOTH)
@pytest.mark.parametrize(
    ("way", "model", "note"),
    [
        ("reset", begun("plain"), None),
        ("reset", begun("timed", more=(CLOCK,)), None),  # an output that no two runs repeat judges nothing
        ("reset", begun("ended", "AT_TERMINATE ended = 1", "AT_RESET if (!ended--) return 3"), None),
        ("instance", begun("frozen", *FROZEN), "each run has a new instance"),
        ("instance", begun("refusing", "AT_RESET return 3"), "each run has a new instance"),
        ("instance", begun("fatal", "AT_RESET abort()"), "each run has a new instance"),
        ("process", begun("spoilt", "SPOILT 0.1"), "each run has a new process"),
        ("process", begun("slight", "SPOILT 1e-5"), "each run has a new process"),
        ("process", begun("both", *FROZEN, "SPOILT 0.1", more=(CLOCK,)), "each run has a new process"),
    ],
    ids=lambda x: getattr(x, "name", None),
)
def test_the_cheapest_restart_that_repeats_a_run_is_taken(tmp_path, way, model, note, interface):
    """Runs at other values between equal ones, each against the closed form."""
    found = read_fmu(build(model, tmp_path), interface=interface, limits=PATIENT)
    for lag in (0.1, 0.05, 0.1, 0.1):
        run = simulate(found, FREE, {"T": lag}, outputs=["out"])
        assert np.abs(run["out"] - np.exp(-TIME / lag)).max() < 1e-6
        assert found.pool.learned["restart"] == way and (note or "") in run.notes.get("restart", "")
    moved = simulate(found, FREE, {"T": 0.1}, ["T"], outputs=["out"])
    assert np.abs(moved.gradient("out")[:, 0] - TIME / 0.01 * np.exp(-TIME / 0.1)).max() < 2e-3
    assert found.pool.started == 1
    there = pickle.loads(pickle.dumps(found))
    assert there.pool.learned["restart"] == way  # nobody tries it a second time
    found.pool.close()


@pytest.mark.parametrize("interface", BOTH)
@pytest.mark.parametrize(
    ("way", "model"),
    [
        ("instance", begun("waiting", "AT_RESET for (;;)")),
        ("process", begun("stuck", "SPOILT ({ while (runs > 1 && r[0] < 0.5); 0.0; })")),
        ("process", begun("stuck-at-once", "INITIALIZE(r) if (runs++) for (;;)")),
    ],
    ids=lambda x: getattr(x, "name", x),
)
def test_a_trial_that_hangs_fails_no_run(tmp_path, way, model, interface):
    """Where a reset, or each further run of a process, hangs, the next way is tried, against the closed form."""
    found = read_fmu(build(model, tmp_path), interface=interface, limits=replace(PATIENT, deadline=8.0))
    for lag in (0.1, 0.05, 0.1):
        run = simulate(found, FREE, {"T": lag}, outputs=["out"])
        assert np.abs(run["out"] - np.exp(-TIME / lag)).max() < 1e-6
        assert found.pool.learned["restart"] == way
    assert found.pool.started == 1
    found.pool.close()


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("interface", BOTH)
def test_an_fmu_that_takes_its_input_from_the_initialization_on_is_given_it_there(tmp_path, interface, version):
    picky = "AT_SET(r, v, x) do { if (v == 3 && r[6] == 0) return 3; } while (0)"
    model = begun("picky", picky, "AT_ENTER(r) (r[6] = 1)")
    found = read_fmu(build(model, tmp_path, version), interface=interface, limits=PATIENT)
    held = FREE.with_(inputs={"u": InputSignal.constant(0.5)})
    assert np.abs(simulate(found, held, outputs=["out"])["out"] - 0.5 * (1.0 + np.exp(-TIME / 0.1))).max() < 1e-6
    found.pool.close()


def test_a_run_at_rest_does_not_judge_a_reset(tmp_path):
    """At 0 with no input the frozen lag repeats itself: an input that moves tells it."""
    model = begun("rest", "INITIALIZE(r) (r[0] = 0)", *FROZEN)
    found = read_fmu(build(model, tmp_path), interface="co-simulation", limits=PATIENT)
    assert np.abs(simulate(found, FREE)["out"]).max() == 0.0
    assert found.pool.learned["restart"] == "instance"
    step = experiment("step", TIME, {"u": InputSignal.step(0.1, 0.0, 1.0)})
    wanted = np.where(TIME < 0.1, 0.0, 1.0 - np.exp(-(TIME - 0.1) / 0.1))
    assert np.abs(simulate(found, step)["out"] - wanted).max() < 1e-6
    found.pool.close()


def test_outputs_that_are_small_judge_a_reset_by_their_size(tmp_path):
    spoilt = begun("small", "SPOILT 0.1")
    small = replace(spoilt, code=spoilt.code.replace("r[0] = 1;", "r[0] = 1e-6;"))
    found = read_fmu(build(small, tmp_path), interface="co-simulation", limits=PATIENT)
    for _ in range(2):
        assert simulate(found, FREE, outputs=["out"])["out"] == pytest.approx(1e-6 * np.exp(-TIME / 0.1), rel=1e-5)
        assert found.pool.learned["restart"] == "process"
    found.pool.close()


def test_values_are_set_after_the_experiment_is_told(tmp_path):
    """Some FMUs put their own values back as the experiment is set up."""
    found = read_fmu(build(begun("setup", "AT_SETUP(r, t, e, end) start(r)"), tmp_path), interface="co-simulation")
    assert np.abs(simulate(found, FREE, {"T": 0.2})["out"] - np.exp(-TIME / 0.2)).max() < 1e-6
    found.pool.close()


def test_a_value_that_the_fmu_does_not_take_is_an_error(tmp_path):
    found = read_fmu(build(begun("deaf", "INITIALIZE(r) (r[2] = 0.1)"), tmp_path), interface="co-simulation")
    assert np.abs(simulate(found, FREE)["out"] - np.exp(-TIME / 0.1)).max() < 1e-6
    with pytest.raises(SimulationError, match=r"parameter 'T' was set to 0.2 and reads 0.1"):
        simulate(found, FREE, {"T": 0.2})
    found.pool.close()


def test_an_experiment_of_one_instant_has_no_end(tmp_path):
    found = read_fmu(
        build(begun("ends", "AT_SETUP(r, t, e, end) if (e && end <= t) return 3"), tmp_path), interface="co-simulation"
    )
    assert simulate(found, experiment("now", np.array([0.0])))["out"].tolist() == [1.0]
    found.pool.close()


@pytest.mark.parametrize("fault", ["SHIFTS=1e-3", "SHIFTS=10", "LATER=1.2"])
def test_derivatives_by_a_parameter_are_those_of_runs_where_the_fmu_gets_them_wrong(fmu, fault):
    """The mass moves with each question for its derivative, or its derivative is wrong once the spring has moved."""
    name = "spring" + "".join(c for c in fault if c.isalnum())
    found = fmu(spring(name, more=(fault,)), 2, "model-exchange")
    run = simulate(found, STEP, {}, ["m", "k"])
    assert run.notes["sensitivities"] == "differences of runs: m; directional derivatives: k"
    assert np.abs(run["y"] - response(STEP.time)).max() < 2e-7
    h = 1e-5
    wanted = (response(STEP.time, m=2.0 + h) - response(STEP.time, m=2.0 - h)) / (2 * h)
    assert np.abs(run.gradient("y")[:, 0] - wanted).max() < 1e-4
    assert np.array_equal(simulate(found, STEP)["y"], simulate(found, STEP)["y"])


def test_an_iteration_of_a_fit_takes_one_run_and_one_a_parameter(fmu):
    """A trial, then a gradient at the same values: the trial is not run again."""
    model = fmu(spring("counted", own=False), 2, "co-simulation")
    names = ["m", "d", "k", "b"]
    simulate(model, STEP, {}, names)
    before = model.pool.runs
    for step in range(1, 5):
        values = {"m": 2.0 + 0.01 * step, "k": 8.0 - 0.01 * step}
        simulate(model, STEP, values)
        simulate(model, STEP, values, names)
    assert model.pool.runs - before == 4 * (len(names) + 1)


ONCE = "static int count;\n#define AT_INSTANTIATE if (count++) abort()\n#include <stdlib.h>\n"
"""An FMU that a process can make once: its tool ends the process at the second instance, and does not say so before."""


def changed(name, *code, **how):
    """The spring with its own derivatives, and code before it."""
    model = spring(name, **how)
    return replace(model, code="".join(code) + model.code)


@pytest.mark.parametrize("version", [2, 3])
def test_an_fmu_that_can_be_made_once_is_checked_and_run_by_resets(tmp_path, version):
    """The derivatives by its parameters need other values of them, one after the other; columns as in closed form."""
    found = read_fmu(build(changed("once", ONCE), tmp_path, version), interface="model-exchange", limits=PATIENT)
    before = found.pool.started
    told = found.capabilities.found
    assert told["brought back to its start by"] == "reset" and told["two short runs"].startswith("equal")
    assert told["derivatives at the start"].startswith("directional ones agree with differences, for all 7")
    run = simulate(found, STEP, {}, ["m", "k"])
    assert run.notes["sensitivities"] == "directional derivatives: m, k"
    h = 1e-5
    wanted = (response(STEP.time, m=2.0 + h) - response(STEP.time, m=2.0 - h)) / (2 * h)
    assert np.abs(run.gradient("y")[:, 0] - wanted).max() < 1e-4
    assert found.pool.started == before + 1
    found.pool.close()


@pytest.mark.parametrize("first", ["run", "point"])
def test_a_reset_that_keeps_a_parameter_which_the_fmu_moved_itself_restores_its_value(tmp_path, first):
    """The mass moves with each question for its derivative, and a reset restores the states alone."""
    kept = "#define AT_RESET M->r[0] = M->r[1] = 0; return 0\n"
    found = read_fmu(
        build(changed("keeps", kept, more=("SHIFTS=10",)), tmp_path), interface="model-exchange", limits=PATIENT
    )
    simulate(found, STEP)
    assert found.pool.learned["restart"] == "reset"
    if first == "point":
        point = at_point(found, {"u": 0.5, "k": 6.0}, np.array([0.4, 0.0]), ["twice"], ["k", "m"])
        assert point.jacobian[:, 3:] == pytest.approx(np.array([[0.0, 0.0], [0.05, -0.15], [0.0, 0.0]]), abs=1e-6)
    run = simulate(found, STEP, {}, ["m", "k"])
    assert run.notes["sensitivities"] == "differences of runs: m; directional derivatives: k"
    assert np.abs(run["y"] - response(STEP.time)).max() < 2e-7
    found.pool.close()


@pytest.mark.parametrize(
    ("way", "code"),
    [
        ("reset", ONCE),
        ("instance", "#define AT_RESET abort()\n#include <stdlib.h>\n"),
        ("instance", "static int frozen;\n#define AT_RESET frozen = 1\n#define AT_INSTANTIATE frozen = 0\n"),
        (
            "process",
            "static int frozen;\n#define AT_RESET frozen = 1\n#define AT_INSTANTIATE frozen = count++\nstatic int count;\n",
        ),
    ],
    ids=["once", "fatal", "frozen", "spoilt"],
)
def test_derivatives_by_parameters_before_any_run_come_from_a_restart_that_repeats_the_point(tmp_path, way, code):
    """At rest, where x' = 0 and v' = (k u - k x)/m = 0 whatever the model does: a reset is judged beside it."""
    model = changed(f"spring-{way}", code, own=False)
    frozen = "for (int i = 2; i < 4; i++) r[i] *= 1 - frozen;" if "frozen" in code else ""
    model = replace(model, code=model.code.replace("    r[9] =", f"    {frozen}\n    r[9] ="))
    found = read_fmu(build(model, tmp_path), interface="model-exchange", limits=PATIENT)
    values, rest = {"u": 0.5, "k": 6.0}, np.array([0.4, 0.0])
    if way == "process":
        with pytest.raises(SimulationError, match="neither a reset nor a new instance brings the FMU back"):
            at_point(found, values, rest, ["twice"], ["m", "k"])
    else:
        point = at_point(found, values, rest, ["twice"], ["m", "k"])
        wanted = [[0, 1, 0, 0, 0], [-3, -0.25, 3, -0.15, 0.05], [0, 2, 0, 0, 0]]
        assert point.jacobian == pytest.approx(np.array(wanted), abs=1e-6)
        assert "restart" not in found.pool.learned
        assert found.pool.learned["restart at a point"] == way
    found.pool.close()
