"""Eigenvalues and step responses of the units of tests/plants/cases.toml by andes 2.0, as tests/plants/andes.json.

    python benchmarks/plants_against_andes.py [CASE ...]
    python benchmarks/plants_against_andes.py playback

andes (extra `bench`) shares no code with the package: it reads the same .dyr records and a .raw of two buses. The tests compare with
the numbers that stand in the file, so that they need no andes. Cases that are not named keep theirs. `playback`: units at andes'
playback bus, PLBVFU1, as tests/plants/playback_andes.json.
"""

from __future__ import annotations

import json
import math
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import Any

import andes
import numpy as np

HERE = Path(__file__).resolve().parents[1] / "tests" / "plants"
STEPS = {
    "Vref": 0.02,
    "Pref": 0.05,
    "nref": 0.0025,
    "Plant_pref": 0.05,
    "Qext": 0.05,
    "Qref": 0.05,
    "PFaref": 0.05,
    "E": -0.05,
}
"""Steps at 0.5 s of the references and of the infinite bus, pu; of the angle of the power factor in rad."""
REFERENCES = {
    "HYGOV": {"nref": "q0"},
    "IEEEG1": {"Pref": "tm012"},
    "REPCA1": {"Plant_pref": "Pline0", "Vref": "Vref0", "Qref": "Qline0"},
}
"""By model of andes: the references that it takes, with the names of the constants that hold them; q0 is nref/R."""
OF_GROUP = {
    "Exciter": {"Vref": "vref0"},
    "TurbineGov": {"Pref": "pref0"},
    "RenExciter": {"Pref": "Pref0", "Qext": "qref0", "PFaref": "pfaref0"},
    "RenPlant": {},
}
"""The same for the other models of a group; qref0 is -Qext."""
FACTORS = {"qref0": -1.0, "q0": 20.0}
"""Factors from the step of a reference to that of a constant; 1/R = 20 in the cases with q0."""
SHOWN = {"P": ("Pe", 100.0, 0.0), "Q": ("Qe", 100.0, 0.0), "Vt": ("v", 1.0, 0.0), "dw": ("omega", 1.0, -1.0)}
"""Signals by name: the variable of the machine or converter, the factor and what is added; MW, Mvar, pu."""
TIME_STEPS = {"SynGen": 0.001, "RenTorque": 0.001, "RenGen": 0.002}
"""Time steps, s, by the first of these groups that the unit has. Swings, of rotors and of shafts, are hardly damped: the trapezoidal
rule's error of their frequency shows soon."""
ENDS = {"SynGen": 5.0, "RenGen": 2.5}
"""Ends of the runs, s: converters settle sooner."""
TIMES = np.round(np.arange(0.0, 5.01, 0.1), 6)
SHELF = Path(__file__).resolve().parents[1] / "hvdc_ident" / "shelf"
ORDERS = {
    "ESST1A": "UEL VOS TR VIMAX VIMIN TB TC TB1 TC1 VAMAX VAMIN KA TA ILR KLR VRMAX VRMIN KF TF KC",
    "ESAC1A": "TR TB TC VAMAX VAMIN KA TA VRMAX VRMIN TE E1 SE1 E2 SE2 KC KD KE KF TF",
    "AC8B": "TR KPR KIR KDR TDR VPIDMAX VPIDMIN VRMAX VRMIN VFEMAX VEMIN TA KA TE KC KD KE E1 SE1 E2 SE2",
}
"""Order in which andes reads the values of a record, where it is not PSS/E's."""
ESAC8B = {
    "KPR": "KP",
    "KIR": "KI",
    "KDR": "KD",
    "TDR": "TD",
    "VPIDMAX": 999.0,
    "VPIDMIN": -999.0,
    "VFEMAX": 999.0,
    "VEMIN": -999.0,
    "KC": 0.0,
    "KD": 0.0,
}
"""Values of AC8B that make it ESAC8B, which andes does not have: by name, the value or the name of ESAC8B's."""
SCALES = {"WTDTA1": {"Freq1": 2.0 * math.pi}, "WTTQA1": {"Kpp": -1.0, "Kip": -1.0}}
"""Factors from a record's values to those that andes reads: it takes Freq1 in rad/s, and has the error of the torque, which these gains
multiply, with the opposite sign."""
TORQUE = "WTTQA1"
"""A model whose record andes cannot read, although it has the model."""
NAMED = ("rea", "rego", "ree", "reg")
"""Parts that it refers to."""
ABSENT = {"SCRX", "PSS2B", "STAB2A"}
"""Models that andes does not have, or takes another for."""
PLAYED = ("ieeet1", "sexs")
"""Cases that are played back."""
TABLE = {
    "t": [0.0, *np.round(np.arange(0.5, 1.0, 0.1), 6).tolist(), *np.round(np.arange(2.0, 3.0, 0.1), 6).tolist()],
    "V": [1.0, 0.99, 0.98, 0.97, 0.96, 0.95, *np.linspace(0.955, 1.0, 10).round(6).tolist()],
    "f": [1.0, *np.linspace(0.9995, 0.9975, 5).round(6).tolist(), *np.linspace(0.9977, 0.9995, 10).round(6).tolist()],
}
"""What PLBVFU1 plays back, pu: each value holds until the next. A dip and a fall of the frequency by ramps, and back, in stairs that
the lags below make smooth; the frequency does not come back entirely."""
LAGS = {"V": 0.2, "f": 0.15}
"""Time constants of the lags behind which PLBVFU1 plays back, Tv and Tf, s."""
SMALL = 1e-6
"""Reactance of the playback bus, and of the line between it and the unit, pu of 100 MVA: small enough for the voltage at the unit to
be the played one within 1e-6 pu."""
RAW = """0, 100.00, 32, 0, 1, 60.00 / two buses
a unit at an infinite bus

1,'UNIT        ', 20.0, 2, 1, 1, 1, 1.02, 10.0
2,'GRID        ', 20.0, 3, 1, 1, 1, 1.0, 0.0
0 / END OF BUS DATA
0 / END OF LOAD DATA
0 / END OF FIXED SHUNT DATA
1,'1', 80.0, 0.0, 999.0, -999.0, 1.02, 0, 100.0, 0.0, 0.3, 0.0, 0.0, 1.0, 1, 100.0, 999.0, -999.0, 1, 1.0
2,'1', 0.0, 0.0, 999.0, -999.0, 1.0, 0, 100.0, 0.0, 1.0, 0.0, 0.0, 1.0, 1, 100.0, 999.0, -999.0, 1, 1.0
0 / END OF GENERATOR DATA
1, 2, '1 ', 0.01, 0.3, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1, 1, 0.0, 1, 1.0
0 / END OF BRANCH DATA
0 / END OF TRANSFORMER DATA
0 / END OF AREA DATA
0 / END OF TWO-TERMINAL DC DATA
0 / END OF VSC DC LINE DATA
0 / END OF IMPEDANCE CORRECTION DATA
0 / END OF MULTI-TERMINAL DC DATA
0 / END OF MULTI-SECTION LINE DATA
0 / END OF ZONE DATA
0 / END OF INTER-AREA TRANSFER DATA
0 / END OF OWNER DATA
0 / END OF FACTS DEVICE DATA
Q
"""


