"""Linear models with an algebraic part that stays: E x' = A x + B u with a singular E."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
import scipy.linalg

from hvdc_ident.linearize.delays import EPS, Channel
from hvdc_ident.linearize.stability import Change, Roots, counted_eigenvalues, first_roots
from hvdc_ident.linearize.system import Array


@dataclass(frozen=True, eq=False)
class Descriptor:
    """The equation of a descriptor, with what `stability.Characteristic` offers of one without: E s x = matrix x + given u."""

    matrix: Array
    e: Array
    given: Array
    read: Array
    through: Array
    channels: ClassVar[tuple[Channel, ...]] = ()

    def response(self, s: Array) -> Array:
        """Return (frequencies, outputs, inputs) transfer matrix at complex frequencies s, rad/s."""
        return np.asarray(self.through + self.read @ np.linalg.solve(*self.pencil(s)))

    def pencil(self, s: Array) -> tuple[Array, Array]:
        """Return s E - A and what the inputs add to its rows, (frequencies, rows, inputs)."""
        drive = np.broadcast_to(self.given.astype(complex), (s.size, *self.given.shape))
        return s[:, None, None] * self.e - self.matrix, drive

    def pencil_by_s(self, s: Array) -> tuple[Array, float]:
        """Return the derivatives of both by s."""
        return np.broadcast_to(self.e, (s.size, *self.e.shape)), 0.0

    def pencil_along(self, s: Array, change: Change) -> tuple[Array, Array]:
        """Return the derivatives of both by a parameter, the same at all frequencies."""
        return -change.matrix, change.given

    @cached_property
    def roots(self) -> Roots:
        """The finite eigenvalues, rad/s."""
        alpha, beta = scipy.linalg.eigvals(self.matrix, self.e, homogeneous_eigvals=True)
        largest = np.maximum(np.maximum(np.abs(alpha), np.abs(beta)), 1e-300)
        finite = np.abs(beta) > 1e-12 * largest
        values = np.asarray(alpha[finite] / beta[finite], dtype=complex)
        off = np.full(values.size, 10.0 * len(self.e) * EPS * float(np.abs(values).max(initial=0.0)))
        roots = counted_eigenvalues(values, off)
        return replace(roots, values=first_roots([roots.values], None))
