"""Every shipped model: it comes to rest, stays there, runs a step, and fits on a card."""

import numpy as np
import pytest

from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.errors import ModelError, UnknownNameError
from hvdc_ident.model import parse_card, write_card
from hvdc_ident.models import load_model, shipped_models, summaries
from hvdc_ident.simulate import simulate


@pytest.mark.parametrize("name", shipped_models())
def test_it_stays_at_rest(name):
    result = simulate(load_model(name), experiment("rest", np.linspace(0.0, 0.2, 11)))
    assert np.ptp(result.trajectory.values, axis=0).max() < 1e-6


@pytest.mark.parametrize("name", shipped_models())
def test_it_follows_a_step_and_settles(name):
    run = experiment("step", np.linspace(0.0, 0.8, 81), {"Pref2": InputSignal.step(0.1, 0.4, 0.5)})
    result = simulate(load_model(name), run, rtol=1e-6)
    assert np.isfinite(result.trajectory.values).all()
    assert result["P2"][-1] == pytest.approx(0.5, abs=2e-3)


@pytest.mark.parametrize("name", shipped_models())
def test_it_survives_a_card(name):
    model = load_model(name)
    assert parse_card(write_card(model)) == model
    assert summaries()[name]


def test_the_links_names_are_those_of_its_definition():
    """The names that studies and results hold on to, in their order; nothing else can have an effect."""
    link = load_model("vsc-hvdc-link")
    names = {
        "parameters": "KPVDC KIVDC KPQ KIQ KPP KIP KPQ2 KIQ2 C1 C2 Rdc Zg XR",
        "inputs": "Vdcref1 Qref1 Pref2 Qref2 E1 E2 Iload1",
        "states": "Vdc1 Vdc2 xv xp xq1 xq2",
        "signals": "R X Vac1 P1 Q1 Pdc1 Vac2 P2 Q2 Pdc2 Vdc1_m ev yv_u yv Irorder1 P2_m ep yp_u yp Irorder2 "
        "Q1_m eq1 yq1_u yq1 m1 Iiorder1 Q2_m eq2 yq2_u yq2 m2 Iiorder2 Idc",
        "algebraic": "Ir1 Ii1 Ir2 Ii2",
        "outputs": "Irorder1 Iiorder1 Irorder2 Iiorder2 Vdc1 Vdc2 P1 Q1 P2 Q2 Vac1 Vac2 Idc",
    }
    assert {section: " ".join(getattr(link, section)) for section in names} == names


def test_the_grids_names_are_those_of_its_definition():
    grid = load_model("vsc-mtdc-3")
    names = {
        "parameters": "KPVDC KIVDC KPP2 KIP2 KPP3 KIP3 KPQ1 KIQ1 C1 KPQ2 KIQ2 C2 KPQ3 KIQ3 C3 Rdc1_2 Rdc2_3 Zg XR",
        "inputs": "Vdcref1 Pref2 Pref3 Qref1 E1 Iload1 Qref2 E2 Iload2 Qref3 E3 Iload3",
        "states": "Vdc1 Vdc2 Vdc3 xv xp2 xp3 xq1 xq2 xq3",
        "signals": "R X Vdc1_m ev yv_u yv Irorder1 Vac1 P1 Q1 Pdc1 Q1_m eq1 yq1_u yq1 m1 Iiorder1 "
        "Vac2 P2 Q2 Pdc2 Q2_m eq2 yq2_u yq2 m2 Iiorder2 Vac3 P3 Q3 Pdc3 Q3_m eq3 yq3_u yq3 m3 Iiorder3 "
        "P2_m ep2 yp2_u yp2 Irorder2 P3_m ep3 yp3_u yp3 Irorder3 Idc1_2 Idc2_3",
        "algebraic": "Ir1 Ii1 Ir2 Ii2 Ir3 Ii3",
    }
    assert {section: " ".join(getattr(grid, section)) for section in names} == names


def test_the_design_rule_gives_table_1():
    link = load_model("vsc-hvdc-link")
    physical = link.parameterised("physical")
    assert "KIVDC" not in physical.parameters and {"J", "Ts"} <= set(physical.parameters)
    run = experiment("step", np.linspace(0.0, 0.5, 51), {"Vdcref1": InputSignal.step(0.1, 1.0, 1.019)})
    exact = {"KIVDC": (3 / (0.7 * 0.1)) ** 2 * 0.4}
    np.testing.assert_allclose(
        simulate(physical, run).trajectory.values, simulate(link, run, exact).trajectory.values, atol=1e-7
    )
    gains = simulate(physical, run, outputs=("KPVDC", "KIVDC", "KIP", "KIQ")).trajectory.values[0]
    np.testing.assert_allclose(gains, [24.0, 734.69, 30.0, 30.0], rtol=1e-5)


def test_the_gains_parameterisation_is_the_model_itself():
    link = load_model("vsc-hvdc-link")
    assert link.parameterised("gains") == link


def test_what_cannot_be_loaded_is_said(tmp_path):
    with pytest.raises(UnknownNameError, match="did you mean 'vsc-hvdc-link'"):
        load_model("vsc-hvdc-lnk")
    script = tmp_path / "m.py"
    script.write_text("raise SystemExit")
    with pytest.raises(ModelError, match="trust"):
        load_model(script)
    with pytest.raises(ModelError, match="cannot be read"):
        load_model(tmp_path / "m.docx")
