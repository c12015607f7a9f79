"""The study's own simulators, each at a fixed step, on a batch of runs at once.

Plants 1 and 2 are integrated by the classical Runge-Kutta method, plants 3 and 4 by the trapezoidal rule, as in programs for power
systems. Both have a coarse variant, Heun's method. The others have a program of their own, `kutta`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from hidden.kutta import Integration
from hidden.operators import CATALOGUE, OUTSIDE, Operator
from hidden.plant import INTERVAL, STEP, Plant

Array = NDArray[np.floating]
CORRECTIONS = 2
"""Of the trapezoidal rule in a step: with the fastest root times half a step at 0.03 the last one changes 1e-5 of the step."""
AT_REST = 1e-9
"""Change of a state from row to row, of 1 and its size, below which it rests: over a record no noise of the study hides more."""
SETTLING, LONGER = 1e7, 1.2
"""Steps of the integration that the longest step has by which a plant is followed to its rest, and times the one before that each has."""
__all__ = ["INTERVAL", "STEP", "Hidden", "Run", "Signal", "at_rest", "simulate"]


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
    interval: float | None = None,
    watch: Sequence[str] = (),
    step: float | None = None,
    lead: float | None = None,
    coarse: bool = False,
) -> Array:
    """Return (rows, runs, outputs) at k * interval s, or the signals in `watch` as their readers see them.

    interval, step, lead: the plant's own where none is given. lead: time in s before the first row, for a run without a steady
    start to settle or to become periodic. coarse: integrate by Heun's method.
    """
    interval = plant.interval if interval is None else interval
    step = plant.step if step is None else step
    lead = plant.lead if lead is None else lead
    watch = tuple(watch) or tuple(f"outputs.{o}" for o in plant.outputs)
    return _kind(plant)(plant, runs, hidden, rows, interval, watch, step, lead, coarse).result()


def at_rest(plant: Plant, runs: Sequence[Run]) -> Array:
    """Return (states, runs): where the runs begin. NaN of one that has no steady state, or anything in a plant of `kutta`."""
    watch = tuple(f"outputs.{o}" for o in plant.outputs)
    batch = _kind(plant)(plant, runs, (), 1, plant.interval, watch, plant.step, plant.lead, False)
    with np.errstate(all="ignore"):
        return np.array(batch.at_rest())[: len(plant.states)]


def _kind(plant: Plant) -> type[_Batch | Integration]:
    """Return the integrator of a plant."""
    return {"runge-kutta": _RungeKutta, "trapezoidal": _Trapezoidal, "kutta": Integration}[plant.scheme]


class _Batch:
    """A batch of runs: what every integrator needs of inputs, effects, steady state and rows."""

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
        self.plant, self.n, self.h, self.coarse = plant, len(runs), step, coarse
        self.rows, self.every = rows, round(interval / step)
        assert abs(self.every * step - interval) < 1e-12, "the rows fall on whole steps"
        self.watch = watch
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
        if self.plant.timed:
            times = np.stack([t, middle, end], axis=1)[:, :, None]
            found["time"] = np.broadcast_to(times, (self.steps, 3, self.n))
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

    def at_rest(self) -> list[Array]:
        """Return the steady state, and initialise the operators there; NaN of a run that has none and does not wait for it.

        By Newton's method; where a limit of the plant lets that go in circles, the plant is followed in time until it rests.
        """
        inputs = {n: v[0, 0] for n, v in self.inputs.items()}
        m = len(self.plant.states)
        guess = [np.full(self.n, g) for g in self.plant.states.values()]
        x, lost = self._newton(guess, inputs)
        if lost.any():
            settled, lost_still = self._newton(self._settled(guess, inputs), inputs)
            x = [np.where(lost & ~lost_still, b, a) for a, b in zip(x, settled, strict=True)]
            if not self.lead:
                x = [np.where(lost & lost_still, np.nan, a) for a in x]
        x = x + [np.zeros(self.n) for _ in range(self.count - m)]
        self._flow("begin", x, inputs, 0.0, 0.0)
        return x

    def _newton(self, x: list[Array], inputs: Mapping[str, Array]) -> tuple[list[Array], Array]:
        """Return where Newton's method ends, and (runs,) whether that is no steady state."""
        for _ in range(60):
            f, jac = self._slopes(x, inputs)
            bad = np.abs(np.linalg.det(jac)) < 1e-12
            jac[bad] += 1e-6 * np.eye(len(x))
            change = np.linalg.solve(jac, f.T[:, :, None])[:, :, 0].T
            x = [a - np.clip(c, -0.5, 0.5) for a, c in zip(x, change, strict=True)]
            if np.abs(change).max() < 1e-12:
                break
        drift = np.abs(self._unrest(x, inputs)) * self.plant.interval / (1.0 + np.abs(np.array(x)))
        return x, ~(drift.max(axis=0) < AT_REST)

    def _settled(self, x: list[Array], inputs: Mapping[str, Array]) -> list[Array]:
        """Return where the plant comes to by implicit Euler steps, each longer than the one before: it ends at rest, if it does."""
        h = self.h
        while h < SETTLING * self.h:
            f, jac = self._slopes(x, inputs)
            change = np.linalg.solve(np.eye(len(x)) / h - jac, f.T[:, :, None])[:, :, 0].T
            x = [a + c for a, c in zip(x, change, strict=True)]
            h *= LONGER
        return x

    def _slopes(self, x: list[Array], inputs: Mapping[str, Array]) -> tuple[Array, Array]:
        """Return the derivatives, (states, runs), and by differences their own by the states, (runs, states, states)."""
        f = self._unrest(x, inputs)
        jac = np.empty((self.n, len(x), len(x)))
        for j in range(len(x)):
            d = 1e-6 * (1.0 + np.abs(x[j]))
            moved = [*x[:j], x[j] + d, *x[j + 1 :]]
            jac[:, :, j] = ((self._unrest(moved, inputs) - f) / d).T
        return f, jac

    def _unrest(self, x: list[Array], inputs: Mapping[str, Array]) -> Array:
        """Return (states, runs), by which the derivatives of the plant's states are not those of a steady state."""
        f = np.array(self._flow("rest", x, inputs, 0.0, 0.0)[: len(self.plant.states)])
        return f if self.plant.turning is None else f - np.array(self.plant.turning(x))

    # --- the run ---

    def result(self) -> Array:
        """Return (rows, runs, watched); a diverged run is NaN from there on."""
        with np.errstate(all="ignore"):
            return self._result()

    def _result(self) -> Array:
        x = np.array(self.at_rest())
        out = np.full((self.rows, self.n, len(self.watch)), np.nan)
        for step in range(self.steps):
            row = step >= self.lead and (step - self.lead) % self.every == 0
            place = (step - self.lead) // self.every
            inputs = [{n: v[step, k] for n, v in self.inputs.items()} for k in range(3)]
            if row and self.ticks and step:
                # The end of the last step: as things stand before what ticks now. A row on a tick is thus read before it.
                self._flow("run", list(x), inputs[0], (step - self.lead) * self.h, 1.0)
                out[place] = self._row()
                row = False
            x = self._stepped(x, step, inputs, out[place] if row else None)
        return out

    def _row(self) -> Array:
        """Return (runs, watched) of the last evaluation."""
        return np.array([self.seen[n] for n in self.watch]).T

    def _rate(self, x: Array, step: int, inputs: Mapping[str, Array], share: float) -> Array:
        """Return the derivatives, (states, runs), a share of a step after the step's beginning."""
        return np.array(self._flow("run", list(x), inputs, (step - self.lead) * self.h + share * self.h, share))

    def _stepped(self, x: Array, step: int, inputs: Sequence[Mapping[str, Array]], out: Array | None) -> Array:
        """Return the states after a step, and write the row at its beginning to `out`."""
        raise NotImplementedError


