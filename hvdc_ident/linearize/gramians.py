"""Gramians of stable linear models, whose time constants may lie any number of decades apart."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from hvdc_ident.linearize.system import Array


def reached_gramian(a: Array, b: Array) -> Array:
    """Return the controllability Gramian P of a stable system: A P + P A' + B B' = 0.

    LAPACK's solver takes a sum of two eigenvalues below its rounding of |A| for 0 and moves it, which leaves nothing right of a state of
    1e-6 rad/s beside one of 1e12: here the triangular equations are solved column by column as they are (Bartels and Stewart 1972),
    in an order of the states that keeps what acts one way only apart. Raises LinAlgError where two eigenvalues add up to 0.
    """
    if a.shape[0] == 0:
        return np.zeros((0, 0))
    ordered, (scale, order) = scipy.linalg.matrix_balance(a, permute=True, separate=True)
    t, q = scipy.linalg.schur(ordered, output="complex")
    driven = q.conj().T @ (b[order] / scale[:, None])
    y = np.zeros_like(t)
    for j in reversed(range(len(t))):
        right = -driven @ driven[j].conj() - y[:, j + 1 :] @ t[j, j + 1 :].conj()
        y[:, j] = scipy.linalg.solve_triangular(t + t[j, j].conj() * np.eye(len(t)), right)
    gramian = np.zeros(a.shape)
    gramian[np.ix_(order, order)] = np.outer(scale, scale) * (q @ y @ q.conj().T).real
    return gramian


def seen_gramian(a: Array, c: Array) -> Array:
    """Return the observability Gramian Q of a stable system: A' Q + Q A + C' C = 0. Raises as `reached_gramian` does."""
    return reached_gramian(a.T, c.T)
