"""Sizes of hidden effects in units of the smallest detectable size after a refit of the gains."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from hidden import kinds
from hidden.campaigns import ROWS, campaign
from hidden.noise import whitened
from hidden.operators import WITH_SOURCE
from hidden.plant import INTERVAL, STEP, Plant
from hidden.plants import PLANTS
from hidden.simulator import Hidden, Run, simulate

Array = NDArray[np.floating]
UNIT = 4.15
"""One unit: the post-refit signature |M s|, in whitened noise, at which its score s'Mr/|Ms| has a mean equal to the
threshold of a two-sided test at 1 % over three hundred candidates."""
GRID = 14
NEAR = 0.03
"""A change of a parameter, as a logarithm, up to which its answer counts as linear."""
ROUNDS, SETTLED = 8, 1e-2
"""Of a refit: runs at most, and the relative fall of the sum of squares at which it has ended."""
WIDTH = 5.0
"""The bounds of a fitted parameter: its true value divided and multiplied by this."""
FARTHEST = 4.0
"""Ranges of an output in the plant without effects: what goes farther counts as diverged."""
PACED = {"T": 1, "Ts": 1, "compute": 1, "T1": 1, "T2": 1, "wn": -1, "rate": -1, "up": -1, "down": -1, "frequency": -1}
"""Parameters of effects that are times, with 1, or rates, with -1."""
LATE = 1e-7
"""By how much a sampler's period is longer than its steps. Rows and samples both begin with the record: without it they
would meet exactly, and which of the two comes first would be a matter of rounding."""


@dataclass(frozen=True)
class About:
    """Reference of a size: the insertion point's signal (and the other one) in the fitted experiments without the effect.

    start: its value before the event. steepest: its largest speed from row to row, 1/s at a plant with pace 1.
    """

    low: float
    high: float
    rest: float
    other_range: float = 1.0
    other_peak: float = 1.0
    other_rest: float = 0.0
    start: float = 0.0
    steepest: float = 1.0

    @property
    def peak(self) -> float:
        """Return its largest magnitude."""
        return max(abs(self.low), abs(self.high), 1e-9)

    @property
    def range(self) -> float:
        """Return its range, or at least a hundredth of its peak."""
        return max(self.high - self.low, 0.01 * self.peak)


SPANS: Mapping[str, tuple[float, float]] = {
    "lag": (4e-4, 0.3),
    "delay": (2e-4, 0.15),
    "window-mean": (4e-4, 0.3),
    "sample-hold": (1e-3, 0.2),
    "second-order": (2e-4, 0.1),
    "inner-loop": (4e-4, 0.2),
    "lead-lag": (0.01, 0.9),
    "limit": (0.02, 0.9),
    "saturation": (0.05, 1.5),
    "rate-limit": (1e-3, 0.6),
    "deadband": (2e-4, 0.6),
    "backlash": (1e-3, 1.2),
    "quantisation": (0.01, 1.5),
    "inductance": (4e-4, 0.3),
    "notch": (0.01, 0.95),
    kinds.SLOW_STATE: (0.02, 0.98),
    kinds.HELD_STATE: (0.02, 0.98),
}
"""From the smallest to the largest size tried, in what `parameters` counts sizes in; (1e-3, 1) where not listed."""

TIMES = ("lag", "delay", "window-mean", "sample-hold", "second-order", "inner-loop", "inductance")
"""Sized by a time, which the simulator's step bounds from below."""


def paced(effect: str, values: Mapping[str, Array], pace: float) -> dict[str, Array]:
    """Return the effect's parameters at a plant with another pace than 1."""
    powers = {**PACED, "k": -1} if effect == "drift" else PACED
    return {n: v * pace ** powers.get(n, 0) for n, v in values.items()}


