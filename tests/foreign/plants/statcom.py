"""A STATCOM with voltage droop on a Thevenin grid: regulator, current loop, dc capacitor. After Hingorani and Gyugyi 2000, ch. 5.

Per unit of 50 Mvar. Hidden: the reactive current order is limited to 0.4, not to the card's 1. Recorded as MATLAB v5.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.io import savemat

from tests.foreign.plant import Hidden, Plant, Record

CARD = """
schema = 1
name = "statcom"
[parameters]
X = {value = 0.2}
Ks = {value = 0.04, min = 0.005, max = 0.2, description = "droop"}
Kp = {value = 0.5, min = 0, max = 10}
Ki = {value = 60.0, min = 1, max = 1000}
Tc = {value = 0.008, unit = "s", min = 0.0005, max = 0.1}
Tv = {value = 0.006, unit = "s"}
Cdc = {value = 0.05, unit = "s"}
Kdc = {value = 4.0, min = 0.2, max = 50}
Rl = {value = 0.01}
[inputs]
Vref = {value = 1.0}
E = {value = 1.0}
[states]
vm = {derivative = "(V - vm)/Tv", guess = 1.0}
xi = {derivative = "Ki*err", guess = 0.0}
iq = {derivative = "(iqo - iq)/Tc", guess = 0.0}
vdc = {derivative = "(V*ip - Rl*iq**2 - 0.005*vdc**2)/(Cdc*vdc)", guess = 1.0}
ip = {derivative = "(Kdc*(1 - vdc) + xdc - ip)/Tc", guess = 0.0}
xdc = {derivative = "20*(1 - vdc)", guess = 0.0}
[signals]
V = "sqrt((E + X*iq)**2 + (X*ip)**2)"
err = "Vref - vm - Ks*iq"
order = "Kp*err + xi"
iqo = "clip(order, -1, 1)"
[outputs]
V = "V"
Q = "V*iq"
vdc = "vdc"
"""

TRUE = {"X": 0.2, "Ks": 0.03, "Kp": 0.8, "Ki": 90.0, "Tc": 0.006, "Tv": 0.006, "Cdc": 0.05, "Kdc": 5.0, "Rl": 0.01}


def _voltage(x, u, p):
    return np.hypot(u["E"] + p["X"] * x[2], p["X"] * x[4])


def _derivative(t, x, u, p, h):
    vm, xi, iq, vdc, ip, xdc = x
    v = _voltage(x, u, p)
    error = u["Vref"] - vm - p["Ks"] * iq
    order = np.clip(p["Kp"] * error + xi, -1.0, 1.0)
    if h:
        order = np.clip(order, -h["level"], h["level"])
    return [
        (v - vm) / p["Tv"],
        p["Ki"] * error,
        (order - iq) / p["Tc"],
        (v * ip - p["Rl"] * iq**2 - 0.005 * vdc**2) / (p["Cdc"] * vdc),
        (p["Kdc"] * (1 - vdc) + xdc - ip) / p["Tc"],
        20.0 * (1 - vdc),
    ]


def _outputs(x, u, p, h):
    v = _voltage(x, u, p)
    return {"V": v, "Q": v * x[2], "vdc": x[3]}


def _write(folder: Path, record: Record, c) -> str:
    savemat(folder / f"{record.name}.mat", {k: v[:, None] for k, v in c.items()})
    return f'data = "{record.name}.mat"\ninputs = {list(record.inputs)}\noutputs = ["V", "Q", "vdc"]'.replace("'", '"')


PLANT = Plant(
    name="statcom",
    card=CARD,
    begin={"vm": 1.0, "xi": 0.0, "iq": 0.0, "vdc": 1.0, "ip": 0.005, "xdc": 0.005},
    true=TRUE,
    bounds={"Ks": (0.01, 0.1), "Kp": (0, 4), "Ki": (10, 500), "Tc": (0.001, 0.05), "Kdc": (1, 20)},
    noise={"V": 2e-4, "Q": 1e-3, "vdc": 2e-4},
    rest={"Vref": 1.0, "E": 1.0},
    records=(
        Record("sag", {"E": [(0, 1.0), (0.1, 0.9), (0.3, 1.0)]}, 0.5, 0.001),
        Record("step", {"Vref": [(0, 1.0), (0.1, 1.03)]}, 0.3, 0.001),
        Record("swell", {"E": [(0, 1.0), (0.1, 1.12), (0.25, 0.97)]}, 0.4, 0.001, "holdout"),
    ),
    derivative=_derivative,
    outputs=_outputs,
    hidden=Hidden("limit", ("iqo",), {"level": 0.4}, ("saturation",)),
    settling=5.0,
    write=_write,
)
