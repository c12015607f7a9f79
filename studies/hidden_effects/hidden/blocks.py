"""Hidden effects as blocks of the second simulator, on a batch of runs. It shares no code with the first one's operators.

A block is placed on a signal: u goes in, what its readers see comes out. Its memory advances at the beginning of a step only.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hidden.kinds import HELD_STATE, SLOW_STATE

Array = NDArray[np.floating]
Values = Mapping[str, Array]


class Moment(NamedTuple):
    """An instant of the run. t: s. step: its number, from the first row on. part: of the step. advances: memory moves on here."""

    t: float
    step: int
    part: float
    advances: bool


class Block:
    """What all blocks have. p: parameters (runs,). h: step, s. steps: of the run."""

    states = 0
    periodic = False  # whether it has no steady start, so that the run has to begin earlier
    sampled = False  # whether it changes at instants of its own
    jumps = False  # whether it jumps, or remembers from step to step

    def __init__(self, p: Values, h: float, steps: int) -> None:
        self.p, self.h, self.steps = p, h, steps

    def settled(self, u: Array, other: Any) -> Array:
        """Return what comes out at rest."""
        return u

    def start(self, u: Array, other: Any) -> Sequence[Array]:
        """Return the states at rest, and set the memory."""
        return ()

    def out(self, u: Array, z: Sequence[Array], now: Moment, other: Any) -> Array:
        """Return what comes out."""
        raise NotImplementedError

    def slopes(self, u: Array, z: Sequence[Array]) -> Sequence[Array]:
        """Return the derivatives of the states."""
        return ()


# --- without memory ---

Formula = Callable[[Array, Any, Values], Array]
FORMULAS: dict[str, Formula] = {
    "gain": lambda u, v, p: p["k"] * u,
    "offset": lambda u, v, p: p["c"] + u,
    "limit": lambda u, v, p: np.clip(u, -p["level"], p["level"]),
    "saturation": lambda u, v, p: p["level"] * np.tanh(u / p["level"]),
    "deadband": lambda u, v, p: u - np.clip(u, -p["width"], p["width"]),
    "loss": lambda u, v, p: u - p["a"] - p["b"] * np.abs(v) - p["c"] * v * v,
    "conductance": lambda u, v, p: u - v * p["g"],
    "cubic": lambda u, v, p: u * (1.0 + p["k"] * u * u),
    "relay": lambda u, v, p: u + p["k"] * np.tanh((p["centre"] - v) / p["width"]),
}
OF_CHANGES: dict[str, Formula] = {
    "coupling": lambda u, v, p: u + v * p["k"],
    "droop": lambda u, v, p: u - v * p["k"],
    "product": lambda u, v, p: u + u * v * p["k"],
}
"""v: change of the other signal since the start."""


class Static(Block):
    """A formula of u and of another signal."""

    def __init__(self, formula: Formula, p: Values, h: float, steps: int) -> None:
        super().__init__(p, h, steps)
        self.formula = formula

    def settled(self, u, other):  # type: ignore[no-untyped-def]
        return self.formula(u, other, self.p)

    def out(self, u, z, now, other):  # type: ignore[no-untyped-def]
        return self.formula(u, other, self.p)


class OfChange(Block):
    """A formula of u and of the change of another signal since the start."""

    def __init__(self, formula: Formula, p: Values, h: float, steps: int) -> None:
        super().__init__(p, h, steps)
        self.formula = formula

    def start(self, u, other):  # type: ignore[no-untyped-def]
        self.at_start = np.array(other)
        return ()

    def out(self, u, z, now, other):  # type: ignore[no-untyped-def]
        return self.formula(u, other - self.at_start, self.p)


class Rounding(Block):
    """The nearest whole multiple of a step."""

    periodic = jumps = True

    def out(self, u, z, now, other):  # type: ignore[no-untyped-def]
        return np.rint(u / self.p["step"]) * self.p["step"]


class Tone(Block):
    """An added sine."""

    periodic = True

    def out(self, u, z, now, other):  # type: ignore[no-untyped-def]
        turns = now.t * self.p["frequency"]
        return u + self.p["amplitude"] * np.sin(2.0 * np.pi * turns + self.p["phase"])


class Ageing(Block):
    """A gain that grows with the time from the first row on."""

    def out(self, u, z, now, other):  # type: ignore[no-untyped-def]
        return u + u * self.p["k"] * max(now.t, 0.0)


# --- linear filters ---


@dataclass(frozen=True)
class Filter:
    """A linear filter. rest(u, p): its states at rest. out(u, z, p). slopes(u, z, p)."""

    states: int
    rest: Callable[[Array, Values], Sequence[Array]]
    out: Callable[[Array, Sequence[Array], Values], Array]
    slopes: Callable[[Array, Sequence[Array], Values], Sequence[Array]]


def _oscillator(damping: Callable[[Values], Any]) -> Callable[[Array, Sequence[Array], Values], Sequence[Array]]:
    """Return the slopes of z0'' + damping wn z0' + wn^2 z0 = u."""
    return lambda u, z, p: (z[1], u - p["wn"] * (damping(p) * z[1] + p["wn"] * z[0]))


