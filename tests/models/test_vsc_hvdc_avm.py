"""The average-value link: balances at rest, limits, options, and its sensitivities."""

from __future__ import annotations

import numpy as np
import pytest

from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.effects import apply_effects
from hvdc_ident.errors import UnknownNameError
from hvdc_ident.models import load_model
from hvdc_ident.models.vsc_hvdc_avm import RATINGS, VARIANTS, model
from hvdc_ident.simulate import Tolerance, engine_of, simulate

NAMES = ("vsc-hvdc-avm", *VARIANTS)
FINE = Tolerance(1e-12, 1e-15)


def at_rest(link, outputs, **values):
    time = np.array([0.0, 1e-6])
    return {
        n: v[0]
        for n, v in zip(
            outputs, simulate(link, experiment("rest", time, values), outputs=outputs).trajectory.values.T, strict=True
        )
    }


@pytest.mark.parametrize("name", NAMES)
def test_powers_balance_at_rest(name):
    link = load_model(name)
    v = link.values
    seen = at_rest(
        link, ("P1", "P2", "Q1", "Q2", "Idc", "Vdc1", "Pdc1", "Pdc2", "Ir1", "Ii1", "Ir2", "Ii2", "vq1", "vq2")
    )
    assert (seen["P2"], seen["Vdc1"]) == (pytest.approx(link.inputs["Pref2"].value), pytest.approx(1.0))
    assert (seen["Q1"], seen["Q2"], seen["vq1"], seen["vq2"]) == pytest.approx((0.0,) * 4, abs=1e-9)
    for i in "12":
        loss = v["RT"] * (seen[f"Ir{i}"] ** 2 + seen[f"Ii{i}"] ** 2)
        assert seen[f"P{i}"] - seen[f"Pdc{i}"] == pytest.approx(loss, abs=1e-9)
    # Terminal voltages stand inside of the stations' Rs: between the capacitors 2 Rs + Rdc.
    loss = (2 * v["Rs"] + v["Rdc"]) * seen["Idc"] ** 2
    inside = 2 * v["Rs"] * seen["Idc"] ** 2
    assert seen["Pdc1"] + seen["Pdc2"] == pytest.approx(loss - inside, abs=1e-7)


@pytest.mark.parametrize("rating", RATINGS)
def test_the_guesses_are_near_the_steady_state(rating):
    link = model(rating=rating)
    code = engine_of(link)
    y, _ = code.start(np.array(list(link.values.values())), np.array([i.value for i in link.inputs.values()]))
    for (name, state), value in zip(link.states.items(), y, strict=True):
        assert state.guess == pytest.approx(value, abs=0.01), name


@pytest.mark.parametrize("power", [-0.9, -0.3, 0.0, 0.9])
@pytest.mark.parametrize("name", NAMES)
def test_other_operating_points_are_found_at_once(name, power):
    seen = at_rest(load_model(name), ("P2", "Q1"), Pref2=power, Qref1=0.1)
    assert (seen["P2"], seen["Q1"]) == pytest.approx((power, 0.1))


def test_the_study_of_the_phasor_link_drives_it_too():
    phasor, average = load_model("vsc-hvdc-link"), load_model("vsc-hvdc-avm")
    assert set(phasor.inputs) == set(average.inputs) and set(phasor.outputs) <= set(average.outputs)
    assert set(phasor.parameters) <= set(average.parameters)
    assert set(phasor.insertion_points) <= set(average.insertion_points)
    same = [n for n in phasor.parameters if phasor.values[n] != average.values[n]]
    assert same == []


@pytest.mark.parametrize(("priority", "order"), [("d", (1.1, 0.0)), ("q", (np.sqrt(1.1**2 - 0.5**2), 0.5))])
def test_the_axis_with_priority_keeps_its_order(priority, order):
    link = model(("P", "Q", "Vdc"), "paper", priority)
    steps = {"Pref2": InputSignal.step(0.1, 0.4, 1.2), "Qref2": InputSignal.step(0.1, 0.0, 0.7)}
    run = simulate(link, experiment("both", np.linspace(0.0, 1.0, 101), steps), rtol=1e-6)
    assert (run["Irorder2"][-1], run["Iiorder2"][-1]) == pytest.approx(order, abs=1e-6)
    assert np.hypot(run["Irorder2"], run["Iiorder2"]).max() <= 1.1 + 1e-6


def test_it_rides_through_a_dip_and_a_load_step():
    dip = InputSignal.corners([(0.1, 1.0), (0.1, 0.7), (0.2, 0.7), (0.2, 1.0)])
    drawn = {"E2": dip, "Iload1": InputSignal.step(0.7, 0.0, 0.05)}
    run = simulate(load_model("vsc-hvdc-avm"), experiment("dip", np.linspace(0.0, 1.5, 301), drawn), rtol=1e-6)
    assert np.abs(np.array([run["Irorder1"], run["Irorder2"]])).max() <= 1.1 + 1e-9
    assert run["P2"][-1] == pytest.approx(0.4, abs=1e-3) and run["Vdc1"][-1] == pytest.approx(1.0, abs=1e-3)
    assert run["P1"][-1] - run["P1"][0] == pytest.approx(0.05, abs=1e-3)  # the load is fed by station 1


def test_sampling_and_computing_late_are_effects_on_its_slots():
    late = [
        {"effect": "sample-hold", "at": [s], "parameters": {"Ts": 1e-4, "compute": 5e-5}} for s in ("P2_m", "Vdc1_m")
    ]
    step = experiment("step", np.linspace(0.0, 0.4, 401), {"Pref2": InputSignal.step(0.1, 0.4, 0.5)})
    plain, sampled = (
        simulate(m, step, rtol=1e-6)
        for m in (load_model("vsc-hvdc-avm"), apply_effects(load_model("vsc-hvdc-avm"), late))
    )
    assert 1e-6 < np.abs(plain["Irorder2"] - sampled["Irorder2"]).max() < 2e-3


@pytest.mark.parametrize("name", NAMES)
def test_its_sensitivities_are_derivatives(name):
    link = load_model(name)
    power = link.inputs["Pref2"].value
    step = experiment("step", np.linspace(0.0, 0.3, 31), {"Pref2": InputSignal.step(0.053, power, power - 0.1)})
    # The step and what comes back of it one delay later lie between the instants that are compared.
    names, outputs = ("KIP", "KIVDC", "Ls", "Zg", "Tpll"), ("Irorder1", "P2", "Q2", "Vdc1")
    exact = simulate(link, step, None, names, outputs=outputs, tolerance=FINE)
    for k, n in enumerate(names):
        h = 1e-3 * link.values[n]
        high, low = (
            simulate(link, step, {n: link.values[n] + s * h}, outputs=outputs, tolerance=FINE).trajectory.values
            for s in (1, -1)
        )
        difference = (high - low) / (2 * h)
        size = np.abs(difference).max(axis=0) + 1e-6 / link.values[n]
        assert (np.abs(exact.gradients[:, :, k] - difference) / size).max() < 2e-4, n


def test_options_that_are_not_there_are_refused():
    for wrong in ({"filters": ("R",)}, {"rating": "mine"}, {"priority": "z"}):
        with pytest.raises(UnknownNameError, match="average-value link"):
            model(**wrong)
