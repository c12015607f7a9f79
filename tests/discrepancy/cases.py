"""A small drive with hidden effects, computed by scipy: nothing here knows how the package simulates or what its effects are."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp

from hvdc_ident import Experiment, InputSignal, Model, Trajectory
from hvdc_ident.data import Array
from hvdc_ident.fit import FitParameter
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import parse_card

CARD = """
schema = 1
name = "drive"
[parameters]
Kp = {value = 2.0, min = 0.0}
Ki = {value = 12.0, min = 0.0}
J = {value = 0.2, min = 0.01}
b = {value = 0.3, min = 0.0}
[inputs]
ref = {value = 1.0}
load = {value = 0.0}
[states]
w = {derivative = "(torque - drag - load) / J", guess = 1.0}
x = {derivative = "Ki * err", guess = 0.3}
[signals]
wm = "w"
err = "ref - wm"
torque = "Kp*err + x"
drag = "b*w"
[outputs]
w = "w"
torque = "torque"
"""
TRUE = {"Kp": 2.0, "Ki": 12.0, "J": 0.2, "b": 0.3}
TIME = np.round(np.arange(300) * 4e-3, 9)
EVENT = 0.2
SIGMA = {"w": 2e-3, "torque": 4e-3}
FREE = (FitParameter("Kp", 2.4, 0.4, 10.0), FitParameter("Ki", 10.0, 2.0, 60.0))
RUNS = {
    "fit-1": ("fit", {"ref": [(EVENT, 0.6), (0.7, -0.9)]}),
    "fit-2": ("fit", {"load": [(EVENT, 0.5), (0.75, -0.4)]}),
    "held": ("holdout", {"ref": [(0.3, -0.5)], "load": [(0.6, 0.4)]}),
}
"""What each experiment does: (time, change) of its inputs."""


def model() -> Model:
    """The drive as a user has it."""
    return parse_card(CARD)


def experiments(
    lag: float = 0.0,
    drag: Callable[[float], float] | None = None,
    offset: float = 0.0,
    noise: str = "white",
    seed: int = 0,
    meter: Callable[[Array], Array] | None = None,
    late: Mapping[str, float] | None = None,
    quieter: float = 1.0,
) -> tuple[Experiment, ...]:
    """Records of the drive with something hidden. lag: of the measured speed, s. drag: of the speed, instead of b w.

    offset: of the torque that acts. noise: white, ar (0.9) or quantised. meter: what becomes of the torque before it. late: by
    how much the clock of a record is late, s: its rows show what was so long before. quieter: times that the noise is smaller.
    """
    random = np.random.default_rng(seed)
    found, sigma = [], {n: s / quieter for n, s in SIGMA.items()}
    for name, (role, moves) in RUNS.items():
        inputs = {n: InputSignal.corners(corners({"ref": 1.0, "load": 0.0}[n], m)) for n, m in moves.items()}
        later = (late or {}).get(name, 0.0)
        shown = {n: [(t + later, change) for t, change in m] for n, m in moves.items()}
        seen = {n: InputSignal.corners(corners({"ref": 1.0, "load": 0.0}[n], m)) for n, m in shown.items()}
        clean = _solved(seen, lag, drag or (lambda w: TRUE["b"] * w), offset)
        if meter:
            clean[:, 1] = meter(clean[:, 1])
        y = np.column_stack([_noisy(clean[:, k], s, noise, random) for k, s in enumerate(sigma.values())])
        measured = Trajectory(TIME, y, tuple(sigma), ("", ""))
        told = FrozenMap(sigma) if noise == "white" else FrozenMap()
        found.append(
            Experiment(TIME, name, inputs=FrozenMap(inputs), measured=measured, noise=told, event=EVENT, role=role)
        )
    return tuple(found)


def corners(before: float, moves: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """The corners of an input that jumps by so much at each time."""
    points, level = [(0.0, before)], before
    for t, change in moves:
        points += [(t, level), (t, level + change)]
        level += change
    return points


def _solved(inputs: dict[str, InputSignal], lag: float, drag: Callable[[float], float], offset: float) -> Array:
    """(n, 2) speed and torque by an implicit Runge-Kutta method, piece by piece between the jumps."""

    def level(name: str, t: float) -> float:
        return float(inputs[name](t)) if name in inputs else {"ref": 1.0, "load": 0.0}[name]

    def slopes(t: float, s: Array) -> list[float]:
        w, x, seen = s
        measured = seen if lag else w
        err = level("ref", t) - measured
        torque = TRUE["Kp"] * err + x
        return [
            (torque + offset - drag(w) - level("load", t)) / TRUE["J"],
            TRUE["Ki"] * err,
            (w - seen) / lag if lag else w - seen,
        ]

    start = np.array([1.0, drag(1.0) - offset, 1.0])
    jumps = sorted({float(b) for i in inputs.values() for b in i.breaks if 0 < b < TIME[-1]})
    edges = [0.0, *jumps, float(TIME[-1])]
    rows, s = np.zeros((TIME.size, 3)), start
    for a, b in pairwise(edges):
        inner = (a <= TIME) & (b >= TIME)
        ask = np.unique(np.concatenate([TIME[inner], [b - 1e-12]]))
        run = solve_ivp(slopes, (a, b - 1e-12), s, "Radau", t_eval=ask[ask <= b - 1e-12], rtol=1e-9, atol=1e-11)
        keep = inner & (b > TIME)
        rows[keep] = run.y[:, : keep.sum()].T
        s = run.y[:, -1]
    rows[-1] = s
    err = np.array([level("ref", t) for t in TIME]) - (rows[:, 2] if lag else rows[:, 0])
    return np.column_stack([rows[:, 0], TRUE["Kp"] * err + rows[:, 1]])


def _noisy(clean: Array, sigma: float, kind: str, random: np.random.Generator) -> Array:
    e = random.standard_normal(clean.size)
    if kind == "quantised":
        step = sigma * np.sqrt(12.0)
        return np.round((clean + 0.25 * step * e) / step) * step
    if kind == "ar":
        e[1:] *= np.sqrt(1.0 - 0.81)
        for k in range(1, e.size):
            e[k] += 0.9 * e[k - 1]
    return clean + sigma * e
