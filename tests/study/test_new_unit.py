"""`new --dyr`: all that the files of a unit state is used, or named as not used."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from typer.testing import CliRunner

import hvdc_ident as hi
from hvdc_ident.cli import app
from hvdc_ident.plants import RecordedUnit, UnitPart, idle_parts, parts_of, shelf_model
from hvdc_ident.shelf import asked_of, components, record_of
from hvdc_ident.study.new_unit import asked_about, offered
from tests.plants.test_against_andes import CASES

GENROU = "101 'GENROU' 1 7.0 0.03 0.75 0.05 3.0 0.0 2.1 2.0 0.2 0.5 0.18 0.15 0.05 0.3 /\n"
SEXS = "101 'SEXS' 1 0.1 10.0 100.0 0.1 0.0 5.0 /\n"
TGOV1 = "101 'TGOV1' 1 0.05 0.5 1.0 0.0 2.0 6.0 0.0 /\n"
MACHINE = "101,'1',200.0,31.5,120.0,-80.0,1.02,0,250.0,0.003,0.18"


def raw(machine: str = MACHINE, *, frequency: float = 60.0, bus_type: int = 2) -> str:
    return (
        f"0, 100.0, 33, 0, 0, {frequency} / case\none\ntwo\n101,'UNIT', 20.0,{bus_type},1,1,1,1.02,10.5\n"
        f"0 / END OF BUS DATA\n0 / END OF LOAD DATA\n0 / END OF FIXED SHUNT DATA\n{machine}\n0 / END OF GENERATOR DATA\nQ\n"
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A .dyr of a machine with exciter and governor, and a record of 4 s without a frequency."""
    (tmp_path / "plant.dyr").write_text(GENROU + SEXS + TGOV1, encoding="utf-8")
    times = np.arange(0.0, 4.0, 0.02)
    rng = np.random.default_rng(5)
    noise = 1e-3 * rng.standard_normal((4, times.size))
    V = np.where(times < 1.0, 1.02, 1.0)
    table = np.column_stack([times, V + 0.1 * noise[0], 0.1 * noise[1], 200.0 + noise[2], 31.5 + noise[3]])
    np.savetxt(tmp_path / "event.csv", table, delimiter=",", header="time,V,theta,P,Q", comments="")
    return tmp_path


def new(folder: Path, *options: object, power_flow: str | None = None, dyr: str | None = None) -> tuple[int, str]:
    """Return the exit code of `new` in a folder with these files, and all that it says."""
    if dyr is not None:
        (folder / "plant.dyr").write_text(dyr, encoding="utf-8")
    if power_flow is not None:
        (folder / "grid.raw").write_text(power_flow, encoding="utf-8")
    given = [] if power_flow is None else ["--raw", folder / "grid.raw"]
    words = ["new", folder / "unit", "--dyr", folder / "plant.dyr", "--bus", 101, *given, *options]
    result = CliRunner().invoke(app, [str(w) for w in [*words, "--from", folder / "event.csv"]])
    return result.exit_code, result.stdout + result.stderr


def values(folder: Path) -> dict[str, float]:
    return dict(hi.load_study(folder / "unit" / "study.toml").model.values)


def test_what_the_power_flow_states_is_used(folder: Path) -> None:
    code, said = new(folder, power_flow=raw())
    assert code == 0
    at = values(folder)
    assert (at["gen.Ra"], at["gen.Sn"], at["gen.Sb"], at["gen.f0"]) == (0.003, 250.0, 100.0, 60.0)
    used = "grid.raw states, and is used: 100 MVA of the system (SBASE), 250 MVA of the machine (MBASE), 60 Hz (BASFRQ), 20 kV (BASKV)"
    assert f"{used} and gen.Ra = 0.003 pu (ZR)" in said
    assert "is not used: PG 200 MW, QG 31.5 Mvar" in said and "ZX" not in said  # it equals Xpp of the record
    study = (folder / "unit" / "study.toml").read_text(encoding="utf-8")
    assert f"# {used}" in study and "# grid.raw states, and is not used: PG 200 MW" in study


def test_a_source_reactance_that_contradicts_the_record_is_said(folder: Path) -> None:
    code, said = new(folder, power_flow=raw(MACHINE.replace("0.18", "0.25")))
    assert code == 0 and "ZX 0.25 pu (GENROU has Xpp 0.18 itself, and PSS/E wants the same)" in said
    assert values(folder)["gen.Xpp"] == 0.18


