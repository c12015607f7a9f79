"""A quantity to be estimated: its starting value, its bounds and its scaling.

`Coordinates` scales several of them: optimisers and profiles move in coordinates of order 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.errors import StudyError
from hvdc_ident.parameters import Parameter

LOG_FROM = 10.0
"""From this ratio of bounds on, a positive unknown is scaled by its logarithm."""
LARGEST_LOG = 345.0
"""The logarithm of 1e150, whose square is still a float: where no bound keeps a logarithm, this does."""


@dataclass(frozen=True)
class FitParameter:
    """An unknown of a fit, everything in its own unit.

    start: first guess. min, max: bounds of the search (infinite: none). scale: a typical size, 0 means |start|, or 1.
    given: the value that the model came with (left out: the start); a parameter that is not estimated stays there, and
    results are compared with it. It need not lie within the bounds of the search.
    Scaling: by logarithm where min > 0 and max/min > 10 (a gain known to a decade), else by the range (0 may be
    admissible), else, without bounds, by the typical size. Raises StudyError where the bounds do not hold the start.
    """

    name: str
    start: float
    min: float = -math.inf
    max: float = math.inf
    scale: float = 0.0
    given: float = math.nan

    def __post_init__(self) -> None:
        for name in ("start", "min", "max", "scale", "given"):
            object.__setattr__(self, name, float(getattr(self, name)))
        if math.isnan(self.given):
            object.__setattr__(self, "given", self.start)
        if not self.min < self.max:
            turned = (
                f"min = {self.max:g}, max = {self.min:g}" if self.max < self.min else "hold it if it is not to move"
            )
            raise StudyError(
                f"the bounds of '{self.name}' hold no range",
                expected="min < max",
                got=f"min {self.min:g}, max {self.max:g}",
                hint=turned,
            )
        if not (self.min <= self.start <= self.max and math.isfinite(self.start)):
            raise StudyError(
                f"the search for '{self.name}' begins outside its bounds",
                expected=f"a finite start in [{self.min:g}, {self.max:g}]",
                got=f"{self.start:g}",
                hint="a start within the bounds, or wider bounds",
            )

    @classmethod
    def of(cls, name: str, parameter: Parameter, **changes: float) -> FitParameter:
        """Return the unknown that a model's parameter is, given and started at its value; with some of the fields changed."""
        value = changes.get("given", parameter.value)
        fields = {"start": value, "given": value}
        fields |= {"min": parameter.min, "max": parameter.max, "scale": parameter.scale, **changes}
        low, high = fields["min"], fields["max"]
        if "start" not in changes and low < high and not low <= value <= high:
            side, bound = ("below min", "min") if value < low else ("above max", "max")
            raise StudyError(
                f"the search for '{name}' begins at the given value, {side} = {fields[bound]:g}",
                expected=f"a start in [{low:g}, {high:g}]",
                got=f"{value:g}",
                hint=f"start = ... within the bounds, or {bound} = {value:g}",
            )
        return cls(name, **fields)

    def on_bound(self, value: float) -> bool:
        """Return whether a value lies on one of the bounds."""
        return value <= self.min or value >= self.max

    @property
    def log(self) -> bool:
        """True for an unknown that is scaled by its logarithm."""
        return self.min > 0 and self.max / self.min > LOG_FROM

    @property
    def size(self) -> float:
        """Typical size in the unknown's unit, never 0."""
        return self.scale or abs(self.start) or 1.0

    @property
    def span(self) -> float:
        """Range between the bounds, or the typical size where a bound is infinite; in the unknown's unit."""
        width = self.max - self.min
        return width if math.isfinite(width) else self.size

    @property
    def drawn(self) -> tuple[float, float]:
        """Range that starts are drawn from: the bounds; for an infinite one ten typical sizes from the start."""
        low = self.min if math.isfinite(self.min) else min(self.start, self.max) - 10.0 * self.size
        high = self.max if math.isfinite(self.max) else max(self.start, self.min) + 10.0 * self.size
        return low, high

    def draw(self, share: float) -> float:
        """Return the value at a share in [0, 1] of the range that starts are drawn from, even in the scaled unknown.

        Where a bound is infinite the range is no more than a guess of the size: then even in the logarithm of the distance
        from the other bound, or from 0, from a hundredth of the typical size on; of two signs the start's own gets three
        quarters.
        """
        low, high = self.drawn
        if self.log:
            value = low * (high / low) ** share
        elif math.isfinite(self.min) and math.isfinite(self.max):
            value = low + share * (high - low)
        elif math.isfinite(self.min):
            value = self.min + _even_in_log(high - self.min, self.size, share)
        elif math.isfinite(self.max):
            value = self.max - _even_in_log(self.max - low, self.size, 1.0 - share)
        else:
            below = 0.25 if self.start > 0 else 0.75 if self.start < 0 else 0.5
            if share < below:
                value = -_even_in_log(-low, self.size, 1.0 - share / below)
            else:
                value = _even_in_log(high, self.size, (share - below) / (1.0 - below))
        return float(min(max(value, self.min), self.max))


