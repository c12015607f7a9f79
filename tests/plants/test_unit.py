"""Units: which inputs follow what in the recorded network."""

from __future__ import annotations

import numpy as np
import pytest

import hvdc_ident as hi
from hvdc_ident.data import InputSignal
from hvdc_ident.model import parse_card
from hvdc_ident.plants import UnitPart, unit_card


def test_a_plant_of_converters_follows_the_recorded_frequency() -> None:
    """The converter has no input for it, the plant controller has: at rest P falls by Ddn times what lies beyond the dead band."""
    control = {"Fflag": 1.0, "Ddn": 20.0, "fdbd1": -6e-4, "fdbd2": 6e-4, "Pmin": 0.0}
    parts = {
        "gen": UnitPart("regca1"),
        "elec": UnitPart("reeca1", {"QFLAG": 0.0}),
        "plant": UnitPart("repca1", control),
    }
    model = parse_card(unit_card(parts, network="playback", f0=60.0))
    model = model.with_values({"P0": 80.0, "Q0": 10.0})
    point = hi.find_operating_point(model)
    references = ["Plant_pref", "Vref"]
    held = model.driven(references).with_values({n: point.states[n] for n in references})
    high = hi.find_operating_point(held, {"f": 60.2}, guess=point.states)
    assert high.outputs["P"] == pytest.approx(80.0 - 100.0 * 20.0 * (0.2 / 60.0 - 6e-4))
    assert high.outputs["Q"] == pytest.approx(10.0)


def test_controls_measure_the_frequency_of_a_recorded_angle() -> None:
    """A ramp of the angle and a frequency give the plant controller one and the same: P differs by the lag of the measurement alone."""
    control = {"Fflag": 1.0, "Ddn": 20.0, "Dup": 20.0, "fdbd1": 0.0, "fdbd2": 0.0}
    parts = {
        "gen": UnitPart("regca1"),
        "elec": UnitPart("reeca1", {"QFLAG": 0.0}),
        "plant": UnitPart("repca1", control),
    }
    model = parse_card(unit_card(parts, network="playback", f0=50.0)).with_values({"P0": 80.0, "Q0": 10.0})
    times = np.arange(0.0, 8.0, 0.02)
    fall = 0.1
    angle = -2.0 * np.pi * fall * np.maximum(times - 1.0, 0.0)
    turned = hi.simulate(model, times, inputs={"theta": angle})["P"]
    slowed = hi.simulate(model, times, inputs={"f": hi.step(50.0, 50.0 - fall, at=1.0)})["P"]
    assert slowed[-1] - slowed[0] == pytest.approx(100.0 * 20.0 * fall / 50.0, rel=0.05)
    assert np.abs(turned - slowed).max() < 0.02 / 0.25 * np.ptp(slowed)


@pytest.mark.parametrize(
    ("elec", "plant", "reference"),
    [
        ({"PFFLAG": 0.0}, None, "Qext"),
        ({"PFFLAG": 1.0}, None, "PFaref"),
        ({"PFFLAG": 0.0}, {"RefFlag": 1.0}, "Vref"),
        ({"PFFLAG": 0.0}, {"RefFlag": 0.0}, "Qref"),
        ({"PFFLAG": 1.0}, {"RefFlag": 1.0}, "PFaref"),
    ],
)
def test_the_reference_that_the_flags_let_act_is_found(elec, plant, reference) -> None:
    parts = {"gen": UnitPart("regca1"), "elec": UnitPart("reeca1", {"VFLAG": 0.0, "QFLAG": 0.0, **elec})}
    parts |= {} if plant is None else {"plant": UnitPart("repca1", plant)}
    model = parse_card(unit_card(parts, network="playback", f0=60.0))
    assert reference in model.states
    found = hi.find_operating_point(model.with_values({"P0": 80.0, "Q0": 15.0})).outputs
    assert (found["P"], found["Q"]) == pytest.approx((80.0, 15.0), abs=1e-6)


@pytest.mark.parametrize("governor", ["tgov1", "ieeeg1", "ieesgo", "gast", "ggov1", "hygov"])
def test_the_reference_of_every_governor_is_found(governor) -> None:
    """GGOV1 has a transport delay between its reference and the power."""
    parts = {"gen": UnitPart("genrou"), "avr": UnitPart("sexs"), "gov": UnitPart(governor)}
    model = parse_card(unit_card(parts, network="playback", f0=60.0))
    point = hi.find_operating_point(model.with_values({"P0": 75.0, "Q0": 10.0}))
    assert (point.outputs["P"], point.outputs["Q"]) == pytest.approx((75.0, 10.0), abs=1e-6)


@pytest.mark.parametrize(("governor", "scale"), [("tgov1", 1.0), ("ggov1", 0.04)])
def test_a_load_controller_leads_the_power_back(governor, scale) -> None:
    """The frequency stays 0.1 Hz low: the governor's answer is withdrawn, but for 1/droop of the frequency where Fb is that."""
    left = {}
    for Fb in (0.0, 25.0):
        parts = {"gen": UnitPart("genrou"), "avr": UnitPart("sexs"), "gov": UnitPart(governor)}
        parts["lcfb1"] = UnitPart("lcfb1", {"Ki": 0.1, "Kp": 0.2, "Fb": Fb, "scale": scale})
        model = parse_card(unit_card(parts, network="playback", f0=50.0)).with_values({"P0": 60.0, "Q0": 0.0})
        fall = InputSignal.corners([(1.0, 50.0), (2.0, 49.9)])
        P = hi.simulate(model, np.arange(0.0, 200.0, 0.5), inputs={"f": fall})["P"]
        assert P[0] == pytest.approx(60.0, abs=1e-6) and P.max() > 62.0
        left[Fb] = P[-1] - P[0]
    assert left == pytest.approx({0.0: 0.0, 25.0: 100.0 * 25.0 * 0.1 / 50.0}, abs=0.05)
