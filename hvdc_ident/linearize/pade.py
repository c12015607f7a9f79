"""Delays as rational functions: Pade approximants of exp(-sT) in state space, and their exact response."""

from __future__ import annotations

from math import factorial

import numpy as np

from hvdc_ident.errors import LinearizationError
from hvdc_ident.linearize.arrays import Array

MAX_ORDER = 12


def pade(order: int) -> tuple[Array, Array, Array, float]:
    """(A, B, C, D) of the diagonal Pade approximant of exp(-s), scaled so that all entries are of the size of 1 to 30.

    For exp(-sT) divide A and B by T. It is all-pass: gain 1 at every frequency, phase right to about `order` radians.
    Raises LinearizationError for an order outside 1 to 12. Source: Golub and Van Loan, Matrix Computations, 11.3.
    """
    if not 1 <= order <= MAX_ORDER:
        raise LinearizationError(
            "the order of a Pade approximant is out of range", expected=f"1 to {MAX_ORDER}", got=f"{order}"
        )
    n = order
    c = np.array(
        [
            factorial(2 * n - k) * factorial(n) / (factorial(2 * n) * factorial(k) * factorial(n - k))
            for k in range(n + 1)
        ]
    )
    denominator, numerator = c / c[n], c * (-1.0) ** np.arange(n + 1) / c[n]
    through = float(numerator[n])
    rest = numerator - through * denominator
    a = np.zeros((n, n))
    a[range(n - 1), range(1, n)] = 1.0
    a[n - 1] = -denominator[:n]
    b, output = np.zeros(n), rest[:n].copy()
    b[n - 1] = 1.0
    # Scale the companion form's states: powers of the typical root size make the entries alike.
    size = denominator[0] ** (1.0 / n)
    scale = size ** np.arange(n)
    a = a * scale[None, :] / scale[:, None]
    b = b / scale * scale[n - 1]
    output = output * scale / scale[n - 1]
    return a, b, output, through


def response(kind: str, time: float, compute: float, s: Array) -> Array:
    """The exact transfer of a delay, exp(-s T), or of a sampled block: hold over one period, then the compute time.

    A sampled block's aliases are left out: it is the part at the frequency of the excitation, which below half the
    sampling frequency is what matters. time, compute: s; s: complex frequencies, rad/s.
    """
    if kind == "delay":
        return np.asarray(np.exp(-s * time))
    x = s * time
    small = np.abs(x) < 1e-6
    hold = np.where(small, 1.0 - x / 2 + x * x / 6, (1.0 - np.exp(-x)) / np.where(small, 1.0, x))
    return np.asarray(hold * np.exp(-s * compute))


def response_slopes(kind: str, time: float, compute: float, s: Array) -> tuple[Array, Array]:
    """The derivatives of `response` by its time (period) and by the compute time."""
    value = response(kind, time, compute, s)
    if kind == "delay":
        return -s * value, np.zeros_like(value)
    x = s * time
    small = np.abs(x) < 1e-4
    inner = np.where(small, -0.5 + x / 3, (np.exp(-x) * (1.0 + x) - 1.0) / np.where(small, 1.0, x * x))
    return np.asarray(s * inner * np.exp(-s * compute)), np.asarray(-s * value)
