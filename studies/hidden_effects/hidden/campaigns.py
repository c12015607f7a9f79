"""The excitation of a plant: two experiments to fit and one of another kind to validate."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hidden.plant import INTERVAL, Plant
from hidden.simulator import Run, Signal

ROWS, EVENT = 300, 0.2
"""Rows of a record; s: the event of a plant with pace 1."""
EXCITATIONS = ("small", "rich")
VARIANTS = 4
"""How many campaigns there are of each plant and excitation: the sizes and the order of the kicks differ."""


def campaign(plant: Plant, excitation: str, variant: int) -> tuple[Run, Run, Run]:
    """Return the inputs of the two fitted experiments and of the held-out one.

    small: one small step each; the held-out one is a pulse in the other direction with a ramp. rich: a step three times as
    large and back, and a multisine; the held-out one is a staircase with a step of another input.
    """
    rng = np.random.default_rng([excitation == "rich", variant])
    names = list(plant.kicks)
    first, second = names[variant % len(names)], names[(variant + 1) % len(names)]
    size = {n: k * rng.uniform(0.7, 1.3) for n, k in plant.kicks.items()}
    rest = plant.inputs
    if excitation == "small":
        one = {first: _steps(rest[first], (EVENT, size[first]))}
        two = {second: _steps(rest[second], (EVENT, -size[second]))}
        held = {
            first: _steps(rest[first], (EVENT, -0.8 * size[first]), (0.7, 0.5 * size[first])),
            second: _ramp(rest[second], EVENT + 0.2, 0.9, 0.8 * size[second]),
        }
    else:
        one = {
            first: _steps(rest[first], (EVENT, 3 * size[first]), (0.7, -3 * size[first])),
            second: _steps(rest[second], (0.95, size[second])),
        }
        two = {
            first: _multisine(rest[first], size[first], rng),
            second: _multisine(rest[second], 0.5 * size[second], rng),
        }
        third = 0.9 * size[first]
        held = {
            first: _steps(rest[first], (EVENT, third), (0.45, third), (0.7, -3 * third)),
            second: _steps(rest[second], (0.95, -1.2 * size[second])),
        }
    return _paced(one, plant.pace), _paced(two, plant.pace), _paced(held, plant.pace)


def _paced(inputs: Mapping[str, Signal], pace: float) -> Run:
    """Return the run with all its times in multiples of the pace."""
    return Run({n: Signal(tuple((t * pace, v) for t, v in s.points)) for n, s in inputs.items()})


def _steps(rest: float, *moves: tuple[float, float]) -> Signal:
    points, value = [(0.0, rest)], rest
    for time, change in moves:
        points += [(time, value), (time, value + change)]
        value += change
    return Signal(tuple(points))


def _ramp(rest: float, begin: float, end: float, change: float) -> Signal:
    return Signal(((begin, rest), (end, rest + change)))


def _multisine(rest: float, size: float, rng: np.random.Generator) -> Signal:
    """Return ten sines from 0.8 to 40 Hz from the event on, as straight lines between rows, as in the record."""
    t = np.arange(round(EVENT / INTERVAL), ROWS) * INTERVAL
    frequencies = np.geomspace(0.8, 40.0, 10)
    phases = rng.uniform(0, 2 * np.pi, 10)
    wave = sum(
        np.sin(2 * np.pi * f * (t - EVENT)) * np.cos(p) + np.sin(p) * (np.cos(2 * np.pi * f * (t - EVENT)) - 1)
        for f, p in zip(frequencies, phases, strict=True)
    )
    wave = size * wave / np.abs(wave).max()
    return Signal(tuple(zip(t.tolist(), (rest + wave).tolist(), strict=True)))


def summary(run: Run) -> Mapping[str, list[list[float]]]:
    """Return the run's inputs as plain numbers."""
    return {n: [list(p) for p in s.points] for n, s in run.inputs.items()}