NOTCH_WIDTH = 0.5
"""Of the notch, in parts of its middle."""
FILTERS = {
    "lag": Filter(1, lambda u, p: (u,), lambda u, z, p: z[0], lambda u, z, p: ((u - z[0]) / p["T"],)),
    "lead-lag": Filter(
        1,
        lambda u, p: (u,),
        lambda u, z, p: z[0] + p["T1"] / p["T2"] * (u - z[0]),
        lambda u, z, p: ((u - z[0]) / p["T2"],),
    ),
    "second-order": Filter(
        2,
        lambda u, p: (u / p["wn"] ** 2, 0.0 * u),
        lambda u, z, p: p["wn"] ** 2 * z[0],
        _oscillator(lambda p: 2.0 * p["zeta"]),
    ),
    "inner-loop": Filter(
        2,
        lambda u, p: (u / p["wn"] ** 2, 0.0 * u),
        lambda u, z, p: p["wn"] * (p["wn"] * z[0] + 2.0 * p["zeta"] * z[1]),
        _oscillator(lambda p: 2.0 * p["zeta"]),
    ),
    "notch": Filter(
        2,
        lambda u, p: (u / p["wn"] ** 2, 0.0 * u),
        lambda u, z, p: u - p["k"] * NOTCH_WIDTH * p["wn"] * z[1],
        _oscillator(lambda p: NOTCH_WIDTH),
    ),
}


class Filtered(Block):
    """A linear filter of u."""

    def __init__(self, form: Filter, p: Values, h: float, steps: int) -> None:
        super().__init__(p, h, steps)
        self.form, self.states = form, form.states

    def start(self, u, other):  # type: ignore[no-untyped-def]
        return self.form.rest(u, self.p)

    def out(self, u, z, now, other):  # type: ignore[no-untyped-def]
        return self.form.out(u, z, self.p)

    def slopes(self, u, z):  # type: ignore[no-untyped-def]
        return self.form.slopes(u, z, self.p)


# --- with memory ---


class Transport(Block):
    """A delay: a straight line between the values at the beginning and at the end of each step, a jump between steps stays one."""

    jumps = True

    def start(self, u, other):  # type: ignore[no-untyped-def]
        self.left, self.right = (np.tile(u, (self.steps + 1, 1)) for _ in range(2))
        self.now, self.runs = -1, np.arange(u.size)
        self.back = self.p["T"] / self.h
        return ()

    def out(self, u, z, now, other):  # type: ignore[no-untyped-def]
        if now.advances:
            self.now += 1
            self.left[self.now] = u
        elif now.part == 1.0:
            self.right[self.now] = u
        # A row's own look: the step that begins here has not begun, its left end is u all the same.
        step = self.now + (not now.advances and now.part == 0.0)
        place = np.maximum(step + now.part - self.back, 0.0)
        whole = np.minimum(place.astype(int), step)
        share = place - whole
        begin = np.where((whole == step) & (now.part == 0.0), u, self.left[whole, self.runs])
        end = np.where(whole < step, self.right[whole, self.runs], begin + (u - begin) / max(now.part, 1e-12))
        return begin + share * (end - begin)


class Mean(Block):
    """The mean over a window up to now: the difference of u's integral over its length."""

    states = 1
    jumps = True

    def start(self, u, other):  # type: ignore[no-untyped-def]
        self.first, self.now, self.runs = np.array(u), -1, np.arange(u.size)
        self.integral = np.zeros((self.steps + 1, u.size))
        self.back = self.p["T"] / self.h
        return (np.zeros_like(u),)

    def out(self, u, z, now, other):  # type: ignore[no-untyped-def]
        if now.advances:
            self.now += 1
            self.integral[self.now] = z[0]
        step = self.now + (not now.advances and now.part == 0.0)
        place = step + now.part - self.back
        inside = np.clip(place, 0.0, step)
        low = np.minimum(inside.astype(int), max(self.now - 1, 0))
        high = np.minimum(low + 1, self.now)
        a, b = self.integral[low, self.runs], self.integral[high, self.runs]
        before = a + (inside - low) * (b - a) + np.minimum(place, 0.0) * self.h * self.first
        return (z[0] - before) / self.p["T"]

    def slopes(self, u, z):  # type: ignore[no-untyped-def]
        return (u,)


