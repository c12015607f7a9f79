"""Models for the tests of the export: all that a model may have, in small."""

from __future__ import annotations

from hvdc_ident.effects import apply_effects
from hvdc_ident.model import Model, parse_card
from hvdc_ident.models import load_model

ZOO = """
schema = 1
name = "zoo of parts"
description = "states with and without a start, an unknown, a delay, a sampled value, every kind of switch"
[parameters]
a = {value = 20.0, unit = "1/s", min = 0.0}
level = {value = 0.5, description = "of the limit & more <than> that"}
k = {value = 0.8, min = -1.0, max = 1.5}
x0 = {value = 0.1}
T = {value = 0.013, unit = "s"}
Ts = {value = 0.021, unit = "s"}
[inputs]
u = {value = 0.2, unit = "V"}
d = {value = -0.1}
[states]
x = {derivative = "a*(clip(u, -level, level) - x) + 0.3*where(d > 0.3, 1, 0)", unit = "V"}
v = {derivative = "5*(held - v) + 0.2*abs(d)", start = "2*x0"}
f = {derivative = "-3*f*(1 + 0.1*sign(u))", start = "free"}
q = {derivative = "4*(min(z, 0.4) + max(d, -0.2)*late - q)"}
[algebraic]
z = {equation = "tanh(k*z)/2 + x*sqrt(1 + d**2)"}
[delays]
late = {of = "x + 0.5*q", time = "T"}
[sampled]
held = {value = "late + q", period = "Ts", compute = "Ts/3"}
[outputs]
x = "x"
v = "v + z"
u = "u*k"
held = "held"
late = "late"
clock = "sin(30*time)*q"
"""


def zoo() -> Model:
    """A model with one of everything."""
    return parse_card(ZOO)


def undelayed() -> Model:
    """The same with a delay of 0."""
    return zoo().with_values({"T": 0.0})


def link() -> Model:
    """The shipped link."""
    return load_model("vsc-hvdc-link")


def augmented() -> Model:
    """The link with effects that add states and limits: one that linearises exactly."""
    return apply_effects(
        link(),
        [
            {"effect": "lag", "at": ["Ir1", "Ir2"], "parameters": {"T": 0.0016}},
            {"effect": "limit", "at": "yv_u", "parameters": {"level": 0.6}},
            {"effect": "second-order", "at": "Vdc1_m", "parameters": {"wn": 900.0, "zeta": 0.6}},
            {"effect": "saturation", "at": "outputs.P2", "parameters": {"level": 1.5}},
        ],
    )


def remembering() -> Model:
    """The link with effects that remember: a delay, a sampled order, a one-cycle mean and a delayed record."""
    return apply_effects(
        link(),
        [
            {"effect": "delay", "at": "P2_m", "parameters": {"T": 0.0023}},
            {"effect": "sample-hold", "at": "Irorder1", "parameters": {"Ts": 0.0011, "compute": 0.0004}},
            {"effect": "window-mean", "at": "outputs.Q1", "parameters": {"T": 0.02}},
            {"effect": "delay", "at": "outputs.Vdc1", "parameters": {"T": 0.0031}},
        ],
    )


PUNCTUAL = """
schema = 1
name = "punctual"
[parameters]
level = {value = 0.5}
Ts = {value = 0.03125, unit = "s"}
[inputs]
u = {value = 0.25}
[states]
x = {derivative = "20*(late - x)"}
[delays]
late = {of = "clip(u, -level, level)", time = "0.015625"}
[sampled]
held = {value = "x + u", period = "Ts", compute = "Ts/4"}
[outputs]
x = "x"
late = "late"
held = "held"
through = "clip(u, -level, level) + held"
"""


def punctual() -> Model:
    """A model whose delayed jumps and samples fall on multiples of 1/256 s, which have no rounding."""
    return parse_card(PUNCTUAL)
