"""Plant 5: a hydro unit with water column, gate servo and transient-droop governor at a stiff grid."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hidden.plant import Array, Plant, See

SPEED = 2.0 * np.pi * 50.0
"""rad/s, nominal."""


def _hydro(x: list[Array], u: Mapping[str, Array], p: Mapping[str, Array], tap: See) -> list[Array]:
    volts, grid = tap("Vbus", u["Vbus"]), tap("fbus", u["fbus"])
    angle, speed, pilot = tap("delta", x[0]), tap("w", x[1]), tap("pilot", x[2])
    gate, slow, flow = tap("gate", x[3]), tap("slow", x[4]), tap("q", x[5])
    slip = tap("slip", speed - grid)
    faster = tap("dw", speed - 1.0)
    # The power that goes into the bus: no resistance between it and the inner voltage.
    current = (p["E"] * np.exp(1j * angle) - volts) / (1j * p["X"])
    power = tap("Pe", np.real(volts * np.conj(current)))
    # A gate is an orifice: the flow is the opening times the root of the head.
    head = tap("h", (flow / gate) ** 2)
    torque = tap("Pm", p["At"] * (flow - p["qn"]) * head - p["Dt"] * gate * faster)
    reference = tap("Pref", u["Pref"])
    permanent = tap("perm", (reference - gate) * p["Rp"])
    transient = tap("temp", (gate - slow) * p["RT"])
    error = tap("err", permanent - transient - faster)
    moving = tap("vel", np.minimum(np.maximum(pilot / p["TG"], -p["VEL"]), p["VEL"]))
    for name, value in (("Pe", power), ("gate", gate), ("dw", faster), ("h", head)):
        tap(f"outputs.{name}", value)
    return [
        SPEED * slip,
        0.5 * (torque - power - p["D"] * slip) / p["H"],
        (error - pilot) / p["Tp"],
        moving,
        (gate - slow) / p["TR"],
        (1.0 - head) / p["Tw"],
    ]


HYDRO = Plant(
    name="hydro",
    parameters={
        "H": 4.0, "D": 10.0, "E": 1.1, "X": 0.6, "Rp": 0.04, "RT": 0.37, "TR": 6.3, "Tp": 0.05, "TG": 0.2, "VEL": 0.16,
        "Tw": 1.3, "At": 1.2, "qn": 0.08, "Dt": 0.5,
    },
    inputs={"Pref": 0.7, "Vbus": 1.0, "fbus": 1.0},
    states={"delta": 0.42, "w": 1.0, "pilot": 0.0, "gate": 0.7, "slow": 0.7, "q": 0.7},
    outputs=("Pe", "gate", "dw", "h"),
    fitted=("Rp", "RT", "Tw", "H"),
    kicks={"fbus": 0.002, "Pref": 0.1, "Vbus": 0.02},
    slots=(
        "Vbus", "fbus", "delta", "w", "pilot", "gate", "slow", "q", "slip", "dw", "Pe", "h", "Pm", "Pref", "perm", "temp",
        "err", "vel",
    ),
    resistance=("", ""),
    flow=_hydro,
    scheme="kutta",
    pace=20.0,
    coarse=4,
    lead=100.0,
    servos=("pilot", "gate"),
    bounded=("pilot", "gate", "slow"),
    feedbacks=(
        ("err", "Pe"), ("Pref", "Pe"), ("perm", "Pe"), ("err", "h"), ("Pref", "gate"), ("Pm", "dw"), ("vel", "Pe"),
    ),
)  # fmt: skip
