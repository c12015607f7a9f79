"""Records at a unit's terminals in the habits of recorders, and with wrong units, bases and signs: taken right, or said."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hvdc_ident as hi
from hvdc_ident.data import Array, InputSignal
from hvdc_ident.model import Model, parse_card
from hvdc_ident.plants import UnitPart, unit_card
from hvdc_ident.study.column_contradictions import column_contradictions
from hvdc_ident.study.new_study import NewStudy
from hvdc_ident.study.new_unit import UnitAsked, new_unit_study

DYR = """12 'GENROU' 1  7.0 0.03 0.75 0.05 3.0 0.0 2.1 2.0 0.2 0.5 0.18 0.15 0.05 0.3 /
12 'SEXS' 1  0.1 10.0 100.0 0.1 0.0 5.0 /
12 'TGOV1' 1 0.05 0.5 1.0 0.0 2.0 6.0 0.0 /
"""
RAW = """0, 100.0, 33, 0, 0, 60.0 / case
one
two
12,'NORTHPORT 12', 18.0,2,1,1,1,1.02,10.5
0 / END OF BUS DATA
0 / END OF LOAD DATA
0 / END OF FIXED SHUNT DATA
12,'1 ',200.0,31.5,120.0,-80.0,1.02,0,250.0,0.0,0.25
0 / END OF GENERATOR DATA
Q
"""
KV, F0, MVA, RATE = 18.0, 60.0, 250.0, 50.0
Columns = dict[str, Array]


@pytest.fixture(scope="module")
def machine() -> Model:
    """The unit behind a line, at rest; E is the voltage there, and turn its angle."""
    parts = {
        "gen": UnitPart("genrou", {"Sn": MVA, "H": 3.6}),
        "avr": UnitPart("sexs", {"K": 140.0}),
        "gov": UnitPart("tgov1"),
    }
    card = unit_card(parts, R=0.004, X=0.12, f0=F0)
    seen = '[outputs]\nVr = {value = "line.Vr", unit = "pu"}\nVi = {value = "line.Vi", unit = "pu"}'
    card = card.replace("[outputs]", seen).replace('"grid.theta" = "0"', '"grid.theta" = "turn"')
    model = parse_card(card.replace("[inputs]", '[inputs]\nturn = {value = 0.0, unit = "rad", settable = false}'))
    point = hi.find_operating_point(model, outputs={"P": 200.0, "Vt": 1.02}, free=["Pref", "Vref"])
    return model.with_values(point.inputs)


def recorded(machine: Model, noise: float = 1.0, **inputs: InputSignal) -> Columns:
    """What a recorder sees at the terminals: V in pu, theta in rad, f in Hz, MW and Mvar, with so many times the usual noise."""
    time = np.arange(0.0, 4.0, 1.0 / RATE)
    run = hi.simulate(machine, time, inputs=inputs)
    angle = np.unwrap(np.arctan2(run["Vi"], run["Vr"]))
    rng = np.random.default_rng(3)

    def noisy(values: Array, std: float) -> Array:
        return np.asarray(values + noise * std * rng.standard_normal(time.size))

    f = F0 + np.gradient(angle, time) / (2.0 * np.pi)
    return {
        "time": time,
        "V": noisy(run["Vt"], 1e-4),
        "theta": noisy(angle, 1e-4),
        "f": noisy(f, 1e-3),
        "P": noisy(run["P"], 0.1),
        "Q": noisy(run["Q"], 0.1),
    }


@pytest.fixture(scope="module")
def plant(machine: Model) -> Columns:
    """A dip of the voltage behind the line, then a lower one."""
    return recorded(machine, E=InputSignal.corners([(1.0, 1.0), (1.1, 0.8), (1.3, 0.97)]))


@pytest.fixture(scope="module")
def turning(machine: Model) -> Columns:
    """The angle behind the line moves by some degrees and the voltage stays; the machine has the inertia that its file states."""
    course = InputSignal.corners([(1.0, 0.0), (1.2, 0.15), (2.0, -0.1)])
    return recorded(machine.with_values({"gen.H": 3.0}), turn=course)


def written(folder: Path, columns: Mapping[str, Array]) -> Path:
    rows = "\n".join(",".join(f"{v:.7g}" for v in row) for row in np.column_stack(list(columns.values())))
    (folder / "event.csv").write_text(f"{','.join(columns)}\n{rows}\n")
    return folder / "event.csv"


def new(folder: Path, columns: Mapping[str, Array]) -> NewStudy:
    """The study of a record in a folder, as `new --dyr --raw --bus` writes it."""
    (folder / "plant.dyr").write_text(DYR)
    (folder / "grid.raw").write_text(RAW)
    asked = UnitAsked(folder / "plant.dyr", 12, raw=folder / "grid.raw")
    return new_unit_study(folder / "unit", written(folder, columns), asked)


def wrapped(angle: Array) -> Array:
    return np.asarray(np.angle(np.exp(1j * angle)))


def habits(p: Columns) -> dict[str, Columns]:
    """The record in the habits of concentrators, relays and historians."""
    deg = np.degrees(p["theta"])
    return {
        "station in front": {
            "Time [s]": p["time"], "NORTHPORT V1 Mag [kV]": KV * p["V"], "NORTHPORT V1 Ang [deg]": np.degrees(wrapped(p["theta"] + 3.1)),
            "NORTHPORT Freq [Hz]": p["f"], "NORTHPORT P [MW]": p["P"], "NORTHPORT Q [MVAR]": p["Q"],
        },
        "underscores": {"time": p["time"], "U1_mag (kV)": KV * p["V"], "U1_ang (deg)": deg, "P_MW": p["P"], "Q_MVAR": p["Q"]},
        "phasors": {
            "time": p["time"], "VPM_kV": KV * p["V"], "VPA_deg": deg, "IPM_A": 100.0 + p["V"], "IPA_deg": deg - 10.0, "FREQ": p["f"],
            "DFREQ": np.gradient(p["f"], p["time"]), "MW": p["P"], "MVAR": p["Q"],
        },
        "words": {"time": p["time"], "Voltage": p["V"], "Angle": p["theta"], "ActivePower": p["P"], "ReactivePower": p["Q"]},
        "phase to ground": {"time": p["time"], "V [kV]": KV / 3**0.5 * p["V"], "theta": p["theta"], "P": p["P"], "Q": p["Q"]},
        "volts": {"time": p["time"], "VM [V]": 1e3 * KV * p["V"], "VA [deg]": deg, "P [kW]": 1e3 * p["P"], "Q [kvar]": 1e3 * p["Q"]},
        "volts without unit": {"time": p["time"], "VM": 1e3 * KV * p["V"], "VA": deg, "P": 1e3 * p["P"], "Q": 1e3 * p["Q"]},
        "degrees without unit": {"time": p["time"], "V": p["V"], "theta": deg, "P": p["P"], "Q": p["Q"]},
        "pu of the machine": {"time": p["time"], "V": p["V"], "theta": p["theta"], "P": p["P"] / MVA, "Q": p["Q"] / MVA},
        "pu of the system": {"time": p["time"], "V": p["V"], "theta": p["theta"], "P": p["P"] / 100.0, "Q": p["Q"] / 100.0},
        "frequency": {"time": p["time"], "V [kV]": KV * p["V"], "f [Hz]": p["f"], "P [MW]": p["P"], "Q [MVAR]": p["Q"]},
        "frequency in pu": {"time": p["time"], "V": p["V"], "f": p["f"] / F0, "P": p["P"], "Q": p["Q"]},
        "deviation": {"time": p["time"], "V": p["V"], "FREQ_DEV [mHz]": 1e3 * (p["f"] - F0), "P": p["P"], "Q": p["Q"]},
        "two stations": {
            "time": p["time"], "NORTHPORT 12 VM [kV]": KV * p["V"], "NORTHPORT 12 VA [deg]": deg, "NORTHPORT 12 P [MW]": p["P"],
            "NORTHPORT 12 Q [Mvar]": p["Q"], "ELM VM [kV]": 130.0 + p["V"], "ELM VA [deg]": 2.0 * deg, "ELM P [MW]": -p["P"],
            "ELM Q [Mvar]": -p["Q"],
        },
        "references beside": {
            "time": p["time"], "V_ref [kV]": 0.0 * p["V"] + KV, "V [kV]": KV * p["V"], "theta [rad]": p["theta"],
            "P_set [MW]": 0.0 * p["P"] + 200.0, "P [MW]": p["P"], "Q [Mvar]": p["Q"],
        },
    }  # fmt: skip


@pytest.mark.parametrize("habit", list(habits(dict.fromkeys(("time", "V", "theta", "f", "P", "Q"), np.arange(2.0)))))
def test_a_record_is_complete_in_any_habit(habit: str, plant: Columns, tmp_path: Path) -> None:
    found = new(tmp_path, habits(plant)[habit])
    (e,) = hi.load_study(found.path).experiments
    turn = "f" if "f" in e.inputs else "theta"
    assert set(e.inputs) == {"V", turn} and e.outputs == ("P", "Q") and e.measured is not None
    for output in e.outputs:
        np.testing.assert_allclose(e.measured[output], plant[output], atol=0.02)
    after = plant["time"] > 0.9  # before it the inputs stand at their level
    np.testing.assert_allclose(e.inputs["V"](plant["time"])[after], plant["V"][after], atol=1e-4)
    played = e.inputs[turn](plant["time"])[after]
    np.testing.assert_allclose(played - played[-1], (plant[turn] - plant[turn][-1])[after], atol=1e-3)
    assert column_contradictions(hi.load_study(found.path)) == ()
    stated = tomllib.loads(found.path.read_text())
    assert {"fit", "diagnose", "identifiability"} <= set(stated) and stated["experiment"][0][
        "interpolation"
    ] == "linear"


Mistake = Callable[[Columns], tuple[Columns, dict[str, Any]]]
MISTAKES: dict[str, tuple[str, Mistake]] = {
    "P and Q into the plant": ("sign", lambda p: (p | {"P": -p["P"], "Q": -p["Q"]}, {})),
    "angle with the other sign": ("sign", lambda p: (p | {"theta": -p["theta"]}, {})),
    "angle in degrees": ("unit", lambda p: (p | {"theta": np.degrees(p["theta"])}, {})),
    "powers in kW": ("unit", lambda p: (p | {"P": 1e3 * p["P"], "Q": 1e3 * p["Q"]}, {})),
    "powers in pu of the machine": ("base", lambda p: (p | {"P": p["P"] / MVA, "Q": p["Q"] / MVA}, {})),
    "voltage of a phase": ("base", lambda p: (p | {"V": KV / 3**0.5 * p["V"]}, {"columns": {"V": {"base": KV}}})),
    "frequency in pu": ("unit", lambda p: (p | {"f": p["f"] / F0}, {"inputs": ["V", "f"]})),
    "deviation of the frequency": ("unit", lambda p: (p | {"f": p["f"] - F0}, {"inputs": ["V", "f"]})),
    "angle and frequency": ("turns twice", lambda p: (p, {"inputs": ["V", "theta", "f"]})),
    "another angle beside the frequency": ("turn", lambda p: (p | {"theta": 3.0 * p["theta"]}, {"beside": True})),
    "angle of the other sign beside the frequency": ("turn", lambda p: (p | {"theta": -p["theta"]}, {"beside": True})),
    "angle in whole turns": ("unit", lambda p: (p | {"theta": p["theta"] / (2.0 * np.pi)}, {})),
    "angle in rad that is said to be degrees": ("unit", lambda p: (p, {"columns": {"theta": {"unit": '"deg"'}}})),
    "P alone into the plant": ("sign", lambda p: (p | {"P": -p["P"]}, {})),
    "Q alone in kvar": ("unit", lambda p: (p | {"Q": 1e3 * p["Q"]}, {})),
    "powers in GW": ("unit", lambda p: (p | {"P": 1e-3 * p["P"], "Q": 1e-3 * p["Q"]}, {})),
    "powers of one phase": ("phase", lambda p: (p | {"P": p["P"] / 3.0, "Q": p["Q"] / 3.0}, {})),
    "angles of voltage and current exchanged": (
        "exchanged",
        lambda p: (
            p | {"theta": np.degrees(p["theta"] - np.arctan2(p["Q"], p["P"])), "I1 Ang [deg]": np.degrees(p["theta"])},
            {"columns": {"theta": {"unit": '"deg"'}}},
        ),
    ),
    "P and Q exchanged": ("exchanged", lambda p: (p | {"P": p["Q"], "Q": p["P"]}, {})),
    "P and Q late": ("clock", lambda p: (p | {"P": late(p["P"]), "Q": late(p["Q"])}, {})),
    "powers of one phase beside the current": (
        "phase",
        lambda p: (metered(p) | {"P": p["P"] / 3.0, "Q": p["Q"] / 3.0}, IN_KV),
    ),
    "powers in GW beside the current": (
        "unit",
        lambda p: (metered(p) | {"P": 1e-3 * p["P"], "Q": 1e-3 * p["Q"]}, IN_KV),
    ),
    "the current of a plant of another size": ("current", lambda p: (metered(p, 7.0), IN_KV)),
    "the current of a plant that moves otherwise": (
        "current",
        lambda p: (metered(p | {"Q": p["Q"][::-1], "P": p["P"][::-1]}) | {n: p[n] for n in "PQ"}, IN_KV),
    ),
    "peak of the voltage of a phase": ("base", lambda p: (p | {"V": (2.0 / 3.0) ** 0.5 * p["V"]}, {})),
    "a voltage that no base explains": ("base", lambda p: (p | {"V": 3.0 * p["V"]}, {})),
    "a power that no unit explains": ("unit", lambda p: (p | {"P": 5.0 * p["P"], "Q": 5.0 * p["Q"]}, {})),
}
OPEN = {
    "another angle beside the frequency": "3 times as far",
    "the current of a plant of another size": "which of them is in another unit, or another plant's",
    "the current of a plant that moves otherwise": "of the square of the movement; one of them is another plant's",
    "a voltage that no base explains": "what is its base",
    "a power that no unit explains": "what is their unit",
}
"""Mistakes that no line of the study mends, with what is said of them."""
OF_TURNING = ("angle in whole turns", "angle in rad that is said to be degrees")
"""Mistakes that only a record shows in which the angle alone moves."""
IN_KV = {"columns": {"V": {"name": '"V1 Mag"', "base": KV}}}


def late(values: Array) -> Array:
    """A column that comes 0.4 s late."""
    return np.concatenate([values[:20], values[:-20]])


def metered(p: Columns, times: float = 1.0) -> Columns:
    """The columns with the voltage in kV and the current in A, times a factor."""
    current = np.hypot(p["P"], p["Q"]) / (3**0.5 * KV * p["V"])
    found = {n: v for n, v in p.items() if n != "V"}
    return found | {"V1 Mag [kV]": KV * p["V"], "I1 Mag [A]": times * 1e3 * current}


def stated(folder: Path, keys: Mapping[str, Any]) -> Path:
    """A study as a hand writes it: columns of the signals' names, nothing else stated."""
    columns = "".join(
        f"columns = {{{n} = {{{', '.join(f'{k} = {v}' for k, v in line.items())}}}}}\n"
        for n, line in keys.get("columns", {}).items()
    )
    inputs = ", ".join(f'"{n}"' for n in keys.get("inputs", ["V", "theta"]))
    (folder / "study.toml").write_text(
        f'schema = 1\n[model]\nsource = "unit/unit.toml"\n[[experiment]]\nname = "event"\ndata = "event.csv"\n'
        f'interpolation = "linear"\ntrim = {{P0 = "P", Q0 = "Q"}}\n{columns}inputs = [{inputs}]\noutputs = ["P", "Q"]\n'
    )
    return folder / "study.toml"


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_said_and_what_to_write_mends_it(
    mistake: str, plant: Columns, turning: Columns, tmp_path: Path
) -> None:
    kind, made = MISTAKES[mistake]
    plant = turning if mistake in OF_TURNING else plant
    new(tmp_path, plant)
    columns, keys = made(plant)
    written(
        tmp_path,
        columns
        if "beside" in keys or "f" in keys.get("inputs", [])
        else {n: v for n, v in columns.items() if n != "f"},
    )
    path = stated(tmp_path, keys)
    (found,) = column_contradictions(hi.load_study(path))
    assert found.kind == kind and found.where == "experiment event"
    shown = str(hi.check(path))
    assert "to be mended" in shown and found.text in shown
    assert shown.count("experiment event: ") <= 3
    if mistake in OPEN:
        assert not found.write and OPEN[mistake] in found.what
        return
    key = found.write.split(" = ")[0]
    text = re.sub(rf"^{key} = .*\n", "", path.read_text(), flags=re.MULTILINE)
    path.write_text(text.replace("interpolation = ", f"{found.write}\ninterpolation = "))
    assert column_contradictions(hi.load_study(path)) == ()


