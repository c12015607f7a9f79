"""Small cases, each made to earn one verdict."""

from __future__ import annotations

import numpy as np

from hvdc_ident.data import InputSignal, experiment, trajectory
from hvdc_ident.errors import SimulationError
from hvdc_ident.model import Model
from hvdc_ident.parameters import Parameter
from hvdc_ident.simulate import simulate
from tests.fit.simulators import Closed, recorded

T = np.linspace(0.0, 1.0, 101)


def closed(formula, **parameters):
    """A simulator of one output y."""
    return Closed({n: p if isinstance(p, Parameter) else Parameter(p) for n, p in parameters.items()}, {"y": formula})


def product(t, p):
    """y = a b t + c."""
    return p["a"] * p["b"] * t + p["c"], {"a": p["b"] * t, "b": p["a"] * t, "c": np.ones_like(t)}


def saturating(t, p):
    """y = a (1 - exp(-k t))."""
    e = np.exp(-p["k"] * t)
    return p["a"] * (1 - e), {"a": 1 - e, "k": p["a"] * t * e}


def line_and_nothing(t, p):
    """y = a + b t + tiny c."""
    return p["a"] + p["b"] * t + p["c"] * 1e-6 * t**2, {"a": np.ones_like(t), "b": t, "c": 1e-6 * t**2}


def measured(simulator, truth, noise, seed=0, name="e", t=T):
    """An experiment on the simulator at the truth."""
    y = simulator.simulate(experiment(name, t), truth).trajectory["y"]
    y = y + noise * np.random.default_rng(seed).normal(size=t.size)
    return recorded(name, t, {"y": noise} if noise else {}, y=y)


def pi_loop():
    """The loop of a plant a, b under a controller kp, ki."""
    return Model(
        name="pi",
        parameters={"a": 0.8, "b": 1.5, "kp": 2.0, "ki": 1.1},
        inputs={"r": 0.0},
        states={"x": "-a*x + b*u", "z": "ki*(r - x)"},
        signals={"u": "kp*(r - x) + z"},
        outputs={"y": "x", "control": "u"},
    )


def on_model(model, name, signals, outputs, noise, seed=0, end=6.0, rows=301):
    """An experiment on a model through the engine."""
    asked = experiment(name, np.linspace(0, end, rows), signals)
    run = simulate(model, asked).trajectory
    rng = np.random.default_rng(seed)
    table = trajectory(asked.time, {o: run[o] + noise * rng.normal(size=rows) for o in outputs})
    return asked.with_(measured=table, noise=dict.fromkeys(outputs, noise) if noise else {})


STEPS = InputSignal.corners([(1.0, 0.0), (1.0, 1.0), (3.5, 1.0), (3.5, 0.4)])


def failing(t, p):
    """A run that never ends well."""
    raise SimulationError("the run does not reach its end")
