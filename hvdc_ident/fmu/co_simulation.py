"""A run of a co-simulation FMU: communication steps from row to row. Runs in the worker alone."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hvdc_ident.fmu.binding import Vector
from hvdc_ident.fmu.plant import Plant, RunFailed
from hvdc_ident.fmu.signals import Signals
from hvdc_ident.trajectory import Array

EARLY = 10_000  # early returns in one communication step


def run(
    plant: Plant, values: Mapping[str, float], signals: Signals, time: Array, names: tuple[str, ...], tolerance: float
) -> Array:
    """(n, outputs) at the instants. Two equal instants are before and after a jump.

    Inputs are held at their mean over a step, or follow their slope where the FMU can, and stand at their own value
    where outputs are read. Only FMI 2.0 has such slopes: FMI 3.0 gives an input during a step only to FMUs that ask for
    it by intermediate updates, which are not used here, so a ramp is stairs of the rows' width there. Steps end at every
    row and every break of an input; an FMU of fixed steps takes its own step (where it states none, the shortest
    interval), a jump within one enters as the mean over it, and rows between are joined by lines.
    """
    stops = _stops(plant, signals, time)
    plant.begin(values, signals.at(stops[:1], "left")[0], float(time[0]), float(stops[-1]), tolerance)
    before, after = signals.at(stops, "left"), signals.at(stops, "right")
    seen = plant.block(names)
    left, right = (np.empty((stops.size, len(names))) for _ in range(2))
    stepper = _Stepper(plant)
    jumps = (before != after).any(axis=1).tolist()
    moves = [False, *(before[1:] != after[:-1]).any(axis=1).tolist()]
    instants = stops.tolist()
    for k, t in enumerate(instants):
        if k:
            stepper.step(instants[k - 1], t, after[k - 1], before[k], moves[k])
        if k == 0 or moves[k]:
            stepper.hold(before[k])
        left[k] = seen.get()
        if jumps[k]:
            stepper.hold(after[k])
            right[k] = seen.get()
        else:
            right[k] = left[k]
    return _rows(time, stops, left, right)


def _stops(plant: Plant, signals: Signals, time: Array) -> Array:
    """Where communication steps end."""
    begin, end = float(time[0]), float(time[-1])
    wanted = np.unique(np.concatenate([time, signals.breaks[(signals.breaks > begin) & (signals.breaks < end)]]))
    if plant.description.variable_step or wanted.size < 2:
        return wanted
    gaps = np.diff(wanted)
    even = bool(np.allclose(gaps, gaps[0], rtol=1e-9, atol=0.0))
    step = plant.description.step or float(gaps.min())
    if even and (plant.description.step is None or np.isclose(gaps[0], step, rtol=1e-9)):
        return wanted
    count = int(np.ceil((end - begin) / step - 1e-9))
    grid = begin + step * np.arange(count + 1)
    # A row or jump that rounding alone keeps off a step's end is at it: a jump just before it would be averaged away.
    near = wanted[np.clip(np.searchsorted(wanted, grid - 1e-6 * step), 0, wanted.size - 1)]
    return np.asarray(np.where(np.abs(near - grid) <= 1e-6 * step, near, grid), dtype=float)


def _rows(time: Array, stops: Array, left: Array, right: Array) -> Array:
    """The values at the rows; of two equal instants the first has what was before the jump."""
    place = np.searchsorted(stops, time)
    if place.max(initial=0) < stops.size and (stops[np.minimum(place, stops.size - 1)] == time).all():
        twice = np.zeros(time.size, dtype=bool)
        twice[:-1] = time[:-1] == time[1:]
        return np.where(twice[:, None], left[place], right[place])
    return np.column_stack([np.interp(time, stops, right[:, k]) for k in range(right.shape[1])])


class _Stepper:
    """The steps of one run."""

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self.sloping = False
        d = plant.description
        self.follows = d.interpolates and bool(d.inputs) and all(v.kind == "Real" for v in d.inputs.values())
        if self.follows:
            self.references = plant.binding.references([v.reference for v in d.inputs.values()])
            self.orders = self._ones(len(d.inputs))
            self.slopes = Vector(len(d.inputs))

    @staticmethod
    def _ones(count: int) -> object:
        from ctypes import c_int

        return (c_int * count)(*([1] * count))

    def hold(self, u: Array) -> None:
        """Nothing; the inputs stand at u."""
        self.plant.inputs.set(u)

    def step(self, a: float, b: float, first: Array, last: Array, moves: bool) -> None:
        """Nothing; the FMU is at b, its inputs having gone from `first` to `last`; moves: whether these differ."""
        if self.follows and (moves or self.sloping):
            self.hold(first)
            self.slopes.values[:] = (last - first) / (b - a)
            self.plant.binding.set_slopes_of_inputs(self.references, self.orders, self.slopes)
            self.sloping = moves
        elif moves:
            self.hold(0.5 * (first + last))
        t = a
        for _ in range(EARLY):
            try:
                reached = self.plant.binding.step(t, b - t)
            except RuntimeError as e:
                raise RunFailed(str(e), t) from None
            if reached >= b - 1e-12 * max(abs(b), 1.0):
                return
            t = reached
        raise RunFailed(f"the FMU returned early {EARLY} times in one step", t)
