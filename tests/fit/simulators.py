"""Simulators in closed form, with exact derivatives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from hvdc_ident.data import Array, Experiment, Trajectory, experiment, trajectory
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit import FitParameter
from hvdc_ident.parameters import Parameter

Formula = Callable[[Array, dict[str, float]], tuple[Array, dict[str, Array]]]
"""From the times and all parameters: an output, and its derivative by each parameter."""


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """A sum of squares given by a function: theta to r, (n,), and dr/dtheta, (n, p)."""

    unknowns: tuple[FitParameter, ...]
    residual: Callable[[Array], tuple[Array, Array]]


@dataclass(frozen=True)
class Run:
    trajectory: Trajectory
    parameters: tuple[str, ...]
    gradients: dict[str, Array]

    def gradient(self, output: str) -> Array:
        return self.gradients[output]


@dataclass
class Closed:
    """Outputs y = f(t; parameters). fails: where in parameter space a run fails."""

    parameters: dict[str, Parameter]
    outputs: dict[str, Formula]
    fails: Callable[[dict[str, float]], bool] = lambda p: False
    runs: int = field(default=0, compare=False)

    def simulate(self, experiment: Experiment, values: Mapping[str, float], sensitivities: Sequence[str] = ()) -> Run:
        self.runs += 1
        p = {n: q.value for n, q in self.parameters.items()} | dict(values)
        if self.fails(p):
            raise SimulationError("the run does not reach its end", where=experiment.name)
        y = {n: f(experiment.time, p) for n, f in self.outputs.items()}
        columns = {
            n: np.column_stack([g[s] for s in sensitivities]) if sensitivities else np.empty((experiment.time.size, 0))
            for n, (_, g) in y.items()
        }
        return Run(trajectory(experiment.time, {n: v for n, (v, _) in y.items()}), tuple(sensitivities), columns)


def parameters(**values: float) -> dict[str, Parameter]:
    return {n: Parameter(v) for n, v in values.items()}


def recorded(name: str, t: Array, noise: dict[str, float] | None = None, rest: dict | None = None, **y: Array):
    """An experiment whose outputs were measured as given."""
    return experiment(name, t, measured=trajectory(t, dict(y)), noise=noise or {}, **(rest or {}))


def decay(t: Array, p: dict[str, float]) -> tuple[Array, dict[str, Array]]:
    """y = a exp(-k t)."""
    e = np.exp(-p["k"] * t)
    return p["a"] * e, {"a": e, "k": -p["a"] * t * e}


def line(t: Array, p: dict[str, float]) -> tuple[Array, dict[str, Array]]:
    """y = a + b t."""
    return p["a"] + p["b"] * t, {"a": np.ones_like(t), "b": t}


def step_response(t: Array, p: dict[str, float]) -> tuple[Array, dict[str, Array]]:
    """The response of gain/(s^2/w^2 + 2 z s/w + 1), z < 1, to a unit step at 0.1 s; 0 before."""
    s = np.maximum(t - 0.1, 0.0)
    z, w, gain = p["z"], p["w"], p["gain"]
    q = np.sqrt(1 - z**2)
    e, c, d = np.exp(-z * w * s), np.cos(w * q * s), np.sin(w * q * s)
    y = 1 - e * (c + z / q * d)
    dw = e * w * s / q * d * (1.0 / w)
    # d/dz by parts: e, the angle w q s, and the factor z/q
    dz = w * s * e * (c + z / q * d) - e * ((d - z / q * c) * (w * s * z / q) + d / q**3)
    return gain * y, {"gain": y, "w": gain * dw, "z": gain * dz}


def coloured(rng: np.random.Generator, n: int, rho: float, sigma: float = 1.0) -> Array:
    """A stationary AR(1) noise of the given standard deviation."""
    e = rng.normal(0.0, sigma, n)
    for k in range(1, n):
        e[k] = rho * e[k - 1] + np.sqrt(1 - rho**2) * e[k]
    return e
