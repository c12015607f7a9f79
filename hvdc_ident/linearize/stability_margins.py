"""Stability margins of loops: gain, phase, delay, modulus and disk of each, and the disk margin of all together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import brentq, minimize, minimize_scalar
from scipy.sparse.csgraph import connected_components

from hvdc_ident.errors import LinearizationError
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize.frequency import default_omega, transfer
from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.matrices import Array
from hvdc_ident.linearize.open_loop import Loop

Curve = Callable[[float], complex]
Curves = Callable[[Array], Array]


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
        return disk_gain(self.disk.value)

    @property
    def disk_phase(self) -> float:
        """Degrees the phase may change either way."""
        return disk_phase(self.disk.value)

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

    def __str__(self) -> str:
        if not self.stable:
            return "the closed loop is not stable: it has no margins"
        gain, phase = self.gain_margin, self.phase_margin
        hertz = 2 * np.pi
        first = f"gain {gain.value:.4g} at {gain.omega / hertz:.4g} Hz" if np.isfinite(gain.value) else "gain unlimited"
        second = (
            f"phase {phase.value:.4g} degrees at {phase.omega / hertz:.4g} Hz, delay {1e3 * self.delay.value:.4g} ms"
            if np.isfinite(phase.value)
            else "phase unlimited"
        )
        return f"{first}, {second}, modulus {self.modulus.value:.3g}, {_disk_text(self.disk)}"


@dataclass(frozen=True, eq=False)
class LoopMargins:
    """Margins of several loops of one plant. each: of every loop alone, by signal, the others closed.

    disk: alpha of the balanced disk in which every loop's gain and phase may vary at once, independently of each other
    (multi-loop disk margin); a bound from below, exact for up to three loops. stable: whether the closed loops are.
    """

    each: FrozenMap[Margins]
    disk: Crossing
    stable: bool

    @property
    def disk_gain(self) -> float:
        """The factor by which every gain may change either way."""
        return disk_gain(self.disk.value)

    @property
    def disk_phase(self) -> float:
        """Degrees every phase may change either way."""
        return disk_phase(self.disk.value)

    def to_dict(self) -> dict[str, Any]:
        """The margins as plain numbers."""
        disk = {
            "value": self.disk.value,
            "omega": self.disk.omega,
            "gain": self.disk_gain,
            "phase_deg": self.disk_phase,
        }
        return {"loops": {n: m.to_dict() for n, m in self.each.items()}, "disk_margin": disk, "stable": self.stable}

    def __str__(self) -> str:
        lines = [f"{name}: {m}" for name, m in self.each.items()]
        if len(self.each) > 1:
            lines.append(f"all loops at once: {_disk_text(self.disk)}")
        return "\n".join(lines)


def disk_gain(alpha: float) -> float:
    """Return the factor either way of a balanced disk margin alpha."""
    return (2.0 + alpha) / (2.0 - alpha) if alpha < 2.0 else float("inf")


def disk_phase(alpha: float) -> float:
    """Return the degrees either way of a balanced disk margin alpha."""
    return float(2.0 * np.degrees(np.arctan(alpha / 2.0))) if alpha < 2.0 else 90.0


def _disk_text(disk: Crossing) -> str:
    a = disk.value
    factor = f"a factor of {disk_gain(a):.3g}" if a < 2.0 - 1e-9 else "any factor"
    where = f"at {disk.omega / (2 * np.pi):.4g} Hz"
    return f"disk margin {a:.3g} {where} (gain by {factor} and phase by {disk_phase(a):.3g} degrees, either way)"


def margins(loop: Loop | LinearModel, omega: Array | None = None) -> Margins:
    """Return the margins of one loop (1 + L = 0), searched on a grid around its poles (or omega, rad/s) and refined.

    Raises LinearizationError for a model with more than one input or output.
    """
    model = loop.open if isinstance(loop, Loop) else loop
    if len(model.input_names) != 1 or len(model.output_names) != 1:
        raise LinearizationError(
            "margins belong to one loop", where=model.name, hint="open a loop, or use loop_margins() for several"
        )

    def values(w: Array) -> Array:
        return transfer(model, 1j * w)[:, 0, 0]

    closed = Loop("loop", model).closed_poles()
    return _of_curve(values, _grid(model, omega), bool((closed.real < 0).all()))


def loop_margins(loop: Loop | LinearModel, omega: Array | None = None) -> LoopMargins:
    """Return the margins of several loops opened together (det(1 + L) = 0), each alone and all at once.

    A loop alone has the others closed: 1 + L_i = 1/S_ii with S = (1 + L)^-1. Raises LinearizationError where there are
    not as many inputs as outputs, or the loops are ill-posed.
    """
    model = loop.open if isinstance(loop, Loop) else loop
    names = model.input_names
    if len(names) != len(model.output_names):
        raise LinearizationError(
            "loops have as many inputs as outputs",
            where=model.name,
            got=f"{len(names)} inputs and {len(model.output_names)} outputs",
            hint="open the model at signals: loop(model, [...])",
        )
    closed = Loop("loops", model).closed_poles()
    stable, grid = bool((closed.real < 0).all()), _grid(model, omega)
    sensitivity = _sensitivity(model)
    each = {n: _of_curve(_alone(sensitivity, i), grid, stable) for i, n in enumerate(names)}
    if not stable:
        return LoopMargins(FrozenMap(each), Crossing(float("nan"), 0.0), False)
    if len(names) == 1:
        return LoopMargins(FrozenMap(each), each[names[0]].disk, stable)
    return LoopMargins(FrozenMap(each), _common_disk(sensitivity, grid), stable)


def _sensitivity(model: LinearModel) -> Curves:
    """S = (1 + L)^-1 over rad/s; from the closed loops' state space where there is one, which poles of L do not disturb."""
    eye = np.eye(len(model.input_names))
    if model.delay_free is not None:
        return lambda w: np.linalg.inv(eye + transfer(model, 1j * w))
    a, b, c, d = model.standard()
    direct = np.linalg.inv(eye + d)
    closed, drive, seen = a - b @ direct @ c, b @ direct, direct @ c

    def values(w: Array) -> Array:
        inner = 1j * w[:, None, None] * np.eye(a.shape[0]) - closed
        return np.asarray(direct - seen @ np.linalg.solve(inner, np.broadcast_to(drive, (w.size, *drive.shape))))

    return values


