"""From a .dyr file and a record at the terminals to a fitted .dyr, as the commands do it."""

from __future__ import annotations

import json

import numpy as np
import pytest
from typer.testing import CliRunner

import hvdc_ident as hi
from hvdc_ident.cli import app
from hvdc_ident.data import InputSignal
from hvdc_ident.model import parse_card
from hvdc_ident.plants import UnitPart, unit_card
from hvdc_ident.psse import read_dyr

DYR = """// a plant
101 'GENROU' 1  7.0 0.03 0.75 0.05 3.0 0.0 2.1 2.0 0.2 0.5 0.18 0.15 0.05 0.3 / machine
101 'SEXS' 1  0.1 10.0 100.0 0.1 0.0 5.0 /   exciter
102 'GENCLS' 1 4.0 0.0 /
101 'TGOV1' 1 0.05 0.5 1.0 0.0 2.0 6.0 0.0 /
101 'XYZ9' 1 1 2 3 /
"""
RAW = """0, 100.0, 33, 0, 0, 50.0 / case
one
two
101,'UNIT', 20.0,2,1,1,1,1.02,10.5
0 / END OF BUS DATA
0 / END OF LOAD DATA
0 / END OF FIXED SHUNT DATA
101,'1 ',200.0,31.5,120.0,-80.0,1.02,0,250.0,0.0,0.25
0 / END OF GENERATOR DATA
Q
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The files of a unit of 250 MVA whose inertia is 3.6 s and whose exciter's gain is 140, and its record of a voltage dip."""
    folder = tmp_path_factory.mktemp("plant")
    (folder / "plant.dyr").write_text(DYR, encoding="utf-8")
    (folder / "grid.raw").write_text(RAW, encoding="utf-8")
    parts = {
        "gen": UnitPart("genrou", {"Sn": 250.0, "H": 3.6}),
        "avr": UnitPart("sexs", {"K": 140.0}),
        "gov": UnitPart("tgov1"),
    }
    card = unit_card(parts, R=0.004, X=0.12)
    card = card.replace(
        "[outputs]", '[outputs]\nVr = {value = "line.Vr", unit = "pu"}\nVi = {value = "line.Vi", unit = "pu"}'
    )
    model = parse_card(card)
    point = hi.find_operating_point(model, outputs={"P": 200.0, "Vt": 1.02}, free=["Pref", "Vref"])
    times = np.arange(0.0, 5.0, 0.01)
    dip = InputSignal.corners([(1.0, 1.0), (1.2, 0.96)])
    run = hi.simulate(model.with_values(point.inputs), times, inputs={"E": dip})
    rng = np.random.default_rng(2)
    angle = np.unwrap(np.arctan2(run["Vi"], run["Vr"]))
    columns = [(run["Vt"], 1e-4), (angle - angle[0], 1e-4), (run["P"], 0.1), (run["Q"], 0.1)]
    table = np.column_stack([times, *(v + s * rng.standard_normal(times.size) for v, s in columns)])
    np.savetxt(folder / "event.csv", table, delimiter=",", header="time,V,theta,P,Q", comments="")
    return folder


