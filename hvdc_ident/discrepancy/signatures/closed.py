"""Answers of a closed model (an FMU) to disturbances at its inputs and outputs: by running it again.

An FMU has no equations to linearise. What is added to an input is added to the signal that is played in; what is added
to an output is added to its record. Everything between stays untested, and the diagnosis says so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, Experiment, InputSignal
from hvdc_ident.discrepancy.signatures.response import instants
from hvdc_ident.errors import SimulationError
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import External
from hvdc_ident.simulate import Tolerance

MOVED = Tolerance(rtol=1e-6)
"""Error control of a run with something added to its inputs, and of the run that it is told against: the inputs are lines
from instant to instant, which bend at each. At 1e-8 an integrator takes several times as many steps for figures that the
lines themselves have not."""


@dataclass(frozen=True, eq=False)
class Ends:
    """A closed model's run of an experiment, and its answer to disturbances; names as in `response.Along`."""

    model: External
    experiment: Experiment
    parameters: FrozenMap[float]
    time: Array
    rows: NDArray[np.int64]
    values: Mapping[str, Array]
    outputs: tuple[str, ...]
    slots: tuple[str, ...]
    base: Array

    @property
    def count(self) -> int:
        """The record's rows."""
        return int(self.experiment.time.size)

    def signal(self, place: str) -> Array:
        """(K,): the slot's own signal on the base run."""
        return self.values[place]

    def answer(self, places: Sequence[str], d: Array) -> tuple[Array, Array]:
        """Return the slots' signals, (m, K, nc), and the outputs, (o, R, nc), in answer to disturbances d (m, K, nc).

        A run that fails answers with nan: that size is then not scored.
        """
        m, count, nc = d.shape
        u, y = np.zeros((m, count, nc)), np.zeros((len(self.outputs), self.count, nc))
        kept = np.flatnonzero(self.rows >= 0)
        for c in range(nc):
            moved = {p: d[k, :, c] for k, p in enumerate(places) if p in self.model.inputs and np.any(d[k, :, c])}
            if moved:
                y[:, :, c] = self._moved(moved)
            for k, p in enumerate(places):
                name = p.removeprefix("outputs.")
                if p not in self.model.inputs and name in self.outputs:
                    y[self.outputs.index(name), self.rows[kept], c] += d[k, kept, c]
        return u, y

    def _moved(self, moved: Mapping[str, Array]) -> Array:
        """(o, R) the outputs' differences with something added to inputs."""
        doubled = self.time[1:][np.diff(self.time) == 0]
        inputs = {p: InputSignal(self.time, self.values[p] + v, doubled) for p, v in moved.items()}
        asked = self.experiment.with_(inputs=FrozenMap({**self.experiment.inputs, **inputs}))
        try:
            run = self.model.simulate(asked, self.parameters, outputs=self.outputs, tolerance=MOVED)
        except SimulationError:
            return np.full(self.base.shape, np.nan)
        return np.array([run.trajectory[o] for o in self.outputs]) - self.base

    def starts(self) -> Array:
        """(o, R, 0): the states are not to be had."""
        return np.zeros((len(self.outputs), self.count, 0))


def ends(model: External, experiment: Experiment, values: Mapping[str, float]) -> Ends:
    """The closed model's run of the experiment. Raises SimulationError where it fails."""
    time, rows = instants(experiment)
    run = model.simulate(experiment, values, outputs=experiment.outputs, tolerance=MOVED)
    base = np.array([run.trajectory[o] for o in experiment.outputs])
    seen: dict[str, Array] = {}
    for name, i in model.inputs.items():
        signal = experiment.inputs.get(name) or InputSignal.constant(float(experiment.values.get(name, i.value)))
        seen[name] = _either_side(signal, time)
    places = [*model.inputs]
    for k, o in enumerate(experiment.outputs):
        place = o if o not in model.inputs else f"outputs.{o}"
        seen[place] = _joined(experiment.time, base[k], time)
        places.append(place)
    return Ends(model, experiment, FrozenMap(dict(values)), time, rows, seen, experiment.outputs, tuple(places), base)


def _either_side(signal: InputSignal, time: Array) -> Array:
    """The signal at the instants; of one that stands twice the first shows it before a jump."""
    v = np.asarray(signal(time), dtype=float)
    first = np.append(np.diff(time) == 0, False)
    v[first] = signal(np.nextafter(time[first], -np.inf))
    return v


def _joined(at: Array, values: Array, time: Array) -> Array:
    keep = np.append(np.diff(at) > 0, True)
    return np.asarray(np.interp(time, at[keep], values[keep]))