def parameters(effect: str, x: Array, about: About, rng: np.random.Generator, resistance: float) -> dict[str, Array]:
    """Return the effect's parameters for sizes x (any shape, growing with the effect), at a plant with pace 1.

    rng: for the other choices.
    """
    sign, one = rng.choice([-1.0, 1.0]), np.ones_like(x)
    ratio = about.range / max(about.other_range, 1e-9)
    match effect:
        case "lag" | "delay" | "window-mean":
            return {"T": x}
        case "sample-hold":
            # An odd number of steps: the samples meet the rows as rarely as they can. The plant's clock is slow by LATE:
            # a row that meets a sample comes before it, which is how the simulator reads it.
            return {"Ts": (1 + LATE) * STEP * (2 * np.round((x / STEP - 1) / 2) + 1), "compute": 0 * one}
        case "second-order":
            return {"wn": 1 / x, "zeta": rng.uniform(0.2, 0.9) * one}
        case "inner-loop":
            return {"wn": 1 / x, "zeta": rng.uniform(0.3, 1.2) * one}
        case "lead-lag":
            t2 = rng.uniform(0.01, 0.04) * one
            return {"T1": t2 * (1 + sign * x), "T2": t2}
        case "limit":
            return {"level": about.peak - x * (about.peak - about.rest)}
        case "saturation":
            return {"level": about.peak / x}
        case "rate-limit":
            return {"rate": about.range / x}
        case "deadband":
            return {"width": x * about.peak}
        case "backlash":
            return {"width": x * about.range}
        case "quantisation":
            return {"step": x * about.range}
        case "gain":
            return {"k": 1 + sign * 0.6 * x}
        case "offset":
            return {"c": sign * x * about.range}
        case "coupling":
            return {"k": sign * x * ratio}
        case "droop":
            return {"k": x * ratio}
        case "conductance":
            return {"g": sign * x * about.range / about.other_peak}
        case "loss":
            share = rng.choice([0.0, 1.0], size=2) if rng.random() < 0.7 else np.ones(2)
            b, c = share if share.any() else (0.0, 1.0)
            size = x * about.range / about.other_peak
            return {"a": 0.2 * b * c * x * about.range, "b": b * size, "c": c * size / about.other_peak}
        case "inductance":
            return {"L": x * resistance, "R": resistance * one}
        case "disturbance":
            frequency, phase = rng.uniform(2.0, 25.0), rng.uniform(0, 2 * np.pi)
            return {"amplitude": x * about.range, "frequency": frequency * one, "phase": phase * one}
        case kinds.SLOW_STATE:
            return dict.fromkeys(("up", "down"), about.steepest * (1 - x))
        case kinds.HELD_STATE:
            up, down = about.high - about.start, about.start - about.low
            if rng.random() * (up + down) < up:
                return {"high": about.high - x * up}
            return {"low": about.low + x * down}
        case "cubic":
            return {"k": sign * x * about.range / about.peak**3}
        case "relay":
            width = 0.1 * max(about.other_range, 1e-9)
            return {"k": x * about.range, "centre": about.other_rest * one, "width": width * one}
        case "notch":
            return {"k": x, "wn": 2 * np.pi * rng.uniform(3.0, 10.0) * one}
        case "drift":
            return {"k": sign * 0.5 * x}
        case "product":
            return {"k": sign * x / max(about.other_range, 1e-9)}
    raise ValueError(f"no such effect: {effect}")


@dataclass(frozen=True, eq=False)
class Nominal:
    """The plant without effects under a campaign: outputs (rows, 3, outputs) and their derivatives by the fit parameters."""

    plant: Plant
    runs: tuple[Run, Run, Run]
    outputs: Array
    slopes: Array  # (rows, 2, parameters, outputs), of the fitted experiments
    coarse: Array  # (rows, 2, outputs), what those of a run at the coarse step lack
    slots: Mapping[str, Array]  # (rows, 2)


@lru_cache(maxsize=32)
def nominal(plant_name: str, excitation: str, variant: int) -> Nominal:
    """Return the plant's response to a campaign and its derivatives by the fit parameters."""
    plant = PLANTS[plant_name]
    runs = campaign(plant, excitation, variant)
    batch = list(runs)
    for name in plant.fitted:
        value = plant.parameters[name]
        for sign in (-1, 1):
            batch += [Run(r.inputs, {name: value * (1 + sign * 1e-3)}) for r in runs[:2]]
    watch = (*(f"outputs.{o}" for o in plant.outputs), *plant.slots)
    found = simulate(plant, batch, watch=watch)
    n = len(plant.outputs)
    moved = found[:, 3:, :n].reshape(found.shape[0], len(plant.fitted), 2, 2, n)
    size = np.array([2e-3 * plant.parameters[p] for p in plant.fitted])
    slopes = (moved[:, :, 1] - moved[:, :, 0]).transpose(0, 2, 1, 3) / size[:, None]
    slots = {s: found[:, :2, n + k] for k, s in enumerate(plant.slots)}
    slots |= {f"outputs.{o}": found[:, :2, k] for k, o in enumerate(plant.outputs)}
    coarse = found[:, :2, :n] - simulate(plant, runs[:2], step=plant.coarse * plant.step)
    return Nominal(plant, runs, found[:, :3, :n], slopes, coarse, slots)


