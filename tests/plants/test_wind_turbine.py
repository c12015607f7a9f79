"""A wind turbine of type 3 as one unit: its start, its response to the reference of its plant, and its .dyr fitted to an event."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import hvdc_ident as hi
from hvdc_ident.cli import app
from hvdc_ident.model import parse_card
from hvdc_ident.plants import UnitPart, parts_of, unit_card
from hvdc_ident.psse import read_dyr
from tests.plants.test_against_andes import CASES

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


@pytest.mark.nightly
def test_from_its_records_and_an_event_to_the_fitted_inertia(tmp_path: Path) -> None:
    """An inertia of 4 s where the record says 5 s, from a voltage dip; torque and pitch control act."""
    records = {m: list(v) for m, v in CASES["type3-plant"].items()} | {"WTPTA1": TURBINE["WTPTA1"]}
    lines = [f"7 '{m}' 1 {' '.join(map(str, values))} /\n" for m, values in records.items()]
    (tmp_path / "plant.dyr").write_text("".join(lines), encoding="utf-8")
    truth = records | {"WTDTA1": [4.0, *records["WTDTA1"][1:]]}
    model = parse_card(unit_card(parts_of(truth), network="playback", f0=60.0))
    times = np.round(np.arange(0.0, 8.0, 0.02), 6)
    V = [(0.0, 1.02), (1.0, 1.02), (1.1, 0.75), (1.3, 0.75), (1.4, 1.0), (9.0, 1.0)]
    before = model.with_values({"V": 1.02, "f": 60.0, "P0": 80.0, "Q0": 15.0})
    run = hi.simulate(before, times, inputs={"V": hi.InputSignal.corners(V)})
    random = np.random.default_rng(1)
    frequency = 60.0 + 1e-4 * random.standard_normal(times.size)
    noisy = [run[n] + 0.02 * random.standard_normal(times.size) for n in "PQ"]
    table = np.column_stack([times, np.interp(times, *zip(*V, strict=True)), frequency, *noisy])
    np.savetxt(tmp_path / "event.csv", table, delimiter=",", header="time,V,f,P,Q", comments="")

    def done(*arguments: object) -> None:
        result = CliRunner().invoke(app, [str(a) for a in arguments])
        assert result.exit_code == 0, result.stderr

    study, unit = tmp_path / "unit" / "study.toml", ["--bus", 7, "--base", 100, "--frequency", 60]
    done("new", tmp_path / "unit", "--dyr", tmp_path / "plant.dyr", *unit, "--from", tmp_path / "event.csv", "--quiet")
    done("fit", study, "--quiet")
    done("export", study, "--to", tmp_path / "fitted.dyr", "--quiet")
    fitted = {r.model: r.values for r in read_dyr(tmp_path / "fitted.dyr").records}
    assert fitted["WTDTA1"][0] == pytest.approx(4.0, rel=1e-3)
    assert fitted["WTTQA1"] == tuple(map(float, records["WTTQA1"]))