def _alone(sensitivity: Curves, i: int) -> Curves:
    """L of the i-th loop with the others closed, 1/S_ii - 1."""

    def values(w: Array) -> Array:
        own = sensitivity(w)[:, i, i]
        return np.asarray(1.0 / np.where(np.abs(own) < 1e-300, 1e-300, own) - 1.0)

    return values


def _grid(model: LinearModel, omega: Array | None) -> Array:
    if omega is not None:
        return np.asarray(omega, dtype=float)
    own = default_omega(model, 4000)
    return np.unique(np.concatenate([own, own[0] * np.logspace(-4, 0, 200)]))


def _of_curve(values_at: Curves, grid: Array, stable: bool) -> Margins:
    """The margins of a loop whose transfer function is given over rad/s."""
    values = values_at(grid)

    def curve(w: float) -> complex:
        return complex(values_at(np.array([w]))[0])

    gain = tuple(sorted(_gains(grid, values, curve), key=lambda c: abs(np.log(c.value))))
    phase = tuple(_phases(grid, values, curve))
    delays = [Crossing(c.omega, float(np.radians(c.value % 360.0) / c.omega)) for c in phase if c.omega > 0]
    none = Crossing(float("inf"), float("inf"))
    modulus = _smallest(grid, np.abs(1 + values), lambda w: abs(1 + curve(w)))
    disk = _smallest(grid, _disk(values), lambda w: float(_disk(np.array([curve(w)]))[0]))
    return Margins(gain, phase, min(delays, key=lambda c: c.value, default=none), modulus, disk, stable)


