"""Elimination of algebraic unknowns, and delays and sampled blocks of a linear model: Pade approximants and exact responses.

`without_unknowns` gives a linear model before its delays are approximated, from which its exact characteristic equation is made;
`Approximants` put Pade states in the place of the delays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import factorial

import numpy as np

from hvdc_ident.errors import LinearizationError
from hvdc_ident.linearize.system import Array, CompiledSystem, Layout
from hvdc_ident.model import Model

EPS = float(np.finfo(float).eps)


@dataclass(frozen=True, eq=False)
class SchurComplement:
    """result = a - b d^-1 c. condition: of d, its rows and columns scaled; left = b d^-1, right = d^-1 c."""

    result: Array
    condition: float
    left: Array
    right: Array

    def derivative(self, da: Array, db: Array, dc: Array, dd: Array) -> Array:
        """Return the derivative of the result for derivatives of the blocks; blocks may have leading axes."""
        return np.asarray(da - db @ self.right - self.left @ dc + self.left @ dd @ self.right)


def eliminate(matrix: Array, rows: int, columns: int) -> SchurComplement:
    """Return the Schur complement that removes the rows and columns after the given counts; what rounding leaves of a 0 in it is 0.

    An entry no larger than the rounding of the terms that it is the sum of may be of either sign: a state that its unknowns only seem
    to act back on would be a slow, perhaps a growing one. (Error of a product and of a solution with d, entry by entry: Higham,
    Accuracy and Stability of Numerical Algorithms, 3.5 and 7.2.)
    A singular block gives the condition infinity and a result that must not be used.
    """
    a, b, c, d = matrix[:rows, :columns], matrix[:rows, columns:], matrix[rows:, :columns], matrix[rows:, columns:]
    if d.shape[0] == 0:
        return SchurComplement(a, 1.0, b, c)
    size_r = np.abs(d).max(axis=1)
    if not (size_r > 0).all() or not np.isfinite(matrix).all():
        return SchurComplement(a, np.inf, b, c)
    scaled = d / size_r[:, None]
    size_c = np.abs(scaled).max(axis=0)
    if not (size_c > 0).all():
        return SchurComplement(a, np.inf, b, c)
    condition = float(np.linalg.cond(scaled / size_c))
    if not np.isfinite(condition) or condition > 1e15:
        return SchurComplement(a, np.inf, b, c)
    inverse = np.linalg.inv(scaled / size_c) / size_c[:, None] / size_r[None, :]
    right, left = np.linalg.solve(d, c), b @ inverse
    result = a - b @ right
    terms = np.abs(a) + np.abs(b) @ np.abs(right) + np.abs(left) @ (np.abs(c) + np.abs(d) @ np.abs(right))
    rounding = (1 + d.shape[0]) * EPS * terms
    return SchurComplement(np.where(np.abs(result) <= rounding, 0.0, result), condition, left, right)


MAX_ORDER = 12


def pade(order: int) -> tuple[Array, Array, Array, float]:
    """Return (A, B, C, D) of the diagonal Pade approximant of exp(-s), scaled so that all entries are of the size of 1 to 30.

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
    """Return the exact transfer of a delay, exp(-s T), or of a sampled block: hold over one period, then the compute time.

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
    """Return the derivatives of `response` by its time (period) and by the compute time."""
    value = response(kind, time, compute, s)
    if kind == "delay":
        return -s * value, np.zeros_like(value)
    return np.asarray(s * _hold_slope(s * time) * np.exp(-s * compute)), np.asarray(-s * value)


def response_by_s(kind: str, time: float, compute: float, s: Array) -> Array:
    """Return the derivative of `response` by s."""
    value = response(kind, time, compute, s)
    if kind == "delay":
        return -time * value
    return np.asarray(time * _hold_slope(s * time) * np.exp(-s * compute) - compute * value)


def _hold_slope(x: Array) -> Array:
    """Return the derivative of (1 - exp(-x))/x."""
    small = np.abs(x) < 1e-4
    return np.asarray(np.where(small, -0.5 + x / 3, (np.exp(-x) * (1.0 + x) - 1.0) / np.where(small, 1.0, x * x)))


@dataclass(frozen=True, eq=False)
class Channel:
    """One delay or sampled block. time: delay or period, s; compute: s. total: the delay its Pade approximant has, s.

    places: of its times among all the model's times; weights: what each adds to the total.
    """

    name: str
    kind: str
    time: float
    compute: float
    places: tuple[int, ...]
    weights: Array

    @property
    def total(self) -> float:
        """T of a delay; half a period (the hold) and the compute time of a sampled block, s."""
        return self.time if self.kind == "delay" else 0.5 * self.time + self.compute


def channels(model: Model, s: CompiledSystem, p: Array) -> tuple[Channel, ...]:
    """Every delay and sampled block with its times at parameters p."""
    times = s.timing(p)
    nd, nq = len(model.delays), len(model.sampled)
    every = [Channel(n, "delay", float(times[k]), 0.0, (k,), np.ones(1)) for k, n in enumerate(model.delays)]
    for k, n in enumerate(model.sampled):
        places = (nd + k, nd + nq + k)
        every.append(
            Channel(n, "sampled", float(times[nd + k]), float(times[nd + nq + k]), places, np.array([0.5, 1.0]))
        )
    return tuple(every)


def _order(size: Layout, inputs: list[int], closed: Sequence[int]) -> tuple[list[int], list[int]]:
    """Return the Jacobian's rows [x', delayed, outputs, eliminated] and columns, the closed delays among the eliminated."""
    open_ = [k for k in range(size.ne) if k not in closed]
    rows = [
        *range(size.nx),
        *(size.n + k for k in open_),
        *range(size.n + size.ne, size.main),
        *(size.n + k for k in closed),
        *range(size.nx, size.n),
    ]
    columns = [
        *range(size.nx),
        *(size.n + size.nu + k for k in open_),
        *(size.n + k for k in inputs),
        *(size.n + size.nu + k for k in closed),
        *range(size.nx, size.n),
    ]
    return rows, columns


def without_unknowns(size: Layout, jac: Array, inputs: list[int], closed: Sequence[int]) -> SchurComplement:
    """Return the Jacobian over rows [x', delayed, outputs] and columns [x, delays' outputs, inputs], unknowns eliminated.

    closed: delays of 0 s by their place, which are none.
    """
    rows, columns = _order(size, inputs, closed)
    jac = jac.copy()
    for k in closed:  # the delayed signal is the signal itself
        jac[size.n + k, size.n + size.nu + k] -= 1.0
    count = size.nx + size.ne - len(closed)
    return eliminate(jac[np.ix_(rows, columns)], count + size.no, count + len(inputs))


def without_unknowns_along(size: Layout, jac: Array, djac: Array, inputs: list[int], closed: Sequence[int]) -> Array:
    """Return (directions, ...) the derivative of the result of `without_unknowns` for derivatives of the Jacobian."""
    rows, columns = _order(size, inputs, closed)
    count = size.nx + size.ne - len(closed)
    r, c = count + size.no, count + len(inputs)
    d = djac[:, np.array(rows)[:, None], columns]
    reduced = without_unknowns(size, jac, inputs, closed)
    return reduced.derivative(d[:, :r, :c], d[:, :r, c:], d[:, r:, :c], d[:, r:, c:])


@dataclass(frozen=True, eq=False)
class Approximants:
    """Pade approximants of delays and sampled blocks: q' = a q + b w and v = c q + d w for their inputs w and outputs v.

    A delay of 0 s has no state: what it gives is what it gets.
    """

    a: Array
    b: Array
    c: Array
    d: Array
    channels: tuple[Channel, ...]
    order: int

    @classmethod
    def of(cls, channels: tuple[Channel, ...], order: int) -> Approximants:
        """Return the approximants of one order. Raises LinearizationError for an order that there is not."""
        a, b, c, through = pade(order) if channels else (np.zeros((0, 0)), np.zeros(0), np.zeros(0), 0.0)
        late = [k for k, ch in enumerate(channels) if ch.total > 0.0]
        times = np.array([channels[k].total for k in late])
        pick = np.eye(len(channels))[late]  # the delays with states, of all
        return cls(
            np.kron(np.diag(1.0 / times), a),
            np.kron(pick / times[:, None], b[:, None]),
            np.kron(pick, c[:, None]).T,
            np.diag([through if ch.total > 0.0 else 1.0 for ch in channels]),
            channels,
            order,
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the states q."""
        late = (c.name for c in self.channels if c.total > 0.0)
        return tuple(f"{name}.pade{k + 1}" for name in late for k in range(self.order))

    def closed(self, matrix: Array, nx: int) -> SchurComplement:
        """Return a matrix over rows [x', w, outputs] and columns [x, v, inputs] over [x', q', outputs] and [x, q, inputs]."""
        total = self._spread(matrix, nx)
        q, ends = slice(nx, nx + len(self.a)), tuple(size - len(self.channels) for size in total.shape)
        total[q, q] += self.a
        total[q, ends[1] :] += self.b
        total[ends[0] :, ends[1] :] -= np.eye(len(self.channels))
        return eliminate(total, *ends)

    def closed_along(self, reduced: SchurComplement, change: Array, nx: int, times: Array) -> Array:
        """Return (directions, ...) the derivative of the result of `closed`.

        change: of the matrix, (directions, ...). times: (channels, directions) of the delays, s. It is not a number along a
        delay of 0 s: -s of what is delayed is no derivative of A, B, C and D.
        """
        total = self._spread(change, nx)
        q, (r, c) = slice(nx, nx + len(self.a)), (size - len(self.channels) for size in total.shape[1:])
        sizes = np.array([ch.total for ch in self.channels])
        shares = np.repeat(-times[sizes > 0.0] / sizes[sizes > 0.0, None], self.order, axis=0).T[:, :, None]
        total[:, q, q] += shares * self.a
        total[:, q, c:] += shares * self.b
        total[(times[sizes == 0.0] != 0.0).any(axis=0)] = np.nan
        return reduced.derivative(total[:, :r, :c], total[:, :r, c:], total[:, r:, :c], total[:, r:, c:])

    def _spread(self, matrix: Array, nx: int) -> Array:
        """Return the matrix over rows [x', q', outputs, w] and columns [x, q, inputs, w] with v = c q + d w; rows q' are 0."""
        end = nx + len(self.channels)
        v = matrix[..., nx:end]
        wide = np.concatenate([matrix[..., :nx], v @ self.c, matrix[..., end:], v @ self.d], axis=-1)
        none = np.zeros((*wide.shape[:-2], len(self.a), wide.shape[-1]))
        return np.concatenate([wide[..., :nx, :], none, wide[..., end:, :], wide[..., nx:end, :]], axis=-2)
