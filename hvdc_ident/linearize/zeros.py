"""Zeros from the system matrix, never from polynomials, and transfer functions as zeros, poles and gain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.linalg

from hvdc_ident.linearize.arrays import Array

if TYPE_CHECKING:
    from hvdc_ident.linearize.linear_model import LinearModel

RANK = 1e-11
"""Singular values below this share of the largest count as 0 when ranks are decided."""


def zeros(a: Array, b: Array, c: Array, d: Array) -> Array:
    """The finite invariant zeros, complex, rad/s: infinite ones are deflated by orthogonal steps beforehand.

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
    """The same system with states, inputs and outputs scaled so that rows and columns are alike in size."""
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
    """The system with D of full row rank and the same zeros."""
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


@dataclass(frozen=True, eq=False)
class TransferFunction:
    """gain * prod(s - zeros) / prod(s - poles), s in rad/s; cancelled: (pole, zero) pairs that were left out."""

    input: str
    output: str
    zeros: Array
    poles: Array
    gain: float
    cancelled: tuple[tuple[complex, complex], ...] = ()

    def __call__(self, s: complex | Array) -> Array:
        """The value at complex frequencies s."""
        s = np.asarray(s, dtype=complex)
        top = np.prod(s[..., None] - self.zeros, axis=-1)
        return np.asarray(self.gain * top / np.prod(s[..., None] - self.poles, axis=-1))

    @property
    def dc_gain(self) -> float:
        """The value at s = 0; infinite with a pole there."""
        if (self.poles == 0).any():
            return float("inf")
        return float(self(0.0).real)

    def to_dict(self) -> dict[str, Any]:
        """The transfer function as plain numbers, complex ones as [re, im]."""

        def pairs(values: Array) -> list[list[float]]:
            return [[float(v.real), float(v.imag)] for v in values]

        return {
            "input": self.input,
            "output": self.output,
            "zeros": pairs(self.zeros),
            "poles": pairs(self.poles),
            "gain": self.gain,
            "cancelled": [[[p.real, p.imag], [z.real, z.imag]] for p, z in self.cancelled],
        }


def transfer_function(model: LinearModel, input: str, output: str) -> TransferFunction:
    """Zeros, poles and gain of one channel; stable pole-zero pairs that cancel are left out and listed.

    An unstable pair is never cancelled. A channel without a path is 0: no zeros, no poles, gain 0.
    """
    from hvdc_ident.linearize.reduce import uncontrollable_unobservable

    part = model.channel(input, output)
    a, b, c, d = part.standard()
    if not _connected(a, b, c, d):
        none = np.zeros(0, dtype=complex)
        return TransferFunction(input, output, none, none, 0.0)
    all_poles, all_zeros = np.linalg.eigvals(a).astype(complex), zeros(a, b, c, d)
    hidden = uncontrollable_unobservable(a, b, c)
    kept_poles, kept_zeros, cancelled = _cancel(all_poles, all_zeros, hidden)
    gain = _gain(a, b, c, d, kept_zeros, kept_poles)
    return TransferFunction(input, output, _paired(kept_zeros), _paired(kept_poles), gain, tuple(cancelled))


def _connected(a: Array, b: Array, c: Array, d: Array) -> bool:
    if np.any(d):
        return True
    reached = np.any(b != 0, axis=1)
    for _ in range(a.shape[0]):
        reached = reached | (np.abs(a) @ reached > 0)
    return bool((np.abs(c) @ reached > 0).any())


def _cancel(poles: Array, zeros_: Array, hidden: Array) -> tuple[Array, Array, list[tuple[complex, complex]]]:
    """Poles and zeros without the pairs that stand for a hidden, stable mode."""
    left, pairs = list(zeros_), []
    kept = []
    candidates = list(hidden)
    for p in poles:
        match = min(candidates, key=lambda h: abs(h - p), default=None)
        near = min(range(len(left)), key=lambda k: abs(left[k] - p), default=None)
        close = 1e-6 * max(1.0, abs(p))
        if (
            match is not None
            and abs(match - p) < close
            and near is not None
            and abs(left[near] - p) < close
            and p.real < 0
        ):
            candidates.remove(match)
            pairs.append((complex(p), complex(left.pop(near))))
        else:
            kept.append(p)
    return np.array(kept, dtype=complex), np.array(left, dtype=complex), pairs


def _paired(values: Array) -> Array:
    """Sorted by size; rounding's imaginary parts removed."""
    values = np.where(np.abs(values.imag) < 1e-13 * np.abs(values), values.real, values)
    return np.asarray(values[np.lexsort((-values.imag, values.real, np.abs(values).round(12)))], dtype=complex)


def _gain(a: Array, b: Array, c: Array, d: Array, zeros_: Array, poles: Array) -> float:
    """The leading coefficient, from values of the transfer function at points away from every pole and zero."""
    sizes = np.abs(np.concatenate([poles, zeros_, [1.0 + 0j]]))
    typical = float(np.exp(np.log(np.maximum(sizes, 1e-3)).mean()))
    found, eye = [], np.eye(a.shape[0])
    for angle in (0.31, 0.77, 1.23):
        s = 1.7 * typical * np.exp(1j * angle)
        value = (c @ np.linalg.solve(s * eye - a, b) + d)[0, 0]
        log = np.log(value) + np.log(s - poles).sum() - np.log(s - zeros_).sum() if value != 0 else -np.inf
        found.append(float(np.exp(log).real))
    return float(np.median(found))