def test_the_impedance_of_a_classical_machine_is_that_of_the_power_flow(folder: Path) -> None:
    """Its inertia is then found: 4 s of a swing by scipy, where the .dyr says 3 s."""
    H, D, x, r, base = 4.0, 1.5, 0.21, 0.004, 250.0
    times = np.arange(0.0, 6.0, 0.02)

    def V(t: float) -> float:
        return float(np.interp(t, [1.0, 1.2], [1.02, 0.98]))

    current = np.conj((200.0 + 31.5j) / base / V(0.0))
    internal = V(0.0) + (r + 1j * x) * current

    def power(angle: float, t: float) -> tuple[float, complex]:
        e = abs(internal) * np.exp(1j * angle)
        i = (e - V(t)) / (r + 1j * x)
        return float((e * np.conj(i)).real), complex(V(t) * np.conj(i))

    turbine = power(float(np.angle(internal)), 0.0)[0]

    def rate(t: float, y: np.ndarray) -> list[float]:
        return [2 * np.pi * 50.0 * y[1], (turbine - D * y[1] - power(y[0], t)[0]) / (2 * H)]

    swing = solve_ivp(rate, (0, 6), [np.angle(internal), 0.0], t_eval=times, rtol=1e-9, atol=1e-11, max_step=0.01)
    S = base * np.array([power(a, t)[1] for a, t in zip(swing.y[0], times, strict=True)])
    noise = 0.05 * np.random.default_rng(1).standard_normal((2, times.size))
    table = np.column_stack([times, [V(t) for t in times], 0 * times, S.real + noise[0], S.imag + noise[1]])
    np.savetxt(folder / "event.csv", table, delimiter=",", header="time,V,theta,P,Q", comments="")
    machine = MACHINE.replace("0.003,0.18", f"{r},{x}")
    code, said = new(folder, power_flow=raw(machine, frequency=50.0), dyr="101 'GENCLS' 1 3.0 1.5 /\n")
    assert code == 0 and "gen.Xpd = 0.21 pu (ZX)" in said and "gen.Ra = 0.004 pu (ZR)" in said
    study = folder / "unit" / "study.toml"
    assert CliRunner().invoke(app, ["fit", str(study), "--quiet"]).exit_code == 0
    found = json.loads((folder / "unit" / "study-results" / "fit.json").read_text("utf-8"))["estimates"]["gen.H"]
    low, high = found["ci95"]
    assert found["value"] == pytest.approx(H, rel=2e-3) and low < H < high


def test_without_a_power_flow_the_shelf_values_are_named(folder: Path) -> None:
    code, said = new(folder, "--base", 250, "--frequency", 50, dyr="101 'GENCLS' 1 3.0 1.5 /\n")
    assert (
        code == 0
        and "no power flow (a .raw file) is given, which has these: gen.Xpd = 0.3 pu (ZX) and gen.Ra = 0 pu (ZR)"
        in said
    )


@pytest.mark.parametrize(
    ("status", "bus_type", "expected"),
    [
        (0, 2, ["machine 1 of bus 101 is out of service in grid.raw (STAT 0, line 8)"]),
        (1, 1, ["bus 101 is a load bus (IDE 1) in grid.raw, where PSS/E takes its machines as out of service"]),
        (1, 3, ["bus 101 is the swing bus of grid.raw (IDE 3)"]),
        (0, 4, ["STAT 0", "bus 101 is disconnected in grid.raw (IDE 4)"]),
        (1, 2, []),
    ],
)
def test_a_machine_that_the_power_flow_has_not_in_service_is_said(
    folder: Path, status: int, bus_type: int, expected
) -> None:
    code, said = new(folder, power_flow=raw(f"{MACHINE},0,0,1.0,{status}", bus_type=bus_type))
    assert code == 0 and all(text in said for text in expected)
    assert ("out of service" in said or "IDE" in said) == bool(expected)


def test_the_step_up_transformer_of_a_machine_lies_between_it_and_the_bus(folder: Path) -> None:
    """Its terminal voltage by complex numbers: V/GTAP + (RT + j XT) I."""
    code, said = new(folder, power_flow=raw(f"{MACHINE},0.004,0.12,1.05,1"))
    assert code == 0 and "step-up transformer in grid.raw (RT 0.004, XT 0.12, GTAP 1.05)" in said
    study = hi.load_study(folder / "unit" / "study.toml")
    point = hi.find_operating_point(study.model, {"V": 1.02, "P0": 200.0, "Q0": 31.5, "f": 60.0})
    current = np.conj((200.0 + 31.5j) / 250.0 / 1.02) * 1.05
    assert point.outputs["Vt"] == pytest.approx(abs(1.02 / 1.05 + (0.004 + 0.12j) * current), rel=1e-9)
    assert (point.outputs["P"], point.outputs["Q"]) == pytest.approx((200.0, 31.5), abs=1e-6)
    assert not any(place.startswith("step_up") for place in study.settings.diagnose.places)


