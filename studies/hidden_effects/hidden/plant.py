"""A plant of the study: values, equations, and how it is integrated."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
See = Callable[[str, Array], Array]
Flow = Callable[[list[Array], Mapping[str, Array], Mapping[str, Array], See], list[Array]]
INTERVAL, STEP = 4e-3, 2e-4
"""s: from row to row, and of the integration, of a plant with pace 1."""


@dataclass(frozen=True)
class Plant:
    """A plant: values of parameters and inputs, initial guesses of its states, and its equations.

    flow(x, inputs, parameters, see): derivatives of the states; every signal passes through `see(slot, value)`, which
    returns and keeps the value for its readers. fitted: the fit parameters. kicks: by input, the size of a small step.
    slots: insertion points other than the outputs; a signal comes after those that it may read. scheme: how it is integrated.
    pace: of its rows, steps, experiments and effects' times, in multiples of those of the first plants. coarse: steps of the
    simulator that one step of the refits has. lead: time in s that a run without a steady start waits for rest before its first
    row, several times the plant's largest time constant. turning(x): derivatives of the states in steady state (default: 0). timed: True
    if flow reads the time, as the input "time". servos, bounded: states whose speed, or whose range, a hidden effect may limit.
    feedbacks: pairs of a slot and an output that a hidden coupling or droop feeds back into it in every second case; none: never
    by choice.
    """

    name: str
    parameters: Mapping[str, float]
    inputs: Mapping[str, float]
    states: Mapping[str, float]
    outputs: tuple[str, ...]
    fitted: tuple[str, ...]
    kicks: Mapping[str, float]
    slots: tuple[str, ...]
    resistance: tuple[str, str]
    flow: Flow
    scheme: Literal["runge-kutta", "trapezoidal", "kutta"] = "runge-kutta"
    pace: float = 1.0
    coarse: int = 10
    lead: float = 1.0
    turning: Callable[[list[Array]], list[Array]] | None = None
    timed: bool = False
    servos: tuple[str, ...] = ()
    bounded: tuple[str, ...] = ()
    feedbacks: tuple[tuple[str, str], ...] = ()

    @property
    def interval(self) -> float:
        """Return the time from row to row, s."""
        return INTERVAL * self.pace

    @property
    def step(self) -> float:
        """Return the integration step, s."""
        return STEP * self.pace
