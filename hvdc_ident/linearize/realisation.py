"""Minimal realisations: the part of a linear model that its inputs reach and its outputs see, and what is hidden."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.system import Array

TOLERANCE = 1e-10


def staircase(a: Array, b: Array, tolerance: float = TOLERANCE) -> tuple[Array, int]:
    """Return (orthogonal basis, k): its first k columns span what the inputs reach."""
    n = a.shape[0]
    basis, at, reached = np.eye(n), a.copy(), 0
    block, size = b.copy(), max(float(np.linalg.norm(b)), 1e-300)
    while reached < n and block.size:
        u, values, _ = np.linalg.svd(block)
        r = int((values > tolerance * size).sum())
        if r == 0:
            break
        turn = scipy.linalg.block_diag(np.eye(reached), u)
        basis, at = basis @ turn, turn.T @ at @ turn
        block = at[reached + r :, reached : reached + r]
        size = max(float(np.linalg.norm(a)), 1e-300)
        reached += r
    return basis, reached


def kalman(
    a: Array, b: Array, c: Array, tolerance: float = TOLERANCE
) -> tuple[tuple[Array, Array, Array], tuple[Array, Array]]:
    """Return A, B, C of the controllable and observable part, and the uncontrollable and unobservable eigenvalues."""
    hidden = []
    for transposed in (False, True):
        basis, k = staircase(a.T if transposed else a, c.T if transposed else b, tolerance)
        if k == a.shape[0]:  # nothing is hidden: the model's own states keep the digits that a basis would mix
            hidden.append(np.zeros(0))
            continue
        hidden.append(np.linalg.eigvals((basis.T @ a @ basis)[k:, k:]))
        keep = basis[:, :k]
        a, b, c = keep.T @ a @ keep, keep.T @ b, c @ keep
    return (a, b, c), (hidden[0], hidden[1])


def uncontrollable_unobservable(a: Array, b: Array, c: Array) -> Array:
    """Return the eigenvalues of the modes that no input reaches or no output sees, by orthogonal staircases."""
    return np.concatenate(kalman(*scaled_states(a, b, c))[1]).astype(complex)


def scaled_states(a: Array, b: Array, c: Array) -> tuple[Array, Array, Array]:
    """Return the system with states scaled by powers of two so that rows and columns of A are alike."""
    if a.shape[0] == 0:
        return a, b, c
    _, (scale, _) = scipy.linalg.matrix_balance(a, permute=False, separate=True)
    return a * scale[None, :] / scale[:, None], b / scale[:, None], c * scale[None, :]


def without_sliding_means(model: LinearModel) -> tuple[Array, Array, Array, Array]:
    """Return A, B, C, D without the zero eigenvalues that a Pade approximant leaves where a sliding mean stands.

    y' = (u - u(t - T))/T has no pole at 0; with the delay approximated it has one that no input reaches: what it keeps
    is the difference between y and the mean, which is 0 for ever. Models without delays are left as they are.
    """
    a, b, c, d = model.standard()
    if model.exact is None or a.shape[0] == 0:
        return a, b, c, d
    a, b, c = scaled_states(a, b, c)
    rows = scipy.linalg.null_space(a.T, rcond=1e-13).T
    if rows.shape[0] == 0:
        return a, b, c, d
    # Within the left null space, the combinations that no input drives.
    driven = rows @ b
    u, sizes, _ = np.linalg.svd(driven, full_matrices=True)
    rank = int((sizes > 1e-9 * max(float(np.linalg.norm(b)), 1e-300)).sum())
    free = u[:, rank:].T @ rows
    if free.shape[0] == 0:
        return a, b, c, d
    keep = scipy.linalg.null_space(free)
    return keep.T @ a @ keep, keep.T @ b, c @ keep, d


def on_axis(poles: Array, a: Array) -> Array:
    """Return a mask of the eigenvalues of a matrix that lie on the imaginary axis, as far as rounding errors tell.

    Eigenvalues computed in floating point are those of a matrix within n eps |A|, which moves a simple one by about so
    much; 1e-9 of its size stands for worse conditioned ones.
    """
    size = float(np.linalg.norm(a, 2)) if a.size else 0.0
    return np.asarray(np.abs(poles.real) <= 1e-9 * np.abs(poles) + 10 * len(poles) * np.finfo(float).eps * size)


def visible(model: LinearModel) -> tuple[Array, Array, Array, Array]:
    """Return A, B, C, D of the part that inputs reach and outputs see, the transfer function's, be the rest stable or not."""
    a, b, c, d = without_sliding_means(model)
    return *kalman(*scaled_states(a, b, c))[0], d
