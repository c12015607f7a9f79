"""Hidden effects as operators of a time-stepping program, in numpy on a batch of runs.

An operator sees the slot's signal at four instants of each step (the stages of the classical Runge-Kutta method). Those
with dynamics of their own have states that are stepped along; those with memory keep it from step to step.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
Values = Mapping[str, Array]


class Operator:
    """y = u; subclasses override what they need. p: (batch,) arrays by name. h: step, s; steps: their number."""

    states = 0
    waits_for_rest = False  # whether a steady start cannot be computed: it has to be waited for
    ticks = False  # whether it jumps at instants of its own: a row at such an instant is read before the jump
    stepped = False  # whether it jumps, or remembers from step to step: its answer may hang on where the steps fall

    def __init__(self, p: Values, h: float, steps: int) -> None:
        self.p, self.h, self.steps = p, h, steps

    def begin(self, u: Array, other: Array | None) -> list[Array]:
        """Set the memory and return the operator's states in steady state."""
        return []

    def rest(self, u: Array, other: Array | None) -> Array:
        """Return y in steady state."""
        return u

    def value(self, u: Array, z: list[Array], t: float, share: float, other: Array | None) -> Array:
        """Return y at time t, `share` of a step after the last whole one (0: a step begins and the memory advances)."""
        return u

    def rates(self, u: Array, z: list[Array]) -> list[Array]:
        """Return the derivatives of the operator's states."""
        return []


class Static(Operator):
    """A static effect: y depends on u (and the other signal) only."""

    def rest(self, u: Array, other: Array | None) -> Array:
        return self.value(u, [], 0.0, 0.0, other)


class Gain(Static):
    def value(self, u, z, t, share, other):  # type: ignore[no-untyped-def]
        return u * self.p["k"]


class Offset(Static):
    def value(self, u, z, t, share, other):  # type: ignore[no-untyped-def]
        return u + self.p["c"]


class Limit(Static):
    def value(self, u, z, t, share, other):  # type: ignore[no-untyped-def]
        level = self.p["level"]
        return np.where(np.abs(u) > level, np.copysign(level, u), u)


class Saturation(Static):
    def value(self, u, z, t, share, other):  # type: ignore[no-untyped-def]
        level = self.p["level"]
        return level * (1.0 - 2.0 / (np.exp(2.0 * u / level) + 1.0))


class Deadband(Static):
    def value(self, u, z, t, share, other):  # type: ignore[no-untyped-def]
        return np.sign(u) * np.maximum(np.abs(u) - self.p["width"], 0.0)


class Loss(Static):
    def value(self, u, z, t, share, other):  # type: ignore[no-untyped-def]
        p = self.p
        return u - (p["a"] + np.abs(other) * (p["b"] + p["c"] * np.abs(other)))


class Conductance(Static):
    def value(self, u, z, t, share, other):  # type: ignore[no-untyped-def]
        return u - self.p["g"] * other


class Change(Operator):
    """A function of the change of another signal from its start."""

    def begin(self, u, other):  # type: ignore[no-untyped-def]
        self.first = other.copy()
        return []


class Coupling(Change):
    def value(self, u, z, t, share, other):  # type: ignore[no-untyped-def]
        return u + self.p["k"] * (other - self.first)


class Droop(Change):
    def value(self, u, z, t, share, other):  # type: ignore[no-untyped-def]
        return u - self.p["k"] * (other - self.first)


class Quantisation(Operator):
    waits_for_rest = True
    stepped = True

    def value(self, u, z, t, share, other):  # type: ignore[no-untyped-def]
        return np.round(u / self.p["step"]) * self.p["step"]


class Disturbance(Operator):
    waits_for_rest = True

    def value(self, u, z, t, share, other):  # type: ignore[no-untyped-def]
        p = self.p
        return u + p["amplitude"] * np.sin(2.0 * np.pi * p["frequency"] * t + p["phase"])


class Follower(Operator):
    """y is the first state, which rests at u; the others rest at 0."""

    states = 1

    def begin(self, u, other):  # type: ignore[no-untyped-def]
        return [u.copy(), *(np.zeros_like(u) for _ in range(self.states - 1))]

    def value(self, u, z, t, share, other):  # type: ignore[no-untyped-def]
        return z[0]


