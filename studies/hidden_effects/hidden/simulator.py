"""The study's own simulator: the classical Runge-Kutta method at a fixed step, on a batch of runs at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from hidden.operators import CATALOGUE, OUTSIDE, Operator
from hidden.plants import Plant

Array = NDArray[np.floating]
STEP = 2e-4
LEAD = 1.0
"""s: how long a run that has no steady start waits for rest before its first row."""
STAGES = (0.0, 0.5, 0.5, 1.0)
WEIGHTS = (1 / 6, 1 / 3, 1 / 3, 1 / 6)


@dataclass(frozen=True)
class Signal:
    """An input: straight lines through points (time, value); a repeated time is a jump; constant outside."""

    points: tuple[tuple[float, float], ...]

    def at(self, t: Array, before: bool = False) -> Array:
        """Return the values at times; at a jump the one after it, or before it."""
        times, values = np.array(self.points).T
        right = np.searchsorted(times, t, side="left" if before else "right")
        low, high = np.clip(right - 1, 0, None), np.clip(right, None, times.size - 1)
        span = times[high] - times[low]
        share = np.where(span > 0, (t - times[low]) / np.where(span > 0, span, 1.0), 0.0)
        return np.where(right == 0, values[0], values[low] + np.clip(share, 0, 1) * (values[high] - values[low]))

    @property
    def jumps(self) -> tuple[float, ...]:
        """Return the times of jumps."""
        times = [t for t, _ in self.points]
        return tuple(a for a, b in pairwise(times) if a == b)


@dataclass(frozen=True)
class Hidden:
    """An effect at an insertion point. parameters: numbers, or one for each run. source: the other signal that it reads."""

    effect: str
    at: str
    parameters: Mapping[str, float | Array]
    source: str = ""


@dataclass(frozen=True)
class Run:
    """One run of a batch: the varying inputs and the parameters that differ from the plant's."""

    inputs: Mapping[str, Signal] = field(default_factory=dict)
    values: Mapping[str, float] = field(default_factory=dict)


def simulate(
    plant: Plant,
    runs: Sequence[Run],
    hidden: Sequence[Hidden] = (),
    *,
    rows: int = 300,
    interval: float = 4e-3,
    watch: Sequence[str] = (),
    step: float = STEP,
    lead: float = LEAD,
) -> Array:
    """Return (rows, runs, outputs) at k * interval s, or the signals in `watch` as their readers see them.

    lead: time in s before the first row, for a run without a steady start to settle or to become periodic.
    """
    return _Batch(plant, runs, hidden, rows, interval, watch, step, lead).result()


