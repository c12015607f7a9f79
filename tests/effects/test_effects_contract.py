"""Every effect of the catalogue: neutral it is not there, else it runs, has exact sensitivities and fits on a card."""

import math

import numpy as np
import pytest

from hvdc_ident.effects import EffectUse, effects
from hvdc_ident.errors import ModelError, UnknownNameError
from hvdc_ident.experiment import InputSignal, experiment
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.model.card import parse_card, write_card
from hvdc_ident.models import load_model
from hvdc_ident.simulate import simulate

LINK = load_model("vsc-hvdc-link")
# No row and no step falls on a multiple of a sampling period: there a derivative has two sides.
TIME = np.concatenate([[0.0], np.linspace(0.00037, 0.35, 331)])
CASE = experiment(
    "case", TIME, {"Pref2": InputSignal.step(0.10053, 0.4, 0.5), "Qref1": InputSignal.ramp(0.15, 0.0, 0.25, 0.1)}
)
# One slot of each kind, all within the P loop.
SLOTS = ("Pref2", "P2_m", "Ir2", "xp", "outputs.P2")
NAMES = tuple(effects())


def use(name, at, values=None):
    parameters = {n: q.value for n, q in effects()[name].parameters.items()} | (values or {})
    return EffectUse(name, (at,) if isinstance(at, str) else tuple(at), FrozenMap(parameters))


@pytest.mark.parametrize("name", NAMES)
def test_neutral_gives_the_base_model_back(name):
    effect = effects()[name]
    switches = [n for n, q in effect.parameters.items() if q.neutral is not None]
    assert switches, "an effect can be switched off"
    for parameter in switches:
        assert LINK.with_effects([use(name, "P2_m", {parameter: effect.parameters[parameter].neutral})]) is LINK


@pytest.mark.parametrize("at", SLOTS)
@pytest.mark.parametrize("name", NAMES)
def test_it_runs_with_exact_sensitivities_at_every_kind_of_slot(name, at):
    model = LINK.with_effects([use(name, at)])
    assert model != LINK
    added = tuple(n for n in model.parameters if n not in LINK.parameters)
    wanted = ("KIP", *added)
    run = simulate(model, CASE, sensitivities=wanted, rtol=1e-10, outputs=("P2", "Irorder2"))
    for k, parameter in enumerate(wanted):
        value = model.parameters[parameter].value
        h = 1e-6 * (value or 1e-3)
        if value - h < 0:
            continue
        low, high = (
            simulate(model, CASE, {parameter: v}, rtol=1e-12, outputs=("P2", "Irorder2")).trajectory.values
            for v in (value - h, value + h)
        )
        slope = (high - low) / (2 * h)
        found = run.gradients[:, :, k]
        size = max(np.abs(slope).max(), 1e-3 / model.parameters[parameter].size)
        # Rows at which a jump itself moves within the difference are no derivative.
        assert np.quantile(np.abs(found - slope), 0.97) < 2e-4 * size, parameter


@pytest.mark.parametrize("name", NAMES)
def test_it_changes_what_it_sits_on_and_survives_a_card(name):
    model = LINK.with_effects([use(name, ("Ir1", "Ii1", "Ir2", "Ii2"))])
    again = parse_card(write_card(model))
    assert again == model
    plain = simulate(LINK, CASE, outputs=("P2",))["P2"]
    mine, theirs = (simulate(m, CASE, outputs=("P2",))["P2"] for m in (model, again))
    np.testing.assert_array_equal(mine, theirs)
    if name != "limit":  # the currents stay below their limit here
        assert np.abs(mine - plain).max() > 1e-4


@pytest.mark.parametrize("name", NAMES)
def test_it_describes_itself(name):
    effect = effects()[name]
    assert effect.name == name and effect.summary and effect.excited_by
    text = effect.sentence.format(at="P2_m", **dict.fromkeys(effect.parameters, "1"))
    assert "P2_m" in text
    for q in effect.parameters.values():
        assert q.min <= q.value <= q.max and not math.isnan(q.value)


def test_one_effect_on_several_slots_shares_its_parameter():
    model = LINK.with_effects([{"effect": "lag", "at": ["Ir1", "Ir2"], "parameters": {"T": 0.002}}])
    assert [n for n in model.parameters if n not in LINK.parameters] == ["lag_Ir1_T"]
    assert len(model.states) == len(LINK.states) + 2


def test_mistakes_are_named():
    with pytest.raises(UnknownNameError, match="did you mean 'lag'"):
        LINK.with_effects([{"effect": "lagg", "at": "Ir1"}])
    with pytest.raises(UnknownNameError, match="did you mean"):
        LINK.with_effects([{"effect": "lag", "at": "Ir3"}])
    with pytest.raises(UnknownNameError, match="no parameter 'tau'"):
        LINK.with_effects([{"effect": "lag", "at": "Ir1", "parameters": {"tau": 1.0}}])
    with pytest.raises(ModelError, match="outside its own bounds"):
        LINK.with_effects([{"effect": "lag", "at": "Ir1", "parameters": {"T": -1.0}}])
