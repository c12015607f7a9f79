"""A hydro unit on an isolated load: water column, gate servo, governor with a dashpot. After IEEE 1992 and Kundur 1994, ch. 9.

Rigid water column: dq/dt = (1 - (q/g)^2)/Tw, Pm = At (q/g)^2 (q - qnl). Hidden: a deadband in the speed measurement.
Recorded in ms and 1/min, as a chart recorder writes it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.foreign.plant import Hidden, Plant, Record

CARD = """
schema = 1
name = "hydro"
[parameters]
Tw = {value = 1.5, unit = "s", min = 0.2, max = 5, description = "water starting time"}
H = {value = 4.5, unit = "s", min = 1, max = 12}
D = {value = 0.5}
Rp = {value = 0.05}
Rt = {value = 0.5, min = 0.05, max = 3}
Tr = {value = 5.0, unit = "s", min = 0.5, max = 30}
Tp = {value = 0.05, unit = "s"}
Tg = {value = 0.3, unit = "s", min = 0.05, max = 3}
At = {value = 1.2}
qnl = {value = 0.08}
[inputs]
load = {value = 0.6}
wref = {value = 1.0}
[states]
w = {derivative = "(Pm - load - D*(w - 1))/(2*H)", guess = 1.0}
q = {derivative = "(1 - head)/Tw", guess = 0.6}
g = {derivative = "order", guess = 0.6}
p = {derivative = "(pilot - p)/Tp", guess = 0.0}
d = {derivative = "order - d/Tr", guess = 0.0}
[signals]
head = "(q/g)**2"
Pm = "At*head*(q - qnl)"
wm = "w"
speed = "wm - wref"
pilot = "-speed - Rt*d - Rp*(g - 0.58)"
order = "clip(p/Tg, -0.2, 0.2)"
[outputs]
w = "w"
g = "g"
Pm = "Pm"
"""

TRUE = {"Tw": 1.3, "H": 4.0, "D": 0.5, "Rp": 0.05, "Rt": 0.6, "Tr": 5.0, "Tp": 0.05, "Tg": 0.25, "At": 1.2, "qnl": 0.08}


def _derivative(t, x, u, p, h):
    w, q, g, pilot, d = x
    head = (q / g) ** 2
    speed = w - u["wref"]
    if h:
        speed -= np.clip(speed, -h["width"], h["width"])
    order = np.clip(pilot / p["Tg"], -0.2, 0.2)
    asked = -speed - p["Rt"] * d - p["Rp"] * (g - 0.58)
    power = p["At"] * head * (q - p["qnl"])
    return [
        (power - u["load"] - p["D"] * (w - 1)) / (2 * p["H"]),
        (1 - head) / p["Tw"],
        order,
        (asked - pilot) / p["Tp"],
        order - d / p["Tr"],
    ]


def _outputs(x, u, p, h):
    return {"w": x[0], "g": x[2], "Pm": p["At"] * (x[1] / x[2]) ** 2 * (x[1] - p["qnl"])}


def _write(folder: Path, record: Record, c) -> str:
    name = f"{record.name}.csv"
    titles = ["time [ms]", *(f"{n} (p.u.)" for n in record.inputs), "speed [1/min]", "gate [%]", "power [MW]"]
    scaled = [c["time"] * 1e3, *(c[n] for n in record.inputs), c["w"] * 300.0, c["g"] * 100.0, c["Pm"] * 60.0]
    rows = "\n".join(",".join(f"{v:.9g}" for v in row) for row in np.column_stack(scaled))
    (folder / name).write_text("# chart recorder 4, unit 2\n" + ",".join(titles) + "\n" + rows + "\n", encoding="utf-8")
    return f"""data = "{name}"
inputs = {list(record.inputs)}
outputs = {{w = "speed", g = "gate", Pm = "power"}}
columns = {{w = {{unit = "1/min", base = 300}}, g = {{unit = "%", base = 100}}, Pm = {{unit = "MW", base = 60}}}}""".replace(
        "'", '"'
    )


PLANT = Plant(
    name="hydro",
    card=CARD,
    begin={"w": 1.0, "q": 0.58, "g": 0.58, "p": 0.0, "d": 0.0},
    true=TRUE,
    bounds={"Tw": (0.3, 4), "H": (2, 8), "Rt": (0.1, 2), "Tg": (0.05, 1)},
    noise={"w": 2e-5, "g": 2e-4, "Pm": 5e-4},
    rest={"load": 0.6, "wref": 1.0},
    records=(
        Record("load-up", {"load": [(0, 0.6), (5.0, 0.64), (32.0, 0.61)]}, 60.0, 0.1),
        Record("small", {"load": [(0, 0.5), (5.0, 0.51), (22.0, 0.495)]}, 40.0, 0.1),
        Record("load-down", {"load": [(0, 0.62), (5.0, 0.59)]}, 40.0, 0.1, "holdout"),
    ),
    derivative=_derivative,
    outputs=_outputs,
    hidden=Hidden("deadband", ("speed",), {"width": 1.2e-3}, ("backlash",)),
    write=_write,
)
