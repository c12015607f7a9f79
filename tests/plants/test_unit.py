"""Units: which inputs follow what in the recorded network."""

from __future__ import annotations

import numpy as np
import pytest

import hvdc_ident as hi
from hvdc_ident.model import parse_card
from hvdc_ident.plants import UnitPart, parts_of, unit_card


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


TURBINE = {
    "REGCA1": [1, 0.02, 10.0, 0.9, 0.4, 1.22, 1.2, 0.8, 0.4, -1.3, 0.02, 0.7, 99.0, -99.0, 0.7],
    "WTDTA1": [5.0, 0.5, 0.9, 1.8, 1.5],
    "WTARA1": [0.007, 0.0],
    "WTPTA1": [25.0, 150.0, 30.0, 3.0, 0.0, 0.3, 27.0, 0.0, 10.0, -10.0],
}
SPEEDS = [(0.3, 0.7), (0.6, 0.9), (0.9, 1.1), (1.0, 1.2)]


def turbine(Tflag: float, Fflag: float | None) -> dict[str, UnitPart]:
    """Return the parts of a wind turbine of type 3, under a plant controller or none."""
    table = [x for point in SPEEDS for x in point]
    records = TURBINE | {"WTTQA1": [Tflag, 3.0, 0.6, 0.05, 30.0, 1.2, 0.0, *table, 100.0]}
    plant = {} if Fflag is None else {"plant": UnitPart("repca1", {"Fflag": Fflag, "Kc": 0.0})}
    return parts_of(records) | {"elec": UnitPart("reeca1", {"VFLAG": 0.0, "QFLAG": 0.0})} | plant


@pytest.mark.parametrize("Fflag", [None, 0.0, 1.0])
@pytest.mark.parametrize("Tflag", [0.0, 1.0])
def test_a_wind_turbine_of_type_3_starts_from_its_powers(Tflag, Fflag) -> None:
    """The speed is that of the table, the mechanical power the electrical one, and the unit stays there."""
    model = parse_card(unit_card(turbine(Tflag, Fflag), network="playback", f0=60.0))
    model = model.with_values({"V": 1.02, "f": 60.0, "P0": 80.0, "Q0": 15.0})
    run = hi.simulate(model, np.linspace(0.0, 20.0, 21))
    speed = float(np.interp(0.8, *zip(*SPEEDS, strict=True)))
    for output, expected in {"P": 80.0, "Q": 15.0, "Pm": 0.8, "wt": speed, "wg": speed}.items():
        assert run[output] == pytest.approx(expected, abs=1e-6), output


@pytest.mark.parametrize("Tflag", [0.0, 1.0])
def test_a_wind_turbine_follows_the_power_reference_of_its_plant(Tflag) -> None:
    """By the torque within a second, or by the pitch alone: in the end the power is the reference, and the speed that of the table."""
    model = parse_card(unit_card(turbine(Tflag, 0.0), f0=60.0, R=0.01, X=0.3))
    point = hi.find_operating_point(model, outputs={"P": 80.0, "Vt": 1.02}, free=["Plant_pref", "Vref"])
    lower = {"Plant_pref": hi.step(0.8, 0.7, at=1.0)}
    run = hi.simulate(model.with_values(point.inputs), [0.0, 2.0, 400.0], inputs=lower, outputs=["P", "wt", "drive.Pm"])
    speed = float(np.interp(0.7, *zip(*SPEEDS, strict=True)))
    before = float(np.interp(0.8, *zip(*SPEEDS, strict=True)))
    assert (run["P"][1] < 75.0) == (Tflag == 1.0)
    assert run["P"][-1] == pytest.approx(70.0, abs=1e-3)
    assert run["wt"][-1] == pytest.approx(speed, abs=1e-4)
    assert run["drive.Pm"][-1] == pytest.approx(0.7 + 0.5 * (speed - before) * speed, abs=1e-4)


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
