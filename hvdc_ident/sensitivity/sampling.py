"""Points of a sweep: grids, logarithmic grids, lists, Latin hypercubes, and their products, never held as tuples."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.errors import InputError, StudyError

MOST = 10_000_000


@dataclass(frozen=True, eq=False)
class Samples:
    """Points of one or several parameters that move together: values (n, k), one column a parameter, in its unit."""

    names: tuple[str, ...]
    values: Array
    kind: Literal["grid", "log", "list", "latin-hypercube"] = "list"

    def __post_init__(self) -> None:
        values = np.array(self.values, dtype=float, ndmin=2)
        values.setflags(write=False)
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "names", tuple(self.names))
        where = f"sweep of {', '.join(self.names)}"
        if values.ndim != 2 or values.shape[1] != len(self.names) or not values.size:
            expected = f"a table of {len(self.names)} columns and at least one row"
            raise StudyError("a sweep's values do not fit", where=where, expected=expected, got=f"{values.shape}")
        if not np.isfinite(values).all():
            raise StudyError("a swept value is not finite", where=where, expected="finite numbers")

    def __len__(self) -> int:
        return int(self.values.shape[0])


def grid(name: str, low: float, high: float, points: int) -> Samples:
    """Evenly spread values from low to high, both included."""
    _range(name, low, high, points)
    return Samples((name,), np.linspace(low, high, points)[:, None], "grid")


def log_grid(name: str, low: float, high: float, points: int) -> Samples:
    """Values from low to high, both included, each the same factor above the last; low is above 0."""
    _range(name, low, high, points)
    if not low > 0:
        raise StudyError("a log scale needs a range above 0", where=f"sweep of {name}", got=f"{low:g}")
    values = np.geomspace(low, high, points)
    values[[0, -1]] = low, high
    return Samples((name,), values[:, None], "log")


def listed(name: str, values: Iterable[float]) -> Samples:
    """The values as they are listed."""
    return Samples((name,), np.array([float(v) for v in values])[:, None], "list")


def latin_hypercube(
    bounds: Mapping[str, tuple[float, float]], points: int, *, seed: int = 0, log: Sequence[str] = ()
) -> Samples:
    """Random points of which each parameter has exactly one in each of as many equal slices of its range.

    log: parameters whose slices are equal in their logarithm. The same seed gives the same points.
    """
    random = np.random.default_rng(seed)
    columns = []
    for name, (low, high) in bounds.items():
        _range(name, low, high, points)
        share = (random.permutation(points) + random.random(points)) / points
        if name in log:
            if not low > 0:
                raise StudyError("a log scale needs a range above 0", where=f"sweep of {name}", got=f"{low:g}")
            column = low * (high / low) ** share
        else:
            column = low + share * (high - low)
        columns.append(np.clip(column, low, high))
    table = np.column_stack(columns) if columns else np.empty((0, 0))
    return Samples(tuple(bounds), table, "latin-hypercube")


def _range(name: str, low: float, high: float, points: int) -> None:
    if not (np.isfinite([low, high]).all() and low < high and points >= 2):
        raise StudyError(
            "a sweep's range is wrong",
            where=f"sweep of {name}",
            expected="finite min < max and at least 2 points",
            got=f"min {low:g}, max {high:g}, {points} points",
        )


@dataclass(frozen=True, eq=False)
class Points:
    """The product of axes: the last one moves fastest. Rows are made when they are asked for."""

    axes: tuple[Samples, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "axes", tuple(self.axes))
        names = self.names
        if not names:
            raise StudyError("nothing to sweep", expected="at least one axis", hint='grid("NAME", min, max, points)')
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise StudyError(f"'{twice[0]}' is swept twice", where="sweep", expected="each parameter in one axis")
        if len(self) > MOST:
            raise StudyError(
                "the product of the sweep's axes is too large",
                where="sweep",
                expected=f"at most {MOST} points",
                got=" x ".join(str(len(a)) for a in self.axes),
                hint="fewer points an axis, or a Latin hypercube",
            )

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The parameters, in the order of the columns."""
        return tuple(n for a in self.axes for n in a.names)

    @property
    def shape(self) -> tuple[int, ...]:
        """The number of values on each axis."""
        return tuple(len(a) for a in self.axes)

    def __len__(self) -> int:
        count = 1
        for axis in self.axes:
            count *= len(axis)
        return count

    def rows(self, start: int, stop: int) -> Array:
        """(stop - start, parameters): the points from start up to stop."""
        places = np.unravel_index(np.arange(start, min(stop, len(self))), self.shape)
        return np.column_stack([a.values[i] for a, i in zip(self.axes, places, strict=True)])


AxesLike = Samples | Sequence[Samples] | Mapping[str, Iterable[float]]


def points_of(axes: AxesLike) -> Points:
    """The points of one axis, of several, or of a mapping from names to lists of values."""
    if isinstance(axes, Samples):
        return Points((axes,))
    if isinstance(axes, Mapping):
        return Points(tuple(listed(name, values) for name, values in axes.items()))
    found = tuple(axes)
    if not all(isinstance(a, Samples) for a in found):
        raise InputError(
            "an axis of a sweep is none", expected="grid, log_grid, listed or latin_hypercube", got=str(found)[:80]
        )
    return Points(found)
