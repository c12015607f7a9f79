"""Noise of recorded inputs that the model passes on to its outputs, and levels before the event that are known by noisy rows alone.

A model that is played a recorded voltage follows its noise, which the plant has not seen; it starts where the mean of some noisy
rows is; and it is played lines between rows, where the plant has seen what no row shows. In outputs about a steady state that is Gaussian
noise, alike in all of them and as slow as the model, of a covariance that follows from the model's answers to steps. Residuals are whitened
by it, together, beside the noise that each output has of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256

import numpy as np
from scipy.special import ndtri

from hvdc_ident.data import Array, Experiment, InputNoise, InputSignal, Trajectory, before_event
from hvdc_ident.fit.simulator import Simulator, observe
from hvdc_ident.immutable import FrozenMap

FINER = 8
"""Instants of a step's answer in the time of a row."""
BEYOND = 1e-3
"""Chance that a bend of noise alone, at any of a record's rows, counts as one of the input."""
SIZE = 2.0
"""Standard deviations of a row between the level and either end of a step."""


@dataclass(frozen=True, eq=False)
class PassedNoise:
    """Noise of an experiment's recorded inputs as it stands in its outputs.

    time: (n,) instants of the inputs' rows, s; level: (n,) weights with which they make the level that the model starts from.
    noise, held: of each input, and whether it holds its rows' values; between: (inputs, n - 1) standard deviation of what its mean from
    each row to the next may be off the line, in its unit (`off_the_line`). spacing: s; steps: by output (inputs, m) the answers to a step
    of 1 in each input, so far apart; rest: (inputs,) how much the start moves with the level of each, by 1. levels: outputs at whose level
    before the event the model starts.
    Two are equal that say the same, so that what follows from them is worked out once.
    """

    time: Array
    level: Array
    noise: tuple[InputNoise, ...]
    held: tuple[bool, ...]
    between: Array
    spacing: float
    steps: FrozenMap[Array]
    rest: FrozenMap[Array]
    levels: tuple[str, ...]

    @cached_property
    def _said(self) -> bytes:
        parts = [
            self.time,
            self.level,
            self.between,
            np.array([self.spacing]),
            *self.steps.values(),
            *self.rest.values(),
        ]
        words = repr((self.noise, self.held, self.levels, tuple(self.steps)))
        return sha256(b"".join([words.encode(), *(np.ascontiguousarray(p).tobytes() for p in parts)])).digest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PassedNoise) and self._said == other._said

    def __hash__(self) -> int:
        return hash(self._said)

    def answers(self, output: str, at: Array) -> Array:
        """Return (m, k) the deviations of an output at instants (m,), each an independent cause of standard deviation 1, in its unit."""
        behind = at[:, None] - self.time
        deviations = []
        inputs = zip(self.noise, self.held, self.between, self.steps[output], self.rest[output], strict=True)
        for noise, held, between, step, rest in inputs:
            played = (
                _held(behind, step, self.spacing) if held else _joined(behind, np.diff(self.time), step, self.spacing)
            )
            played[:, 0] = 0.0  # the first row is the level
            before = self.level > 0.0
            size = np.where(before, noise.before, noise.std)
            deviations.append(played * size + np.outer(rest - played.sum(axis=1), self.level * size))
            unknown = between > 0.0
            deviations.append(_held(behind, step, self.spacing)[:, :-1][:, unknown] * between[unknown])
            deviations.append(noise.common * (rest - played[:, ~before].sum(axis=1, keepdims=True)))
        return np.hstack(deviations)


def _joined(behind: Array, width: Array, step: Array, spacing: float) -> Array:
    """Return (m, n) the answers to 1 at each row, joined by lines to 0 at its neighbours.

    behind: (m, n) s since each row; width: (n - 1,) s from row to row.
    """
    since = np.arange(step.size) * spacing
    ramp = np.concatenate([[0.0], np.cumsum(0.5 * (step[1:] + step[:-1]))]) * spacing
    begun = np.interp(behind, since, ramp, left=0.0)
    risen = np.column_stack([(begun[:, :-1] - begun[:, 1:]) / width, np.zeros(behind.shape[0])])
    return np.asarray(np.diff(-risen, axis=1, prepend=0.0))