class _RungeKutta(_Batch):
    """The classical method of fourth order; coarse: Heun's method, of second order."""

    STAGES = ((0.0, 1 / 6, 0), (0.5, 1 / 3, 1), (0.5, 1 / 3, 1), (1.0, 1 / 6, 2))
    HEUN = ((0.0, 0.5, 0), (1.0, 0.5, 2))
    """Share of the step, weight of the rate, and which of the step's three inputs."""

    def _stepped(self, x: Array, step: int, inputs: Sequence[Mapping[str, Array]], out: Array | None) -> Array:
        total, rate = np.zeros_like(x), x
        for share, weight, place in self.HEUN if self.coarse else self.STAGES:
            at = x + (share * self.h) * rate if share else x
            rate = self._rate(at, step, inputs[place], share)
            if share == 0.0 and out is not None:
                out[:] = self._row()
            total += weight * rate
        return np.asarray(x + self.h * total)


class _Trapezoidal(_Batch):
    """The implicit trapezoidal rule by repeated correction; coarse: one correction, which is Heun's method."""

    def _stepped(self, x: Array, step: int, inputs: Sequence[Mapping[str, Array]], out: Array | None) -> Array:
        first = self._rate(x, step, inputs[0], 0.0)
        if out is not None:
            out[:] = self._row()
        after = x + self.h * first
        for _ in range(1 if self.coarse else CORRECTIONS):
            after = x + 0.5 * self.h * (first + self._rate(after, step, inputs[2], 1.0))
        return np.asarray(after)