def test_a_tap_without_an_impedance_is_named(folder: Path) -> None:
    code, said = new(folder, power_flow=raw(f"{MACHINE},0,0,1.05,1"))
    assert code == 0 and "GTAP 1.05 in grid.raw, which is not used" in said


def test_what_is_asked_for_counts_and_the_files_are_named(folder: Path) -> None:
    code, said = new(folder, "--base", 240, "--frequency", 50, power_flow=raw())
    assert code == 0 and "250 MVA of the machine (MBASE): 240 is asked for" in said
    assert "60 Hz (BASFRQ): 50 is asked for" in said
    assert (values(folder)["gen.Sn"], values(folder)["gen.f0"]) == (240.0, 50.0)


def test_values_of_a_record_that_no_component_uses_are_named(folder: Path) -> None:
    code, said = new(folder, power_flow=raw(), dyr=GENROU + SEXS + "101 'IEEEG1' 1 7 'A' " + IEEEG1)
    assert (
        code == 0
        and "not used of the records, as a remote bus or branch: value 1 of IEEEG1 (7) and value 2 of IEEEG1 ('A')"
        in said
    )


IEEEG1 = "20.0 0.0 0.0 0.15 0.30 -0.30 1.0 0.0 0.25 0.30 0.0 7.0 0.40 0.0 0.45 0.30 0.0 0.0 0.0 0.0 /\n"


@pytest.mark.parametrize(
    ("dyr", "expected"),
    [
        (
            GENROU + SEXS.replace("0.1 10.0", "0,1 10,0"),
            "plant.dyr:2: the record of SEXS has 8 values; expected 6: TAoTB, TB, K, TE, EMIN, EMAX, got TAoTB 0, TB 1, K 10, TE 0, "
            "EMIN 100, EMAX 0.1, and then 0, 5. Try: decimal points: 0.1 for 0,1, 10.0 for 10,0",
        ),
        (GENROU + SEXS.replace(" 5.0", ""), "plant.dyr:2: the record of SEXS has 5 values; expected 6: TAoTB"),
        (GENROU + SEXS.replace(" 5.0", ""), "got TAoTB 0.1, TB 10, K 100, TE 0.1, EMIN 0, and no EMAX"),
        (GENROU + SEXS.replace("/", "9 9 /"), "plant.dyr:2: the record of SEXS has 8 values"),
        (
            GENROU + SEXS.replace("100.0", "'A'"),
            "plant.dyr:2: K of SEXS has no number; expected a number, for dynamic data have no",
        ),
        (GENROU + SEXS.replace("100.0", ",,"), "K of SEXS has no number"),
        (
            GENROU + SEXS + "101 'SCRX' 1 0.1 10.0 100.0 0.1 0.0 5.0 0 0 /\n",
            "plant.dyr:3: two records of one part: SEXS and SCRX",
        ),
        (
            SEXS,
            "plant.dyr:1: no record of a machine or converter that is on the shelf; expected one of DERA1, GENCLS, GENROU",
        ),
    ],
)
def test_a_wrong_record_is_said_with_file_line_and_value(folder: Path, dyr: str, expected: str) -> None:
    code, said = new(folder, power_flow=raw(), dyr=dyr)
    assert code == 2 and expected in " ".join(said.split())
    assert not (folder / "unit").exists()


def test_the_frequency_comes_from_a_record_or_is_asked_for(folder: Path) -> None:
    code, said = new(folder, "--base", 250)
    assert code == 2 and "the nominal frequency is not known" in said and "--frequency 60" in said
    rows = np.loadtxt(folder / "event.csv", delimiter=",", skiprows=1)
    rows[:, 2] = 59.98
    np.savetxt(folder / "event.csv", rows, delimiter=",", header="time,V,f,P,Q", comments="")
    code, said = new(folder, "--base", 250)
    assert code == 0 and "60 Hz: column f of event.csv reads 59.98 Hz" in said
    assert values(folder)["gen.f0"] == values(folder)["bus.f0"] == 60.0