def about(base: Nominal, at: str, source: str) -> About:
    """Return the reference of sizes at an insertion point."""
    u, o = base.slots[at], base.slots[source] if source else np.zeros((1, 2))
    return About(
        float(u.min()), float(u.max()), float(np.abs(u[0]).max()),
        float(np.ptp(o)), float(max(np.abs(o).max(), 1e-9)), float(o[0, 0]),
        float(u[0, 0]), float(np.abs(np.diff(u, axis=0)).max()) / INTERVAL,
    )  # fmt: skip


def ranges(base: Nominal) -> Array:
    """Return (outputs,), the range of each output in the fitted experiments, or a bit more than 0 of one that does not move."""
    return np.asarray(np.ptp(base.outputs[:, :2], axis=(0, 1)) + 1e-3 * np.abs(base.outputs).max(axis=(0, 1, 2)))


def on_jumps(runs: Sequence[Run], interval: float = INTERVAL) -> NDArray[np.bool_]:
    """Return (rows, runs), True for rows on a jump of an input: a recording does not state which side such a row shows."""
    rows = [[round(t / interval) for signal in run.inputs.values() for t in signal.jumps] for run in runs]
    return np.stack([np.isin(np.arange(ROWS), own) for own in rows], axis=1)


def units(base: Nominal, answer: Array, sigma: Array, kind: str, channels: Sequence[int]) -> Array:
    """Return (n,), the post-refit size of each response, in units. answer: (rows, 2, n, outputs) of the fitted experiments.

    It is the part of the response that the refitted plant without effects does not explain. If a linear step changes no
    parameter much, it replaces the refit; else the refit is run within the bounds of a fit. Rows on a jump of an input do
    not count.
    """
    pick = list(channels)
    gone = on_jumps(base.runs[:2], base.plant.interval)

    def residual(y: Array) -> Array:
        """Return the residuals (N, n) of outputs (rows, 2, n, outputs)."""
        d = whitened(y, sigma, kind, gone)[..., pick]
        return np.asarray(d.transpose(0, 1, 3, 2).reshape(-1, y.shape[2]))

    logs = np.array([base.plant.parameters[p] for p in base.plant.fitted])[:, None]
    slopes = residual(base.slopes * logs)
    r = residual(answer - base.outputs[:, :2, None])
    steps = np.array([_step(slopes, d, 0.0) for d in r.T])
    found = np.linalg.norm(r - slopes @ steps.T, axis=0)
    far = np.flatnonzero(np.abs(steps).max(axis=1) > NEAR)
    if far.size:
        found[far] = _refitted(base, residual, answer[:, :, far], r[:, far], slopes)
    return found / UNIT


def _step(slopes: Array, r: Array, damping: float) -> Array:
    """Return the Levenberg-Marquardt step of log-parameters towards r."""
    norms = np.maximum(np.linalg.norm(slopes, axis=0), 1e-12 * max(float(np.linalg.norm(slopes)), 1e-300))
    unit = slopes / norms
    left, values, right = np.linalg.svd(unit, full_matrices=False)
    kept = values > 1e-9 * values.max()
    left, values, right = left[:, kept], values[kept], right[kept]
    return np.asarray((right.T @ (values / (values**2 + damping) * (left.T @ r))) / norms)


def _refitted(base: Nominal, residual: Callable[[Array], Array], answer: Array, r: Array, slopes: Array) -> Array:
    """Return (n,), the residual norm of each response at its best parameters, all responses at once."""
    n = answer.shape[2]
    here, cost, jacobians = np.zeros((n, len(base.plant.fitted))), np.sum(r**2, axis=0), [slopes] * n
    r, damping, open_ = r.copy(), np.full(n, 1e-3), np.ones(n, dtype=bool)
    for _ in range(ROUNDS):
        which = np.flatnonzero(open_)
        if not which.size:
            break
        there = np.array([_bounded(here[k], jacobians[k], r[:, k], damping[k]) for k in which])
        y, moved = _plant(base, there)
        new = residual(answer[:, :, which] - y)
        for j, k in enumerate(which):
            power = float(np.sum(new[:, j] ** 2))
            if not power < cost[k]:
                damping[k] *= 10.0
                open_[k] = damping[k] < 1e6
                continue
            open_[k] = cost[k] - power > SETTLED * cost[k]
            here[k], cost[k], r[:, k] = there[j], power, new[:, j]
            jacobians[k], damping[k] = residual(moved[:, :, j]), 0.1 * damping[k]
    return np.asarray(np.sqrt(cost))


