"""The units that a unit may be instead: which cards are connected, what they carry over, and that each of them runs."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

import hvdc_ident as hi
from hvdc_ident.data import InputSignal
from hvdc_ident.effects import EffectUse, apply_effects
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model, parse_card, shelf_model
from hvdc_ident.plants import CardChange, UnitPart, exchanges, part_name, parts_of, unit_card
from hvdc_ident.plants.meaning import of_class
from tests.plants.test_against_andes import CASES

LEVELS = {"P0": 80.0, "Q0": 10.0}


GENROU = UnitPart("genrou", {"Kw": 0.0})
"""The mechanical power acts as a power, and not as a torque: the droop alone decides where P comes to rest."""


def unit(**parts: str | UnitPart) -> Model:
    """Return a unit that is played back."""
    made = {n: UnitPart(p) if isinstance(p, str) else p for n, p in parts.items()}
    return parse_card(unit_card(made, network="playback", f0=50.0, levels=LEVELS))


@lru_cache(maxsize=4)
def changes(model: Model) -> FrozenMap[CardChange]:
    """Return the changes of a unit, by card."""
    return FrozenMap({c.card: c for c in exchanges(model)})


def case(name: str) -> Model:
    """Return the unit of a case of the comparison with andes, played back."""
    return parse_card(unit_card(parts_of(CASES[name]), network="playback", f0=60.0, levels=LEVELS))


def check_runs(model: Model, c: CardChange) -> None:
    """Check that a changed unit has the parameters of the other parts, starts at the levels, and leaves them by no more than it rests."""
    new = ("freq.", f"{c.component}.")  # a stabiliser may ask for a meter of the frequency
    own = {n: p for n, p in model.parameters.items() if not n.startswith(new)}
    assert {n: p for n, p in c.model.parameters.items() if not n.startswith(new)} == own
    assert all(i.settable for n, i in c.model.inputs.items() if n not in model.inputs), "set-points alone are new"
    assert {n.partition(".")[2] for n in c.model.parameters if n.startswith(f"{c.component}.")} == set(
        shelf_model(c.card).parameters
    )
    assert 0 < len(c.free) <= 6
    for n, p in c.free.items():
        assert p.min < p.max and p.value == c.model.values[n], n
    for n, s in c.carried.items():
        assert c.model.values[n] == s.value or (s.value == 0.0 and c.free[n].min == c.free[n].value), n
        assert set(s.of) <= set(model.parameters)
    point = hi.find_operating_point(c.model.with_values(LEVELS))
    assert (point.outputs["P"], point.outputs["Q"]) == pytest.approx((80.0, 10.0), abs=1e-6), (c.stated, c.card)


@pytest.mark.parametrize("name", ["ieeest", "reecb1-q"])
def test_every_change_of_a_unit_starts_at_its_levels(name) -> None:
    model = case(name)
    units = exchanges(model)
    assert units
    for c in units:
        check_runs(model, c)


@pytest.mark.nightly
@pytest.mark.parametrize("name", CASES)
def test_every_change_of_every_unit_starts_at_its_levels(name) -> None:
    model = case(name)
    for c in exchanges(model):
        check_runs(model, c)


def test_every_card_of_a_class_stands_in_for_another() -> None:
    model = unit(gen=GENROU, avr="sexs", gov="tgov1", pss="ieeest")
    cards = {(c.component, c.stated, c.card) for c in exchanges(model)}
    expected = {("avr", "sexs", c) for c in of_class("exciter") if c != "sexs"}
    expected |= {("gov", "tgov1", c) for c in of_class("governor") if c != "tgov1"}
    expected |= {("pss", "ieeest", c) for c in of_class("stabiliser") if c != "ieeest"} | {("lcfb1", None, "lcfb1")}
    assert cards == expected and len(cards) == 21
    assert part_name("lcfb1") == "lcfb1"


@pytest.mark.parametrize("card", ["ieeeg1", "ggov1", "exst1", "ieeet1", "pss2b", "lcfb1"])
def test_a_changed_unit_answers_a_dip_and_comes_to_rest_at_its_droop(card) -> None:
    """The frequency falls by 0.1 Hz and the voltage dips. With the load controller the power comes back."""
    c = changes(unit(gen=GENROU, avr="sexs", gov="tgov1"))[card]
    model = c.model.with_values({"lcfb1.Ki": 0.1} if card == "lcfb1" else {})
    given = {"f": InputSignal.corners([(1.0, 50.0), (3.0, 49.9)])}
    given["V"] = InputSignal.corners([(1.0, 1.0), (1.1, 0.95), (1.3, 1.0)])
    run = hi.simulate(model, np.arange(0.0, 300.0, 0.25), inputs=given)
    assert run["P"][0] == pytest.approx(80.0, abs=1e-6) and run["P"].max() > 81.0
    assert run["P"][-1] == pytest.approx(80.0 if card == "lcfb1" else 80.0 + 100.0 * 20.0 * 0.1 / 50.0, abs=0.05)


GOVERNORS = {
    "tgov1": {"R": 0.04},
    "ieeeg1": {"K": 22.0, "K3": 0.5},
    "ieesgo": {"K1": 18.0},
    "gast": {"R": 0.06},
    "ggov1": {"R": 0.05, "Trate": 80.0},
    "hygov": {"R": 0.06, "Dturb": 0.0},
}


@pytest.mark.parametrize("stated", GOVERNORS)
def test_the_droop_is_carried_over(stated) -> None:
    """P at rest at a low frequency, of every governor in place of every other: by the power, whatever the base of the droop."""

    def rise(model: Model) -> float:
        references = [n for n in ("Pref", "nref", "Vref") if n in model.states]
        start = hi.find_operating_point(model.with_values({"P0": 60.0, "Q0": 0.0}))
        held = model.driven(references).with_values({"Q0": 0.0} | {n: start.states[n] for n in references})
        return float(hi.find_operating_point(held, {"f": 49.9}, guess=start.states).outputs["P"]) - 60.0

    model = unit(gen=GENROU, avr="sexs", gov=UnitPart(stated, GOVERNORS[stated]))
    own = rise(model)
    assert own > 2.0
    for c in exchanges(model):
        if c.klass == "governor":
            off = {n: 0.0 for n in ("gov.Dturb",) if n in c.model.parameters}
            assert rise(c.model.with_values(off)) == pytest.approx(own, rel=1e-3), c.card


def test_there_and_back_is_the_stated_unit() -> None:
    model = unit(gen=GENROU, avr=UnitPart("sexs", {"K": 140.0}), gov=UnitPart("tgov1", {"R": 0.04, "T2": 2.4}))
    dip = {"V": InputSignal.corners([(1.0, 1.0), (1.2, 0.96)]), "f": InputSignal.corners([(1.0, 50.0), (3.0, 49.9)])}
    times = np.arange(0.0, 10.0, 0.05)
    expected = hi.simulate(model, times, inputs=dip)
    for there, back in (("ieeeg1", "tgov1"), ("exst1", "sexs")):
        again = changes(changes(model)[there].model)[back].model
        assert again.values == pytest.approx(model.values, rel=1e-12)
        run = hi.simulate(again, times, inputs=dip)
        np.testing.assert_allclose(run["P"], expected["P"], rtol=1e-8)
        np.testing.assert_allclose(run["Q"], expected["Q"], atol=1e-6)


@pytest.mark.parametrize(
    ("stated", "card", "off"),
    [
        (("gov", "tgov1", {}), "ieeeg1", {"gov.T1": 0.0, "gov.T4": 0.0}),
        (("gov", "tgov1", {}), "ieesgo", {"gov.T1": 0.0, "gov.T4": 0.0}),
        (("avr", "sexs", {"TE": 0.05}), "exst1", {"avr.TR": 0.0, "avr.KF": 0.0}),
        (("avr", "ieeet1", {"KF": 0.05}), "ieeex1", {"avr.TB": 0.0, "avr.TC": 0.0}),
        (("pss", "ieeest", {"KS": 4.0}), "st2cut", {}),
    ],
)
def test_a_card_of_the_same_transfer_function_answers_alike(stated, card, off) -> None:
    """off: blocks that the stated one does not have, and which a fit has to be able to bring in."""
    part, source, values = stated
    parts = {"gen": GENROU, "avr": "exst1" if part == "pss" else "sexs", "gov": "tgov1"}
    model = unit(**parts | {part: UnitPart(source, values)})
    c = changes(model)[card]
    assert {n: c.carried[n].value for n in off} == off
    both = {"V": InputSignal.corners([(1.0, 1.0), (1.2, 0.995)]), "f": InputSignal.corners([(1.0, 50.0), (3.0, 49.97)])}
    times = np.arange(0.0, 20.0, 0.05)
    expected, run = (hi.simulate(m, times, inputs=both) for m in (model, c.model.with_values(off)))
    for output in ("P", "Q", "Efd", "Pm"):
        np.testing.assert_allclose(run[output], expected[output], atol=1e-4 * np.ptp(expected[output]))
    near = hi.simulate(c.model, times, inputs=both)
    assert np.abs(near["P"] - expected["P"]).max() < 0.2 * np.ptp(expected["P"])


def test_what_a_study_sets_is_carried_and_what_it_frees_stays() -> None:
    model = unit(gen=GENROU, avr="sexs", gov="tgov1").with_values({"gov.R": 0.04, "gen.H": 4.5, "P0": 70.0})
    effect = apply_effects(model, [EffectUse("deadband", ("gov.dw",))])
    tied = model.tied({"gov.T2": "gov.T3/3"})
    for given in (model, effect, tied, model.driven(["Pref"])):
        c = changes(given)["ieeeg1"]
        assert c.model.values["gov.K"] == c.free["gov.K"].value == 25.0 and c.carried["gov.K"].of == ("gov.R",)
        assert c.model.values["gen.H"] == 4.5 and c.model.inputs["P0"].value == 70.0
        assert len(changes(given)) == 22
    assert changes(tied)["ieeeg1"].model.values["gov.K1"] == pytest.approx(1 / 3)
    assert (c.carried["gov.T4"].value, c.carried["gov.T4"].of) == (0.0, ())
    assert c.free["gov.T4"].value == c.free["gov.T4"].min > 0


def test_a_value_beyond_the_usual_range_widens_it() -> None:
    c = changes(unit(gen=GENROU, avr=UnitPart("sexs", {"K": 2000.0}), gov="tgov1"))["exst1"]
    assert (c.free["avr.KA"].value, c.free["avr.KA"].min, c.free["avr.KA"].max) == (2000.0, 20.0, 2000.0)


@pytest.mark.parametrize(
    ("flags", "acting"),
    [
        ({"QFLAG": 0.0}, {"Kqv", "Tpord"}),
        ({"QFLAG": 1.0, "VFLAG": 0.0}, {"Kqv", "Kvp", "Kvi", "Tpord"}),
        ({"QFLAG": 1.0, "VFLAG": 1.0}, {"Kqv", "Kqp", "Kqi", "Kvp", "Kvi", "Tpord"}),
    ],
)
def test_what_a_flag_switches_off_is_not_freed(flags, acting) -> None:
    c = changes(unit(gen="regca1", elec=UnitPart("reeca1", flags)))["reecb1"]
    assert set(c.free) == {f"elec.{n}" for n in acting}


def test_a_unit_with_a_step_up_transformer_is_one() -> None:
    model = unit(gen=GENROU, avr="sexs", gov="tgov1", step_up=UnitPart("transformer", {"X": 0.12}))
    assert len(exchanges(model)) == 22
    check_runs(model, changes(model)["exst1"])


def test_controls_that_a_unit_lacks() -> None:
    def added(**parts: str | UnitPart) -> dict[str, CardChange]:
        return {c.card: c for c in exchanges(unit(**parts)) if c.stated is None}

    assert set(added(gen=GENROU, gov="tgov1")) == {"lcfb1"}, "no stabiliser without an exciter"
    assert set(added(gen=GENROU, avr="sexs", gov="hygov")) == set(of_class("stabiliser")), "HYGOV takes a speed"
    assert set(added(gen="gencls", gov="gast")) == {"lcfb1"}
    assert set(added(gen="regca1", elec="reecb1")) == {"repca1"}
    assert not added(gen="regca1", elec="reecb1", plant="repca1")
    speed = added(gen=GENROU, avr="sexs", gov=UnitPart("ggov1", {"R": 0.05}))["lcfb1"]
    assert speed.model.values["lcfb1.scale"] == 0.05 and speed.carried["lcfb1.scale"].of == (
        "gov.Kturb",
        "gov.R",
        "gov.Rselect",
        "gov.Sn",
        "gov.Trate",
    )
    power = added(gen=UnitPart("genrou", {"H": 4.0}), avr="sexs", gov="tgov1")["pss2b"]
    assert power.model.values["pss.KS2"] == pytest.approx(2.0 / 8.0) and power.carried["pss.KS2"].of == ("gen.H",)
    plant = added(gen="regca1", elec=UnitPart("reecb1", {"QMax": 0.6}))["repca1"]
    assert plant.model.values["plant.Qmax"] == 0.6 and plant.model.values["plant.Fflag"] == 1.0


def test_what_cannot_be_connected() -> None:
    """A load controller of a power gives no speed reference; REECB1 limits a voltage reference as a reactive power."""
    cards = {c.card for c in exchanges(unit(gen=GENROU, avr="sexs", gov="tgov1", lcfb1="lcfb1"))}
    assert "ieeeg1" in cards and not cards & {"hygov", "ggov1", "lcfb1"}
    voltage = UnitPart("reeca1", {"VFLAG": 0.0, "QFLAG": 1.0, "Vbias": 1.0})
    assert not exchanges(unit(gen="regca1", elec=voltage, plant="repca1"))
    assert changes(unit(gen="regca1", elec=voltage))["reecb1"].model.values["elec.QMax"] == 1.4


def test_a_model_that_is_no_unit_has_none() -> None:
    parts = {"gen": UnitPart("genrou"), "avr": UnitPart("sexs"), "gov": UnitPart("tgov1")}
    text = unit_card(parts, network="playback", f0=50.0)
    assert exchanges(parse_card(text))
    assert exchanges(parse_card(unit_card(parts))) == ()
    assert exchanges(shelf_model("sexs")) == ()
    assert exchanges(hi.load_model("vsc-hvdc-link")) == ()
    assert exchanges(parse_card(text.replace('"gov.dw" = "gen.dw"', '"gov.dw" = "2*gen.dw"'))) == ()
