"""Invariant zeros of a state space.

They come from the system matrix, scaled, never from polynomials; those of python-control 0.10.2 with Slycot 0.7.1 are off by more than
1e-6 on 36 of 100 badly scaled systems (`benchmarks/linear_library.py`).
"""

from __future__ import annotations

import numpy as np
import scipy.linalg

from hvdc_ident.linearize.system import Array

RANK = 1e-11
"""Singular values below this share of the largest count as 0 when ranks are decided."""


def zeros(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Return the finite invariant zeros, complex, rad/s: infinite ones are deflated by orthogonal steps beforehand.

    Emami-Naeini and Van Dooren 1982 (doi 10.1016/0005-1098(82)90070-X): rank decisions on a balanced system, then a
    generalised eigenproblem. A system without any path from input to output has none by this definition.
    """
    if a.shape[0] == 0 or b.shape[1] == 0 or c.shape[0] == 0:
        return np.zeros(0, dtype=complex)
    a, b, c, d = _balanced(a, b, c, d)
    a, b, c, d = _deflate(a, b, c, d)
    a, b, c, d = _deflate(a.T, c.T, b.T, d.T)
    n, m = a.shape[0], d.shape[1]
    if n == 0 or m == 0 or d.shape[0] != m:
        return np.zeros(0, dtype=complex)
    # Compress the columns of [C D]: what remains is a square pencil of the zeros alone.
    q = scipy.linalg.qr(np.concatenate([d, c], axis=1).T[::-1], mode="full")[0]
    stacked = np.concatenate([b, a], axis=1)
    basis = q[::-1][:, m:]
    left = stacked @ basis
    right = np.concatenate([np.zeros((n, m)), np.eye(n)], axis=1) @ basis
    alpha, beta = scipy.linalg.eig(left, right, right=False, homogeneous_eigvals=True)
    keep = np.abs(beta) > 1e-13 * np.maximum(np.abs(alpha), 1.0)
    return np.asarray(alpha[keep] / beta[keep], dtype=complex)


def _balanced(a: Array, b: Array, c: Array, d: Array) -> tuple[Array, Array, Array, Array]:
    """Return the system with states, inputs and outputs scaled so that rows and columns are alike in size."""
    n, m, o = a.shape[0], b.shape[1], c.shape[0]
    whole = np.block([[a, b], [c, d]])
    t, rows, columns = np.ones(n), np.ones(o), np.ones(m)
    for _ in range(8):
        for k in range(n):
            row = np.abs(np.delete(whole[k], k)).sum()
            column = np.abs(np.delete(whole[:, k], k)).sum()
            if row > 0 and column > 0:
                factor = 2.0 ** round(np.log2(np.sqrt(column / row)))
                whole[k] *= factor
                whole[:, k] /= factor
                t[k] /= factor
        for k in range(m):
            size = np.abs(whole[:, n + k]).max()
            if size > 0:
                factor = 2.0 ** round(np.log2(size))
                whole[:, n + k] /= factor
                columns[k] *= factor
        for k in range(o):
            size = np.abs(whole[n + k]).max()
            if size > 0:
                factor = 2.0 ** round(np.log2(size))
                whole[n + k] /= factor
                rows[k] *= factor
    return whole[:n, :n], whole[:n, n:], whole[n:, :n], whole[n:, n:]


def _rank(values: Array, scale: float) -> int:
    return int((values > RANK * scale).sum())


def _deflate(a: Array, b: Array, c: Array, d: Array) -> tuple[Array, Array, Array, Array]:
    """Return the system with D of full row rank and the same zeros."""
    while True:
        n, o = a.shape[0], c.shape[0]
        scale = max(float(np.abs(np.block([[b], [d]])).max(initial=0.0)), 1e-300) if d.size else 1.0
        if o == 0 or n == 0:
            return a, b, c, d
        u, values, _ = np.linalg.svd(d) if d.shape[1] else (np.eye(o), np.zeros(0), None)
        r = _rank(values, scale)
        if r == o:
            return a, b, c, d
        c, d = u.T @ c, u.T @ d
        c_low = c[r:]
        v = np.linalg.svd(c_low)
        k = _rank(v[1], max(float(np.abs(c).max(initial=0.0)), float(np.abs(a).max(initial=0.0)) * 1e-3, 1e-300))
        if k == 0:
            return a, b, c[:r], d[:r]
        # The first n - k columns span the null space of the low part of C.
        basis = np.concatenate([v[2].T[:, k:], v[2].T[:, :k]], axis=1)
        at, bt, ct = basis.T @ a @ basis, basis.T @ b, c @ basis
        keep = n - k
        a = at[:keep, :keep]
        c = np.concatenate([ct[:r, :keep], at[keep:, :keep]])
        b, d = bt[:keep], np.concatenate([d[:r], bt[keep:]])