def called(*arguments: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    return result.exit_code, result.stdout, result.stderr


def test_from_a_dyr_file_to_a_fitted_one(folder) -> None:
    unit = folder / "unit12"
    new = ["new", unit, "--dyr", folder / "plant.dyr", "--raw", folder / "grid.raw", "--bus", 101]
    code, out, _ = called(*new, "--from", folder / "event.csv", "--json")
    assert code == 0 and json.loads(out)["unknown_models"] == ["XYZ9"]
    study = hi.load_study(unit / "study.toml")
    assert study.model.values["gen.Sn"] == 250.0 and set(study.candidates) == {"gen.H", "avr.K", "gov.R"}
    assert study.experiments[0].values["P0"] == pytest.approx(200.0, abs=0.05)
    assert study.model.inputs["P0"].value == pytest.approx(200.0, abs=0.05)
    assert called("fit", unit / "study.toml", "--quiet")[0] == 0
    assert called("export", unit / "study.toml", "--to", folder / "fitted.dyr", "--quiet")[0] == 0
    before, after = read_dyr(folder / "plant.dyr"), read_dyr(folder / "fitted.dyr")
    assert after.records[0].values[4] == pytest.approx(3.6, rel=0.02)
    assert after.records[1].values[2] == pytest.approx(140.0, rel=0.01)
    lines = [
        (a, b)
        for a, b in zip(before.content.decode().split("\n"), after.content.decode().split("\n"), strict=True)
        if a != b
    ]
    assert all(
        a.split()[1] in ("'GENROU'", "'SEXS'", "'TGOV1'") and a.split("/")[1] == b.split("/")[1] for a, b in lines
    )


CONVERTER = """101 'REGCA1' 1 0 0.02 10 0.9 0.4 1.22 1.2 0.8 0.4 -1.3 0.02 0.7 99 -99 0.7 /
101 'REECB1' 1 0 0 {VFLAG} {QFLAG} 1 0.5 1.3 0 -0.02 0.02 2 1.05 -1.05 1.02 0.05 0.8 -0.8 1.3 -1.3 0.3 0.1 1 10 0.02 99 -99 1.2 0 1.5 0.05 /
"""


@pytest.mark.parametrize(
    ("flags", "asked"),
    [({"VFLAG": 1, "QFLAG": 1}, "elec.Kvp"), ({"VFLAG": 1, "QFLAG": 0}, "elec.Kqv")],
)
def test_a_gain_that_a_flag_switches_off_is_not_asked_about(folder, tmp_path, flags, asked) -> None:
    (tmp_path / "plant.dyr").write_text(CONVERTER.format(**flags), encoding="utf-8")
    new = ["new", tmp_path / "a", "--dyr", tmp_path / "plant.dyr", "--raw", folder / "grid.raw", "--bus", 101]
    code, out, _ = called(*new, "--from", folder / "event.csv")
    assert code == 0 and "levels before the event: P0 = that of P, Q0 = that of Q" in out
    assert list(hi.load_study(tmp_path / "a" / "study.toml").candidates) == [asked]


def test_a_recorded_voltage_does_not_jump_between_rows(folder, tmp_path) -> None:
    """A dip by 0.04 pu from one row, at 1 s, to the next: halfway between them the voltage is their mean."""
    rows = np.loadtxt(folder / "event.csv", delimiter=",", skiprows=1)
    rows[:, 1] = np.where(rows[:, 0] < 1.005, 1.02, 0.98) + 1e-4 * np.sin(1e3 * rows[:, 0])
    np.savetxt(tmp_path / "dip.csv", rows, delimiter=",", header="time,V,theta,P,Q", comments="")
    new = ["new", tmp_path / "a", "--dyr", folder / "plant.dyr", "--raw", folder / "grid.raw", "--bus", 101]
    assert called(*new, "--from", tmp_path / "dip.csv", "--quiet")[0] == 0
    (record,) = hi.load_study(tmp_path / "a" / "study.toml").experiments
    assert float(record.inputs["V"](1.005)) == pytest.approx(1.0, abs=2e-4)


def test_what_is_missing_is_told(folder, tmp_path) -> None:
    event, dyr = folder / "event.csv", folder / "plant.dyr"
    code, _, err = called("new", tmp_path / "a", "--dyr", dyr, "--bus", 101, "--from", event)
    assert code == 2 and "the base of the machine is not known" in err and "--raw FILE" in err
    code, _, err = called("new", tmp_path / "b", "--dyr", dyr, "--from", event)
    assert code == 2 and "--dyr, --bus and --from go together" in err
    code, _, err = called("new", tmp_path / "c", "--dyr", dyr, "--bus", 7, "--base", 1, "--from", event)
    assert code == 2 and "no record of bus 7" in err
    assert not any(tmp_path.iterdir())
    again = ["new", tmp_path / "d", "--dyr", dyr, "--bus", 101, "--base", 250, "--frequency", 50, "--from"]
    code, _, err = called(*again, tmp_path / "none.csv")
    assert code == 2 and "none.csv" in err
    assert called(*again, event, "--quiet")[0] == 0  # what failed has left nothing in the way


def test_a_study_without_a_dyr_file_writes_none(tmp_path) -> None:
    called("new", tmp_path / "x", "--quiet")
    code, _, err = called("export", tmp_path / "x" / "study.toml", "--to", tmp_path / "y.dyr")
    assert code == 2 and "does not say which .dyr file" in err


def test_a_value_is_written_with_its_interval_or_not_at_all(folder, tmp_path) -> None:
    """Of a fit of the unit and of the same with the verdict that it misses its record."""
    unit = tmp_path / "unit"
    new = ["new", unit, "--dyr", folder / "plant.dyr", "--raw", folder / "grid.raw", "--bus", 101]
    assert called(*new, "--from", folder / "event.csv")[0] == 0
    assert called("fit", unit / "study.toml", "--quiet")[0] == 0
    results = unit / "study-results" / "fit.json"
    fit = json.loads(results.read_text())
    code, out, _ = called("export", unit / "study.toml", "--to", tmp_path / "fitted.dyr")
    before, after = read_dyr(folder / "plant.dyr"), read_dyr(tmp_path / "fitted.dyr")
    written = {
        f"{part}.{name}": (before.records[k].values[i], after.records[k].values[i], text)
        for k, i, part, name in ((0, 4, "gen", "H"), (1, 2, "avr", "K"), (3, 0, "gov", "R"))
        for text in [after.content.decode().splitlines()[after.records[k].line - 1]]
    }
    for name, (old, new_value, line) in written.items():
        estimate = fit["estimates"].get(name)
        if name in fit["fitted"] and None not in estimate["ci95"]:
            assert new_value == pytest.approx(estimate["value"], rel=1e-6)
            assert f"{name} {estimate['value']:.7g} (" in line and ", 95 %)" in line
        else:
            assert new_value == old and name not in line
    assert sum(new_value != old for old, new_value, _ in written.values()) >= 2
    fit["adequacy"]["verdict"] = "does-not-fit"
    results.write_text(json.dumps(fit))
    code, out, _ = called("export", unit / "study.toml", "--to", tmp_path / "kept.dyr")
    assert code == 0 and (tmp_path / "kept.dyr").read_bytes() == (folder / "plant.dyr").read_bytes()
    assert "as given, for only a value with a 95 % interval is written: the model leaves more than the noise" in out
    called("export", unit / "study.toml", "--to", tmp_path / "kept.toml")
    card = (tmp_path / "kept.toml").read_text()
    assert hi.load_model(tmp_path / "kept.toml").values["gen.H"] == before.records[0].values[4], card[:300]