def record_of(model: str) -> list[str]:
    """Return the names of a record's values, in PSS/E's order."""
    card: dict[str, list[str]] = tomllib.loads((SHELF / f"{model.lower()}.toml").read_text(encoding="utf-8"))
    return card["record"]


def line(model: str, values: list[float]) -> str:
    """Return the .dyr line of a record, its values in the order in which andes reads them."""
    if model in ORDERS or model in SCALES or model == "ESAC8B":
        named = dict(zip(record_of(model), values, strict=True))
        if model == "ESAC8B":
            given = {n: named[v] if isinstance(v, str) else v for n, v in ESAC8B.items()}
            model, named = "AC8B", named | given
        names = ORDERS[model].split() if model in ORDERS else record_of(model)
        values = [named[n] * SCALES.get(model, {}).get(n, 1.0) for n in names]
    return f"1 '{model}' 1 {' '.join(map(repr, values))} /"


def system(records: dict[str, list[float]], folder: Path) -> Any:
    """Return andes' system of a unit, initialised."""
    (folder / "unit.raw").write_text(RAW, encoding="utf-8")
    lines = [line(model, values) for model, values in records.items() if model != TORQUE]
    (folder / "unit.dyr").write_text("\n".join(lines) + "\n", encoding="utf-8")
    found = andes.load(
        str(folder / "unit.raw"), addfile=str(folder / "unit.dyr"), no_output=True, default_config=True, setup=False
    )
    if TORQUE in records:
        named = dict(zip(record_of(TORQUE), records[TORQUE], strict=True))
        own = {n.replace("spd", "sp"): v * SCALES[TORQUE].get(n, 1.0) for n, v in named.items() if n != "-"}
        found.add(TORQUE, {"idx": "torque", "rep": found.WTPTA1.idx.v[0], **own})
        for reference in (found.WTPTA1.rego, found.WTPTA1.ree, *(getattr(found.WTTQA1, n) for n in NAMED)):
            reference.vtype = str  # of the names of other parts, which andes takes for numbers
    found.setup()
    found.PFlow.config.tol = 1e-10
    found.PFlow.run()
    found.TDS.config.fixt, found.TDS.config.shrinkt, found.TDS.config.tol = 1, 0, 1e-7
    found.TDS.config.tstep = next(
        h for group, h in TIME_STEPS.items() if any(m.n for m in found.groups[group].models.values())
    )
    found.TDS.config.criteria = 0
    found.TDS.init()
    return found


