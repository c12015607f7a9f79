"""Quantities of phasors against identities of alternating current, and the study that plays them in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hvdc_ident.data import Trajectory, trajectory
from hvdc_ident.data.three_phase import (
    PhasorColumns,
    PhasorSettings,
    frequency_noise,
    phasor_quantities,
    sliding_frequency,
    unwrapped,
)
from hvdc_ident.errors import InputError, UnknownNameError, WaveformError
from hvdc_ident.formats import write_csv
from hvdc_ident.study.study import load_study
from hvdc_ident.study.summary import Summary

TIME = np.arange(101) * 0.02
VOLTAGE, CURRENT = PhasorColumns(("U",), ("U ang",)), PhasorColumns(("I",), ("I ang",))


def wrapped(degrees: np.ndarray) -> np.ndarray:
    """Degrees within -180 and 180, as a measurement unit sends them."""
    return (degrees + 180.0) % 360.0 - 180.0


def record(angle: np.ndarray, lag: float = 30.0) -> Trajectory:
    """100 kV and 2 kA, the current behind the voltage by `lag` degrees; angle: (n,) of the voltage in degrees."""
    columns = {"U": np.full(101, 100.0), "U ang": wrapped(angle), "I": np.full(101, 2.0), "I ang": wrapped(angle - lag)}
    return trajectory(TIME, columns, {"U": "kV", "U ang": "deg", "I": "kA", "I ang": "°"})


@pytest.mark.parametrize(
    ("counted", "factor"), [("phase-rms", 3.0), ("line-rms", np.sqrt(3.0)), ("phase-peak", 1.5), ("pu", 1.0)]
)
def test_powers(counted: str, factor: float) -> None:
    found = phasor_quantities(record(72.0 * TIME), VOLTAGE, CURRENT, ["p", "q"], PhasorSettings(counted=counted))
    np.testing.assert_allclose(found["p"], factor * 200.0 * np.cos(np.pi / 6), rtol=1e-12)
    np.testing.assert_allclose(found["q"], factor * 200.0 * np.sin(np.pi / 6), rtol=1e-12)
    assert found.units == ("MW", "Mvar")


def test_components_and_what_angles_are_counted_from() -> None:
    data = record(170.0 + 20.0 * TIME)  # passes 180 degrees
    wanted = ["v", "angle", "real", "imag", "id", "iq", "i-angle"]
    found = phasor_quantities(data, VOLTAGE, CURRENT, wanted, PhasorSettings())
    np.testing.assert_allclose(found["angle"], np.radians(170.0 + 20.0 * TIME), rtol=1e-12)
    np.testing.assert_allclose(found["real"] + 1j * found["imag"], 100.0 * np.exp(1j * found["angle"]), rtol=1e-12)
    np.testing.assert_allclose(found["id"] + 1j * found["iq"], 2.0 * np.exp(-1j * np.pi / 6), rtol=1e-12)
    assert found.units == ("kV", "rad", "kV", "kV", "kA", "kA", "rad")
    begun = phasor_quantities(data, VOLTAGE, CURRENT, ["angle", "i-angle"], PhasorSettings(reference="start"))
    np.testing.assert_allclose(begun["angle"], np.radians(20.0 * TIME), atol=1e-12)
    np.testing.assert_allclose(begun["i-angle"], np.radians(20.0 * TIME - 30.0), atol=1e-12)
    between = phasor_quantities(data, VOLTAGE, CURRENT, ["angle"], PhasorSettings(reference="I ang"))
    np.testing.assert_allclose(between["angle"], np.pi / 6, rtol=1e-12)


def test_positive_sequence_of_three_phasors() -> None:
    """Positive 1 at 10 degrees, negative 0.2 at 40, zero 0.1 at -70: Xb = a^2 X1 + a X2 + X0 (Fortescue)."""
    x1, x2, x0 = (m * np.exp(1j * np.radians(d)) for m, d in ((1.0, 10.0), (0.2, 40.0), (0.1, -70.0)))
    a = np.exp(2j * np.pi / 3)
    phases = {"a": x1 + x2 + x0, "b": a**2 * x1 + a * x2 + x0, "c": a * x1 + a**2 * x2 + x0}
    columns = {
        f"{part}{n}": np.full(101, f(x)) for n, x in phases.items() for part, f in (("m", np.abs), ("p", np.angle))
    }
    three = PhasorColumns(("ma", "mb", "mc"), ("pa", "pb", "pc"), "rad")
    found = phasor_quantities(trajectory(TIME, columns), three, None, ["v", "angle"], PhasorSettings())
    np.testing.assert_allclose(found.values, np.tile([1.0, np.radians(10.0)], (101, 1)), rtol=1e-12)


def test_frequency_is_the_mean_over_the_window() -> None:
    """Of a ramp of r Hz/s the mean over the last W lies r W/2 behind; of a constant it is that."""
    steady = phasor_quantities(record(360.0 * 0.2 * TIME), VOLTAGE, None, ["f"], PhasorSettings(frequency=50.0))
    np.testing.assert_allclose(steady["f"], 50.2, rtol=1e-12)
    rate, window = 0.5, 0.1
    ramp = phasor_quantities(
        record(360.0 * 0.5 * rate * TIME**2), VOLTAGE, None, ["f"], PhasorSettings(frequency=50.0, window=window)
    )
    whole = window - 1e-12 <= TIME
    np.testing.assert_allclose(ramp["f"][whole], 50.0 + rate * (TIME[whole] - window / 2), rtol=1e-10)
    np.testing.assert_allclose(ramp["f"][~whole], 50.0 + rate * window / 2, rtol=1e-10)


def test_noise_of_the_frequency_is_what_is_told() -> None:
    time = np.arange(20_000) * 0.02
    angle = 1e-3 * np.random.default_rng(3).standard_normal(time.size)
    for window in (0.1, 0.4):
        found = sliding_frequency(time, angle, 50.0, window)
        assert np.std(found) == pytest.approx(frequency_noise(1e-3, window), rel=0.03)


def test_gaps_of_phasors_stay_gaps() -> None:
    data = record(300.0 * TIME)
    values = np.array(data.values)
    values[10:14, 1] = np.nan
    holed = Trajectory(TIME, values, data.names, data.units)
    found = phasor_quantities(holed, VOLTAGE, CURRENT, ["v", "angle", "f", "i"], PhasorSettings(frequency=50.0))
    assert [found.gaps(n) for n in found.names] == [4, 4, 4, 0]
    there = np.isfinite(found["angle"])
    np.testing.assert_allclose(found["angle"][there], np.radians(300.0 * TIME[there]), atol=1e-12)
    assert unwrapped(np.array([np.nan, 3.0, -3.0]))[2] == pytest.approx(2 * np.pi - 3.0)


@pytest.mark.parametrize(
    ("wanted", "how", "says"),
    [
        (["f"], PhasorSettings(), "nominal frequency"),
        (["p"], PhasorSettings(), "how magnitudes are counted"),
        (["f"], PhasorSettings(frequency=50.0, window=0.02), "at least two steps"),
        (["f"], PhasorSettings(frequency=50.0, window=10.0), "no longer than the record"),
    ],
)
def test_what_is_needed_is_asked_for(wanted: list[str], how: PhasorSettings, says: str) -> None:
    with pytest.raises(WaveformError, match=says):
        phasor_quantities(record(TIME), VOLTAGE, CURRENT, wanted, how)


def test_a_quantity_or_a_unit_that_is_not_known() -> None:
    with pytest.raises(UnknownNameError, match="'angle'"):
        phasor_quantities(record(TIME), VOLTAGE, CURRENT, ["angel"], PhasorSettings())
    plain = trajectory(TIME, {"U": TIME, "U ang": TIME})
    with pytest.raises(WaveformError, match='unit = "deg" or "rad"'):
        phasor_quantities(plain, VOLTAGE, None, ["v"], PhasorSettings())
    with pytest.raises(WaveformError, match="needs the current"):
        phasor_quantities(plain, VOLTAGE, None, ["p"], PhasorSettings(counted="pu"))


CARD = """schema = 1
name = "load"
[parameters]
G = {value = 0.02, unit = "S"}
[inputs]
u = {value = 100.0, unit = "kV"}
f = {value = 50.0, unit = "Hz"}
[states]
x = {derivative = "(f - x)/0.1", unit = "Hz"}
[outputs]
P = {value = "3*G*u**2", unit = "MW"}
x = {value = "x", unit = "Hz"}
"""

STUDY = """schema = 1
[model]
source = "m.toml"
[[experiment]]
name = "pmu"
data = "pmu.csv"
inputs = {u = "V1", f = "F1"}
outputs = {P = "P1"}
values = {}
noise = {P = 0.1}
[[experiment.phasors]]
voltage = {magnitude = "U", angle = "U ang"}
current = {magnitude = "I", angle = "I ang"}
frequency = 50
window = 0.2
magnitudes = "phase-rms"
gives = {V1 = "v", F1 = "f", P1 = "p"}
"""


def test_a_study_plays_phasors_in(tmp_path: Path) -> None:
    (tmp_path / "m.toml").write_text(CARD)
    (tmp_path / "s.toml").write_text(STUDY)
    write_csv(record(36.0 * TIME, lag=0.0), tmp_path / "pmu.csv", units=True)
    study = load_study(tmp_path / "s.toml")
    (e,) = study.experiments
    np.testing.assert_allclose(e.inputs["f"](TIME), 50.1, rtol=1e-9)
    assert e.measured is not None
    np.testing.assert_allclose(e.measured["P"], 600.0, rtol=1e-9)
    assert "F1: mean frequency over the last 0.2 s, from the angle; noise of 1 deg in it is 0.0196 Hz" in str(
        Summary.of(study)
    )
    (tmp_path / "s.toml").write_text(STUDY.replace('angle = "U ang"', 'angle = ["U ang", "I ang"]'))
    with pytest.raises(InputError, match="one column's name, or a list of three"):
        load_study(tmp_path / "s.toml")
