"""A dc motor with Coulomb and viscous friction, driven through an amplifier, in both directions.

Friction after Armstrong 1991: Fc tanh(w/w0) + b w. Hidden: the amplifier has a deadband of 0.6 V. Recorded as text with a
semicolon, empty cells where the encoder missed, and the speed in 1/min.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.foreign.plant import Hidden, Plant, Record

CARD = """
schema = 1
name = "dc-motor"
[parameters]
J = {value = 0.01, unit = "kg.m2", min = 0.001, max = 0.1}
b = {value = 0.02, unit = "N.m.s", min = 0, max = 0.2}
Fc = {value = 0.15, unit = "N.m", min = 0, max = 1}
w0 = {value = 2.0, unit = "rad/s"}
k = {value = 0.5, min = 0.1, max = 2}
R = {value = 1.0, unit = "ohm", min = 0.1, max = 5}
L = {value = 0.02, unit = "H"}
[inputs]
u = {value = 0.0, unit = "V"}
[states]
w = {derivative = "(k*i - b*w - Fc*tanh(w/w0))/J", unit = "rad/s"}
i = {derivative = "(v - R*i - k*w)/L", unit = "A"}
[signals]
v = "u"
[outputs]
w = {value = "w", unit = "rad/s"}
i = {value = "i", unit = "A"}
"""

TRUE = {"J": 0.012, "b": 0.025, "Fc": 0.2, "w0": 2.0, "k": 0.45, "R": 1.2, "L": 0.02}


def _derivative(t, x, u, p, h):
    w, i = x
    v = u["u"] - np.clip(u["u"], -h["width"], h["width"]) if h else u["u"]
    friction = p["b"] * w + p["Fc"] * np.tanh(w / p["w0"])
    return [(p["k"] * i - friction) / p["J"], (v - p["R"] * i - p["k"] * w) / p["L"]]


def _outputs(x, u, p, h):
    return {"w": x[0], "i": x[1]}


def _write(folder: Path, record: Record, c) -> str:
    lines = ["Time (s);Voltage (V);Speed (1/min);Current (A)"]
    for k, row in enumerate(np.column_stack([c["time"], c["u"], c["w"] * 30 / np.pi, c["i"]])):
        cells = [f"{v:.9g}" for v in row]
        if k % 37 == 5:
            cells[2] = ""
        lines.append(";".join(cells))
    (folder / f"{record.name}.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return f"""data = "{record.name}.csv"
inputs = {{u = "Voltage"}}
outputs = {{w = "Speed", i = "Current"}}
columns = {{w = {{unit = "1/min"}}}}"""


_STAIRS = [(0, 0.0), (0.2, 3.0), (1.0, 6.0), (1.8, -2.0), (2.6, -5.0), (3.4, 1.5)]

PLANT = Plant(
    name="dc-motor",
    card=CARD,
    begin={"w": 0.0, "i": 0.0},
    true=TRUE,
    bounds={"J": (0.002, 0.05), "b": (0, 0.1), "Fc": (0, 0.8), "k": (0.2, 1), "R": (0.3, 4)},
    noise={"w": 0.05, "i": 0.02},
    rest={"u": 0.0},
    records=(
        Record("stairs", {"u": _STAIRS}, 4.2, 0.01),
        Record("other-way", {"u": [(0, 0.0), (0.2, -2.0), (1.0, 4.0)]}, 1.8, 0.01),
        Record("reversal", {"u": [(0, 0.0), (0.2, 8.0), (1.2, -1.0), (2.0, 2.5)]}, 3.0, 0.01, "holdout"),
    ),
    derivative=_derivative,
    outputs=_outputs,
    hidden=Hidden("deadband", ("v",), {"width": 0.6}, ("backlash",)),
    settling=2.0,
    write=_write,
)