def _held(behind: Array, step: Array, spacing: float) -> Array:
    """Return (m, n) the answers to 1 from each row to the next."""
    begun = np.interp(behind, np.arange(step.size) * spacing, step, left=0.0)
    return np.asarray(np.diff(-begun, axis=1, append=0.0))


def off_the_line(time: Array, values: Array, noise: float) -> Array:
    """Return (n - 1,) the standard deviation of what the mean of a signal from each row to the next may be off the line between them.

    time: (n,) s; values: (n,) of the signal at the rows, noise: standard deviation of each, in its unit.
    The bends at both rows tell it, a bend being how far the line through a row and its other neighbour misses the next row. A jump by J
    at any instant of an interval h puts the mean off by J(1/2 - p), 0 <= p <= 1, of standard deviation J/sqrt(12), and bends the record
    by J at both rows. A corner in the middle is off by 1/4 of the bend, an even curve by 1/12 of it: the rule of the jump is near for the
    first and wide for the second. It holds at the rows too, whose values may be means about them. Bends that noise alone makes are none.
    """
    width = np.diff(time)
    inverse = 1.0 / width
    turn = np.zeros(time.size)  # of the slope, in units per s
    turn[1:-1] = np.diff(np.diff(values) * inverse)
    chance = np.zeros(time.size)
    chance[1:-1] = noise**2 * (inverse[:-1] ** 2 + (inverse[:-1] + inverse[1:]) ** 2 + inverse[1:] ** 2)
    limit = float(ndtri(1.0 - 0.5 * BEYOND / max(time.size, 1)))
    bent = np.where(np.abs(turn) > limit * np.sqrt(chance), np.maximum(turn**2 - chance, 0.0), 0.0)
    return np.asarray(width * np.sqrt((bent[:-1] + bent[1:]) / 24.0))


def passed_noise(
    simulator: Simulator, experiment: Experiment, values: Mapping[str, float], sensitivities: Sequence[str] = ()
) -> PassedNoise:
    """Return what the noise of an experiment's inputs makes of its outputs, by steps from its start.

    values: of parameters. sensitivities: of which the runs have derivatives, which nobody asks for: with those of a fit their machine
    code is the fit's. Raises SimulationError where a run fails.
    """
    e, names = experiment, tuple(experiment.input_noise)
    time = np.unique(e.time)
    rows = before_event(time, np.zeros(time.size), e.event)
    level = rows / rows.sum() if rows.any() else np.eye(1, time.size)[0]
    width = float(np.median(np.diff(time)))
    spacing = width / FINER
    after = width + spacing * np.arange(int(np.ceil((time[-1] - time[0]) / spacing)) + FINER)
    grid = np.concatenate([[0.0, width], after])
    still = {n: InputSignal.constant(float(s.values[0])) for n, s in e.inputs.items()}
    blank = Trajectory(grid, np.zeros((grid.size, len(e.outputs))), e.outputs)
    rest = e.with_(time=grid, measured=blank, window=None, event=None, nuisance=(), inputs=FrozenMap(still))
    steps = {o: np.empty((len(names), after.size)) for o in e.outputs}
    rests = {o: np.empty(len(names)) for o in e.outputs}
    for k, n in enumerate(names):
        low, high = (float(still[n].values[0]) + h * e.input_noise[n].std for h in (-SIZE, SIZE))
        up, down = (
            observe(
                simulator, rest.with_(inputs=rest.inputs | {n: InputSignal.step(width, *ends)}), values, sensitivities
            ).values
            for ends in ((low, high), (high, low))
        )
        for o in e.outputs:
            rests[o][k] = (down[o][0] - up[o][0]) / (high - low)
            steps[o][k] = 0.5 * ((up[o] - up[o][0]) - (down[o] - down[o][0]))[2:] / (high - low)
    held = tuple(_holds(e.inputs[n]) for n in names)
    between = np.zeros((len(names), time.size - 1))
    for k, n in enumerate(names):
        if not held[k]:
            between[k] = off_the_line(time, e.inputs[n](time), e.input_noise[n].std)
    return PassedNoise(
        time, level, tuple(e.input_noise.values()), held, between, spacing,
        FrozenMap(steps), FrozenMap(rests), e.levels,
    )  # fmt: skip


def _holds(signal: InputSignal) -> bool:
    """Return whether a recorded signal holds its values between rows: nearly every change of it is a jump."""
    return bool(2 * signal.jumps.size > np.count_nonzero(np.diff(signal.values)))
