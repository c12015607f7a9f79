"""Every effect of the catalogue: neutral it is not there, else it runs, has exact sensitivities and fits on a card."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.effects import EffectUse, apply_effects, effects
from hvdc_ident.errors import ModelError, UnknownNameError
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model, parse_card, write_card
from hvdc_ident.models import load_model
from hvdc_ident.simulate import simulate
from tests.effects.sizes import NAMES, SIZES, use

LINK = load_model("vsc-hvdc-link")
# No row and no step falls on a multiple of a sampling period: there a derivative has two sides.
TIME = np.concatenate([[0.0], np.linspace(0.00037, 0.25, 241)])
CASE = experiment(
    "case", TIME, {"Pref2": InputSignal.step(0.05053, 0.4, 0.5), "Qref1": InputSignal.ramp(0.1, 0.0, 0.15, 0.1)}
)
# The slots in the tests are one of each kind, all within the P loop.
NEUTRAL = {
    "backlash": ({"width": 0.0},),
    "conductance": ({"g": 0.0},),
    "coupling": ({"k": 0.0},),
    "deadband": ({"width": 0.0},),
    "deadband-step": ({"width": 0.0},),
    "delay": ({"T": 0.0},),
    "disturbance": ({"amplitude": 0.0},),
    "droop": ({"k": 0.0},),
    "filter": ({"k": 0.0},),
    "gain": ({"k": 1.0},),
    "inductance": ({"L": 0.0},),
    "lag": ({"T": 0.0},),
    "inner-loop": ({"wn": math.inf},),
    "lead-lag": ({"T1": 0.003, "T2": 0.003},),
    "limit": ({"level": math.inf},),
    "loss": ({"a": 0.0, "b": 0.0, "c": 0.0},),
    "non-windup-limit": ({"low": -math.inf, "high": math.inf},),
    "offset": ({"c": 0.0},),
    "quantisation": ({"step": 0.0},),
    "rate-limit": ({"rate": math.inf},),
    "sample-hold": ({"Ts": 0.0},),
    "saturation": ({"level": math.inf},),
    "second-order": ({"wn": math.inf},),
    "servo": ({"T": 0.0},),
    "state-rate-limit": ({"up": math.inf, "down": math.inf},),
    "term": ({"k": 0.0},),
    "window-mean": ({"T": 0.0},),
}
NEARLY = {
    "backlash": {"width": 1e-9},
    "disturbance": {"amplitude": 1e-9},
    "droop": {"k": 1e-8},
    "loss": {"a": 1e-9, "b": 1e-9, "c": 1e-9},
    "limit": {"level": 1e6},
    "saturation": {"level": 1e5},
    "second-order": {"wn": 1e6},
    "inner-loop": {"wn": 1e6},
    "rate-limit": {"rate": 1e7},
    "servo": {"T": 1e-8, "up": 1e7, "down": 1e7},
    "state-rate-limit": {"up": 1e7, "down": 1e7},
    "non-windup-limit": {"low": -1e6, "high": 1e6},
    "gain": {"k": 1.0 + 1e-9},
    "lead-lag": {"T1": 0.003, "T2": 0.003 * (1 + 1e-9)},
    "lag": {"T": 1e-8},
    "inductance": {"L": 1e-8},
    "quantisation": {"step": 1e-4},
    "delay": {"T": 2e-5},
    "window-mean": {"T": 4e-5},
    "sample-hold": {"Ts": 1e-4, "compute": 0.0},
}
SMALL = {
    "rate-limit": 2e-3,  # it follows within 0.2 ms, however close to neutral
    "sample-hold": 1e-3,
    "quantisation": 3e-4,
    "deadband-step": 3e-4,  # so does what lies on an algebraic loop
    "window-mean": 1e-4,
    "delay": 1e-4,
}


def declared(name, near=False):
    """The values that switch an effect off, as it declares them; or values close to these."""
    found = {n: q.neutral for n, q in effects()[name].parameters.items() if q.neutral is not None}
    values = {n: effects()[name].example.get(v, v) if isinstance(v, str) else v for n, v in found.items()}
    return {n: min(v, 1e7) * (1 + 1e-9) or 1e-9 for n, v in values.items()} if near else values


def test_the_catalogue_holds_the_one_of_the_interface():
    assert set(NEUTRAL) <= set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_the_example_acts_and_its_values_are_the_effects_own(name):
    effect = effects()[name]
    if effect.needs_expression:
        assert not effect.parameters, "coefficients have the user's names"
        return
    assert set(effect.example) <= set(effect.parameters)
    values = {n: q.value for n, q in effect.parameters.items()} | dict(effect.example)
    assert not effect.is_neutral(values)
    assert effect.is_neutral(values | declared(name))


@pytest.mark.parametrize("name", NAMES)
def test_neutral_gives_the_base_model_back(name):
    for values in NEUTRAL.get(name, (declared(name),)):
        assert apply_effects(LINK, [use(name, "P2_m", values)]) is LINK
    if not effects()[name].needs_expression:
        without_source = replace(use(name, "P2_m", declared(name)), source="")
        assert apply_effects(LINK, [without_source]) is LINK


@pytest.mark.parametrize("name", NAMES)
def test_near_neutral_it_is_near_the_base_model(name):
    small = {"k": 1e-9} if effects()[name].needs_expression else declared(name, near=True)
    model = apply_effects(LINK, [use(name, "P2_m", NEARLY.get(name, small))])
    assert model != LINK
    plain, with_it = (simulate(m, CASE, outputs=("P2",), rtol=1e-9)["P2"] for m in (LINK, model))
    np.testing.assert_allclose(with_it, plain, atol=SMALL.get(name, 3e-6))


@pytest.mark.parametrize("at", ("Pref2", "xp"))
@pytest.mark.parametrize("name", NAMES)
def test_it_runs_at_inputs_and_states(name, at):
    model = apply_effects(LINK, [use(name, at)])
    change = np.abs(np.subtract(*(simulate(m, CASE, outputs=("P2",))["P2"] for m in (LINK, model)))).max()
    if at == "xp" and name in ("offset", "deadband", "dry-friction"):
        assert change < 1e-8, "an integrator makes up for what is added to it"
    else:
        assert 1e-5 < change < 0.5


@pytest.mark.parametrize("at", ("P2_m", "Ir2", "outputs.P2"))
@pytest.mark.parametrize("name", NAMES)
def test_it_runs_with_exact_sensitivities_at_signals_unknowns_and_outputs(name, at):
    model = apply_effects(LINK, [use(name, at)])
    assert model != LINK
    added = tuple(n for n in model.parameters if n not in LINK.parameters)
    assert len(added) == len(SIZES[name])
    wanted = ("KIP", *added)
    run = simulate(model, CASE, sensitivities=wanted, rtol=1e-10, outputs=("P2", "Irorder2"))
    for k, parameter in enumerate(wanted):
        value = model.parameters[parameter].value
        h = 1e-6 * (value or 1.0)
        low, high = (
            # With the same sensitivities, so that the same machine code serves.
            simulate(model, CASE, {parameter: v}, wanted, rtol=1e-12, outputs=("P2", "Irorder2")).trajectory.values
            for v in (value - h, value + h)
        )
        slope = (high - low) / (2 * h)
        found = run.gradients[:, :, k]
        size = max(np.abs(slope).max(), 1e-3 / model.parameters[parameter].size)
        # Rows at which a jump itself moves within the difference are no derivative.
        assert np.quantile(np.abs(found - slope), 0.97) < 2e-4 * size, parameter


@pytest.mark.parametrize("name", NAMES)
def test_it_changes_what_it_sits_on_and_survives_a_card(name):
    model = apply_effects(LINK, [use(name, ("P2_m", "Q2_m"))])
    again = parse_card(write_card(model))
    assert again == model
    added = [n for n in model.parameters if n not in LINK.parameters]
    assert len(added) == len(SIZES[name]), "two slots share the parameters"
    plain = simulate(LINK, CASE, outputs=("P2",))["P2"]
    mine, theirs = (simulate(m, CASE, outputs=("P2",))["P2"] for m in (model, again))
    np.testing.assert_array_equal(mine, theirs)
    assert np.abs(mine - plain).max() > 1e-5


WIDER = {
    ("lead-lag", "lag"): ({"T1": 1e-9, "T2": 0.02}, {"T": 0.02}),
    ("second-order", "lag"): ({"wn": 1e3, "zeta": 10.0}, {"T": 0.02}),
    ("servo", "lag"): ({"T": 0.02, "up": 1e6, "down": 1e6}, {"T": 0.02}),
    ("servo", "rate-limit"): ({"T": 2e-4, "up": 0.3, "down": 0.3}, {"rate": 0.3}),
}
"""Values at which an effect is the one that it widens, to a few per cent."""


def test_an_effect_turns_into_those_that_it_widens():
    assert {(n, other) for n, e in effects().items() for other in e.generalises} == set(WIDER)
    plant = load_model("vsc-hvdc-link")
    moved = experiment("step", np.linspace(0.0, 0.4, 201), {"Vdcref1": InputSignal.step(0.05, 1.0, 1.01)})
    plain = simulate(plant, moved)["Irorder1"]
    for (wide, narrow), values in WIDER.items():
        runs = [
            simulate(apply_effects(plant, [{"effect": e, "at": ["Vdc1_m"], "parameters": v}]), moved)["Irorder1"]
            for e, v in zip((wide, narrow), values, strict=True)
        ]
        assert np.abs(runs[0] - runs[1]).max() < 0.05 * np.abs(runs[1] - plain).max()


@pytest.mark.parametrize("name", NAMES)
def test_it_describes_itself(name):
    effect = effects()[name]
    assert effect.name == name and effect.summary and effect.excited_by and effect.states
    words = (
        dict.fromkeys(effect.parameters, "1")
        | {"from": "Vdc2", "expression": "w**2"}
        | ({"equivalent_delay": "1 s"} if effect.equivalent_delay else {})
        | (
            effect.words({n: q.value for n, q in effect.parameters.items()} | dict(effect.example))
            if effect.words
            else {}
        )
    )
    text = effect.sentence.format(at="P2_m", **words)
    assert "P2_m" in text and "{" not in text
    assert ("Vdc2" in text) == effect.needs_source
    assert set(effect.confusable) <= set(NAMES) - {name} and all(effect.confusable.values())
    for q in effect.parameters.values():
        assert q.min <= q.value <= q.max and not math.isnan(q.value)
        assert q.description


def test_one_effect_on_several_slots_shares_its_parameter():
    model = apply_effects(LINK, [{"effect": "lag", "at": ["Ir1", "Ir2"], "parameters": {"T": 0.002}}])
    assert [n for n in model.parameters if n not in LINK.parameters] == ["lag_Ir1_T"]
    assert len(model.states) == len(LINK.states) + 2


def test_one_effect_on_several_slots_may_bring_in_a_signal_of_each():
    shared = {"effect": "droop", "at": ["Pref2", "Qref1"], "from": ["Vdc2", "Vdc1"], "parameters": {"k": 2.0}}
    model = apply_effects(LINK, [shared])
    assert [n for n in model.parameters if n not in LINK.parameters] == ["droop_Pref2_k"]
    one_by_one = apply_effects(
        LINK,
        [
            {"effect": "droop", "at": at, "from": seen, "parameters": {"k": 2.0}}
            for at, seen in zip(shared["at"], shared["from"], strict=True)
        ],
    )
    mine, theirs = (simulate(m, CASE).trajectory.values for m in (model, one_by_one))
    np.testing.assert_array_equal(mine, theirs)
    assert np.abs(mine - simulate(LINK, CASE).trajectory.values).max() > 1e-4
    assert parse_card(write_card(model)) == model
    assert EffectUse.of(shared).to_dict() == shared
    with pytest.raises(ModelError, match=r"one for each of its places.*1 or 2 names, got Vdc2, Vdc1, Vdc1"):
        apply_effects(LINK, [{**shared, "from": ["Vdc2", "Vdc1", "Vdc1"]}])


def test_a_resistance_of_the_model_stands_in():
    model = apply_effects(LINK, [{"effect": "inductance", "at": "Idc", "parameters": {"L": 1e-6, "R": "Rdc"}}])
    assert [n for n in model.parameters if n not in LINK.parameters] == ["inductance_Idc_L"]
    lag = apply_effects(LINK, [{"effect": "lag", "at": "Idc", "parameters": {"T": 1e-6 * 4096}}])
    mine, theirs = (simulate(m, CASE, outputs=("Idc",))["Idc"] for m in (model, lag))
    np.testing.assert_allclose(mine, theirs, atol=1e-7)


def test_effects_can_stand_on_each_other_and_on_one_slot():
    model = apply_effects(LINK, [use("lag", "P2_m"), use("gain", "P2_m"), use("lag", "P2_m"), use("droop", "Pref2")])
    assert {"lag_P2_m_T", "lag_P2_m_T_2", "gain_P2_m_k", "droop_Pref2_k"} <= set(model.parameters)
    assert parse_card(write_card(model)) == model
    steady = simulate(model, CASE, outputs=("P2_m", "P2")).trajectory.values[0]
    assert steady[0] == pytest.approx(0.9 * steady[1])


def test_a_use_and_its_mapping_are_the_same():
    for name in NAMES:
        given = use(name, ("P2_m", "Q2_m"))
        assert EffectUse.of(given.to_dict()) == given


def test_mistakes_are_named():
    with pytest.raises(UnknownNameError, match="did you mean 'lag'"):
        apply_effects(LINK, [{"effect": "lagg", "at": "Ir1"}])
    with pytest.raises(UnknownNameError, match="did you mean"):
        apply_effects(LINK, [{"effect": "lag", "at": "Ir3"}])
    with pytest.raises(UnknownNameError, match="no parameter 'tau'"):
        apply_effects(LINK, [{"effect": "lag", "at": "Ir1", "parameters": {"tau": 1.0}}])
    with pytest.raises(ModelError, match="outside its own bounds"):
        apply_effects(LINK, [{"effect": "lag", "at": "Ir1", "parameters": {"T": -1.0}}])
    with pytest.raises(UnknownNameError, match=r"effect 'inductance' at Idc, parameter 'R'.*did you mean 'Rdc'"):
        apply_effects(LINK, [{"effect": "inductance", "at": "Idc", "parameters": {"R": "Rd"}}])
    with pytest.raises(ModelError, match=r"needs another signal.*from = NAME"):
        apply_effects(LINK, [{"effect": "droop", "at": "Pref2", "parameters": {"k": 0.1}}])
    with pytest.raises(UnknownNameError, match=r"effect 'droop' at Pref2, from: no signal 'Vdc'.*did you mean.*'Vdc1'"):
        apply_effects(LINK, [{"effect": "droop", "at": "Pref2", "from": "Vdc", "parameters": {"k": 0.1}}])
    with pytest.raises(ModelError, match="brings no other signal in"):
        apply_effects(LINK, [{"effect": "lag", "at": "Pref2", "from": "Vdc1"}])
    with pytest.raises(ModelError, match="signals run in a circle"):
        apply_effects(LINK, [{"effect": "loss", "at": "P2_m", "from": "ep", "parameters": {"b": 0.1}}])
    with pytest.raises(ModelError, match="at least one coefficient"):
        apply_effects(LINK, [{"effect": "term", "at": "Pref2", "expression": "Vdc1**2"}])
    with pytest.raises(ModelError, match="does not use its coefficient 'k'"):
        apply_effects(LINK, [{"effect": "term", "at": "Pref2", "expression": "Vdc1**2", "parameters": {"k": 1.0}}])
    with pytest.raises(UnknownNameError, match=r"effect 'term' at Pref2.*no variable 'Vdx'"):
        apply_effects(LINK, [{"effect": "term", "at": "Pref2", "expression": "k*Vdx", "parameters": {"k": 1.0}}])
    with pytest.raises(ModelError, match="only a term has an expression"):
        apply_effects(LINK, [{"effect": "lag", "at": "Pref2", "expression": "Vdc1"}])
    with pytest.raises(UnknownNameError, match=r"an effect.*did you mean 'from'"):
        apply_effects(LINK, [{"effect": "droop", "at": "Pref2", "form": "Vdc1"}])


def test_in_a_term_the_slots_own_name_is_what_it_was_before():
    model = Model("m", inputs={"v": 0.5}, signals={"a": "2*v"}, outputs={"a": "a"})
    bent = apply_effects(
        model, [EffectUse("term", ("a",), FrozenMap({"k": 0.25, "c": 0.0}), expression="k*a**3 + c*v")]
    )
    assert set(bent.parameters) == {"term_a_k"}, "a coefficient at 0 is left out"
    run = simulate(bent, experiment("e", [0.0, 1.0], {"v": 0.5}))
    np.testing.assert_allclose(run["a"], 1.0 + 0.25)
