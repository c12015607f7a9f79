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
