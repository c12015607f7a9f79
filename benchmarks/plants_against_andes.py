"""Eigenvalues and step responses of the units of tests/plants/cases.toml by andes 2.0, as tests/plants/andes.json.

    python benchmarks/plants_against_andes.py [CASE ...]

andes (extra `bench`) shares no code with the package: it reads the same .dyr records and a .raw of two buses. The tests compare with
the numbers that stand in the file, so that they need no andes. Cases that are not named keep theirs.
"""

from __future__ import annotations

import json
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import Any

import andes
import numpy as np

HERE = Path(__file__).resolve().parents[1] / "tests" / "plants"
STEPS = {"Vref": 0.02, "Pref": 0.05, "nref": 0.0025, "E": -0.05}
"""Steps at 0.5 s of the references and of the infinite bus, pu."""
REFERENCES = {"HYGOV": ("nref", "q0"), "IEEEG1": ("Pref", "tm012")}
"""By model of andes: the reference that it takes, and the name of the constant that holds it; q0 is nref/R."""
OF_GROUP = {"Exciter": ("Vref", "vref0"), "TurbineGov": ("Pref", "pref0")}
"""The same for the other models of a group."""
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
ABSENT = {"SCRX", "PSS2B", "STAB2A"}
"""Models that andes does not have, or takes another for."""
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


def line(model: str, values: list[float]) -> str:
    """Return the .dyr line of a record, its values in the order in which andes reads them."""
    if model in ORDERS or model == "ESAC8B":
        card = tomllib.loads((SHELF / f"{model.lower()}.toml").read_text(encoding="utf-8"))
        named = dict(zip(card["record"], values, strict=True))
        if model == "ESAC8B":
            given = {n: named[v] if isinstance(v, str) else v for n, v in ESAC8B.items()}
            model, named = "AC8B", named | given
        values = [named[n] for n in ORDERS[model].split()]
    return f"1 '{model}' 1 {' '.join(map(repr, values))} /"


def system(records: dict[str, list[float]], folder: Path) -> Any:
    """Return andes' system of a unit, initialised."""
    (folder / "unit.raw").write_text(RAW, encoding="utf-8")
    lines = [line(model, values) for model, values in records.items()]
    (folder / "unit.dyr").write_text("\n".join(lines) + "\n", encoding="utf-8")
    found = andes.load(str(folder / "unit.raw"), addfile=str(folder / "unit.dyr"), no_output=True, default_config=True)
    found.PFlow.run()
    found.TDS.config.fixt, found.TDS.config.shrinkt, found.TDS.config.tstep = 1, 0, 0.001
    found.TDS.config.criteria = 0
    found.TDS.init()
    return found


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
    machine = next(m for m in found.groups["SynGen"].models.values() if m.n)
    found.TDS.config.tf = 0.5
    found.TDS.run()
    if step == "E":
        found.Slack.v0.v[:] += STEPS[step]
    else:
        named = [
            (m, *REFERENCES.get(m.class_name, reference))
            for group, reference in OF_GROUP.items()
            for m in found.groups[group].models.values()
            if m.n
        ]
        taken = next(((m, constant) for m, reference, constant in named if reference == step), None)
        if taken is None:
            return None
        model, constant = taken
        getattr(model, constant).v[:] += STEPS[step] / (model.R.v if step == "nref" else 1.0)
    found.TDS.config.tf = float(TIMES[-1]) + 0.01
    found.TDS.run()
    series = found.dae.ts
    # The trapezoidal rule takes the step over the whole of one time step: in its middle, to second order.
    times = np.where(TIMES > 0.5, TIMES + 0.5 * found.TDS.config.tstep, TIMES)
    algebraic, states = (
        np.column_stack([np.interp(times, series.t, column) for column in values.T]) for values in (series.y, series.x)
    )
    return {
        "P": (100.0 * algebraic[:, machine.Pe.a[0]]).tolist(),
        "Q": (100.0 * algebraic[:, machine.Qe.a[0]]).tolist(),
        "Vt": algebraic[:, machine.v.a[0]].tolist(),
        "dw": (states[:, machine.omega.a[0]] - 1.0).tolist(),
    }


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
        known["andes"] = andes.__version__
        known["cases"] = {n: known["cases"][n] for n in cases if n in known["cases"]}
        rounded = json.loads(json.dumps(known), parse_float=lambda x: float(f"{float(x):.9g}"))
        path.write_text(json.dumps(rounded) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
