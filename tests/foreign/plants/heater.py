"""An electric heater in an air duct: element, air and wall, with the heat carried to the outlet by the flow.

Lumped energy balances. Hidden: the heater's command reaches it 9 s late. Recorded over hours in minutes and degrees Celsius.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.foreign.plant import Hidden, Plant, Record

CARD = """
schema = 1
name = "heater"
[parameters]
Ce = {value = 400.0, unit = "J/K", min = 50, max = 4000}
Cw = {value = 3000.0, unit = "J/K", min = 300, max = 30000}
h = {value = 12.0, unit = "W/K", min = 1, max = 100}
hw = {value = 6.0, unit = "W/K", min = 0.5, max = 60}
cp = {value = 1005.0, unit = "J/(kg.K)"}
Pmax = {value = 2000.0, unit = "W"}
Ca = {value = 60.0, unit = "J/K"}
[inputs]
u = {value = 0.2}
flow = {value = 0.05, unit = "kg/s"}
Tin = {value = 20.0, unit = "degC"}
[states]
Te = {derivative = "(Pmax*command - h*(Te - Ta))/Ce", unit = "degC", guess = 60.0}
Ta = {derivative = "(h*(Te - Ta) - hw*(Ta - Tw) - flow*cp*(Ta - Tin))/Ca", unit = "degC", guess = 30.0}
Tw = {derivative = "(hw*(Ta - Tw) - 1.5*(Tw - Tin))/Cw", unit = "degC", guess = 25.0}
[signals]
command = "clip(u, 0, 1)"
[outputs]
Tout = {value = "Ta", unit = "degC"}
Twall = {value = "Tw", unit = "degC"}
"""

TRUE = {"Ce": 520.0, "Cw": 2400.0, "h": 10.0, "hw": 7.0, "cp": 1005.0, "Pmax": 2000.0, "Ca": 60.0}


def _derivative(t, x, u, p, h):
    te, ta, tw = x
    return [
        (p["Pmax"] * np.clip(u["u"], 0, 1) - p["h"] * (te - ta)) / p["Ce"],
        (p["h"] * (te - ta) - p["hw"] * (ta - tw) - u["flow"] * p["cp"] * (ta - u["Tin"])) / p["Ca"],
        (p["hw"] * (ta - tw) - 1.5 * (tw - u["Tin"])) / p["Cw"],
    ]


def _outputs(x, u, p, h):
    return {"Tout": x[1], "Twall": x[2]}


def _write(folder: Path, record: Record, c) -> str:
    titles = ["t/min", *(f"{n} in %" if n == "u" else n for n in record.inputs), "outlet °C", "wall °C"]
    inputs = [c[n] * (100.0 if n == "u" else 1.0) for n in record.inputs]
    rows = np.column_stack([c["time"] / 60.0, *inputs, c["Tout"], c["Twall"]])
    text = ",".join(titles) + "\n" + "\n".join(",".join(f"{v:.10g}" for v in row) for row in rows) + "\n"
    (folder / f"{record.name}.csv").write_text(text, encoding="utf-8")
    named = ", ".join(f'{n} = "{n} in %"' if n == "u" else f'{n} = "{n}"' for n in record.inputs)
    per_cent = 'columns = {u = {unit = "%", base = 100}}' if "u" in record.inputs else ""
    return f"""data = "{record.name}.csv"
inputs = {{{named}}}
outputs = {{Tout = "outlet °C", Twall = "wall °C"}}
{per_cent}"""


PLANT = Plant(
    name="heater",
    card=CARD,
    begin={"Te": 60.0, "Ta": 30.0, "Tw": 25.0},
    true=TRUE,
    bounds={"Ce": (100, 2000), "Cw": (500, 15000), "h": (2, 60), "hw": (1, 40)},
    noise={"Tout": 0.02, "Twall": 0.02},
    rest={"u": 0.2, "flow": 0.05, "Tin": 20.0},
    records=(
        Record("power", {"u": [(0, 0.2), (150.0, 0.6), (600.0, 0.3)]}, 1200.0, 3.0),
        Record("flow", {"flow": [(0, 0.05), (150.0, 0.08)], "u": [(0, 0.4), (501.0, 0.5)]}, 900.0, 3.0),
        Record("pulse", {"u": [(0, 0.3), (150.0, 0.9), (240.0, 0.1)]}, 600.0, 3.0, "holdout"),
    ),
    derivative=_derivative,
    outputs=_outputs,
    hidden=Hidden("delay", ("command",), {"T": 9.0}, ("lag", "second-order", "window-mean", "lead-lag")),
    delayed=("u",),
    settling=20000.0,
    write=_write,
)
