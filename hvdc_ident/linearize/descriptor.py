"""Descriptor models: the algebraic part taken out, or the reason why it cannot be."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hvdc_ident.errors import LinearizationError
from hvdc_ident.linearize.arrays import Array
from hvdc_ident.linearize.schur import eliminate

if TYPE_CHECKING:
    from hvdc_ident.linearize.linear_model import LinearModel


def standard(model: LinearModel) -> tuple[Array, Array, Array, Array]:
    """A, B, C, D of a descriptor with E = diag(1, ..., 0, ...), its zero rows eliminated, or of any regular E.

    Raises LinearizationError where neither works.
    """
    e, n = model.E, model.A.shape[0]
    k = int(np.count_nonzero(np.diag(e)))
    if np.array_equal(e, np.diag([1.0] * k + [0.0] * (n - k))):
        top = np.block([[model.A[:k, :k], model.B[:k]], [model.C[:, :k], model.D]])
        right = np.concatenate([model.A[:k, k:], model.C[:, k:]])
        bottom = np.concatenate([model.A[k:, :k], model.B[k:]], axis=1)
        reduced = eliminate(
            np.block([[top, right], [bottom, model.A[k:, k:]]]), k + model.C.shape[0], k + model.B.shape[1]
        )
        if reduced.condition < 1e14:
            r = reduced.result
            return r[:k, :k], r[:k, k:], r[k:, :k], r[k:, k:]
        condition = reduced.condition
    else:
        condition = float(np.linalg.cond(e))
        if condition < 1e12:
            return np.linalg.solve(e, model.A), np.linalg.solve(e, model.B), model.C, model.D
    raise LinearizationError(
        "the algebraic part cannot be eliminated",
        where=f"linear model '{model.name}'",
        got=f"condition number {condition:.2g}",
        hint="use poles(), zeros of the pencil and the frequency response, which take E as it is",
    )
