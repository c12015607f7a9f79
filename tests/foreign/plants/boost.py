"""A boost converter, averaged over a switching period, under voltage and current control (Erickson and Maksimovic 2001, ch. 12).

In volts and amperes. Hidden: the sensed voltage passes a filter that the card lacks. Recorded by a simulator with a variable
step, so that the rows are uneven, as a MATLAB 7.3 file.
"""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from tests.foreign.plant import Hidden, Plant, Record

CARD = """
schema = 1
name = "boost"
[parameters]
L = {value = 200e-6, unit = "H", min = 20e-6, max = 2e-3}
C = {value = 470e-6, unit = "F", min = 50e-6, max = 5e-3}
r = {value = 0.05, unit = "ohm"}
kpv = {value = 0.4, min = 0.01, max = 5}
kiv = {value = 80.0, min = 1, max = 2000}
kpi = {value = 0.02, min = 0.001, max = 0.3}
kii = {value = 30.0, min = 0.1, max = 1000}
[inputs]
vref = {value = 48.0, unit = "V"}
vin = {value = 24.0, unit = "V"}
load = {value = 2.0, unit = "A"}
[states]
i = {derivative = "(vin - r*i - (1 - duty)*v)/L", unit = "A", guess = 4.0}
v = {derivative = "((1 - duty)*i - load)/C", unit = "V", guess = 48.0}
xv = {derivative = "kiv*ev", unit = "A", guess = 4.0}
xi = {derivative = "kii*ei", guess = 0.5}
[signals]
vs = "v"
ev = "vref - vs"
iref = "clip(kpv*ev + xv, 0, 20)"
ei = "iref - i"
duty = "clip(kpi*ei + xi, 0, 0.9)"
[outputs]
v = {value = "v", unit = "V"}
i = {value = "i", unit = "A"}
d = "duty"
"""

TRUE = {"L": 180e-6, "C": 420e-6, "r": 0.05, "kpv": 0.5, "kiv": 80.0, "kpi": 0.025, "kii": 30.0}


def _duty(x, u, p, h):
    i, v, xv, xi = x[:4]
    error = u["vref"] - (x[4] if h else v)
    e_i = np.clip(p["kpv"] * error + xv, 0.0, 20.0) - i
    return error, e_i, np.clip(p["kpi"] * e_i + xi, 0.0, 0.9)


def _derivative(t, x, u, p, h):
    error, e_i, duty = _duty(x, u, p, h)
    i, v = x[:2]
    rates = [
        (u["vin"] - p["r"] * i - (1 - duty) * v) / p["L"],
        ((1 - duty) * i - u["load"]) / p["C"],
        p["kiv"] * error,
        p["kii"] * e_i,
    ]
    return [*rates, (v - x[4]) / h["T"]] if h else rates


def _outputs(x, u, p, h):
    return {"v": x[1], "i": x[0], "d": _duty(x, u, p, h)[2]}


def _write(folder: Path, record: Record, c) -> str:
    # A variable step: dense where something happens, every fourth row elsewhere.
    near = np.min([np.abs(c["time"] - b) for b in record.breaks], axis=0) < 3e-3
    kept = near | (np.arange(record.time.size) % 4 == 0)
    with h5py.File(folder / f"{record.name}.mat", "w", userblock_size=512) as f:
        for n, v in c.items():
            f.create_dataset("t" if n == "time" else n, data=v[kept][None, :]).attrs["MATLAB_class"] = np.bytes_(
                "double"
            )
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64, Created on: Mon Nov 24 2025 HDF5 schema 1.00 ."
    with open(folder / f"{record.name}.mat", "r+b") as f:
        f.write(head.ljust(116) + bytes(8) + b"\x00\x02IM")
    return f'data = "{record.name}.mat"\ninputs = {list(record.inputs)}\noutputs = ["v", "i", "d"]'.replace("'", '"')


PLANT = Plant(
    name="boost",
    card=CARD,
    begin={"i": 4.0, "v": 48.0, "xv": 4.0, "xi": 0.5},
    true=TRUE,
    bounds={"L": (50e-6, 800e-6), "C": (100e-6, 2e-3), "kpv": (0.1, 2), "kpi": (0.005, 0.1)},
    noise={"v": 0.02, "i": 0.02, "d": 1e-3},
    rest={"vref": 48.0, "vin": 24.0, "load": 2.0},
    records=(
        Record("load", {"load": [(0, 2.0), (5e-3, 2.6)]}, 25e-3, 5e-5),
        Record("set-point", {"vref": [(0, 48.0), (5e-3, 50.0), (15e-3, 47.0)]}, 25e-3, 5e-5),
        Record("supply", {"vin": [(0, 24.0), (5e-3, 22.0)], "load": [(0, 1.5)]}, 25e-3, 5e-5, "holdout"),
    ),
    derivative=_derivative,
    outputs=_outputs,
    hidden=Hidden("lag", ("vs",), {"T": 2.5e-4}, ("second-order", "delay", "window-mean", "lead-lag")),
    extra=lambda u, p, h: (48.0,),
    settling=0.3,
    write=_write,
)