class _Batch:
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
    ) -> None:
        self.plant, self.n, self.h = plant, len(runs), step
        self.rows, self.every = rows, round(interval / step)
        assert abs(self.every * step - interval) < 1e-12, "the rows fall on whole steps"
        self.watch = tuple(watch) or tuple(f"outputs.{o}" for o in plant.outputs)
        kinds = CATALOGUE | OUTSIDE
        waits = any(kinds[h.effect].waits_for_rest for h in hidden)
        self.lead = round(lead / step) if waits else 0
        self.ticks = any(kinds[h.effect].ticks for h in hidden)
        self.steps = self.lead + (rows - 1) * self.every + 1
        self.p = {n: np.array([float(r.values.get(n, v)) for r in runs]) for n, v in plant.parameters.items()}
        self.chains: dict[str, list[tuple[Operator, int, str]]] = {}
        count = len(plant.states)
        for e in hidden:
            full = {n: np.broadcast_to(np.asarray(v, dtype=float), (self.n,)) for n, v in e.parameters.items()}
            operator = kinds[e.effect](full, step, self.steps)
            self.chains.setdefault(e.at, []).append((operator, count, e.source))
            count += operator.states
        self.count = count
        self.inputs = self._inputs(runs)
        self.states = {name: k for k, name in enumerate(plant.states)}
        self.seen: dict[str, Array] = {}

    def _inputs(self, runs: Sequence[Run]) -> dict[str, Array]:
        """Return (steps, 3, runs): the inputs at the beginning, in the middle and just before the end of every step."""
        # To a picosecond: by rounding the end of a step may lie behind a jump that stands there, and see it one step early.
        t, middle, end = (
            np.round((np.arange(self.steps) - self.lead + share) * self.h, 12) for share in (0.0, 0.5, 1.0)
        )
        found = {}
        for name, value in self.plant.inputs.items():
            table = np.full((self.steps, 3, self.n), value)
            for k, run in enumerate(runs):
                if name in run.inputs:
                    signal = run.inputs[name]
                    table[:, 0, k] = signal.at(t)
                    table[:, 1, k] = signal.at(middle)
                    table[:, 2, k] = signal.at(end, before=True)
            found[name] = table
        return found

    # --- one evaluation ---

    def _flow(
        self, mode: str, x: list[Array], inputs: Mapping[str, Array], t: float, share: float
    ) -> list[Array | None]:
        """Return the derivatives of all states. mode: "rest" (operators in steady state), "begin" (they are initialised) or "run"."""
        own = len(self.plant.states)
        rates: list[Array | None] = [None] * (self.count - own)
        chains, seen = self.chains, self.seen

        def see(slot: str, u: Array) -> Array:
            chain = chains.get(slot)
            if chain is None:  # nearly all slots, and this is called a million times a case
                seen[slot] = u
                return u
            raw = u
            for operator, first, source in chain:
                other = raw if source == slot else self._brought_in(source, x, inputs)
                if mode != "run":
                    if mode == "begin":
                        x[first : first + operator.states] = operator.begin(u, other)
                    u = operator.rest(u, other)
                    continue
                z = x[first : first + operator.states]
                y = operator.value(u, z, t, share, other)
                if operator.states:
                    rates[first - own : first - own + operator.states] = operator.rates(u, z)
                u = y
            seen[slot] = u
            return u

        return [*self.plant.flow(x, inputs, self.p, see), *rates]

    def _brought_in(self, source: str, x: list[Array], inputs: Mapping[str, Array]) -> Array | None:
        """Return the value of the input or state, or a signal as its readers see it; None without a source."""
        if not source:
            return None
        if source in inputs:
            return inputs[source]
        return x[self.states[source]] if source in self.states else self.seen[source]

    def _rest(self) -> list[Array]:
        """Return the steady state by Newton's method with differences, and initialise the operators there."""
        inputs = {n: v[0, 0] for n, v in self.inputs.items()}
        m = len(self.plant.states)
        x = [np.full(self.n, g) for g in self.plant.states.values()]
        for _ in range(60):
            f = np.array(self._flow("rest", x, inputs, 0.0, 0.0)[:m])
            jac = np.empty((self.n, m, m))
            for j in range(m):
                d = 1e-6 * (1.0 + np.abs(x[j]))
                moved = [*x[:j], x[j] + d, *x[j + 1 :]]
                jac[:, :, j] = ((np.array(self._flow("rest", moved, inputs, 0.0, 0.0)[:m]) - f) / d).T
            bad = np.abs(np.linalg.det(jac)) < 1e-12
            jac[bad] += 1e-6 * np.eye(m)
            change = np.linalg.solve(jac, f.T[:, :, None])[:, :, 0].T
            x = [a - np.clip(c, -0.5, 0.5) for a, c in zip(x, change, strict=True)]
            if np.abs(change).max() < 1e-12:
                break
        x = x + [np.zeros(self.n) for _ in range(self.count - m)]
        self._flow("begin", x, inputs, 0.0, 0.0)
        return x

    # --- the run ---

    def result(self) -> Array:
        """Return (rows, runs, watched); a diverged run is NaN from there on."""
        with np.errstate(all="ignore"):
            return self._result()

    def _result(self) -> Array:
        x = np.array(self._rest())
        out = np.full((self.rows, self.n, len(self.watch)), np.nan)
        h, places = self.h, (0, 1, 1, 2)
        for step in range(self.steps):
            t = (step - self.lead) * h
            total, rate = np.zeros_like(x), x
            row = step >= self.lead and (step - self.lead) % self.every == 0
            inputs = [{n: v[step, place] for n, v in self.inputs.items()} for place in range(3)]
            if row and self.ticks and step:
                # The end of the last step: as things stand before what ticks now. A row on a tick is thus read before it.
                self._flow("run", list(x), inputs[0], t, 1.0)
                out[(step - self.lead) // self.every] = np.array([self.seen[n] for n in self.watch]).T
                row = False
            for stage in range(4):
                share = STAGES[stage]
                at = x + (share * h) * rate if stage else x
                rate = np.array(self._flow("run", list(at), inputs[places[stage]], t + share * h, share))
                if stage == 0 and row:
                    out[(step - self.lead) // self.every] = np.array([self.seen[n] for n in self.watch]).T
                total += WEIGHTS[stage] * rate
            x = x + h * total
        return out
