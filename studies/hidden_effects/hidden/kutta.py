"""The second simulator, for plants with rate-limited servos and states with limits. It shares no code with the first one.

Kutta's method of third order at a fixed step, on a batch of runs; coarse: Heun's method. Steps begin and end at the inputs' jumps.
A state at a limit stays there while it is pushed beyond: its derivative is 0, and a step that leads beyond ends at the limit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hidden.blocks import BLOCKS, MOTIONS, Block, Moment, Motion

if TYPE_CHECKING:
    from hidden.plant import Plant
    from hidden.simulator import Hidden, Run

Array = NDArray[np.floating]
NUDGE = 1e-9
"""s: an input is read so much after the beginning of a step and before its end, that is on the step's side of a jump."""
STEPS_TO_REST, AT_REST = 50, 1e-12


class Integration:
    """A batch of runs under way. Arguments: as of `simulator.simulate`, none left out."""

    def __init__(
        self,
        plant: Plant,
        runs: Sequence[Run],
        hidden: Sequence[Hidden],
        rows: int,
        interval: float,
        watch: Sequence[str],
        step: float,
        lead: float,
        coarse: bool,
    ) -> None:
        self.plant, self.h, self.coarse, self.watch, self.rows = plant, step, coarse, watch, rows
        self.per_row = round(interval / step)
        if abs(self.per_row * step - interval) > 1e-9 * interval:
            raise ValueError(f"an interval of {interval} s between rows is no whole number of steps of {step} s")
        count = len(runs)
        self.p = {n: np.array([r.values.get(n, v) for r in runs], dtype=float) for n, v in plant.parameters.items()}
        kinds = [BLOCKS[e.effect] for e in hidden if e.effect in BLOCKS]
        periodic = any(getattr(k, "periodic", False) for k in kinds)
        self.ahead = round(lead / step) if periodic else 0
        self.steps = self.ahead + (rows - 1) * self.per_row + 1
        self.names = list(plant.states)
        self.blocks: dict[str, list[tuple[Block, slice, str]]] = {}
        self.motions: list[tuple[int, Motion]] = []
        self.size = len(self.names)
        for e in hidden:
            p = {n: np.broadcast_to(np.asarray(v, dtype=float), (count,)) for n, v in e.parameters.items()}
            if e.effect in MOTIONS:
                self.motions.append((self.names.index(e.at), MOTIONS[e.effect](p, count)))
                continue
            block = BLOCKS[e.effect](p, step, self.steps)
            own = slice(self.size, self.size + block.states)
            self.blocks.setdefault(e.at, []).append((block, own, e.source))
            self.size = own.stop
        self.played = self._played(runs)
        self.seen: dict[str, Array] = {}

    def _played(self, runs: Sequence[Run]) -> dict[str, Array]:
        """Return each input at the beginning, the middle and the end of every step: (steps, 3, runs)."""
        begins = (np.arange(self.steps) - self.ahead) * self.h
        times = begins[:, None] + np.array([NUDGE, 0.5 * self.h, self.h - NUDGE])
        found = {}
        for name, constant in self.plant.inputs.items():
            found[name] = np.full((self.steps, 3, len(runs)), constant, dtype=float)
            for k, run in enumerate(runs):
                if name in run.inputs:
                    at, values = np.transpose(run.inputs[name].points)
                    found[name][:, :, k] = np.interp(times, at, values)
        return found

    # --- the equations with what is hidden in them ---

    def _other(self, source: str, at: str, u: Array, x: Sequence[Array], inputs: Mapping[str, Array]) -> Array:
        """Return the signal that a block at a slot brings in: an input, a state, or one evaluated before; u where it reads none."""
        if source in inputs:
            return inputs[source]
        if source in self.names:
            return x[self.names.index(source)]
        return u if source == at or not source else self.seen[source]

    def _resting(self, x: Sequence[Array], inputs: Mapping[str, Array]) -> Array:
        """Return what is 0 at rest, for the plant's states (states, ...); everything hidden is at rest with them."""
        self.seen = {}

        def tap(name: str, u: Array) -> Array:
            first = u
            for block, _, source in self.blocks.get(name, ()):
                u = block.settled(u, self._other(source, name, first, x, inputs))
            self.seen[name] = u
            return u

        rates = list(self.plant.flow(list(x), inputs, self.p, tap))
        for k, motion in self.motions:
            rates[k] = motion.unrest(x[k], rates[k])
        return np.stack(np.broadcast_arrays(*rates))

    def at_rest(self) -> Array:
        """Return all states at rest, (states, runs), and begin what is hidden there.

        Newton's method, with the plant beside its state moved by a little in each of its states at once.
        """
        m, runs = len(self.names), len(next(iter(self.p.values())))
        inputs = {n: v[0, 0] for n, v in self.played.items()}
        x = np.tile(np.array(list(self.plant.states.values()), dtype=float)[:, None], (1, runs))
        for _ in range(STEPS_TO_REST):
            little = 1e-7 * (1.0 + np.abs(x))
            around = np.repeat(x[:, None], m + 1, axis=1)  # (state, which is moved, run)
            for k in range(m):
                around[k, k + 1] += little[k]
            found = self._resting(around, inputs)
            slopes = (found[:, 1:] - found[:, :1]) / little
            inverse = np.linalg.pinv(np.nan_to_num(slopes.transpose(2, 0, 1)), rcond=1e-11)
            change = np.einsum("rij,jr->ir", inverse, found[:, 0])
            x -= np.clip(change, -0.5, 0.5)
            if np.abs(change).max() < AT_REST:
                break
        full = np.concatenate([x, np.zeros((self.size - m, runs))])
        self.seen = {}

        def tap(name: str, u: Array) -> Array:
            first = u
            for block, own, source in self.blocks.get(name, ()):
                other = self._other(source, name, first, x, inputs)
                for k, value in zip(range(own.start, own.stop), block.start(u, other), strict=True):
                    full[k] = value
                u = block.settled(u, other)
            self.seen[name] = u
            return u

        self.plant.flow(list(x), inputs, self.p, tap)
        return full

    def _slopes(self, x: Array, step: int, part: float, advances: bool = False) -> Array:
        """Return the derivatives of all states a part of a step after its beginning."""
        column = 0 if part == 0.0 else 1 if part == 0.5 else 2
        inputs = {n: v[step, column] for n, v in self.played.items()}
        now = Moment((step - self.ahead + part) * self.h, step - self.ahead, part, advances)
        slopes = np.empty_like(x)
        for k, motion in self.motions:
            x = x.copy()
            x[k] = motion.within(x[k])
        blocks, seen = self.blocks, {}
        self.seen = seen

        def tap(name: str, u: Array) -> Array:
            if name in blocks:
                first = u
                for block, own, source in blocks[name]:
                    z = x[own]
                    out = block.out(u, z, now, self._other(source, name, first, x, inputs))
                    for k, slope in zip(range(own.start, own.stop), block.slopes(u, z), strict=True):
                        slopes[k] = slope
                    u = out
            seen[name] = u
            return u

        for k, slope in enumerate(self.plant.flow(list(x), inputs, self.p, tap)):
            slopes[k] = slope
        for k, motion in self.motions:
            slopes[k] = motion.rate(x[k], slopes[k])
        return slopes

    # --- the run ---

    def result(self) -> Array:
        """Return (rows, runs, watched), NaN or infinite where a run diverges."""
        with np.errstate(all="ignore"):
            return self._rows()

    def _rows(self) -> Array:
        x = self.at_rest()
        found = np.full((self.rows, x.shape[1], len(self.watch)), np.nan)
        for step in range(self.steps):
            row, rest = divmod(step - self.ahead, self.per_row)
            if rest == 0 and row >= 0:
                self._slopes(x, step, 0.0)  # a look: whatever samples at this instant comes after the row
                for k, name in enumerate(self.watch):
                    found[row, :, k] = self.seen[name]
            x = self._stepped(x, step)
        return found

    def _stepped(self, x: Array, step: int) -> Array:
        """Return the states a step later."""
        h = self.h
        a = self._slopes(x, step, 0.0, advances=True)
        if self.coarse:
            x = x + 0.5 * h * (a + self._slopes(x + h * a, step, 1.0))
        else:
            b = self._slopes(x + 0.5 * h * a, step, 0.5)
            c = self._slopes(x + h * (2.0 * b - a), step, 1.0)
            x = x + h / 6.0 * (a + 4.0 * b + c)
        for k, motion in self.motions:
            x[k] = motion.within(x[k])
        return x