class Follower(Block):
    """What follows u within bounds that the last whole step and the time since then set."""

    jumps = True

    def start(self, u, other):  # type: ignore[no-untyped-def]
        self.last = np.array(u)
        return ()

    def bounds(self, u: Array, time: float) -> tuple[Array, Array]:
        """Return the lowest and the highest value that may come out `time` s after the last whole step."""
        raise NotImplementedError

    def out(self, u, z, now, other):  # type: ignore[no-untyped-def]
        low, high = self.bounds(u, (now.part or 1.0) * self.h)
        found = self.held(u, low, high)
        if now.advances:
            self.last = found
        return found

    def held(self, u: Array, low: Array, high: Array) -> Array:
        """Return u within the bounds."""
        return np.clip(u, low, high)


class Ramped(Follower):
    """The ideal rate limit."""

    def bounds(self, u, time):  # type: ignore[no-untyped-def]
        most = self.p["rate"] * time
        return self.last - most, self.last + most


class Play(Follower):
    """Backlash: what comes out moves only where u would leave the play around it."""

    def bounds(self, u, time):  # type: ignore[no-untyped-def]
        half = self.p["width"] / 2.0
        return u - half, u + half

    def held(self, u, low, high):  # type: ignore[no-untyped-def]
        return np.clip(self.last, low, high)


class Sampler(Block):
    """A sample and hold whose samples are taken at whole multiples of its period from the first row on."""

    sampled = jumps = True

    def start(self, u, other):  # type: ignore[no-untyped-def]
        self.period = np.maximum(np.rint(self.p["Ts"] / self.h), 1.0)
        self.later = np.rint(self.p["compute"] / self.h)
        self.sample, self.shown = np.array(u), np.array(u)
        return ()

    def out(self, u, z, now, other):  # type: ignore[no-untyped-def]
        if now.advances:
            since = np.mod(now.step, self.period)
            self.sample = np.where(since == 0.0, u, self.sample)
            self.shown = np.where(since == self.later, self.sample, self.shown)
        return self.shown


BLOCKS: dict[str, Callable[[Values, float, int], Block]] = {
    **{name: partial(Static, f) for name, f in FORMULAS.items()},
    **{name: partial(OfChange, f) for name, f in OF_CHANGES.items()},
    **{name: partial(Filtered, f) for name, f in FILTERS.items()},
    "quantisation": Rounding,
    "disturbance": Tone,
    "drift": Ageing,
    "delay": Transport,
    "window-mean": Mean,
    "rate-limit": Ramped,
    "backlash": Play,
    "sample-hold": Sampler,
}


# --- on how a state moves ---


class Motion:
    """An effect on a state: bounds of its values, and its derivative."""

    def __init__(self, p: Values, runs: int) -> None:
        self.p = p
        self.low = np.broadcast_to(p.get("low", np.array(-np.inf)), (runs,))
        self.high = np.broadcast_to(p.get("high", np.array(np.inf)), (runs,))

    def within(self, x: Array) -> Array:
        """Return the state within its bounds."""
        return x

    def rate(self, x: Array, rate: Array) -> Array:
        """Return the derivative, of a state within its bounds."""
        raise NotImplementedError

    def unrest(self, x: Array, rate: Array) -> Array:
        """Return what is 0 at rest, and changes like the derivative."""
        return rate


class SlowState(Motion):
    """A state that rises and falls no faster than a rate each."""

    def rate(self, x, rate):  # type: ignore[no-untyped-def]
        return np.clip(rate, -self.p["down"], self.p["up"])


class HeldState(Motion):
    """A state that stays at a limit for as long as it is pushed beyond it, and leaves it at once."""

    def within(self, x):  # type: ignore[no-untyped-def]
        return np.clip(x, self.low, self.high)

    def rate(self, x, rate):  # type: ignore[no-untyped-def]
        outward = ((x >= self.high) & (rate > 0.0)) | ((x <= self.low) & (rate < 0.0))
        return np.where(outward, 0.0, rate)

    def unrest(self, x, rate):  # type: ignore[no-untyped-def]
        return np.clip(x + rate, self.low, self.high) - x


MOTIONS: dict[str, type[Motion]] = {SLOW_STATE: SlowState, HELD_STATE: HeldState}
