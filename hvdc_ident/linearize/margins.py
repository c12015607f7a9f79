"""Stability margins of a loop: gain, phase, delay, modulus and disk, delays exact."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import brentq, minimize_scalar

from hvdc_ident.errors import LinearizationError
from hvdc_ident.linearize.arrays import Array
from hvdc_ident.linearize.frequency import default_omega, transfer
from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.loop import Loop

Curve = Callable[[float], complex]


@dataclass(frozen=True)
class Crossing:
    """A frequency in rad/s and the margin there."""

    omega: float
    value: float


@dataclass(frozen=True)
class Margins:
    """Margins of 1 + L = 0. Infinite where the curve has no such crossing.

    gain: factors on L that reach -1, nearest to 1 first (as 1/|L|; below 1 for a loop that must not be weakened).
    phase: degrees at |L| = 1. delay: s that the loop stands, at its frequency. modulus: the smallest |1 + L|, the
    stability margin, 1 over the peak of S. disk: alpha of the balanced disk |(S - T)/2| < 1/alpha, with the gain and
    phase it guarantees together. stable: whether the closed loop is (delays in Pade form).
    """

    gain: tuple[Crossing, ...]
    phase: tuple[Crossing, ...]
    delay: Crossing
    modulus: Crossing
    disk: Crossing
    stable: bool

    @property
    def gain_margin(self) -> Crossing:
        """The smallest factor above 1 that reaches the limit of stability."""
        above = [c for c in self.gain if c.value > 1.0]
        return min(above, key=lambda c: c.value, default=Crossing(float("inf"), float("inf")))

    @property
    def phase_margin(self) -> Crossing:
        """The phase margin of the smallest size, degrees."""
        return min(self.phase, key=lambda c: abs(c.value), default=Crossing(float("inf"), float("inf")))

    @property
    def disk_gain(self) -> float:
        """The factor by which the gain may change either way, phase held within `disk_phase` too."""
        a = self.disk.value
        return (2.0 + a) / (2.0 - a) if a < 2.0 else float("inf")

    @property
    def disk_phase(self) -> float:
        """Degrees the phase may change either way."""
        return float(2.0 * np.degrees(np.arctan(self.disk.value / 2.0)))

    def to_dict(self) -> dict[str, Any]:
        """The margins as plain numbers."""

        def pair(c: Crossing) -> dict[str, float]:
            return {"value": c.value, "omega": c.omega}

        return {
            "gain_margin": pair(self.gain_margin),
            "phase_margin_deg": pair(self.phase_margin),
            "delay_margin_s": pair(self.delay),
            "modulus_margin": pair(self.modulus),
            "disk_margin": {**pair(self.disk), "gain": self.disk_gain, "phase_deg": self.disk_phase},
            "stable": self.stable,
        }


def margins(loop: Loop | LinearModel, omega: Array | None = None) -> Margins:
    """The margins of a loop (1 + L = 0), searched on a grid around its poles (or omega, rad/s) and refined.

    Raises LinearizationError for a model with more than one input or output.
    """
    model = loop.open if isinstance(loop, Loop) else loop
    if len(model.input_names) != 1 or len(model.output_names) != 1:
        raise LinearizationError(
            "margins belong to one loop", where=model.name, hint="open a loop, or use sigma() for many"
        )
    own = default_omega(model, 4000) if omega is None else np.asarray(omega, dtype=float)
    grid = np.unique(np.concatenate([own, own[0] * np.logspace(-4, 0, 200)])) if omega is None else own
    values = transfer(model, 1j * grid)[:, 0, 0]

    def curve(w: float) -> complex:
        return complex(transfer(model, np.array([1j * w]))[0, 0, 0])

    gain = tuple(sorted(_gains(grid, values, curve), key=lambda c: abs(np.log(c.value))))
    phase = tuple(_phases(grid, values, curve))
    delays = [Crossing(c.omega, float(np.radians(c.value % 360.0) / c.omega)) for c in phase if c.omega > 0]
    closed = Loop("loop", model).closed_poles()
    none = Crossing(float("inf"), float("inf"))
    modulus = _smallest(grid, np.abs(1 + values), lambda w: abs(1 + curve(w)))
    disk = _smallest(grid, _disk(values), lambda w: float(_disk(np.array([curve(w)]))[0]))
    return Margins(
        gain, phase, min(delays, key=lambda c: c.value, default=none), modulus, disk, bool((closed.real < 0).all())
    )


def _disk(values: Array) -> Array:
    """1/|(S - T)/2| for L: the balanced disk at each frequency."""
    return np.asarray(2.0 * np.abs(1 + values) / np.maximum(np.abs(1 - values), 1e-300))


def _gains(grid: Array, values: Array, curve: Curve) -> list[Crossing]:
    """Crossings of the negative real axis."""
    found = []
    imag = values.imag
    for k in np.flatnonzero((imag[:-1] * imag[1:] <= 0) & (imag[:-1] != imag[1:])):
        w = float(brentq(lambda x: curve(x).imag, grid[k], grid[k + 1], xtol=1e-14 * grid[k + 1], rtol=1e-14))
        real = curve(w).real
        if real < -1e-9 and abs(curve(w).imag) < 1e-6 * abs(real):
            found.append(Crossing(w, -1.0 / real))
    return found


def _phases(grid: Array, values: Array, curve: Curve) -> list[Crossing]:
    """Crossings of the unit circle."""
    found = []
    level = np.abs(values) - 1.0
    for k in np.flatnonzero((level[:-1] * level[1:] <= 0) & (level[:-1] != level[1:])):
        w = float(brentq(lambda x: abs(curve(x)) - 1.0, grid[k], grid[k + 1], xtol=1e-14 * grid[k + 1], rtol=1e-14))
        angle = float(np.degrees(np.angle(curve(w)))) + 180.0
        found.append(Crossing(w, (angle + 180.0) % 360.0 - 180.0))
    return found


def _smallest(grid: Array, values: Array, at: Callable[[float], float]) -> Crossing:
    """The smallest value of a curve over the frequencies, refined between the grid's neighbours."""
    k = int(np.argmin(values))
    low, high = grid[max(k - 1, 0)], grid[min(k + 1, grid.size - 1)]
    if high > low:
        found = minimize_scalar(at, bounds=(low, high), method="bounded", options={"xatol": 1e-12 * high})
        if found.fun <= values[k]:
            return Crossing(float(found.x), float(found.fun))
    return Crossing(float(grid[k]), float(values[k]))