def _even_in_log(far: float, size: float, share: float) -> float:
    """Return the distance at a share in [0, 1] of the way, in the logarithm, from a hundredth of the size to `far`."""
    near = 0.01 * size
    return near * (max(far, size) / near) ** share


def starting_points(
    spread: Sequence[FitParameter], others: Sequence[FitParameter], count: int, seed: int | Sequence[int]
) -> list[Array]:
    """Return `count` points, (p,) each, of a seeded Latin hypercube.

    spread: unknowns spread over their bounds (even in the logarithm where scaled so). others: unknowns that keep their own
    start, as nuisances do: they are small by nature, and far off they only lead a run astray.
    """
    if count < 1:
        return []
    from scipy.stats import qmc

    kept = [u.start for u in others]
    shares = qmc.LatinHypercube(d=len(spread), seed=np.random.default_rng(seed)).random(count)
    return [np.array([*(u.draw(float(s)) for u, s in zip(spread, row, strict=True)), *kept]) for row in shares]


@dataclass(frozen=True, eq=False)
class Coordinates:
    """The scaled coordinates x of some unknowns: x = ln(theta) or theta/span, of order 1 each."""

    unknowns: tuple[FitParameter, ...]

    @cached_property
    def log(self) -> Array:
        """True for each coordinate that is a logarithm, (p,)."""
        return np.array([u.log for u in self.unknowns], dtype=bool)

    @cached_property
    def span(self) -> Array:
        """Length of a coordinate's unit, (p,), where it is not a logarithm, in the unknown's unit."""
        return np.array([u.span for u in self.unknowns])

    @cached_property
    def ranges(self) -> Array:
        """Distance of the bounds in scaled coordinates, (p,); 1 where a bound is infinite."""
        return np.array([np.log(u.drawn[1] / u.drawn[0]) if u.log else 1.0 for u in self.unknowns])

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Bounds in scaled coordinates, (p,) and (p,)."""
        low, high = self._limits
        return self.scaled(low), self.scaled(high)

    @cached_property
    def _limits(self) -> tuple[Array, Array]:
        """Bounds in the unknowns' units, (p,) and (p,)."""
        return np.array([u.min for u in self.unknowns]), np.array([u.max for u in self.unknowns])

    def scaled(self, theta: Array) -> Array:
        """Return x of theta, (p,)."""
        return np.where(self.log, np.log(np.where(self.log, theta, 1.0)), theta / self.span)

    def unscaled(self, x: Array) -> Array:
        """Return theta of x, (p,), inside the bounds to the last digit."""
        theta = np.where(self.log, np.exp(np.where(self.log, np.minimum(x, LARGEST_LOG), 0.0)), x * self.span)
        low, high = self._limits
        x_low, x_high = self.bounds
        with np.errstate(invalid="ignore"):
            theta = np.where(x <= x_low + 1e-14 * (1.0 + np.abs(x_low)), low, theta)
            theta = np.where(x >= x_high - 1e-14 * (1.0 + np.abs(x_high)), high, theta)
        return np.clip(theta, low, high)

    def slope(self, theta: Array) -> Array:
        """Return dtheta/dx, (p,)."""
        return np.where(self.log, theta, self.span)