def _common_disk(sensitivity: Curves, grid: Array) -> Crossing:
    """The largest balanced disk for all loops at once: 1 over the largest structured singular value of (S - T)/2.

    Its bound by Osborne's scaling is cheap and never below the sharper one, so that only the frequencies whose cheap
    bound exceeds the largest sharp one found so far have to be looked at.
    """

    def matrices(w: Array) -> Array:
        values = sensitivity(w)
        return np.asarray(values - 0.5 * np.eye(values.shape[1]))  # (S - T)/2 with T = 1 - S

    everywhere = matrices(grid)
    cheap = np.array([_scaled_norm(m, _osborne(m)) for m in everywhere])
    best, place = 0.0, 0
    for k in np.argsort(-cheap):
        if cheap[k] <= best * (1.0 + 1e-6):
            break
        sharp = structured_singular_value(everywhere[k])
        if sharp > best:
            best, place = sharp, int(k)
    low, high = grid[max(place - 1, 0)], grid[min(place + 1, grid.size - 1)]
    found = minimize_scalar(
        lambda w: -structured_singular_value(matrices(np.array([w]))[0]), bounds=(low, high), method="bounded",
        options={"xatol": 1e-9 * high},
    )  # fmt: skip
    if -found.fun > best:
        return Crossing(float(found.x), float(-1.0 / found.fun))
    return Crossing(float(grid[place]), 1.0 / best)


def structured_singular_value(matrix: Array) -> float:
    """Return the upper bound min over D of |D M D^-1| of mu for independent complex factors, one a row; exact up to three rows.

    D is positive and diagonal. The norm is convex in its logarithms (Sezginer and Overton 1990) but not smooth where two
    singular values meet; Schatten norms of rising order p, which exceed it by at most n^(1/p), are minimised instead.
    The value returned is the norm itself, so that it is a bound whatever the search did.
    """
    size = np.abs(matrix)
    # A coupling below the rounding of the largest entry is none; one that goes only one way is scaled away altogether.
    _, label = connected_components(size > 1e-15 * size.max(initial=0.0), directed=True, connection="strong")
    parts = [np.flatnonzero(label == k) for k in range(label.max() + 1)]
    return max(_strongly_coupled(matrix[np.ix_(part, part)]) for part in parts)


def _strongly_coupled(matrix: Array) -> float:
    if matrix.shape[0] == 1:
        return float(abs(matrix[0, 0]))
    logs = _osborne(matrix)
    best = _scaled_norm(matrix, logs)
    lower = float(np.abs(np.linalg.eigvals(matrix)).max())  # a common factor for all rows is one of the factors allowed
    for order in (8, 64, 512, 4096):
        if best <= lower * (1.0 + 1e-9):
            break
        found = minimize(_schatten, logs, (matrix, order), jac=True, method="BFGS", options={"gtol": 1e-7})
        value = _scaled_norm(matrix, found.x)
        if value < best:
            best, logs = value, found.x - found.x[0]
    return best


def _scaled_norm(matrix: Array, logs: Array) -> float:
    scale = np.exp(logs)
    return float(np.linalg.norm(scale[:, None] * matrix / scale, 2))


def _schatten(logs: Array, matrix: Array, order: int) -> tuple[float, Array]:
    """The logarithm of the Schatten norm of D M D^-1 and its derivatives by log D."""
    scale = np.exp(logs - logs.mean())
    u, s, vh = np.linalg.svd(scale[:, None] * matrix / scale)
    weight = (s / s[0]) ** order
    total = weight.sum()
    slope = (np.abs(u) ** 2 - np.abs(vh.T) ** 2) @ weight / total
    return float(np.log(s[0]) + np.log(total) / order), np.asarray(slope)


def _osborne(matrix: Array) -> Array:
    """log D for which every row of |D M D^-1| has the norm of its column, off the diagonal (Osborne 1960)."""
    size = np.abs(matrix) ** 2
    np.fill_diagonal(size, 0.0)
    logs = np.zeros(size.shape[0])
    for _ in range(20):
        moved = 0.0
        for i in range(logs.size):
            row = float(size[i] @ np.exp(2 * (logs[i] - logs)))
            column = float(size[:, i] @ np.exp(2 * (logs - logs[i])))
            if row > 0 and column > 0:
                step = 0.25 * np.log(column / row)
                logs[i] += step
                moved = max(moved, abs(step))
        if moved < 1e-6:
            break
    return logs


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
