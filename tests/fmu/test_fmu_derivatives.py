"""Operating points, linear models and sensitivities against matrices and derivatives known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from hvdc_ident import find_operating_point, linearize, simulate
from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.effects import apply_effects
from hvdc_ident.errors import InputError, LinearizationError, ModelError, SteadyStateError
from hvdc_ident.fmu import at_point
from hvdc_ident.fmu.differences import (
    SHORT_STEP,
    SUFFICIENT,
    ParameterRuns,
    difference,
    first_difference,
    noise_of,
    together,
)
from hvdc_ident.linearize import continuation, jacobian_error, point_at
from tests.fmu.c_fmu import needs_compiler
from tests.fmu.c_models import BALL, COUNTER, FAULTY, response, spring

TIME = np.linspace(0.0, 5.0, 251)
STEP = experiment("step", TIME, {"u": InputSignal.step(1.0, 0.0, 1.0)})
WAYS = {
    "own": spring(),
    "none": spring("without", own=False),
    "wrong": spring("liar", wrong=2.0),
}
"""Directional derivatives that are right but for an output that is a state, there are none, or they are wrong."""


@needs_compiler
@pytest.mark.parametrize(("way", "version"), [*((w, 2) for w in WAYS), ("own", 3)])
def test_the_linear_model(fmu, way, version):
    model = fmu(WAYS[way], version)
    point = find_operating_point(model, {"u": 0.3, "k": 9.0})
    assert point.states["x"] == pytest.approx(0.3, abs=1e-9) and point.states["v"] == pytest.approx(0.0, abs=1e-9)
    found = linearize(model, point, outputs=["y", "twice"], sensitivities=["m", "k"])
    tight = {"abs": 1e-12 if way == "own" else 1e-8}
    assert found.A.ravel().tolist() == pytest.approx([0, 1, -4.5, -0.25], **tight)
    assert found.B.ravel().tolist() == pytest.approx([0, 4.5], **tight)
    assert found.C.ravel().tolist() == pytest.approx([1, 0, 0, 2], **tight)
    assert found.D.ravel().tolist() == pytest.approx([0, 0], **tight)
    assert found.provenance["method"] == ("directional" if way == "own" else "finite-difference")
    assert jacobian_error(model, point) < 1e-6
    assert found.gradients["m"].A.ravel() == pytest.approx([0, 0, 2.25, 0.125], abs=1e-5)
    assert found.gradients["k"].B.ravel() == pytest.approx([0, 0.5], abs=1e-5)
    assert [p.real for p in found.poles()] == pytest.approx([-0.125, -0.125], abs=1e-8)


@needs_compiler
@pytest.mark.parametrize("way", WAYS)
def test_derivatives_by_parameters_at_a_point(fmu, way):
    """v' = (k (u - x) - d v)/m, of which a wrong derivative by m has to be found out beside another step's."""
    model = fmu(WAYS[way])
    x, v, m, d, k = 0.5, 0.2, 2.0, 0.5, 8.0
    found = at_point(model, {}, np.array([x, v]), ["twice"], ["m", "k", "b"])
    force = -k * x - d * v
    assert found.derivatives == pytest.approx([v, force / m]) and found.outputs == pytest.approx([2 * v + 0.25])
    wanted = [[0.0, 0.0, 0.0], [-force / m**2, -x / m, 0.0], [0.0, 0.0, 1.0]]
    assert found.jacobian[:, 3:] == pytest.approx(np.array(wanted), abs=1e-7)
    assert found.directional.tolist()[3:] == [way == "own"] * 3 and found.error < 1e-7 and not found.near


@needs_compiler
def test_points_that_are_sought_and_points_that_are_not(fmu):
    model = fmu(spring())
    sought = find_operating_point(model, {"y": 0.7}, free=["u"])
    assert sought.inputs["u"] == pytest.approx(0.7, abs=1e-9) and sought.residual < 1e-9
    assert sought.stable is True and sought.notes == ()
    pushed = find_operating_point(model, {"u": 0.1, "k": -8.0})  # lambda^2 + lambda/4 - 4 = 0
    assert pushed.stable is False and pushed.notes == ("Unstable: the eigenvalue 1.88 1/s grows.",)
    with pytest.raises(SteadyStateError, match=r"on its bound: u"):
        find_operating_point(model, {"y": 0.7}, free=["u"], bounds={"u": (0.0, 0.5)})
    held = point_at(model, {"x": 0.2, "v": 1.0}, {"u": 0.1})
    assert held.outputs["twice"] == pytest.approx(2.25) and held.states["x"] == 0.2
    start = find_operating_point(model, {"u": 0.4}, at="start")
    assert start.states == {"x": 0.4, "v": 0.0}
    assert [p.states["x"] for p in continuation(model, "u", [0.0, 0.5, 1.0])] == pytest.approx([0, 0.5, 1.0], abs=1e-9)
    with pytest.raises(SteadyStateError, match=r"no operating point.*d\(v\)/dt = 0 left with -9.81"):
        find_operating_point(fmu(BALL, 2, "model-exchange"))
    with pytest.raises(InputError, match="no variable 'uu'"):
        find_operating_point(model, {"uu": 1.0})
    with pytest.raises(InputError, match="no input 'x'"):
        linearize(model, sought, inputs=["x"])
    with pytest.raises(ModelError, match="expected model exchange"):
        linearize(fmu(FAULTY, 2, "co-simulation"))
    with pytest.raises(ModelError, match="effects at its ends"):
        linearize(apply_effects(model, [{"effect": "lag", "at": "u", "parameters": {"T": 0.1}}]))
    for option in ({"pade_order": 3}, {"side": "below"}, {"descriptor": True}):
        with pytest.raises(LinearizationError, match=f"an FMU does not show its .*{next(iter(option))} has no meaning"):
            linearize(model, sought, **option)
    assert linearize(fmu(COUNTER)).A.shape == (0, 0)
    assert issubclass(LinearizationError, InputError)


def exact(name):
    """The derivative of the step response, by complex-free differences of its closed form."""
    h, at = 1e-5, {"m": 2.0, "d": 0.5, "k": 8.0}
    up, down = ({**at, name: at[name] + s * h} for s in (1, -1))
    return (response(TIME, **up) - response(TIME, **down)) / (2 * h)


@needs_compiler
@pytest.mark.parametrize(
    ("way", "interface"), [*((w, "model-exchange") for w in WAYS), ("none", "co-simulation")]
)  # co-simulation has differences alone
def test_sensitivities(fmu, way, interface):
    model = fmu(WAYS[way], 2, interface)
    found = simulate(model, STEP, {}, ["m", "d", "k", "b"])
    directional = way == "own" and interface == "model-exchange"
    said = "directional derivatives: m, d, k, b" if directional else "differences of runs: m, d, k, b"
    assert found.notes["sensitivities"] == said
    assert ("sensitivity error" in found.notes) is not directional
    said = float(found.notes.get("sensitivity error", "1e-6").split()[0])
    assert said < 1e-3
    for j, name in enumerate("mdk"):
        wanted = exact(name)
        assert np.abs(found.gradient("y")[:, j] - wanted).max() < said * max(np.abs(wanted).max(), 1.0), name
    assert found.gradient("y")[:, 3] == pytest.approx(0.0, abs=1e-9)
    assert found.gradient("twice")[:, 3] == pytest.approx(1.0, abs=1e-9)


@needs_compiler
def test_a_bounce_is_too_much_for_directional_derivatives(fmu):
    """Before the first bounce the height does not depend on the factor; after it the closed form is known."""
    time = np.linspace(0.0, 1.0, 101)
    found = simulate(fmu(BALL, 2, "model-exchange"), experiment("fall", time), {}, ["e"])
    first = np.sqrt(2 / 9.81)
    wanted = np.where(time > first, np.sqrt(2 * 9.81) * (time - first), 0.0)
    assert np.abs(found.gradient("height")[:, 0] - wanted).max() < 1e-6
    assert found.notes["sensitivities"] == "differences of runs: e"


@needs_compiler
def test_there_is_no_derivative_by_a_whole_number(fmu):
    from dataclasses import replace

    from tests.fmu.c_fmu import Var

    counted = replace(
        FAULTY,
        name="counted",
        variables=tuple(
            v if v.name != "fault" else Var("fault", 3, "parameter", "fixed", (("start", "0"),), "Integer")
            for v in FAULTY.variables
        ),
    )
    model = fmu(counted)
    assert simulate(model, STEP, {"T": 0.5})["out"][-1] == pytest.approx(1.0, abs=1e-3)
    with pytest.raises(InputError, match="takes whole numbers only"):
        simulate(model, STEP, {"fault": 0.5})
    with pytest.raises(InputError, match="no derivative by 'fault'"):
        simulate(model, STEP, {}, ["fault"])


def done(rule, run):
    """Return the result of a rule whose runs are made one by one."""
    return together([rule], lambda values: [run(v) for v in values])[0]


@pytest.mark.parametrize("noise", [0.0, 1e-10, 1e-7])
@pytest.mark.parametrize(("low", "high"), [(-np.inf, np.inf), (2.0, np.inf), (-np.inf, 2.0)])
def test_a_step_is_chosen_against_the_noise(noise, low, high):
    """exp(p t) with noise: the error is at most about what is said, of the first derivative and of the later ones."""
    t, random, counted = np.linspace(0.0, 1.0, 200), np.random.default_rng(0), []

    def runs(p):
        assert low <= p <= high
        counted.append(p)
        return (np.exp(p * t) + noise * random.normal(size=t.size))[:, None]

    away = -1.0 if high == 2.0 else 1.0
    middle = runs(2.0)
    level = done(noise_of(lambda k: 2.0 + away * k * 2e-3, middle), runs)
    assert level[0] == pytest.approx(noise, rel=0.3) if noise else level[0] < 1e-12
    wanted = t * np.exp(2.0 * t)
    line = ParameterRuns(float, 2.0, 2.0, low, high, middle)
    begun, step = done(first_difference(line, level), runs)
    assert len(counted) <= 1 + 6 + 2 and step.sides == 1 and step.error <= SUFFICIENT
    counted.clear()
    later = done(difference(line, step), runs)
    assert len(counted) == 1
    for found in (begun, later):
        error = np.sqrt(np.mean((found[:, 0] - wanted) ** 2)) / np.sqrt(np.mean(wanted**2))
        assert error < max(2.0 * step.error, 1e-5)
    assert step.error < {0.0: 1e-6, 1e-10: 1e-4, 1e-7: 1e-3}[noise]


def test_noise_asks_for_both_sides():
    """With noise of 1e-4 one side would leave 3 %: two sides leave less than what is said of them."""
    t, random = np.linspace(0.0, 1.0, 2000), np.random.default_rng(0)

    def runs(p):
        return (np.exp(p * t) + 1e-4 * random.normal(size=t.size))[:, None]

    middle = runs(2.0)
    wanted = t * np.exp(2.0 * t)
    line = ParameterRuns(float, 2.0, 2.0, -np.inf, np.inf, middle)
    begun, step = done(first_difference(line, done(noise_of(lambda k: 2.0 + k * 2e-3, middle), runs)), runs)
    assert step.sides == 2 and step.error < 1e-2
    for found in (begun, done(difference(line, step), runs)):
        assert np.sqrt(np.mean((found[:, 0] - wanted) ** 2) / np.mean(wanted**2)) < 2.0 * step.error


@pytest.mark.parametrize("width", [1e-4, 1e-3, 2.5e-3, 2e-2, 0.05])
@pytest.mark.parametrize("at", [0.37, 0.4, 0.40005])
def test_a_simulator_of_fixed_steps_is_differentiated_over_many_of_them(width, at):
    """A ramp that begins at p, but at a fixed step only: its slope by p is -1 after that, whatever the step."""
    t = np.linspace(0.0, 1.0, 401)
    counted = []

    def runs(p):
        counted.append(p)
        return np.maximum(t - width * np.round(p / width), 0.0)[:, None]

    middle = runs(at)
    level = done(noise_of(lambda k: at + k * SHORT_STEP * 0.4, middle), runs)
    line = ParameterRuns(float, at, 0.4, -np.inf, np.inf, middle)
    begun, step = done(first_difference(line, level), runs)
    later = done(difference(line, step), runs)
    for found in (begun, later):
        assert found[-1, 0] == pytest.approx(-1.0, abs=max(0.1, 1.5 * width / 0.02))
    assert len(counted) <= 1 + 6 + 2 + 4 + 2


def test_a_parameter_that_nothing_answers_to_has_no_derivative():
    middle = np.linspace(0.0, 1.0, 20)[:, None]
    line = ParameterRuns(float, 1.0, 1.0, -np.inf, np.inf, middle)
    found, step = done(first_difference(line, np.zeros(1)), lambda p: middle)
    assert not found.any() and step.error == 0.0
