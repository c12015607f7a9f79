"""How well parameters are determined together, by an information matrix in scaled coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.sensitivity import independent

HOPELESS = 1e3
"""A half-width of more than so many units of the scaled coordinate is no knowledge."""


@dataclass(frozen=True)
class Merit:
    """seen: how many directions. smallest: eigenvalue of those. determinant: log of the product of their eigenvalues."""

    seen: int
    smallest: float
    determinant: float


def merit(matrix: Array, error: float) -> Merit:
    """The merit of a (p, p) matrix whose columns are known to a relative error."""
    values = np.linalg.eigvalsh(matrix)
    seen = values[values > error**2 * max(values[-1], 1e-300)]
    if not seen.size:
        return Merit(0, 0.0, -np.inf)
    return Merit(int(seen.size), float(seen[0]), float(np.log(seen).sum()))


def half_widths(matrix: Array, reach: Array, names: Sequence[str], error: float) -> FrozenMap[float | None]:
    """Half the first-order 95 % interval by parameter; None where it is not determined.

    Where only combinations are seen, as few as possible are taken as known, and those have None. reach: (p,) half-width
    of a scaled coordinate whose standard deviation is 1, in the parameter's unit.
    """
    kept = sorted(independent(matrix, error))
    found: dict[str, float | None] = dict.fromkeys(names)
    if kept:
        part = matrix[np.ix_(kept, kept)]
        d = np.sqrt(np.diag(part))
        std = np.sqrt(np.diag(np.linalg.inv(part / np.outer(d, d)))) / d
        for i, s in zip(kept, std.tolist(), strict=True):
            if s <= HOPELESS:
                found[names[i]] = s * float(reach[i])
    return FrozenMap(found)
