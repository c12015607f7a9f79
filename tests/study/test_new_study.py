"""`new --from`: a study from recordings of a plant of other code, whose columns have their own names and units."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.io import savemat
from typer.testing import CliRunner, Result

import hvdc_ident as hi
from hvdc_ident.cli import app
from hvdc_ident.study.column_matching import Column, Target, matching

J, B, K, R, L = 0.01, 0.1, 0.5, 1.0, 0.05
MOTOR = f"""\
schema = 1
name = "motor"
[parameters]
J = {{value = {J}, unit = "kg.m2", min = 0.001, max = 0.1, description = "inertia"}}
b = {{value = {B}, unit = "N.m.s"}}
[inputs]
v = {{value = 9.0, unit = "V"}}
load = {{value = 0.0, unit = "N.m"}}
[states]
w = {{derivative = "({K}*i - b*w - load)/J", unit = "rad/s"}}
i = {{derivative = "(v - {R}*i - {K}*w)/{L}", unit = "A"}}
[outputs]
w = {{value = "w", unit = "rad/s"}}
i_a = {{value = "i", unit = "A"}}
heat = {{value = "{R}*i**2", unit = "W"}}
"""


def call(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(a) for a in arguments])


def recorded(noise: float = 1e-3) -> dict[str, Any]:
    """The motor by scipy: a step of its voltage from 10 to 12 V at 0.5 s."""
    time = np.arange(1001) * 2e-3
    v = np.where(time >= 0.5, 12.0, 10.0)
    rest = np.linalg.solve([[B, -K], [K, R]], [0.0, 10.0])

    def derivative(_: float, x: Any) -> list[float]:
        return [(K * x[1] - B * x[0]) / J, (12.0 - R * x[1] - K * x[0]) / L]

    after = solve_ivp(derivative, (0.5, 2.0), rest, t_eval=time[time >= 0.5], rtol=1e-9, atol=1e-12)
    w, i = np.hstack([np.tile(rest[:, None], (1, int((time < 0.5).sum()))), after.y])
    random = np.random.default_rng(7)
    w, i = (x + noise * random.standard_normal(time.size) for x in (w, i))
    return {"time": time, "v": v, "w": w, "i": i}


def write_csv(path: Path, columns: dict[str, Any]) -> Path:
    np.savetxt(path, np.column_stack(list(columns.values())), delimiter=",", header=",".join(columns), comments="")
    return path


@pytest.fixture
def motor(tmp_path: Path) -> Path:
    (tmp_path / "motor.toml").write_text(MOTOR)
    return tmp_path / "motor.toml"


def test_renamed_columns_of_other_units_are_mapped_and_the_study_passes_check(motor: Path, tmp_path: Path) -> None:
    """V in kV, the current as I_arm in kA, the speed as W without a unit; no load, no heat, and a temperature."""
    r = recorded()
    columns = {"time [ms]": 1e3 * r["time"], "V [kV]": 1e-3 * r["v"], "I_arm [kA]": 1e-3 * r["i"], "W": r["w"]}
    data = write_csv(tmp_path / "run 1.csv", columns | {"winding [degC]": 0 * r["w"] + 23.0})
    shown = call("new", tmp_path / "st", "--from", data, "--model", motor)
    assert shown.exit_code == 0, shown.output
    path = tmp_path / "st" / "study.toml"
    checked = call("check", path)
    assert checked.exit_code == 0 and "event at 0.5 s" in checked.stdout and "before the event" not in checked.stdout
    lines = shown.stdout.splitlines()
    assert "input v = column V: the same name but for case and punctuation; kV is converted to V" in lines
    assert (
        "output w = column W: the same name but for case and punctuation; the file states no unit: taken as rad/s"
        in lines
    )
    (current,) = (
        line for line in lines if line.startswith("output i_a = column I_arm: its unit kA, converted to A; it reads")
    )
    rest = float(np.linalg.solve([[B, -K], [K, R]], [0.0, 10.0])[1])
    assert f"the model is at {rest:.4g} A" in current  # at the recorded 10 V, not at the model's own 9 V
    assert "inputs without a column keep their values: load = 0 N.m" in lines
    assert "outputs without a column: heat" in lines and "columns not used: winding" in lines
    table = tomllib.loads(path.read_text())
    (experiment,) = table["experiment"]
    assert experiment["inputs"] == {"v": "V"} and experiment["outputs"] == {"w": "W", "i_a": "I_arm"}
    assert experiment["data"] == "../run 1.csv" and table["model"]["source"] == "../motor.toml"
    simulated = json.loads(call("simulate", path, "--json").stdout)
    for output in ("w", "i_a"):  # the card is the plant: what is left is the noise
        assert simulated["rmse"][output]["run 1"] == pytest.approx(1e-3, rel=0.1)


def test_the_commented_parameters_and_stages_are_ready_to_be_taken(motor: Path, tmp_path: Path) -> None:
    r = recorded()
    data = write_csv(tmp_path / "a.csv", {"time [s]": r["time"], "v": r["v"], "w": r["w"]})
    assert call("new", tmp_path / "st", "--from", data, "--model", motor).exit_code == 0
    path = tmp_path / "st" / "study.toml"
    path.write_text(path.read_text().replace("# J = {start = 0.01}", "J = {start = 0.02}").replace("# [fit]", "[fit]"))
    result = call("fit", path, "--json")
    assert result.exit_code == 0, result.output
    low, high = json.loads(result.stdout)["estimates"]["J"]["ci95"]
    assert low < J < high


def test_each_recording_is_an_experiment_whatever_its_format(motor: Path, tmp_path: Path) -> None:
    r = recorded()
    table = {"time [s]": r["time"], "v": r["v"], "w": r["w"]}
    (tmp_path / "other").mkdir()
    first, second = write_csv(tmp_path / "a.csv", table), write_csv(tmp_path / "other" / "a.csv", table)
    savemat(tmp_path / "m.mat", {"time": r["time"], "v": r["v"], "w": r["w"]})
    found = hi.new_study(tmp_path / "st", [first, second, tmp_path / "m.mat"], motor)
    study = hi.load_study(found.path)
    assert [e.name for e in study.experiments] == ["a", "a-2", "m"]
    assert all(e.event == pytest.approx(0.5) and e.outputs == ("w",) for e in study.experiments)


def test_a_unit_that_needs_a_base_is_proposed_with_the_base_and_not_mapped(tmp_path: Path) -> None:
    time = np.arange(900) * 1e-3
    order = np.where(time >= 0.1, 50.0, 40.0)
    power = np.where(time >= 0.1, 50.0 - 10.0 * np.exp(-30.0 * (time - 0.1)), 40.0)
    data = write_csv(
        tmp_path / "b.csv", {"time [s]": time, "Pref2 [MW]": order, "P_2 [MW]": power, "Vdc1 [%]": 100.0 + 0.0 * time}
    )
    found = call("new", tmp_path / "st", "--from", data, "--model", "vsc-hvdc-link", "--json")
    told = json.loads(found.stdout)["experiments"]["b"]
    assert list(told["mapped"]) == ["Vdc1"]  # percent is a number of per unit
    assert {p["signal"]: p["base"] for p in told["proposed"]} == {"Pref2": 100.0, "P2": 100.0}
    path = tmp_path / "st" / "study.toml"
    assert call("check", path).exit_code == 0
    taken = path.read_text()
    for line in ("[experiment.inputs]", 'Pref2 = "Pref2"', 'P2 = "P_2"', "[experiment.columns]", "Pref2 = {", "P2 = {"):
        assert f"# {line}" in taken
        taken = taken.replace(f"# {line}", line)
    path.write_text(taken)
    study = hi.load_study(path)
    e = study.experiments[0]
    assert e.event == pytest.approx(0.1) and e.measured is not None
    np.testing.assert_allclose(e.measured["P2"], power / 100.0, rtol=1e-12)
    assert "the model rests at" not in call("check", path).stdout


def test_levels_alone_map_nothing_and_are_said(tmp_path: Path) -> None:
    """Columns without units or known names: every candidate is a comment, and the study still loads."""
    time = np.arange(300) * 1e-3
    data = write_csv(
        tmp_path / "c.csv", {"t": time, "order": np.where(time >= 0.1, 0.5, 0.4), "chan 7": 0 * time + 7.0}
    )
    found = hi.new_study(tmp_path / "st", data, "vsc-hvdc-link")
    (r,) = found.recordings
    assert r.columns.mapped == () and r.experiment is None and r.columns.unused == ("chan 7",)
    assert [m.target.name for m in r.columns.proposed] == ["Pref2", "P2", "Idc"]  # 0.4, 0.4 and 0.39996 pu
    assert all("no unit is stated; it reads 0.4 pu" in m.reason for m in r.columns.proposed)
    assert "c: no output could be mapped" in str(found) and "take out the #" in str(found)
    assert '# Pref2 = "order"' in found.path.read_text()
    assert hi.load_study(found.path).experiments == ()


A, B1, B2 = (Target(n, "output", u, v) for n, u, v in (("a", "A", 2.0), ("b1", "V", 5.0), ("b2", "V", 5.0)))


@pytest.mark.parametrize(
    ("columns", "mapped", "proposed"),
    [
        ([Column("x", "kA", 0.0021, 0.0)], {"a": "x"}, []),  # the only one of its unit, at its level
        ([Column("x", "kA", 0.0042, 0.0)], {}, [("a", "x")]),  # at another level
        ([Column("x", "A", 2.0, 0.0), Column("y", "A", 2.1, 0.0)], {}, [("a", "x"), ("a", "y")]),
        ([Column("x", "V", 5.0, 0.0)], {}, [("b1", "x"), ("b2", "x")]),
        ([Column("x", "", 2.0, 0.0)], {}, [("a", "x")]),  # no unit: the level is all there is
        ([Column("x", "", 900.0, 0.0)], {}, []),
        ([Column("A.", "kA", 900.0, 0.0)], {"a": "A."}, []),  # a name counts whatever the level
        ([Column("a", "V", 2.0, 0.0)], {}, [("a", "a")]),
        ([Column("A", "A", 2.0, 0.0), Column("a_", "A", 2.0, 0.0)], {}, [("a", "A"), ("a", "a_")]),
    ],
)
def test_what_maps_and_what_is_proposed(columns: list[Column], mapped: Any, proposed: Any) -> None:
    found = matching(columns, (A, B1, B2))
    assert {m.target.name: m.column.name for m in found.mapped} == mapped
    assert [(m.target.name, m.column.name) for m in found.proposed] == proposed


def test_an_input_with_gaps_is_mapped_and_its_gaps_are_left_out(motor: Path, tmp_path: Path) -> None:
    r = recorded()
    v = r["v"].astype(object)
    v[7] = ""
    rows = "\n".join(f"{t},{a},{b}" for t, a, b in zip(r["time"], v, r["w"], strict=True))
    (tmp_path / "a.csv").write_text(f"time [s],v,w\n{rows}\n")
    found = hi.new_study(tmp_path / "st", tmp_path / "a.csv", motor)
    assert not found.recordings[0].columns.proposed
    (experiment,) = hi.load_study(found.path).experiments
    line = np.interp(r["time"][7], r["time"][[6, 8]], r["v"][[6, 8]])
    assert experiment.inputs["v"](r["time"][7]) == pytest.approx(line) and np.isnan(experiment.measured["w"][7])
    at = f"{r['time'][7]:.12g}"
    assert f"leave_out = {{v = [[{at}, {at}]]}}" in found.path.read_text()
    (said,) = experiment.measured.origin.contradictions
    assert said.rows == (8, 8) and said.done


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--from", "a.csv"), "--from and --model go together"),
        (("--model", "motor.toml"), "--from and --model go together"),
        (("--from", "none.csv", "--model", "motor.toml"), "no such file"),
        (("--from", "a.csv", "--model", "vsc-hvdc-lnk"), "vsc-hvdc-link"),
    ],
)
def test_what_cannot_be_made_is_refused_and_nothing_written(
    motor: Path, tmp_path: Path, words: tuple[str, ...], reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    r = recorded()
    write_csv(tmp_path / "a.csv", {"time [s]": r["time"], "v": r["v"], "w": r["w"]})
    result = call("new", "st", *words)
    assert result.exit_code == 2 and reason in result.stderr and ". Try: " in result.stderr
    assert not (tmp_path / "st").exists()


def test_a_study_is_never_overwritten(motor: Path, tmp_path: Path) -> None:
    r = recorded()
    data = write_csv(tmp_path / "a.csv", {"time [s]": r["time"], "v": r["v"], "w": r["w"]})
    assert call("new", tmp_path / "st", "--from", data, "--model", motor).exit_code == 0
    again = call("new", tmp_path / "st", "--from", data, "--model", motor)
    assert again.exit_code == 2 and "already holds a study" in again.stderr


def test_hostile_names_stay_text(tmp_path: Path) -> None:
    """Names that would end a comment, a string or a table of the study: they come back as they were, and add nothing."""
    evil = ['x"]\n[fit]\nstarts = 1 #', "y\u2028[diagnose]", "a\\", "=1+1", "näme 7"]
    path = tmp_path / "evil.hdf5"
    with h5py.File(path, "w") as file:
        file["time"] = np.arange(50) * 0.01
        for number, name in enumerate((*evil, "Vdc1")):
            file[name] = np.full(50, 1.0 + number)
    found = hi.new_study(tmp_path / "st", path, "vsc-hvdc-link")
    table = tomllib.loads(found.path.read_text("utf-8"))
    assert set(table) == {"schema", "name", "model", "parameters", "experiment"} and table["parameters"] == {}
    assert [e["outputs"] for e in table["experiment"]] == [{"Vdc1": "Vdc1"}]
    assert set(found.recordings[0].columns.unused) | {
        m.column.name for m in found.recordings[0].columns.proposed
    } == set(evil)
    hi.load_study(found.path)


THREE = """schema = 1
name = "converter"
[parameters]
T = {value = 0.05, unit = "s"}
Vb = {value = 400.0, unit = "kV"}
Sb = {value = 200.0, unit = "MVA"}
[inputs]
V = {value = 1.0, unit = "UNIT"}
[states]
x = {derivative = "(V/SIZE - x)/T", unit = "pu"}
[outputs]
P = {value = "100e6*x", unit = "W"}
"""


def three_phases(path: Path, unit: str = "kV") -> Path:
    """400 kV that fall to 80 % at 0.3 s, and the currents of 100 MW that follow with 50 ms; the raw phases alone."""
    time = np.arange(0.0, 1.0, 1e-4)
    voltage = np.where(time >= 0.3, 0.8, 1.0) * 400.0 * np.sqrt(2.0 / 3.0)
    power = np.where(time >= 0.3, 0.8 + 0.2 * np.exp(-(time - 0.3) / 0.05), 1.0) * 1e5
    random = np.random.default_rng(5)
    columns = {"time [s]": time}
    for name, size, of in (("U", voltage, unit), ("I", power / (1.5 * voltage), "A")):
        for k, phase in enumerate("ABC"):
            wave = np.cos(2 * np.pi * 50 * time - 2 * np.pi * k / 3) + 1e-3 * random.standard_normal(time.size)
            columns[f"{name}{phase} [{of}]"] = size * wave * (1e3 if of == "V" else 1.0)
    return write_csv(path, columns)


def test_phases_are_proposed_and_what_they_give_is_mapped(tmp_path: Path) -> None:
    """A model in V, line to line rms: the two magnitudes of the phases are told apart by their levels."""
    (tmp_path / "c.toml").write_text(
        THREE.replace("UNIT", "kV").replace("SIZE", "400").replace("1.0, unit", "400, unit")
    )
    shown = call(
        "new", tmp_path / "st", "--from", three_phases(tmp_path / "r.csv"), "--model", tmp_path / "c.toml", "--json"
    )
    assert shown.exit_code == 0, shown.output
    told = json.loads(shown.stdout)["experiments"]["r"]
    assert told["mapped"]["P"]["column"] == "p" and "V" not in told["mapped"] and told["unused"] == []
    candidates = {p["column"]: p["reason"] for p in told["proposed"] if p["signal"] == "V"}
    assert "phase to ground, peak; it reads 326.6 kV" in candidates["v"] and "the model is at 400 kV" in candidates["v"]
    assert "it reads 400 kV" in candidates["v-rms"]
    (line,) = told["phases"]
    assert (line["voltage"], line["current"]) == (["UA", "UB", "UC"], ["IA", "IB", "IC"]) and line["frequency"] == 50.0
    assert line["gives"]["p"] == "p"
    path = tmp_path / "st" / "study.toml"
    (experiment,) = tomllib.loads(path.read_text())["experiment"]
    assert experiment["phases"] == told["phases"] and experiment["outputs"] == {"P": "p"}
    (read,) = hi.load_study(path).experiments
    assert read.measured is not None and read.measured["P"][0] == pytest.approx(1e8, rel=1e-2)
    text = path.read_text().replace("# [experiment.inputs]", "[experiment.inputs]")
    path.write_text(text.replace('# V = "v-rms"', 'V = "v-rms"'))
    (read,) = hi.load_study(path).experiments
    assert read.event == pytest.approx(0.3, abs=1e-3) and 0.0 < read.noise["P"] < 1e-3 * 1e8


@pytest.mark.parametrize("unit", ["kV", "V"])
def test_the_base_of_a_peak_is_told_from_the_rated_voltage(tmp_path: Path, unit: str) -> None:
    (tmp_path / "c.toml").write_text(THREE.replace("UNIT", "pu").replace("SIZE", "1"))
    shown = call(
        "new",
        tmp_path / "st",
        "--from",
        three_phases(tmp_path / "r.csv", unit),
        "--model",
        tmp_path / "c.toml",
        "--json",
    )
    told = json.loads(shown.stdout)["experiments"]["r"]["proposed"]
    (voltage,) = (p for p in told if p["signal"] == "V" and p["column"] == "v")
    base = 400.0 * np.sqrt(2.0 / 3.0) * (1e3 if unit == "V" else 1.0)
    assert voltage["base"] == pytest.approx(base, rel=1e-5)
    assert "of the base Vb = 400 by sqrt(2/3): peak of phase for rms of line to line?" in voltage["reason"]


def test_units_in_names_count_as_those_in_headers(motor: Path, tmp_path: Path) -> None:
    r = recorded()
    data = write_csv(
        tmp_path / "a.csv",
        {"time_ms": 1e3 * r["time"], "v_kV": 1e-3 * r["v"], "w_rpm": r["w"] * 30 / np.pi, "i_a": r["i"]},
    )
    found = hi.new_study(tmp_path / "st", data, motor)
    assert {m.target.name: (m.column.name, m.column.unit) for m in found.recordings[0].columns.mapped} == {
        "v": ("v_kV", "kV"), "w": ("w_rpm", "rpm"), "i_a": ("i_a", ""),
    }  # fmt: skip
    (e,) = hi.load_study(found.path).experiments
    assert e.event == pytest.approx(0.5) and e.measured is not None
    np.testing.assert_allclose(e.measured["w"], r["w"], rtol=1e-12)