def test_sound_records_are_not_nagged(plant: Columns, tmp_path: Path) -> None:
    new(tmp_path, plant)
    path = stated(tmp_path, {})
    assert column_contradictions(hi.load_study(path)) == () and "good" in str(hi.check(path)).splitlines()[0]


def test_an_angle_that_turns_before_the_event_turns_the_frame(plant: Columns, tmp_path: Path) -> None:
    turn = 0.03
    angle = plant["theta"] + 2.0 * np.pi * turn * plant["time"]
    found = new(tmp_path, {n: plant[n] for n in ("time", "V", "P", "Q")} | {"theta": angle})
    (e,) = hi.load_study(found.path).experiments
    assert e.values["f"] == pytest.approx(F0 + turn, abs=1e-4)
    played = e.inputs["theta"](plant["time"])[-1] - e.inputs["theta"](0.0)
    assert float(played) == pytest.approx(plant["theta"][-1] - plant["theta"][0], abs=5e-3)


def test_the_finer_of_angle_and_frequency_is_used(plant: Columns, tmp_path: Path) -> None:
    coarse = np.round(np.degrees(plant["theta"]))
    found = new(tmp_path, plant | {"theta": np.radians(coarse)})
    (e,) = hi.load_study(found.path).experiments
    assert "f" in e.inputs and "theta" not in e.inputs
    assert any("theta is not used beside f" in note for note in found.recordings[0].notes)


def test_what_no_unit_explains_is_left_open(plant: Columns, tmp_path: Path) -> None:
    """A voltage of 7 kV at a bus of 18 kV is asked about, and not mapped."""
    columns = {"time": plant["time"], "V [kV]": 7.0 * plant["V"], **{n: plant[n] for n in ("theta", "P", "Q")}}
    found = new(tmp_path, columns)
    (r,) = found.recordings
    (open_,) = (m for m in r.columns.proposed if m.target.name == "V")
    assert open_.is_open and "not where a bus of 18 kV rests" in open_.reason and open_.base == KV


def test_a_column_of_another_quantity_is_never_offered(plant: Columns, tmp_path: Path) -> None:
    angle = np.degrees(plant["theta"])
    found = new(tmp_path, {"time": plant["time"], "V1 Ang [deg]": angle, "I1 Ang [deg]": angle, "IPM": plant["P"]})
    (r,) = found.recordings
    offered = {(m.target.name, m.column.name) for m in (*r.columns.mapped, *r.columns.proposed)}
    assert offered == {("theta", "V1 Ang")} and set(r.columns.unused) == {"I1 Ang", "IPM"}
