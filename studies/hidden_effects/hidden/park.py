"""Plant 6: a converter park with plant controller and electrical controller at a weak grid.

Its card solves the network in closed form in the frame of the terminal voltage. Here it is solved with phasors in the grid's frame,
in which the converter turns its current by the angle of its terminals.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hidden.plant import Array, Plant, See


def _bounded(value: Array, low: float | Array, high: float | Array) -> Array:
    return np.minimum(np.maximum(value, low), high)


def _terminals(p: Mapping[str, Array], grid: Array, current: Array) -> tuple[Array, Array]:
    """Return the terminals' voltage and the injected current as phasors in the grid's frame, in which the grid has the angle 0.

    current: in the frame of the terminals. v exp(-j angle) - Z i is the grid's voltage in that frame, and has the angle
    opposite to the terminals'.
    """
    inner = ((p["Rg"] + p["Rc"]) + 1j * (p["Xg"] + p["Xc"])) * current
    angle = np.arcsin(inner.imag / grid)
    turn = np.exp(1j * angle)
    return grid + inner * turn, current * turn


def _park(x: list[Array], u: Mapping[str, Array], p: Mapping[str, Array], tap: See) -> list[Array]:
    grid, frequency = tap("Vbus", u["Vbus"]), tap("fbus", u["fbus"])
    v_seen, q_seen, p_seen, f_seen, x_v, q_sent, x_p, p_sent, vt_seen, x_q, x_i, p_cmd, active, reactive = (
        tap(n, x[k]) for k, n in enumerate(PARK.states)
    )
    terminals, current = _terminals(p, grid, active - 1j * reactive)
    at_terminals = tap("Vt", np.abs(terminals))
    point = terminals - (p["Rc"] + 1j * p["Xc"]) * current
    volts = tap("V", np.abs(point))
    power = point * np.conj(current)
    real, imaginary = tap("P", power.real), tap("Q", power.imag)
    local = tap("Qt", at_terminals * reactive)
    v_order, p_order = tap("Vref", u["Vref"]), tap("Pref", u["Pref"])
    # The plant's voltage control and its order of reactive power.
    compensated = tap("Vc", v_seen + q_seen * p["Kc"])
    v_error = tap("verr", v_order - compensated)
    q_order = tap("Qcmd", x_v + p["KPV"] * v_error)
    # The converter's: reactive power, then its terminals' voltage.
    q_error = tap("qerr", q_sent - local)
    vt_order = tap("Vcmd", _bounded(x_q + p["KPQ"] * q_error, 0.8, 1.2))
    vt_error = tap("vterr", vt_order - vt_seen)
    reactive_order = tap("Iqcmd", _bounded(x_i + p["KPI"] * vt_error, -0.6, 0.6))
    # Active power.
    slower = tap("ferr", 1.0 - f_seen)
    beyond = tap("fdb", np.sign(slower) * np.maximum(np.abs(slower) - p["db"], 0.0))
    p_error = tap("perr", p_order + beyond * p["Dd"] - p_seen)
    power_order = tap("Pcmd", x_p + p["KPP"] * p_error)
    active_order = tap("Ipcmd", _bounded(p_cmd / vt_seen, 0.0, 1.1))
    for name, value in (("P", real), ("Q", imaginary), ("V", volts), ("Vt", at_terminals)):
        tap(f"outputs.{name}", value)
    return [
        (volts - v_seen) / p["Tf"],
        (imaginary - q_seen) / p["Tf"],
        (real - p_seen) / p["Tf"],
        (frequency - f_seen) / p["Tf"],
        p["KIV"] * v_error,
        (q_order - q_sent) / p["Tc"],
        p["KIP"] * p_error,
        (power_order - p_sent) / p["Tc"],
        (at_terminals - vt_seen) / p["Tv"],
        p["KIQ"] * q_error,
        p["KII"] * vt_error,
        (p_sent - p_cmd) / p["Tp"],
        _bounded((active_order - active) / p["Tg"], -p["rr"], p["rr"]),
        (reactive_order - reactive) / p["Tg"],
    ]


PARK = Plant(
    name="park",
    parameters={
        "KPV": 0.5, "KIV": 2.5, "Kc": 0.05, "KPP": 0.5, "KIP": 3.0, "Dd": 20.0, "db": 6e-4, "Tf": 0.05, "Tc": 0.1,
        "KPQ": 0.1, "KIQ": 2.0, "KPI": 1.0, "KII": 40.0, "Tv": 0.02, "Tp": 0.05, "Tg": 0.02, "rr": 2.0, "Rg": 0.04,
        "Xg": 0.4, "Rc": 0.005, "Xc": 0.1,
    },
    inputs={"Vref": 1.0, "Pref": 0.7, "Vbus": 1.0, "fbus": 1.0},
    states={
        "Vf": 1.0, "Qf": 0.1, "Pf": 0.7, "ff": 1.0, "xv": 0.1, "Qext": 0.1, "xp": 0.7, "Pext": 0.7, "Vtf": 1.0, "xq": 1.0,
        "xi": 0.1, "Pord": 0.7, "Ip": 0.7, "Iq": 0.1,
    },
    outputs=("P", "Q", "V", "Vt"),
    fitted=("KIV", "KIP", "KII", "Xg"),
    kicks={"Vref": 0.02, "Pref": 0.1, "Vbus": 0.03, "fbus": 0.004},
    slots=(
        "Vbus", "fbus", "Vf", "Qf", "Pf", "ff", "xv", "Qext", "xp", "Pext", "Vtf", "xq", "xi", "Pord", "Ip", "Iq", "Vt", "V",
        "P", "Q", "Qt", "Vref", "Pref", "Vc", "verr", "Qcmd", "qerr", "Vcmd", "vterr", "Iqcmd", "ferr", "fdb", "perr", "Pcmd",
        "Ipcmd",
    ),
    resistance=("", ""),
    flow=_park,
    scheme="kutta",
    pace=5.0,
    coarse=4,
    lead=10.0,
    servos=("Qext", "Pext", "Pord", "Ip", "Iq"),
    bounded=("xv", "Qext", "xp", "Pext", "xq", "xi", "Pord", "Ip", "Iq"),
    feedbacks=(
        ("verr", "Q"), ("Vref", "Q"), ("Vref", "P"), ("Vcmd", "Q"), ("vterr", "Q"), ("Qcmd", "V"), ("perr", "V"),
        ("Pref", "Q"), ("Iqcmd", "P"), ("Pcmd", "Vt"),
    ),
)  # fmt: skip
