"""Plant 3: a synchronous machine with voltage regulator and governor behind a reactance from an infinite bus.

Its card solves stator and network in closed form, in the machine's frame. Here, as in programs for the stability of power
systems, the machine is a source behind an admittance in the network's frame, and the nodal equations of its terminals are
solved in each evaluation.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hidden.plant import Array, Plant, See

SPEED = 2.0 * np.pi * 60.0
"""rad/s, nominal."""


def _terminals(p: Mapping[str, Array], sin: Array, cos: Array, inner: Array, bus: Array) -> tuple[Array, Array]:
    """Return the terminal voltage, real and imaginary, in the network's frame, in which the bus has the angle 0.

    sin, cos: of the rotor's angle. The machine injects i = source + G v, where i_d = (inner - v_q)/xdp and i_q = v_d/xq are
    turned into the network's frame by x = d sin + q cos, y = q sin - d cos. The line carries i = (v - bus)/(j xe).
    """
    of_d, of_q, line = 1.0 / p["xdp"], 1.0 / p["xq"], 1.0 / p["xe"]
    gxx, gxy = (of_q - of_d) * sin * cos, -of_d * sin**2 - of_q * cos**2
    gyx, gyy = of_d * cos**2 + of_q * sin**2, -gxx
    # The balance of both currents: A v = b.
    a11, a12, b1 = -gxx, line - gxy, of_d * inner * sin
    a21, a22, b2 = line + gyx, gyy, of_d * inner * cos + line * bus
    det = a11 * a22 - a12 * a21
    return (b1 * a22 - b2 * a12) / det, (a11 * b2 - a21 * b1) / det


def _machine(x: list[Array], u: Mapping[str, Array], p: Mapping[str, Array], see: See) -> list[Array]:
    wanted, load, bus, grid = (see(n, u[n]) for n in ("Vref", "Pref", "Vbus", "fbus"))
    angle, speed, inner, field, valve, steam = (see(n, x[k]) for k, n in enumerate(MACHINE.states))
    sin, cos = np.sin(angle), np.cos(angle)
    real, imaginary = _terminals(p, sin, cos, inner, bus)
    i = ((real - bus) + 1j * imaginary) / (1j * p["xe"])
    i_d = see("Id", i.real * sin - i.imag * cos)
    i_q = see("Iq", i.real * cos + i.imag * sin)
    v_d = see("Vd", p["xq"] * i_q)
    v_q = see("Vq", inner - p["xdp"] * i_d)
    voltage = see("Vt", np.abs(v_d + 1j * v_q))
    power = (v_d + 1j * v_q) * (i_d - 1j * i_q)
    active = see("Pe", power.real)
    see("outputs.Qe", see("Qe", power.imag))
    measured = see("Vm", voltage)
    error = see("err", wanted - measured)
    regulator = see("VR", np.clip(p["KA"] * error, -6.4, 7.0))
    slip = see("dw", speed - 1.0)
    order = see("order", load - slip / p["R"])
    gate = see("gate", np.clip(order, 0.0, 1.1))
    share = p["T2"] / p["T3"]
    turbine = see("Pm", share * valve + (1.0 - share) * steam)
    for name, value in (("Vt", voltage), ("Pe", active), ("dw", slip), ("Efd", field)):
        see(f"outputs.{name}", value)
    return [
        SPEED * (speed - grid),
        (turbine - active - p["D"] * slip) / (2.0 * p["H"]),
        (field - inner - (p["xd"] - p["xdp"]) * i_d) / p["Td0p"],
        (regulator - field) / p["TA"],
        (gate - valve) / p["T1"],
        (valve - steam) / p["T3"],
    ]


MACHINE = Plant(
    name="machine",
    parameters={
        "H": 3.2, "D": 2.0, "xd": 2.5, "xq": 2.1, "xdp": 0.39, "Td0p": 9.6, "xe": 0.5,
        "KA": 200.0, "TA": 0.2, "R": 0.05, "T1": 0.5, "T2": 2.1, "T3": 7.0,
    },
    inputs={"Vref": 1.0082, "Pref": 0.5435, "Vbus": 1.05, "fbus": 1.0},
    states={"delta": 1.14, "w": 1.0, "Eqp": 0.79, "Efd": 1.64, "valve": 0.54, "steam": 0.54},
    outputs=("Vt", "Pe", "Qe", "dw", "Efd"),
    fitted=("H", "KA", "R"),
    kicks={"Vref": 0.02, "Pref": 0.1, "Vbus": 0.02, "fbus": 0.001},
    slots=(
        "Vref", "Pref", "Vbus", "fbus", "delta", "w", "Eqp", "Efd", "valve", "steam", "Id", "Iq", "Vd", "Vq", "Vt",
        "Pe", "Qe", "Vm", "err", "VR", "dw", "order", "gate", "Pm",
    ),
    resistance=("", ""),
    flow=_machine,
    scheme="trapezoidal",
    pace=10.0,
    lead=40.0,
)  # fmt: skip
