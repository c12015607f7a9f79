"""Plants of which the card states one value plainly wrong."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import root

from hidden.plant import Plant
from hidden.simulator import Run, at_rest, simulate
from hidden.sizes import FARTHEST, Nominal, ranges, units

Array = NDArray[np.floating]
FACTORS = (1.25, 3.0)
"""By which the stated value is larger or smaller than the true one: many times the tolerance of nameplate and test data, which is
in the messy records."""


@dataclass(frozen=True)
class Value:
    """A parameter of a plant: its true value, and what the card states."""

    name: str
    true: float
    stated: float

    def truly(self, runs: Sequence[Run]) -> tuple[Run, Run, Run]:
        """Return the three runs of a campaign with the true value."""
        first, second, held = (replace(r, values={**r.values, self.name: self.true}) for r in runs)
        return first, second, held


def drawn(plant: Plant, rng: np.random.Generator) -> Value:
    """Return one of the parameters that are not fitted at random, with a factor whose logarithm is uniform, up or down.

    What the card states is the plant's own value in this study, so that the card is the package's; the truth is another.
    """
    name = str(rng.choice([n for n in plant.parameters if n not in plant.fitted]))
    factor = math.exp(rng.choice([-1.0, 1.0]) * rng.uniform(*np.log(FACTORS)))
    return Value(name, plant.parameters[name] * factor, plant.parameters[name])


def misstated(
    base: Nominal,
    wanted: float,
    sigma: Array,
    kind: str,
    channels: Sequence[int],
    rng: np.random.Generator,
    tries: int,
) -> tuple[Value, Array, float, int] | None:
    """Return a value that is stated wrong, the plant's response (rows, 3, outputs), its size and the draws; None after too many.

    Drawn again where the plant is not stable, moves farther than a plant that counts as diverged, or answers with less than the
    wanted size after the refit. wanted, size: in units of the noise.
    """
    plant = base.plant
    for count in range(1, tries + 1):
        value = drawn(plant, rng)
        if not stable(plant, {value.name: value.true}):
            continue
        clean = simulate(plant, value.truly(base.runs))
        # Where it rests elsewhere it has not diverged: what counts is how far it moves.
        if not np.isfinite(clean).all() or (np.ptp(clean, axis=(0, 1)) > FARTHEST * ranges(base)).any():
            continue
        size = float(units(base, clean[:, :2, None], sigma, kind, channels)[0])
        if size >= wanted:
            return value, clean, size, count
    return None


def stable(plant: Plant, values: Mapping[str, float]) -> bool:
    """Return True if the plant comes to rest at its inputs and goes back there: all eigenvalues have negative real parts.

    A plant may have other steady states, as a machine beyond its pull-out: it is asked where its runs begin. Where its steady states
    turn, they and the eigenvalues are those in the frame that turns with them.
    """
    inputs = {n: np.array([v]) for n, v in {**plant.inputs, "time": 0.0}.items()}
    parameters = {n: np.array([values.get(n, v)]) for n, v in plant.parameters.items()}

    def rates(x: Array) -> Array:
        states = [np.array([v]) for v in x]
        moving = np.array(plant.flow(states, inputs, parameters, lambda slot, signal: signal))
        return np.asarray(moving if plant.turning is None else moving - np.array(plant.turning(states)))[:, 0]

    with np.errstate(all="ignore"):
        begin = at_rest(plant, [Run(values=values)])[:, 0]
        rest = root(rates, begin) if np.isfinite(begin).all() else None
        if rest is None or not rest.success:
            return False
        little = 1e-6 * np.diag(1.0 + np.abs(rest.x))
        slopes = [(rates(rest.x + d) - rates(rest.x - d)) / (2.0 * d.sum()) for d in little]
    return bool(np.isfinite(slopes).all() and np.linalg.eigvals(np.array(slopes)).real.max() < 0.0)
