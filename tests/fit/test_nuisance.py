"""What is unknown about one experiment alone: input offsets, free starts, values of its own, clocks."""

from __future__ import annotations

import numpy as np
import pytest

from hvdc_ident import Model, simulate
from hvdc_ident.data import InputSignal, experiment, trajectory
from hvdc_ident.errors import StudyError
from hvdc_ident.fit import FitParameter, Problem, fit
from hvdc_ident.fit.simulator import unit_of
from hvdc_ident.simulate import ModelSimulator
from tests.fit.link import STEPS, TIME, TRUTH, link, step
from tests.fit.simulators import Closed, decay, parameters, recorded

GAINS = (FitParameter("KPVDC", 20, 10, 40), FitParameter("KIVDC", 750, 550, 950), FitParameter("KIP", 25, 5, 50))


@pytest.mark.parametrize("setpoint", ["Pref2", "Vdcref1"])
def test_the_derivative_by_an_offset_is_that_of_tight_differences(setpoint):
    e = step("Vdcref1", ("Irorder1", "Irorder2"))
    model, h = link().model, 1e-4
    exact = simulate(model, e, TRUTH, ["KIP", setpoint], outputs=e.outputs)
    assert exact.parameters == ("KIP", setpoint)
    up, down = (simulate(model, e.with_(offsets={setpoint: s}), TRUTH, outputs=e.outputs, rtol=1e-11) for s in (h, -h))
    for output in e.outputs:
        slope = (up[output] - down[output]) / (2 * h)
        assert exact.gradient(output)[:, 1] == pytest.approx(slope, abs=1e-5 * max(np.abs(slope).max(), 1.0))


def test_an_offset_is_the_set_point_moved_from_the_start_on():
    e = step("Vdcref1", ("Irorder2",))
    moved = simulate(link().model, e.with_(offsets={"Pref2": 0.05}), TRUTH, outputs=e.outputs)
    given = simulate(link().model, e.with_(values={"Pref2": 0.45}), TRUTH, outputs=e.outputs)
    assert moved["Irorder2"] == pytest.approx(given["Irorder2"], abs=1e-12)


def test_a_set_points_offset_is_found_together_with_the_gains():
    """A set-point read 0.013 pu wrong in one of two experiments; the other has no unknown of its own."""
    wrong = step("Vdcref1", hidden={"offsets": {"Pref2": 0.013}}, nuisance=("Pref2",))
    problem = Problem(link(), (wrong, step("Pref2")), GAINS)
    result = fit(problem, starts=2)
    assert result.status == "converged"
    found = result.nuisance["step of Vdcref1"]["Pref2"]
    assert found.value == pytest.approx(0.013, abs=1e-8)
    assert found.unit == "pu"
    assert [result.values[n] for n in ("KPVDC", "KIVDC", "KIP")] == pytest.approx([24.0, 734.7, 30.0], rel=1e-6)
    blind = fit(problem.with_(experiments=[wrong.with_(nuisance=()), step("Pref2")]), starts=1)
    assert blind.cost > 100 * result.cost


def test_the_problems_jacobian_by_every_kind_of_nuisance_is_that_of_differences():
    e = step("Vdcref1", nuisance=("Pref2", "time-shift", "KIP"))
    problem = Problem(link(), (e,), GAINS[:2])
    theta = problem.start.copy()
    theta[2:] = [0.01, 0.003, 33.0]
    _, exact = problem.residual(theta)
    for i, u in enumerate(problem.unknowns):
        h = np.zeros(theta.size)
        h[i] = 1e-4 * u.size
        slope = (problem.residual(theta + h)[0] - problem.residual(theta - h)[0]) / (2 * h[i])
        close = np.abs(exact[:, i] - slope) <= 0.02 * np.abs(slope).max()
        # a time shift differs at the rows beside the jump, where no derivative exists
        assert close.mean() > 0.98, u.name
    assert problem.names[2:] == tuple(f"step of Vdcref1:{n}" for n in ("Pref2", "time-shift", "KIP"))


