"""A grid-following converter with a phase-locked loop on a weak grid, in the grid's rotating frame.

An L filter, a capacitor at the point of connection, a Thevenin grid; current control in the frame of the phase-locked loop,
power control above it (Yazdani and Iravani 2010, ch. 8). Per unit of 100 MVA and 33 kV, 50 Hz. Hidden: the power is measured
through a filter that the card lacks. Recorded by a fault recorder: COMTRADE 1999, ASCII, in MW, Mvar and kV.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.foreign.plant import Hidden, Plant, Record

CARD = """
schema = 1
name = "converter"
[parameters]
L = {value = 0.15}
R = {value = 0.005}
C = {value = 0.1}
Lg = {value = 0.4}
Rg = {value = 0.02}
wb = {value = 314.159265358979}
kpc = {value = 0.4, min = 0.05, max = 3}
kic = {value = 30.0, min = 1, max = 300}
kpl = {value = 40.0, min = 5, max = 400}
kil = {value = 500.0, min = 10, max = 20000}
kpp = {value = 0.1}
kip = {value = 20.0, min = 1, max = 200}
[inputs]
Pref = {value = 0.5, unit = "pu"}
iqref = {value = 0.0, unit = "pu"}
Vg = {value = 1.0, unit = "pu"}
[states]
iD = {derivative = "wb*((eD - vD - R*iD)/L + iQ)", guess = 0.5}
iQ = {derivative = "wb*((eQ - vQ - R*iQ)/L - iD)", guess = 0.0}
vD = {derivative = "wb*((iD - gD)/C + vQ)", guess = 1.0}
vQ = {derivative = "wb*((iQ - gQ)/C - vD)", guess = 0.1}
gD = {derivative = "wb*((vD - Vg - Rg*gD)/Lg + gQ)", guess = 0.5}
gQ = {derivative = "wb*((vQ - Rg*gQ)/Lg - gD)", guess = 0.0}
th = {derivative = "kpl*vq + xl", guess = 0.1}
xl = {derivative = "kil*vq", guess = 0.0}
xd = {derivative = "kic*(idref - id)", guess = 0.0}
xq = {derivative = "kic*(iqref - iq)", guess = 0.0}
xp = {derivative = "kip*ep", guess = 0.5}
[signals]
vd = "vD*cos(th) + vQ*sin(th)"
vq = "vQ*cos(th) - vD*sin(th)"
id = "iD*cos(th) + iQ*sin(th)"
iq = "iQ*cos(th) - iD*sin(th)"
P = "vd*id + vq*iq"
Q = "vq*id - vd*iq"
Pm = "P"
ep = "Pref - Pm"
idref = "clip(kpp*ep + xp, -1.1, 1.1)"
ed = "kpc*(idref - id) + xd - L*iq + vd"
eq = "kpc*(iqref - iq) + xq + L*id + vq"
eD = "ed*cos(th) - eq*sin(th)"
eQ = "ed*sin(th) + eq*cos(th)"
[outputs]
P = "P"
Q = "Q"
V = "sqrt(vd**2 + vq**2)"
"""

TRUE = {
    "L": 0.15,
    "R": 0.005,
    "C": 0.1,
    "Lg": 0.4,
    "Rg": 0.02,
    "wb": 314.159265358979,
    "kpc": 0.5,
    "kic": 30.0,
    "kpl": 60.0,
    "kil": 900.0,
    "kpp": 0.1,
    "kip": 25.0,
}


def _in_frame(x):
    c, s = np.cos(x[6]), np.sin(x[6])
    v_d, v_q = x[2] * c + x[3] * s, x[3] * c - x[2] * s
    i_d, i_q = x[0] * c + x[1] * s, x[1] * c - x[0] * s
    return c, s, v_d, v_q, i_d, i_q


def _derivative(t, x, u, p, h):
    i_D, i_Q, v_D, v_Q, g_D, g_Q, _, x_l, x_d, x_q, x_p = x[:11]
    c, s, v_d, v_q, i_d, i_q = _in_frame(x)
    power = v_d * i_d + v_q * i_q
    error = u["Pref"] - (x[11] if h else power)
    order = np.clip(p["kpp"] * error + x_p, -1.1, 1.1)
    e_d = p["kpc"] * (order - i_d) + x_d - p["L"] * i_q + v_d
    e_q = p["kpc"] * (u["iqref"] - i_q) + x_q + p["L"] * i_d + v_q
    e_D, e_Q, wb = e_d * c - e_q * s, e_d * s + e_q * c, p["wb"]
    rates = [
        wb * ((e_D - v_D - p["R"] * i_D) / p["L"] + i_Q),
        wb * ((e_Q - v_Q - p["R"] * i_Q) / p["L"] - i_D),
        wb * ((i_D - g_D) / p["C"] + v_Q),
        wb * ((i_Q - g_Q) / p["C"] - v_D),
        wb * ((v_D - u["Vg"] - p["Rg"] * g_D) / p["Lg"] + g_Q),
        wb * ((v_Q - p["Rg"] * g_Q) / p["Lg"] - g_D),
        p["kpl"] * v_q + x_l,
        p["kil"] * v_q,
        p["kic"] * (order - i_d),
        p["kic"] * (u["iqref"] - i_q),
        p["kip"] * error,
    ]
    return [*rates, (power - x[11]) / h["T"]] if h else rates


def _outputs(x, u, p, h):
    _, _, v_d, v_q, i_d, i_q = _in_frame(x)
    return {"P": v_d * i_d + v_q * i_q, "Q": v_q * i_d - v_d * i_q, "V": np.hypot(v_d, v_q)}


def _write(folder: Path, record: Record, c) -> str:
    factors = {"P": ("MW", 100.0), "Q": ("Mvar", 100.0), "V": ("kV", 33.0), "Vg": ("kV", 33.0), "Pref": ("pu", 1.0)}
    names = [n for n in c if n != "time"]
    head, counts = [f"Substation,REC{record.name},1999", f"{len(names)},{len(names)}A,0D"], []
    for k, n in enumerate(names, 1):
        unit, factor = factors[n]
        values = c[n] * factor
        middle, scale = values.mean(), max(np.ptp(values), 1e-6) / 60000
        counts.append(np.round((values - middle) / scale).astype(int))
        head.append(f"{k},{n},,,{unit},{scale:.12g},{middle:.12g},0,-32767,32767,1,1,P")
    head += ["50", "1", f"{1 / record.step:g},{record.time.size}", "12/03/2024,10:15:00.000000"]
    head += ["12/03/2024,10:15:00.100000", "ASCII", "1"]
    (folder / f"{record.name}.cfg").write_text("\r\n".join(head) + "\r\n", encoding="ascii")
    rows = [",".join(map(str, [k + 1, round(t * 1e6), *(v[k] for v in counts)])) for k, t in enumerate(record.time)]
    (folder / f"{record.name}.dat").write_text("\r\n".join(rows) + "\r\n", encoding="ascii")
    inputs = list(record.inputs)
    volts = 'Vg = {unit = "kV", base = 33}, ' if "Vg" in inputs else ""
    return f"""data = "{record.name}.cfg"