class Lag(Follower):
    def rates(self, u, z):  # type: ignore[no-untyped-def]
        return [(u - z[0]) / self.p["T"]]


class Inductance(Follower):
    def rates(self, u, z):  # type: ignore[no-untyped-def]
        return [self.p["R"] * (u - z[0]) / self.p["L"]]


class SecondOrder(Follower):
    states = 2

    def rates(self, u, z):  # type: ignore[no-untyped-def]
        wn = self.p["wn"]
        return [z[1], wn * wn * (u - z[0]) - 2.0 * self.p["zeta"] * wn * z[1]]


class InnerLoop(Follower):
    """A feedback of proportional and integral action around an integrator, in the form of an observer."""

    states = 2

    def rates(self, u, z):  # type: ignore[no-untyped-def]
        wn, off = self.p["wn"], u - z[0]
        return [z[1] + 2.0 * self.p["zeta"] * wn * off, wn * wn * off]


class LeadLag(Operator):
    states = 1

    def begin(self, u, other):  # type: ignore[no-untyped-def]
        return [u * (1.0 - self.p["T1"] / self.p["T2"])]

    def value(self, u, z, t, share, other):  # type: ignore[no-untyped-def]
        return z[0] + u * self.p["T1"] / self.p["T2"]

    def rates(self, u, z):  # type: ignore[no-untyped-def]
        return [(u * (1.0 - self.p["T1"] / self.p["T2"]) - z[0]) / self.p["T2"]]


class History:
    """The values at whole steps, interpolated linearly between them."""

    def __init__(self, first: Array, h: float, steps: int) -> None:
        self.values = np.empty((steps + 2, first.size))
        self.values[0] = first
        self.count, self.h, self.columns = 0, h, np.arange(first.size)

    def add(self, value: Array) -> None:
        """Add one step."""
        self.values[self.count] = value
        self.count += 1

    def at(self, back: Array) -> tuple[Array, Array]:
        """Return the values `back` steps before the last one, and the time before the first one."""
        place = np.minimum(self.count - 1 - back, self.count - 1.0)
        low = np.clip(np.floor(place).astype(int), 0, max(self.count - 2, 0))
        share = np.clip(place - low, 0.0, 1.0)
        above = np.minimum(low + 1, self.count - 1)
        left, right = self.values[low, self.columns], self.values[above, self.columns]
        return left + share * (right - left), np.minimum(place, 0.0) * self.h


class Delay(Operator):
    """A delay of the values at both ends of every step: a jump between two steps is preserved."""

    stepped = True

    def begin(self, u, other):  # type: ignore[no-untyped-def]
        self.begins, self.ends = np.empty((2, self.steps + 2, u.size))
        self.begins[0] = self.ends[0] = u
        self.count, self.ended, self.columns = 0, 0, np.arange(u.size)
        return []

    def value(self, u, z, t, share, other):  # type: ignore[no-untyped-def]
        if share == 0.0:
            self.begins[self.count] = u
            self.count += 1
        elif share == 1.0 and self.ended < self.count:
            self.ended = self.count
            self.ends[self.count] = u
        place = np.clip(self.count - 1 + share - self.p["T"] / self.h, 0.0, self.count - 1.0)
        low = np.minimum(place.astype(int), max(self.count - 2, 0))
        left, right = self.begins[low, self.columns], self.ends[low + 1, self.columns]
        at_end = place >= self.count - 1.0
        last = self.begins[self.count - 1]
        return np.where(at_end, last, left + (place - low) * (right - left))


class WindowMean(Operator):
    """The increment of the integral of u over the window."""

    states = 1
    stepped = True

    def begin(self, u, other):  # type: ignore[no-untyped-def]
        self.first = u.copy()
        self.past = History(np.zeros_like(u), self.h, self.steps)
        return [np.zeros_like(u)]

    def value(self, u, z, t, share, other):  # type: ignore[no-untyped-def]
        if share == 0.0:
            self.past.add(z[0])
        before, early = self.past.at(self.p["T"] / self.h - share)
        return (z[0] - before - early * self.first) / self.p["T"]

    def rates(self, u, z):  # type: ignore[no-untyped-def]
        return [u]


