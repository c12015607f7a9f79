"""A synchronous machine with exciter, stabiliser and governor behind a reactance, after Kundur 1994, examples 12.3 to 12.5.

One-axis machine (flux decay), thyristor exciter with transducer, stabiliser with wash-out and one lead, governor and reheat
turbine. Per unit of 2220 MVA and 24 kV. Hidden: the voltage transducer is slower than the card's, which has none.
Recorded as a spreadsheet from a German PC: semicolons, decimal commas, kV, MW and Mvar.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.foreign.plant import Hidden, Plant, Record

CARD = """
schema = 1
name = "unit"
[parameters]
H = {value = 3.2, unit = "s", min = 0.5, max = 15}
D = {value = 1.0}
xd = {value = 1.81}
xdp = {value = 0.3}
xq = {value = 1.76}
Td0p = {value = 8.0, unit = "s"}
xe = {value = 0.65}
w0 = {value = 376.99111843}
KA = {value = 180.0, min = 1, max = 1000}
TA = {value = 0.05, unit = "s", min = 0.001, max = 1}
KS = {value = 8.0, min = 0, max = 60}
TW = {value = 1.4, unit = "s"}
T1 = {value = 0.154, unit = "s"}
T2 = {value = 0.033, unit = "s"}
R = {value = 0.05, min = 0.01, max = 0.2}
TG = {value = 0.2, unit = "s"}
TR = {value = 7.0, unit = "s"}
FH = {value = 0.3}
[inputs]
Vref = {value = 1.01}
Pref = {value = 0.8}
Einf = {value = 0.995}
[states]
delta = {derivative = "w0*w", guess = 1.2}
w = {derivative = "(Pm - Pe - D*w)/(2*H)"}
eqp = {derivative = "(Efd - eqp - (xd - xdp)*id)/Td0p", guess = 1.0}
Efd = {derivative = "(clip(KA*(Vref - Vm + Vs), -6.4, 7) - Efd)/TA", guess = 2.0}
xw = {derivative = "yw/TW"}
xs = {derivative = "(yw - xs)/T2"}
g = {derivative = "(Pref - w/R - g)/TG", guess = 0.8}
xr = {derivative = "(g - xr)/TR", guess = 0.8}
[signals]
id = "(eqp - Einf*cos(delta))/(xdp + xe)"
iq = "Einf*sin(delta)/(xq + xe)"
vd = "xq*iq"
vq = "eqp - xdp*id"
Vt = "sqrt(vd**2 + vq**2)"
Vm = "Vt"
Pe = "vd*id + vq*iq"
Qe = "vq*id - vd*iq"
yw = "KS*w - xw"
Vs = "clip(xs + T1/T2*(yw - xs), -0.1, 0.1)"
Pm = "FH*g + (1 - FH)*xr"
[outputs]
U = "Vt"
P = "Pe"
Q = "Qe"
Uf = "Efd"
"""

TRUE = {
    "H": 3.5, "D": 1.0, "xd": 1.81, "xdp": 0.3, "xq": 1.76, "Td0p": 8.0, "xe": 0.65, "w0": 376.99111843, "KA": 200.0,
    "TA": 0.05, "KS": 9.5, "TW": 1.4, "T1": 0.154, "T2": 0.033, "R": 0.05, "TG": 0.2, "TR": 7.0, "FH": 0.3,
}  # fmt: skip


def _terminal(x, u, p):
    i_d = (x[2] - u["Einf"] * np.cos(x[0])) / (p["xdp"] + p["xe"])
    i_q = u["Einf"] * np.sin(x[0]) / (p["xq"] + p["xe"])
    v_d, v_q = p["xq"] * i_q, x[2] - p["xdp"] * i_d
    return i_d, i_q, v_d, v_q


def _derivative(t, x, u, p, h):
    _delta, w, eqp, efd, xw, xs, g, xr = x[:8]
    i_d, i_q, v_d, v_q = _terminal(x, u, p)
    v = np.hypot(v_d, v_q)
    power = v_d * i_d + v_q * i_q
    yw = p["KS"] * w - xw
    vs = np.clip(xs + p["T1"] / p["T2"] * (yw - xs), -0.1, 0.1)
    measured = x[8] if h else v
    pm = p["FH"] * g + (1 - p["FH"]) * xr
    rates = [
        p["w0"] * w,
        (pm - power - p["D"] * w) / (2 * p["H"]),
        (efd - eqp - (p["xd"] - p["xdp"]) * i_d) / p["Td0p"],
        (np.clip(p["KA"] * (u["Vref"] - measured + vs), -6.4, 7.0) - efd) / p["TA"],
        yw / p["TW"],
        (yw - xs) / p["T2"],
        (u["Pref"] - w / p["R"] - g) / p["TG"],
        (g - xr) / p["TR"],
    ]
    return [*rates, (v - x[8]) / h["T"]] if h else rates


def _outputs(x, u, p, h):
    i_d, i_q, v_d, v_q = _terminal(x, u, p)
    return {"U": np.hypot(v_d, v_q), "P": v_d * i_d + v_q * i_q, "Q": v_q * i_d - v_d * i_q, "Uf": x[3]}


def _write(folder: Path, record: Record, c) -> str:
    titles = {
        "time": "Zeit [s]", "Vref": "U soll (p.u.)", "Pref": "P soll (p.u.)", "Einf": "Netz (p.u.)",
        "U": "Generatorspannung U [kV]", "P": "Wirkleistung P [MW]", "Q": "Blindleistung Q [Mvar]", "Uf": "Uf / p.u.",
    }  # fmt: skip
    factors = {"U": 24.0, "P": 2220.0, "Q": 2220.0}
    lines = [";".join(titles[n] for n in c)]
    rows = np.column_stack([v * factors.get(n, 1.0) for n, v in c.items()])
    lines += [";".join(f"{v:.8g}".replace(".", ",") for v in row) for row in rows]
    name = f"Messung {record.name}.csv"
    (folder / name).write_text("\r\n".join(lines) + "\r\n", encoding="cp1252")
    inputs = ", ".join(f'{n} = "{titles[n].split(" (")[0]}"' for n in record.inputs)
    return f"""data = "{name}"