inputs = {inputs}
outputs = ["P", "Q", "V"]
columns = {{{volts}P = {{unit = "MW", base = 100}}, Q = {{unit = "Mvar", base = 100}}, V = {{unit = "kV", base = 33}}}}""".replace(
        "'", '"'
    )


PLANT = Plant(
    name="converter",
    card=CARD,
    begin={
        "iD": 0.5,
        "iQ": 0.0,
        "vD": 1.0,
        "vQ": 0.1,
        "gD": 0.5,
        "gQ": 0.0,
        "th": 0.2,
        "xl": 0.0,
        "xd": 0.0,
        "xq": 0.0,
        "xp": 0.5,
    },
    true=TRUE,
    bounds={"kpl": (10, 300), "kil": (50, 10000), "kpc": (0.1, 2), "kip": (2, 100)},
    noise={"P": 1e-3, "Q": 1e-3, "V": 5e-4},
    rest={"Pref": 0.5, "iqref": 0.0, "Vg": 1.0},
    records=(
        Record("dip", {"Vg": [(0, 1.0), (0.1, 0.8), (0.25, 1.0)]}, 0.45, 0.001),
        Record("power", {"Pref": [(0, 0.5), (0.1, 0.7)]}, 0.4, 0.001),
        Record("recovery", {"Vg": [(0, 0.9), (0.1, 1.02)], "Pref": [(0, 0.4), (0.25, 0.55)]}, 0.4, 0.001, "holdout"),
    ),
    derivative=_derivative,
    outputs=_outputs,
    hidden=Hidden("lag", ("Pm",), {"T": 0.012}, ("second-order", "delay", "window-mean", "lead-lag")),
    extra=lambda u, p, h: (u["Pref"],),
    settling=3.0,
    write=_write,
)