class RateLimit(Operator):
    """The ideal rate limit: towards u by at most rate times the time since the last whole step."""

    stepped = True

    def begin(self, u, other):  # type: ignore[no-untyped-def]
        self.y = u.copy()
        return []

    def value(self, u, z, t, share, other):  # type: ignore[no-untyped-def]
        most = self.p["rate"] * self.h * (share or 1.0)
        y = self.y + np.minimum(np.maximum(u - self.y, -most), most)
        if share == 0.0:
            self.y = y
        return y


class Backlash(Operator):
    """The play operator of Krasnosel'skii: the smallest movement that keeps u within the play."""

    stepped = True

    def begin(self, u, other):  # type: ignore[no-untyped-def]
        self.y = u.copy()
        return []

    def value(self, u, z, t, share, other):  # type: ignore[no-untyped-def]
        half = 0.5 * self.p["width"]
        y = np.minimum(np.maximum(self.y, u - half), u + half)
        if share == 0.0:
            self.y = y
        return y


class SampleHold(Operator):
    """Samples at whole multiples of the period, counted in steps from the start."""

    ticks = True
    stepped = True

    def begin(self, u, other):  # type: ignore[no-untyped-def]
        self.every = np.maximum(np.round(self.p["Ts"] / self.h), 1.0)
        self.late = np.round(self.p["compute"] / self.h)
        self.step, self.y, self.taken = 0, u.copy(), u.copy()
        return []

    def value(self, u, z, t, share, other):  # type: ignore[no-untyped-def]
        if share == 0.0:
            phase = self.step % self.every
            self.taken = np.where(phase == 0, u, self.taken)
            self.y = np.where(phase == self.late, self.taken, self.y)
            self.step += 1
        return self.y


class Cubic(Static):
    """Outside the catalogue: a term of third order."""

    def value(self, u, z, t, share, other):  # type: ignore[no-untyped-def]
        return u + self.p["k"] * u**3


class Relay(Static):
    """Outside the catalogue: dry friction, a step of either sign around 0 of another signal, rounded over a tenth."""

    stepped = True

    def value(self, u, z, t, share, other):  # type: ignore[no-untyped-def]
        return u - self.p["k"] * np.tanh((other - self.p["centre"]) / self.p["width"])


class Notch(Operator):
    """Outside the catalogue: a notch filter."""

    states = 2
    width = 0.5  # of the band, in parts of its middle

    def begin(self, u, other):  # type: ignore[no-untyped-def]
        return [np.zeros_like(u), self.width * u]

    def value(self, u, z, t, share, other):  # type: ignore[no-untyped-def]
        return u - self.p["k"] * z[0]

    def rates(self, u, z):  # type: ignore[no-untyped-def]
        # z0 is u through a band pass around wn with gain 1 there.
        wn = self.p["wn"]
        return [wn * (self.width * (u - z[0]) - z[1]), wn * z[0]]


class Drift(Operator):
    """Outside the catalogue: a gain that changes with time."""

    def value(self, u, z, t, share, other):  # type: ignore[no-untyped-def]
        return u * (1.0 + self.p["k"] * max(t, 0.0))


class Product(Operator):
    """Outside the catalogue: the change of another signal scales that of the insertion point."""

    def begin(self, u, other):  # type: ignore[no-untyped-def]
        self.first = other.copy()
        return []

    def value(self, u, z, t, share, other):  # type: ignore[no-untyped-def]
        return u * (1.0 + self.p["k"] * (other - self.first))


CATALOGUE: dict[str, type[Operator]] = {
    "backlash": Backlash,
    "conductance": Conductance,
    "coupling": Coupling,
    "deadband": Deadband,
    "delay": Delay,
    "disturbance": Disturbance,
    "droop": Droop,
    "gain": Gain,
    "inductance": Inductance,
    "inner-loop": InnerLoop,
    "lag": Lag,
    "lead-lag": LeadLag,
    "limit": Limit,
    "loss": Loss,
    "offset": Offset,
    "quantisation": Quantisation,
    "rate-limit": RateLimit,
    "sample-hold": SampleHold,
    "saturation": Saturation,
    "second-order": SecondOrder,
    "window-mean": WindowMean,
}
OUTSIDE: dict[str, type[Operator]] = {
    "cubic": Cubic,
    "relay": Relay,
    "notch": Notch,
    "drift": Drift,
    "product": Product,
}
WITH_SOURCE = ("conductance", "coupling", "droop", "loss", "relay", "product")
