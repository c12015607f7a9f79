"""An induction motor through a voltage dip: third order, rotor flux in the synchronous frame (Kundur 1994, ch. 7.2).

Per unit of 2 MVA, stator resistance neglected. Hidden: the power transducer is slow, which the card lacks. Recorded as tab
separated text with names and units on lines of their own.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.foreign.plant import Hidden, Plant, Record

CARD = """
schema = 1
name = "induction-motor"
[parameters]
H = {value = 0.8, unit = "s", min = 0.1, max = 5}
Xs = {value = 3.5}
Xp = {value = 0.2, min = 0.05, max = 0.6}
T0 = {value = 0.8, unit = "s", min = 0.05, max = 5}
TL = {value = 0.7, min = 0.1, max = 1.5}
m = {value = 2.0}
ws = {value = 314.159265358979}
[inputs]
U = {value = 1.0}
[states]
s = {derivative = "(TL*(1 - s)**m - Te)/(2*H)", guess = 0.01}
ed = {derivative = "-(ed + (Xs - Xp)*iq)/T0 + s*ws*eq", guess = 0.9}
eq = {derivative = "-(eq - (Xs - Xp)*id)/T0 - s*ws*ed", guess = -0.15}
[signals]
id = "-eq/Xp"
iq = "(ed - U)/Xp"
Te = "ed*id + eq*iq"
Pe = "U*id"
Qe = "-U*iq"
[outputs]
P = "Pe"
Q = "Qe"
n = {value = "1500*(1 - s)", unit = "1/min"}
"""

TRUE = {"H": 1.0, "Xs": 3.5, "Xp": 0.17, "T0": 0.6, "TL": 0.75, "m": 2.0, "ws": 314.159265358979}


def _currents(x, u, p):
    return -x[2] / p["Xp"], (x[1] - u["U"]) / p["Xp"]


def _derivative(t, x, u, p, h):
    s, ed, eq = x[:3]
    i_d, i_q = _currents(x, u, p)
    rates = [
        (p["TL"] * (1 - s) ** p["m"] - ed * i_d - eq * i_q) / (2 * p["H"]),
        -(ed + (p["Xs"] - p["Xp"]) * i_q) / p["T0"] + s * p["ws"] * eq,
        -(eq - (p["Xs"] - p["Xp"]) * i_d) / p["T0"] - s * p["ws"] * ed,
    ]
    return [*rates, (u["U"] * i_d - x[3]) / h["T"]] if h else rates


def _outputs(x, u, p, h):
    i_d, i_q = _currents(x, u, p)
    return {"P": x[3] if h else u["U"] * i_d, "Q": -u["U"] * i_q, "n": 1500.0 * (1.0 - x[0])}


def _write(folder: Path, record: Record, c) -> str:
    titles = {
        "time": ("time", "s"),
        "U": ("voltage", "V"),
        "P": ("active power", "kW"),
        "Q": ("reactive power", "kvar"),
        "n": ("speed", "rpm"),
    }
    factors = {"U": 690.0, "P": 2000.0, "Q": 2000.0}
    lines = ["\t".join(titles[n][k] for n in c) for k in (0, 1)]
    lines += [
        "\t".join(f"{v:.9g}" for v in row) for row in np.column_stack([v * factors.get(n, 1.0) for n, v in c.items()])
    ]
    (folder / f"{record.name}.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return f"""data = "{record.name}.txt"
inputs = {{U = "voltage"}}
outputs = {{P = "active power", Q = "reactive power", n = "speed"}}
columns = {{U = {{unit = "V", base = 690}}, P = {{unit = "kW", base = 2000}}, Q = {{unit = "kvar", base = 2000}}, n = {{unit = "rpm"}}}}"""


PLANT = Plant(
    name="induction",
    card=CARD,
    begin={"s": 0.01, "ed": 0.9, "eq": -0.15},
    true=TRUE,
    bounds={"H": (0.3, 3), "Xp": (0.08, 0.4), "T0": (0.1, 3), "TL": (0.3, 1.2)},
    noise={"P": 3e-3, "Q": 3e-3, "n": 0.2},
    rest={"U": 1.0},
    records=(
        Record("dip", {"U": [(0, 1.0), (0.2, 0.7), (0.352, 1.0)]}, 1.2, 0.004),
        Record("low", {"U": [(0, 0.95), (0.2, 1.05)]}, 0.8, 0.004),
        Record("deep", {"U": [(0, 1.0), (0.2, 0.55), (0.3, 0.98)]}, 1.2, 0.004, "holdout"),
    ),
    derivative=_derivative,
    outputs=_outputs,
    hidden=Hidden("lag", ("P",), {"T": 0.03}, ("second-order", "delay", "window-mean", "lead-lag")),
    extra=lambda u, p, h: (0.75,),
    settling=20.0,
    write=_write,
)