def _bounded(at: Array, slopes: Array, r: Array, damping: float) -> Array:
    """Return the end of a step, with parameters clipped to the bounds."""
    edge, free = np.log(WIDTH), np.ones(at.size, dtype=bool)
    there = at.copy()
    for _ in range(at.size):
        there[free] = at[free] + _step(slopes[:, free], r - slopes[:, ~free] @ (there - at)[~free], damping)
        out = free & (np.abs(there) > edge)
        if not out.any():
            break
        there[out], free = np.sign(there[out]) * edge, free & ~out
        if not free.any():
            break
    return np.clip(there, -edge, edge)


def _plant(base: Nominal, logs: Array) -> tuple[Array, Array]:
    """Return the outputs (rows, 2, n, outputs) of the plant without effects at log-parameters (n, p), and their derivatives.

    slopes: (rows, 2, n, parameters, outputs).
    """
    plant, n, p = base.plant, *logs.shape
    batch = []
    for run in base.runs[:2]:
        for k in range(n):
            for j in range(p + 1):
                shift = logs[k] + 1e-3 * (np.arange(p) == j - 1)
                values = {q: plant.parameters[q] * float(np.exp(v)) for q, v in zip(plant.fitted, shift, strict=True)}
                batch.append(Run(run.inputs, values))
    found = simulate(plant, batch, step=plant.coarse * plant.step)
    found = found.reshape(found.shape[0], 2, n, p + 1, -1)
    slopes = (found[:, :, :, 1:] - found[:, :, :, :1]) / 1e-3
    return found[:, :, :, 0] + base.coarse[:, :, None], slopes


def sized(
    base: Nominal,
    effect: str,
    at: str,
    source: str,
    wanted: float,
    sigma: Array,
    kind: str,
    channels: Sequence[int],
    seed: Sequence[int],
) -> Hidden | None:
    """Return the effect at the required size, in units; None if no size reaches it or a run diverges before.

    A size whose response is larger than FARTHEST of the outputs' ranges counts as diverged.
    """
    plant = base.plant
    low, high = SPANS.get(effect, (1e-3, 1.0))
    x = np.geomspace(low, high, GRID)
    signal = about(base, at, source)
    resistance = plant.parameters.get(plant.resistance[1], 1.0)
    values = paced(effect, parameters(effect, x, signal, np.random.default_rng(seed), resistance), plant.pace)
    tiled = {n: np.tile(v, 2) for n, v in values.items()}
    runs = [r for r in base.runs[:2] for _ in range(GRID)]
    answer = simulate(plant, runs, [Hidden(effect, at, tiled, source)])
    answer = answer.reshape(answer.shape[0], 2, GRID, -1)
    far = np.abs(answer - base.outputs[:, :2, None]).max(axis=(0, 1)) / ranges(base)
    fine = np.isfinite(answer).all(axis=(0, 1, 3)) & (far < FARTHEST).all(axis=1)
    count = GRID if fine.all() else int(np.argmin(fine))
    if count == 0:
        return None
    size = units(base, answer[:, :, :count], sigma, kind, channels)
    above = np.flatnonzero(size >= wanted)
    if above.size == 0:
        return None
    k = int(above[0])
    if k == 0:
        chosen = x[0] * wanted / size[0]
    else:
        share = np.log(wanted / max(size[k - 1], 1e-9 * wanted)) / np.log(size[k] / max(size[k - 1], 1e-9 * wanted))
        chosen = x[k - 1] * (x[k] / x[k - 1]) ** share
    if chosen < (low if effect in TIMES else 0.2 * low):
        return None
    point = parameters(effect, np.array([chosen]), signal, np.random.default_rng(seed), resistance)
    point = paced(effect, point, plant.pace)
    return Hidden(effect, at, {n: float(v[0]) for n, v in point.items()}, source)


def needs_source(effect: str) -> bool:
    """Return True if the effect reads another signal."""
    return effect in WITH_SOURCE