def test_a_record_of_another_frequency_than_stated_is_said(folder: Path) -> None:
    rows = np.loadtxt(folder / "event.csv", delimiter=",", skiprows=1)
    rows[:, 2] = 49.98
    np.savetxt(folder / "event.csv", rows, delimiter=",", header="time,V,f,P,Q", comments="")
    code, said = new(folder, power_flow=raw())
    assert code == 0 and "60 Hz: but column f of event.csv reads 49.98 Hz" in said


@pytest.mark.parametrize(
    ("records", "expected", "asked"),
    [
        (
            "101 'OURS9' 1 0.02 150.0 0.05 6.0 -6.0 1.0 0.60 0.05 1.20 0 3.50 0.10 4.60 0.35 /\n" + TGOV1,
            [
                "nearest on the shelf: IEEET1, with 14 values as well",
                "no part gives Efd (field voltage), which stays as before",
            ],
            {"gen.H", "gov.R"},
        ),
        (
            SEXS + "101 'TGOV9' 1 0.05 0.5 1.0 0.0 2.0 6.0 0.0 0.0 /\n",
            [
                "TGOV9 (line 3 of the .dyr)",
                "nearest on the shelf: TGOV1, by name",
                "no part gives Pm (mechanical power)",
            ],
            {"gen.H", "avr.K"},
        ),
        (
            "101 'MYAVR' 1 1.0 /\n101 'IEEEST' 1 1 0 0 0 0 0 0 0 0.2 0.05 0.25 0.05 5.0 5.0 8.0 0.1 -0.1 0 0 /\n"
            + TGOV1,
            ["MYAVR (line 2 of the .dyr)", "IEEEST then acts on nothing", "asked about: gen.H and gov.R"],
            {"gen.H", "gov.R"},
        ),
    ],
)
def test_a_model_that_is_not_on_the_shelf_is_said_with_what_is_left(folder: Path, records, expected, asked) -> None:
    code, said = new(folder, power_flow=raw(), dyr=GENROU + records)
    assert code == 0 and all(text in said for text in expected), said
    assert "is not in the model, and is not fitted" in said
    assert set(hi.load_study(folder / "unit" / "study.toml").candidates) == asked


def test_the_gains_of_an_exciter_stand_in_the_study(folder: Path) -> None:
    record = "0.02 3.15 3.15 1.0 -0.87 0.02 1.0 0.0 99.0 -99.0 0.0 6.5 0.0 8.1 0.08 0.09 0.0"
    code, said = new(folder, power_flow=raw(), dyr=f"{GENROU}101 'ESST4B' 1 {record} /\n")
    assert code == 0, said
    section = (folder / "unit" / "study.toml").read_text("utf-8").split("[parameters]")[1].split("\n\n")[0]
    assert '"avr.KPR" = {min = 0.7875, max = 12.6}' in section.splitlines()
    lines = [line.removeprefix("# ") for line in section.splitlines() if "{min" in line]
    assert {"avr.KPR", "avr.KIR", "avr.TR", "avr.KPM", "avr.KP"} <= set(tomllib.loads("\n".join(lines)))


@pytest.mark.parametrize("card", [c for c in components() if record_of(c)])
def test_every_card_offers_its_gains_and_time_constants(card: str) -> None:
    """By their names in the standards: K..., R and r, H and D for gains, T... in s for time constants; one that is 0 is no block."""
    parts = {"part": UnitPart(card, dict(shelf_model(card).values))}
    unit = RecordedUnit(parts, ())
    bounds = offered(unit)
    parameters = shelf_model(card).parameters
    named = {
        n
        for n in record_of(card)
        if n != "-"
        and parameters[n].value
        and (n[0] == "K" or n in ("R", "r", "H", "D") or (n[0] == "T" and parameters[n].unit == "s"))
    }
    assert named and {f"part.{n}" for n in named} <= set(bounds)
    for n in named:
        low, high = bounds[f"part.{n}"]
        assert low < high and low <= parameters[n].value <= high
    assert not any(flag in n.lower() for n in bounds for flag in ("flag", "max", "min"))


@pytest.mark.parametrize("case", CASES)
def test_a_unit_asks_about_each_part_that_has_something_to_ask(case: str) -> None:
    unit = RecordedUnit(parts_of(CASES[case]), ())
    found = {n.split(".")[0] for n in asked_about(unit)}
    assert found == {n for n, p in unit.parts.items() if asked_of(p.source) and n not in idle_parts(unit.parts)}
