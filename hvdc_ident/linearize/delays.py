"""Elimination of algebraic unknowns, and delays and sampled blocks of a linear model: Pade approximants and exact responses.

`without_unknowns` is a linear model before its delays are approximated, from which its exact characteristic equation is made;
`Blocks` is the matrix over states, inputs and unknowns in which Pade states stand for the delays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import factorial

import numpy as np

from hvdc_ident.errors import LinearizationError
from hvdc_ident.linearize.system import Array, CompiledSystem, Layout
from hvdc_ident.model import Model


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
    """Return the Schur complement that removes the rows and columns after the given counts.

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
    right = np.linalg.solve(d, c)
    return SchurComplement(a - b @ right, condition, b @ inverse, right)


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
    found = [Channel(n, "delay", float(times[k]), 0.0, (k,), np.ones(1)) for k, n in enumerate(model.delays)]
    for k, n in enumerate(model.sampled):
        places = (nd + k, nd + nq + k)
        found.append(
            Channel(n, "sampled", float(times[nd + k]), float(times[nd + nq + k]), places, np.array([0.5, 1.0]))
        )
    return tuple(found)


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


class Blocks:
    """Matrix that is reduced to a linear model, and the places of its rows and columns.

    Rows and columns: states, Pade states, inputs or outputs, unknowns, delayed values.
    """

    def __init__(self, s: CompiledSystem, found: tuple[Channel, ...], order: int) -> None:
        self.size, self.channels, self.order = s.layout, found, order
        self.pade = pade(order) if found else (np.zeros((0, 0)), np.zeros(0), np.zeros(0), 0.0)
        self.closed = tuple(k for k, c in enumerate(found) if c.total == 0.0)
        self.approximated = tuple(k for k, c in enumerate(found) if c.total > 0.0)
        self.n_pade = order * len(self.approximated)
        self.n = self.size.nx + self.n_pade
        self.rows, self.columns = self.n + self.size.no, self.n + self.size.nu

    def spread(self, jac: Array) -> Array:
        """Return the Jacobian's rows f, outputs, g and columns [x, Pade, u, z, e] in place; Pade and delay rows are 0."""
        z, k = self.size, self.n_pade
        total = np.zeros((*jac.shape[:-2], z.nx + k + z.no + z.nz + z.ne, z.nx + k + z.nu + z.nz + z.ne))
        rows = [*range(z.nx), *range(z.n + z.ne, z.main), *range(z.nx, z.n)]
        to_rows = [*range(z.nx), *range(self.n, self.n + z.no + z.nz)]
        columns = [*range(z.nx), *range(z.n, z.n + z.nu), *range(z.nx, z.n), *range(z.n + z.nu, z.columns)]
        to_columns = [*range(z.nx), *range(self.n, self.n + z.nu + z.nz + z.ne)]
        total[..., np.array(to_rows)[:, None], to_columns] = jac[..., np.array(rows)[:, None], columns]
        return total

    def sources(self, jac: Array) -> Array:
        """Return the rows of the delayed signals over the columns [x, Pade, u, z, e]."""
        z = self.size
        total = np.zeros((*jac.shape[:-2], z.ne, z.nx + self.n_pade + z.nu + z.nz + z.ne))
        columns = [*range(z.nx), *range(z.n, z.n + z.nu), *range(z.nx, z.n), *range(z.n + z.nu, z.columns)]
        to_columns = [*range(z.nx), *range(self.n, self.n + z.nu + z.nz + z.ne)]
        total[..., to_columns] = jac[..., z.n : z.n + z.ne, columns]
        return total

    def matrix(self, jac: Array) -> Array:
        """Return the matrix to reduce: rows [x', Pade', outputs | g, delays], columns [x, Pade, u | z, e]."""
        total = self.spread(jac)
        if self.channels:
            a, _, c, _ = self.pade
            z = self.size
            self._add_sources(total, self.sources(jac))
            for i, block in self._blocks():
                total[block, block] += a / self.channels[i].total
                total[-z.ne + i, block] += c
            for i in range(z.ne):
                total[-z.ne + i, -z.ne + i] -= 1.0
        return total

    def _blocks(self) -> list[tuple[int, slice]]:
        """Return each approximated delay or sampled block by its place, and its Pade states."""
        firsts = range(self.size.nx, self.n, self.order)
        return [(i, slice(first, first + self.order)) for i, first in zip(self.approximated, firsts, strict=True)]

    def _add_sources(self, total: Array, sources: Array) -> None:
        ends = total.shape[-2] - self.size.ne
        _, b, _, through = self.pade
        for i in self.closed:
            total[..., ends + i, :] += sources[..., i, :]
        for i, block in self._blocks():
            total[..., block, :] += b[:, None] / self.channels[i].total * sources[..., i : i + 1, :]
            total[..., ends + i, :] += through * sources[..., i, :]

    def matrix_along(self, djac: Array, jac: Array, dtime: Array) -> Array:
        """Return the derivative of `matrix`, (directions, ...); djac: of the Jacobian; dtime: (channels, directions).

        It is not a number along a delay of 0 s: -s of what is delayed is no derivative of A, B, C and D.
        """
        total = self.spread(djac)
        if self.channels:
            a, b, _, _ = self.pade
            self._add_sources(total, self.sources(djac))
            sources = self.sources(jac)
            for i, block in self._blocks():
                change = -dtime[i] / self.channels[i].total ** 2
                total[:, block, block] += change[:, None, None] * a
                total[:, block, :] += change[:, None, None] * b[:, None] * sources[i]
            total[(dtime[list(self.closed)] != 0.0).any(axis=0)] = np.nan
        return total

    def split(self, total: Array, inputs: list[int]) -> tuple[Array, Array, Array, Array]:
        """A, B, C, D of a reduced matrix for the chosen inputs."""
        n = self.n
        through = [n + k for k in inputs]
        return total[..., :n, :n], total[..., :n, through], total[..., n:, :n], total[..., n:, through]