def group_of(found: Any) -> str:
    """Return the group of the unit: machines or converters."""
    return next(group for group in ENDS if any(m.n for m in found.groups[group].models.values()))


def eigenvalues(records: dict[str, list[float]], folder: Path) -> list[list[float]]:
    """Return the eigenvalues as [real, imaginary], 1/s, in rising order, without those of states that nothing reads."""
    found = system(records, folder)
    found.EIG.run()
    matrix = np.array(found.EIG.As)
    while True:
        read = np.abs(matrix - np.diag(np.diag(matrix))).max(axis=0, initial=0.0) > 0
        if read.all():
            break
        matrix = matrix[np.ix_(read, read)]
    return [[float(e.real), float(e.imag)] for e in np.sort_complex(np.linalg.eigvals(matrix))]


def response(records: dict[str, list[float]], step: str, folder: Path) -> dict[str, list[float]] | None:
    """Return P (MW), Q (Mvar), Vt (pu) and dw (pu) at TIMES with a step at 0.5 s; None where nothing takes the step."""
    found = system(records, folder)
    group = group_of(found)
    machine = next(m for m in found.groups[group].models.values() if m.n)
    models = [(g, m) for g in OF_GROUP for m in found.groups[g].models.values() if m.n]
    models = [(g, m) for g, m in models if g == "RenPlant"] or models  # it gives the references of the converter
    constants = [(m, REFERENCES.get(m.class_name, OF_GROUP[g]).get(step)) for g, m in models]
    taken = [(found.Slack, "v0")] if step == "E" else [(m, constant) for m, constant in constants if constant]
    flags = {n: bool(getattr(m, n).v[0]) for _, m in models for n in ("PFFLAG", "Fflag") if hasattr(m, n)}
    unused = {
        "Qext": flags.get("PFFLAG", False),
        "PFaref": not flags.get("PFFLAG", True),
        "Plant_pref": not flags.get("Fflag", True),
        "Pref": any(m.n for m in found.groups["RenTorque"].models.values()),  # it keeps that of the start
    }
    if not taken or unused.get(step, False):
        return None
    found.TDS.config.tf = 0.5
    found.TDS.run()
    model, constant = taken[0]
    getattr(model, constant).v[:] += STEPS[step] * FACTORS.get(constant, 1.0)
    found.TDS.config.tf = ENDS[group] + 0.01
    found.TDS.run()
    series = found.dae.ts
    # The trapezoidal rule takes the step over the whole of one time step: in its middle, to second order.
    times = np.array([t for t in TIMES if t <= ENDS[group]])
    times = np.where(times > 0.5, times + 0.5 * found.TDS.config.tstep, times)
    runs = {}
    for signal, (name, factor, added) in SHOWN.items():
        variable = getattr(machine, name, None)
        if variable is not None:
            column = (series.x if variable.v_code == "x" else series.y)[:, variable.a[0]]
            runs[signal] = (factor * np.interp(times, series.t, column) + added).tolist()
    return runs


