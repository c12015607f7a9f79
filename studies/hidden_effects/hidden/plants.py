"""The plants of the study by name, and the two small ones; their cards for the package are in `cards/`."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hidden.converter import CONVERTER
from hidden.hydro import HYDRO
from hidden.machine import MACHINE
from hidden.park import PARK
from hidden.plant import Array, Plant, See


def _station(x: list[Array], u: Mapping[str, Array], p: Mapping[str, Array], see: See) -> list[Array]:
    ref, grid, bus = see("Pref", u["Pref"]), see("E", u["E"]), see("Vbus", u["Vbus"])
    amps, integral, vdc = see("I", x[0]), see("xi", x[1]), see("Vdc", x[2])
    volts = see("V", grid - p["Z"] * amps)
    power = see("P", volts * amps)
    measured = see("Pm", power)
    err = see("err", ref - measured)
    order = see("order", p["KP"] * err + integral)
    current = see("current", np.minimum(np.maximum(order, -1.2), 1.2))
    line = see("Iline", (vdc - bus) / p["Rl"])
    see("outputs.P", power)
    see("outputs.Vdc", vdc)
    see("outputs.order", order)
    return [(current - amps) / p["Ta"], p["KI"] * err, (power / vdc - line) / p["C"]]


def _drive(x: list[Array], u: Mapping[str, Array], p: Mapping[str, Array], see: See) -> list[Array]:
    ref, load = see("wref", u["wref"]), see("load", u["load"])
    speed, amps, integral = see("w", x[0]), see("i", x[1]), see("xs", x[2])
    measured = see("wm", speed)
    err = see("err", ref - measured)
    order = see("vo", p["KP"] * err + integral)
    volts = see("v", np.minimum(np.maximum(order, -4.0), 4.0))
    emf = see("emf", p["k"] * speed)
    torque = see("torque", p["k"] * amps)
    friction = see("friction", p["b"] * speed)
    see("outputs.w", speed)
    see("outputs.i", amps)
    see("outputs.vo", order)
    return [(torque - friction - load) / p["J"], (volts - emf - p["R"] * amps) / p["L"], p["KI"] * err]


STATION = Plant(
    name="station",
    parameters={"KP": 0.3, "KI": 25.0, "C": 0.25, "Ta": 0.01, "Z": 0.15, "Rl": 0.1},
    inputs={"Pref": 0.5, "E": 1.0, "Vbus": 1.0},
    states={"I": 0.5, "xi": 0.5, "Vdc": 1.05},
    outputs=("P", "Vdc", "order"),
    fitted=("KP", "KI", "C"),
    kicks={"Pref": 0.1, "E": 0.05, "Vbus": 0.02},
    slots=("Pref", "E", "Vbus", "I", "xi", "Vdc", "V", "P", "Pm", "err", "order", "current", "Iline"),
    resistance=("Iline", "Rl"),
    flow=_station,
)
DRIVE = Plant(
    name="drive",
    parameters={"KP": 1.2, "KI": 14.0, "J": 0.02, "k": 0.5, "b": 0.02, "R": 0.5, "L": 0.005},
    inputs={"wref": 1.0, "load": 0.1},
    states={"w": 1.0, "i": 0.3, "xs": 0.7},
    outputs=("w", "i", "vo"),
    fitted=("KP", "KI", "J"),
    kicks={"wref": 0.3, "load": 0.1},
    slots=("wref", "load", "w", "i", "xs", "wm", "err", "vo", "v", "emf", "torque", "friction"),
    resistance=("", ""),
    flow=_drive,
)
PLANTS = {p.name: p for p in (STATION, DRIVE, MACHINE, CONVERTER, HYDRO, PARK)}
"""In the order of their numbers, which begin with 1."""
FIRST = (STATION.name, DRIVE.name)
"""Those that share the designs of the study's first version; each of the others has designs of its own."""
