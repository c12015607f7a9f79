"""What records of real plants have beside noise: the messy variant of a case. The sizes and their reasons are in README.md."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hidden.campaigns import ROWS
from hidden.plant import Plant
from hidden.simulator import Hidden, Run, simulate

Array = NDArray[np.floating]
WRONG = 0.01
"""Relative error of every parameter that is not fitted; its sign is drawn."""
COARSER = 5
"""Steps of the study's simulator that one of the coarse integrator has: a quarter of a row."""
SKEW = 0.25
"""Rows by which a record's time stamps are off at most."""
FILTER = np.array([1.0, 2.0, 3.0, 4.0, 3.0, 2.0, 1.0]) / 16.0
"""The anti-alias filter at quarters of a row: the mean over a row, twice, with its delay corrected."""
OFFSET = DRIFT = 0.0025
"""Of an output's range, at most: its constant error, and what it drifts from the beginning of a record to the end."""
BITS, SCALE = 12, 1.25
"""Of the converter; its full scale in multiples of an output's largest magnitude in the records without an effect."""
AROUND = 2
"""Rows that are simulated beyond the last one, for the filter."""


def resolution(outputs: Array) -> Array:
    """Return (outputs,), the step of the analogue-to-digital converter. outputs: (rows, runs, outputs) without effects."""
    return np.asarray(2.0 * SCALE * np.abs(outputs).max(axis=(0, 1)) / 2**BITS)


def quantised(records: Array, step: Array) -> Array:
    """Return the records as the converter's levels."""
    return np.asarray(np.round(records / step) * step)


def on_coarse_steps(plant: Plant, hidden: Sequence[Hidden]) -> list[Hidden]:
    """Return the effects with sampling periods that are whole steps of the coarse integrator, at least one."""
    step = COARSER * plant.step
    found = []
    for h in hidden:
        values = dict(h.parameters)
        if "Ts" in values:
            late = float(values["Ts"]) / plant.step
            late = late / round(late)  # the slow clock of the study's samplers
            values["Ts"] = late * step * max(round(float(values["Ts"]) / step), 1)
        found.append(replace(h, parameters=values))
    return found


def recorded(plant: Plant, runs: Sequence[Run], hidden: Sequence[Hidden], extent: Array, key: Sequence[int]) -> Array:
    """Return (rows, runs, outputs) before noise and quantisation: what a real plant and its recorder would show.

    runs: values of their own, if any, are of parameters that are not fitted. hidden: on coarse steps. extent: (outputs,), the range
    of each output. key: of the generator.
    """
    rng = np.random.default_rng(key)
    signs = rng.choice([-1.0, 1.0], size=len(plant.parameters))
    off = {n: 1.0 + WRONG * s for n, s in zip(plant.parameters, signs, strict=True) if n not in plant.fitted}
    quarter = plant.interval / 4
    fine = simulate(
        plant,
        [Run(r.inputs, {n: r.values.get(n, plant.parameters[n]) * share for n, share in off.items()}) for r in runs],
        hidden,
        rows=4 * (ROWS - 1 + AROUND) + 1,
        interval=quarter,
        step=COARSER * plant.step,
        coarse=True,
    )
    count, outputs = fine.shape[1:]
    skew = rng.uniform(-SKEW, SKEW, count)
    offset = OFFSET * extent * rng.uniform(-1.0, 1.0, outputs)
    drift = DRIFT * extent * rng.uniform(-1.0, 1.0, (count, outputs))
    # Before the first row as a straight line: the plant rests, or it repeats itself.
    before = fine[0] + (fine[1] - fine[0]) * np.arange(-4 * AROUND, 0)[:, None, None]
    fine = np.concatenate([before, fine])
    quarters = np.arange(-4 * AROUND, fine.shape[0] - 4 * AROUND)
    found = np.zeros((ROWS, count, outputs))
    for run in range(count):
        for place, weight in zip(range(-3, 4), FILTER, strict=True):
            at = 4.0 * (np.arange(ROWS) + skew[run]) + place
            for k in range(outputs):
                found[:, run, k] += weight * np.interp(at, quarters, fine[:, run, k])
    return found + offset + drift * np.linspace(0.0, 1.0, ROWS)[:, None, None]