def tank() -> ModelSimulator:
    """x' = -k x with an unknown start, seen as it is: y = x0 exp(-k t)."""
    model = Model(
        name="tank", parameters={"k": 1.0}, states={"x": {"derivative": "-k*x", "start": "free"}}, outputs={"y": "x"}
    )
    return ModelSimulator(model)


def test_a_free_start_is_estimated_in_every_experiment():
    t = np.linspace(0, 2, 41)

    def run(name: str, x0: float, role: str = "fit"):
        y = trajectory(t, {"y": x0 * np.exp(-1.7 * t)})
        return experiment(name, t, measured=y, nuisance=("x_start",), role=role)

    problem = Problem(
        tank(), (run("a", 2.0), run("b", -0.5), run("c", 4.0, "holdout")), (FitParameter("k", 1.0, 0.1, 5),)
    )
    result = fit(problem, starts=2)
    assert result.status == "converged"
    assert result.estimates["k"].value == pytest.approx(1.7, rel=1e-6)
    assert result.nuisance["a"]["x_start"].value == pytest.approx(2.0, rel=1e-6)
    assert result.nuisance["b"]["x_start"].value == pytest.approx(-0.5, rel=1e-6)
    held_out = result.validation["c"]
    assert held_out.nuisance["x_start"] == pytest.approx(4.0, rel=1e-5)
    assert result.rmse["y"]["c"] < 1e-5 < 1.0 < result.rmse_start["y"]["c"]


def test_a_parameter_may_have_a_value_of_its_own_in_every_experiment():
    t = np.linspace(0.0, 3.0, 61)
    simulator = Closed(parameters(a=1.0, k=1.0), {"y": decay})
    two = [recorded(n, t, rest={"nuisance": ("a",)}, y=a * np.exp(-1.5 * t)) for n, a in (("e", 2.0), ("f", 3.0))]
    result = fit(Problem(simulator, tuple(two), (FitParameter("k", 1.0, 0.1, 5),)), starts=2)
    assert result.fitted == ("k",)
    assert [result.nuisance[n]["a"].value for n in ("e", "f")] == pytest.approx([2.0, 3.0], rel=1e-6)
    with pytest.raises(StudyError, match="stands twice"):
        Problem(simulator, tuple(two), (FitParameter("k", 1.0, 0.1, 5), FitParameter("a", 1.0, 0.1, 5)))


def test_a_nuisance_at_the_end_of_its_range_is_a_fit_on_a_bound():
    wrong = step("Vdcref1", hidden={"offsets": {"Pref2": 0.2}}, nuisance=("Pref2",))
    result = fit(Problem(link(), (wrong,), GAINS[:2]), starts=1)
    assert result.status == "at-bound"
    assert "step of Vdcref1:Pref2" in result.message


def test_a_driven_slot_may_have_an_offset_too():
    """The measured terminal voltage drives its slot, read 0.02 pu too high."""
    plant = simulate(link().model, step("Pref2", ("P2",)), TRUTH, outputs=("Vac2", "Irorder2"))
    column = InputSignal.corners(zip(TIME, plant["Vac2"] + 0.02, strict=True))
    setpoint = InputSignal.step(0.1, *STEPS["Pref2"])
    driven = experiment(
        "driven",
        TIME,
        {"Vac2": column, "Pref2": setpoint},
        drive=("Vac2",),
        nuisance=("Vac2",),
        measured=trajectory(TIME, {"Irorder2": plant["Irorder2"]}),
        event=0.1,
    )
    result = fit(Problem(link(), (driven,), (FitParameter("KIP", 25, 5, 50),)), starts=1)
    assert result.status == "converged"
    assert result.nuisance["driven"]["Vac2"].value == pytest.approx(-0.02, abs=1e-5)
    assert result.values["KIP"] == pytest.approx(30.0, rel=2e-3)
    blind = fit(Problem(link(), (driven.with_(nuisance=()),), (FitParameter("KIP", 25, 5, 50),)), starts=1)
    assert abs(blind.values["KIP"] - 30.0) > 3 * abs(result.values["KIP"] - 30.0)


def test_units_of_nuisances():
    assert (unit_of(link(), "Pref2"), unit_of(link(), "time-shift"), unit_of(link(), "KIP")) == ("pu", "s", "pu/s")