def played(records: dict[str, list[float]], folder: Path) -> dict[str, list[float]]:
    """Return P (MW), Q (Mvar), the voltage V at the unit (pu) and its angle theta since the start (rad) at TIMES."""
    lines = [line(model, values) for model, values in records.items()]
    (folder / "unit.dyr").write_text("\n".join(lines) + "\n", encoding="utf-8")
    grid = 1.02 - 0.2 * SMALL / 1.02  # about 20 Mvar from the unit
    raw = RAW.replace(" 0.01, 0.3,", f" 0.0, {SMALL!r},").replace(
        "-999.0, 1.0, 0, 100.0", f"-999.0, {grid!r}, 0, 100.0"
    )
    (folder / "unit.raw").write_text(raw, encoding="utf-8")
    rows = zip(*TABLE.values(), strict=True)
    table = [",".join(TABLE), *(",".join(map(repr, row)) for row in rows)]
    (folder / "table.csv").write_text("\n".join(table) + "\n", encoding="utf-8")
    found = andes.load(
        str(folder / "unit.raw"), addfile=str(folder / "unit.dyr"), no_output=True, default_config=True, setup=False
    )
    bus = {
        "bus": 2,
        "gen": found.Slack.idx.v[0],
        "xs": SMALL,
        "Tv": LAGS["V"],
        "Tf": LAGS["f"],
        "filename": "table.csv",
    }
    found.add("PLBVFU1", {"idx": "bus", "Sn": 100.0, "Vn": 20.0, "fn": 60.0, **bus})
    course = {
        "path": str(folder / "table.csv"),
        "sheet": "",
        "fields": "V,f",
        "dests": "Vts,fts",
        "tkey": "t",
        "mode": 1,
    }
    found.add("TimeSeries", {"idx": "table", "model": "PLBVFU1", "dev": "bus", **course})
    found.setup()
    found.PFlow.config.tol = 1e-8
    found.PFlow.run()
    found.TDS.config.fixt, found.TDS.config.shrinkt, found.TDS.config.reset_tiny = 1, 0, 1
    found.TDS.config.tstep = TIME_STEPS["SynGen"]
    found.TDS.config.criteria = 0
    found.TDS.config.tf = ENDS["SynGen"] + 0.01
    found.TDS.run()
    series = found.dae.ts
    # andes goes 0.1 ms beyond every row of the table at once, and the trapezoidal rule takes the row in the middle of that.
    times = np.where(TABLE["t"][1] < TIMES, TIMES + 5e-5, TIMES)
    machine, terminals = found.GENROU, found.Bus.idx2uid(1)
    columns = {
        "P": 100.0 * series.y[:, machine.Pe.a[0]],
        "Q": 100.0 * series.y[:, machine.Qe.a[0]],
        "V": series.y[:, found.Bus.v.a[terminals]],
        "theta": series.y[:, found.Bus.a.a[terminals]],
    }
    return {
        n: np.interp(times, series.t, column - (column[0] if n == "theta" else 0.0)).tolist()
        for n, column in columns.items()
    }


def playback() -> None:
    """Write the numbers of the units that are played back."""
    cases = tomllib.loads((HERE / "cases.toml").read_text(encoding="utf-8"))
    runs = {}
    for name in PLAYED:
        with tempfile.TemporaryDirectory() as folder:
            runs[name] = played(cases[name], Path(folder))
        print(name, {n: round(float(np.ptp(v)), 4) for n, v in runs[name].items()}, flush=True)
    known = {"andes": andes.__version__, "table": TABLE, "lags": LAGS, "times": TIMES.tolist(), "cases": runs}
    write(HERE / "playback_andes.json", known)


def write(path: Path, known: dict[str, Any]) -> None:
    """Write numbers with nine digits."""
    rounded = json.loads(json.dumps(known), parse_float=lambda x: float(f"{float(x):.9g}"))
    path.write_text(json.dumps(rounded) + "\n", encoding="utf-8")


def main(names: list[str]) -> None:
    """Write the numbers of the named cases, or of all."""
    cases = tomllib.loads((HERE / "cases.toml").read_text(encoding="utf-8"))
    path = HERE / "andes.json"
    known = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"andes": "", "cases": {}}
    for name in names or [n for n, records in cases.items() if not ABSENT & set(records)]:
        with tempfile.TemporaryDirectory() as folder:
            found: dict[str, Any] = {"eigenvalues": eigenvalues(cases[name], Path(folder))}
            runs = {step: response(cases[name], step, Path(folder)) for step in STEPS}
            found["responses"] = {step: run for step, run in runs.items() if run is not None}
        known["cases"][name] = found
        print(name, len(found["eigenvalues"]), list(found["responses"]), flush=True)
        known |= {"andes": andes.__version__, "steps": STEPS, "times": TIMES.tolist()}
        known["cases"] = {n: known["cases"][n] for n in cases if n in known["cases"]}
        write(path, known)


if __name__ == "__main__":
    playback() if sys.argv[1:] == ["playback"] else main(sys.argv[1:])
