"""Real or complex arrays, and the elimination of unknowns from block matrices with derivatives of the result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Eliminated:
    """result = a - b d^-1 c. condition: of d, its rows and columns scaled; left = b d^-1, right = d^-1 c."""

    result: Array
    condition: float
    left: Array
    right: Array

    def derivative(self, da: Array, db: Array, dc: Array, dd: Array) -> Array:
        """Return the derivative of the result for derivatives of the blocks; blocks may have leading axes."""
        return np.asarray(da - db @ self.right - self.left @ dc + self.left @ dd @ self.right)


def eliminate(matrix: Array, rows: int, columns: int) -> Eliminated:
    """Return the Schur complement that removes the rows and columns after the given counts.

    A singular block gives the condition infinity and a result that must not be used.
    """
    a, b, c, d = matrix[:rows, :columns], matrix[:rows, columns:], matrix[rows:, :columns], matrix[rows:, columns:]
    if d.shape[0] == 0:
        return Eliminated(a, 1.0, b, c)
    size_r = np.abs(d).max(axis=1)
    if not (size_r > 0).all() or not np.isfinite(matrix).all():
        return Eliminated(a, np.inf, b, c)
    scaled = d / size_r[:, None]
    size_c = np.abs(scaled).max(axis=0)
    if not (size_c > 0).all():
        return Eliminated(a, np.inf, b, c)
    condition = float(np.linalg.cond(scaled / size_c))
    if not np.isfinite(condition) or condition > 1e15:
        return Eliminated(a, np.inf, b, c)
    inverse = np.linalg.inv(scaled / size_c) / size_c[:, None] / size_r[None, :]
    right = np.linalg.solve(d, c)
    return Eliminated(a - b @ right, condition, b @ inverse, right)
