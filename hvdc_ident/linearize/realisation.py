"""Minimal realisations: the part of a linear model that its inputs reach and its outputs see, and what is hidden; differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.linalg

from hvdc_ident.errors import LinearizationError
from hvdc_ident.linearize.delays import EPS
from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.stability import Characteristic
from hvdc_ident.linearize.system import Array

TOLERANCE = 1e-10
"""Share of the largest coupling of its equation below which one counts as left over where terms cancelled: 6 digits above rounding."""


def staircase(a: Array, b: Array, uncertain: Array) -> tuple[Array, int]:
    """Return (orthogonal basis, k): its first k columns span what the inputs reach.

    uncertain: (states, states) what the entries of A may be off by. A coupling is one where it is larger than what these leave in
    its place, not where it is large beside all of A: a slow state behind a fast one is reached through an entry as small as its unit
    makes it. The units of the inputs count for nothing.
    """
    n = a.shape[0]
    sizes = np.linalg.norm(b, axis=0)
    basis, at, reached = np.eye(n), a.copy(), 0
    block, off = b / np.where(sizes > 0.0, sizes, 1.0), TOLERANCE
    while reached < n and block.size:
        u, values, _ = np.linalg.svd(block)
        r = int((values > off).sum())
        if r == 0:
            break
        turn = scipy.linalg.block_diag(np.eye(reached), u)
        basis, at = basis @ turn, turn.T @ at @ turn
        next_, done = slice(reached + r, n), slice(reached, reached + r)
        block = at[next_, done]
        off = float(np.linalg.norm(np.abs(basis[:, next_]).T @ uncertain @ np.abs(basis[:, done])))
        reached += r
    return basis, reached


def _uncertain(a: Array, tolerance: float) -> Array:
    """Return what the entries of A may be off by: a share of the largest coupling of their equation, and rounding of their own.

    A state's own rate is no coupling: it is no difference of terms that lead to others. An entry of 0 is one.
    """
    couplings = np.abs(a - np.diag(np.diag(a)))
    left_over = np.where(couplings > 0.0, tolerance * couplings.max(axis=1, initial=0.0, keepdims=True), 0.0)
    return np.asarray(left_over + 10.0 * len(a) * EPS * np.abs(a))


def kalman(
    a: Array, b: Array, c: Array, tolerance: float = TOLERANCE
) -> tuple[tuple[Array, Array, Array], tuple[Array, Array]]:
    """Return A, B, C of the controllable and observable part, and the uncontrollable and unobservable eigenvalues."""
    hidden = []
    for transposed in (False, True):
        uncertain = _uncertain(a, tolerance)
        basis, k = staircase(a.T, c.T, uncertain.T) if transposed else staircase(a, b, uncertain)
        if k == a.shape[0]:  # nothing is hidden: the model's own states keep the digits that a basis would mix
            hidden.append(np.zeros(0))
            continue
        hidden.append(np.linalg.eigvals((basis.T @ a @ basis)[k:, k:]))
        keep = basis[:, :k]
        a, b, c = keep.T @ a @ keep, keep.T @ b, c @ keep
    return (a, b, c), (hidden[0], hidden[1])


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


def visible(model: LinearModel) -> Characteristic:
    """Return the equation of what inputs reach and outputs see, the transfer function's, be the rest stable or not.

    Delays are exact, and what is hidden beside them is found by structure; a model without delays has a minimal realisation.
    """
    return approximate_visible(model) if model.exact is None else whole(model).visible()


def approximate_visible(model: LinearModel) -> Characteristic:
    """Return the minimal realisation of a model in which a delay stands as its Pade approximant."""
    a, b, c, d = without_sliding_means(model)
    return Characteristic.rational(*kalman(*scaled_states(a, b, c))[0], d, model.error)


def whole(model: LinearModel) -> Characteristic:
    """Return the equation of a model, its delays exact and its algebraic part eliminated.

    Raises LinearizationError where that is not possible.
    """
    if model.exact is not None:
        return model.exact.without_zero_delays()
    return Characteristic.rational(*model.standard(), model.error)


def same_channels(first: LinearModel, second: LinearModel) -> None:
    """Raise LinearizationError where two models differ in their number of inputs or outputs."""
    shapes = [(len(m.output_names), len(m.input_names)) for m in (first, second)]
    if shapes[0] != shapes[1]:
        raise LinearizationError(
            "the models have other inputs or outputs",
            where=f"'{first.name}' against '{second.name}'",
            expected=f"{shapes[0][0]} outputs and {shapes[0][1]} inputs",
            got=f"{shapes[1][0]} and {shapes[1][1]}",
        )


def difference(first: LinearModel, second: LinearModel) -> LinearModel:
    """Return the model first - second. Raises LinearizationError where the sizes differ."""
    same_channels(first, second)
    a1, b1, c1, d1 = without_sliding_means(first)
    a2, b2, c2, d2 = without_sliding_means(second)
    rational = first.with_matrices(
        scipy.linalg.block_diag(a1, a2) if a1.size or a2.size else np.zeros((0, 0)),
        np.concatenate([b1, b2]),
        np.concatenate([c1, -c2], axis=1),
        d1 - d2,
        point=None,
        name=f"{first.name} - {second.name}",
        error=max(first.error, second.error),
    )
    if first.exact is None and second.exact is None:
        return rational
    inputs, outputs = np.eye(len(first.input_names)), np.eye(len(first.output_names))
    both = whole(first).beside(whole(second))
    return replace(rational, exact=both.between(np.vstack([inputs, inputs]), np.hstack([outputs, -outputs])))