inputs = {{{inputs}}}
outputs = {{U = "Generatorspannung U", P = "Wirkleistung P", Q = "Blindleistung Q", Uf = "Uf / p.u."}}
columns = {{U = {{unit = "kV", base = 24}}, P = {{unit = "MW", base = 2220}}, Q = {{unit = "Mvar", base = 2220}}}}"""


PLANT = Plant(
    name="machine",
    card=CARD,
    begin={"delta": 1.2, "w": 0.0, "eqp": 1.0, "Efd": 2.0, "xw": 0.0, "xs": 0.0, "g": 0.8, "xr": 0.8},
    true=TRUE,
    bounds={"H": (2, 8), "KA": (50, 500), "KS": (0, 40), "TA": (0.01, 0.3)},
    noise={"U": 2e-4, "P": 1e-3, "Q": 1e-3, "Uf": 5e-3},
    rest={"Vref": 1.01, "Pref": 0.8, "Einf": 0.995},
    records=(
        Record("Usoll", {"Vref": [(0, 1.01), (0.5, 1.03), (4.0, 1.01)]}, 8.0, 0.02),
        Record("Netz", {"Einf": [(0, 0.995), (0.5, 0.96), (0.7, 0.995)]}, 6.0, 0.02),
        Record("Psoll", {"Pref": [(0, 0.8), (0.5, 0.7)], "Vref": [(0, 1.01), (3.0, 0.99)]}, 6.0, 0.02, "holdout"),
    ),
    derivative=_derivative,
    outputs=_outputs,
    hidden=Hidden("lag", ("Vm",), {"T": 0.06}, ("second-order", "delay", "window-mean", "lead-lag")),
    extra=lambda u, p, h: (1.0,),
    write=_write,
)
