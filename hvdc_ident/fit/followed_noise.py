"""Measure the noise of played inputs that a model follows, and free estimates of what they gain by following less of it.

A model follows the noise of a recorded voltage, which the plant has not seen. The less it follows it, the smaller its residuals: a
reactance that is too large, a gain that is too small or a lag that is not there pay off, where residuals are whitened by a covariance
that does not move with them. The sum of squares that the noise makes of the residuals is what a model gains by following none of it;
with it taken off, the sum of squared residuals is least, in the mean, at the truth (an estimating equation without bias; Carroll,
Ruppert, Stefanski and Crainiceanu, Measurement Error in Nonlinear Models, 2006, section 5).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache

import numpy as np

from hvdc_ident.data import Array, Experiment, InputSignal
from hvdc_ident.fit.problem import Problem, stacked
from hvdc_ident.immutable import FrozenMap

DRAWS = 2
"""Records of noise that are followed. Of two models the same ones are: the difference is known to a share of itself, sqrt(2/N) for N
independent residuals, of which a record has hundreds."""

SLOPE_STEP = 0.01
"""Share of a value by which it is moved for a slope: what is followed is smooth in it, and runs are exact to a millionth."""
SINGULAR = 1e-9
"""Smallest singular value, of the largest, of combinations of unknowns that the records determine."""


def follows_noise(problem: Problem) -> bool:
    """Return True where a fitted record has inputs whose noise is known."""
    return any(e.input_noise for e in problem.fitted_experiments)


def followed_noise(problem: Problem, theta: Array, also: Mapping[str, float] | None = None) -> float:
    """Return the mean sum of squares that the noise of the inputs makes of the residuals; 0 where no input's noise is known.

    theta: (p,) unknowns; also: values of further parameters. Raises SimulationError where a run fails.
    """
    if not follows_noise(problem):
        return 0.0
    values = also or {}
    runs = [problem.misfits(theta, values)]
    for draw in range(DRAWS):
        noisier = tuple(_noisier(e, draw) if e.role == "fit" else e for e in problem.experiments)
        runs.append(replace(problem, experiments=noisier).misfits(theta, values))
    whole = problem.residuals(np.column_stack(runs))
    return float(np.sum((whole[:, 1:] - whole[:, :1]) ** 2) / DRAWS)


def unbiased(problem: Problem, theta: Array) -> Array:
    """Return (p,) the unknowns of least squares, freed to first order of what they gain by following less noise, within their bounds.

    The sum of squares is least there, and less the noise that is followed a step further: half the slopes of that, over the information.
    Raises SimulationError where a run fails.
    """
    if not follows_noise(problem):
        return theta
    jacobian = stacked(problem.blocks(theta))[1]
    here, slopes = followed_noise(problem, theta), np.zeros(theta.size)
    for k, f in enumerate(problem.free):
        step = SLOPE_STEP * (abs(theta[k]) or f.size)
        inwards = -step if theta[k] + step > f.max else step
        there = theta.copy()
        there[k] += inwards
        slopes[k] = (followed_noise(problem, there) - here) / inwards
    scale = np.linalg.norm(jacobian, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    unit = jacobian / scale
    move = np.linalg.lstsq(unit.T @ unit, 0.5 * slopes / scale, rcond=SINGULAR)[0] / scale
    low, high = (np.array([getattr(u, end) for u in problem.unknowns]) for end in ("min", "max"))
    return np.asarray(np.clip(theta + move, low, high))


# Many models, and many values of one, are run with the same draws.
@lru_cache(maxsize=32)
def _noisier(experiment: Experiment, draw: int) -> Experiment:
    """Return an experiment whose recorded inputs have a draw of their noise more; it begins where it began."""
    random, inputs = np.random.default_rng(draw), dict(experiment.inputs)
    for name, noise in experiment.input_noise.items():
        signal = inputs[name]
        before = signal.times < (np.inf if experiment.event is None else experiment.event)
        size = np.where(before, noise.before, noise.std)
        inputs[name] = InputSignal(signal.times, signal.values + size * _by_row(signal, random), signal.breaks)
    return experiment.with_(inputs=FrozenMap(inputs))


def _by_row(signal: InputSignal, random: np.random.Generator) -> Array:
    """Return (n,) a normal variable for each row of a signal, the same at both ends of a row that is held; 0 at the first, its level."""
    held = np.zeros(signal.times.size, bool)
    held[1:-1] = (signal.times[1:-1] == signal.times[2:]) & (signal.values[1:-1] == signal.values[:-2])
    row = np.cumsum(~held) - 1
    each = random.standard_normal(row[-1] + 1)
    each[0] = 0.0
    return np.asarray(each[row])
