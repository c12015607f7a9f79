"""Elimination of algebraic unknowns, and delays and sampled blocks of a linear model: Pade approximants and exact responses.

`DelayFreePart` is a linear model before its delays are approximated, from which the exact frequency response is computed;
`Blocks` is the matrix over states, inputs and unknowns in which Pade states stand for the delays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
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
    """Return the Jacobian's rows [x', outputs, delayed, eliminated] and columns, the closed delays among the eliminated."""
    open_ = [k for k in range(size.ne) if k not in closed]
    rows = [
        *range(size.nx),
        *range(size.n + size.ne, size.main),
        *(size.n + k for k in (*open_, *closed)),
        *range(size.nx, size.n),
    ]
    columns = [
        *range(size.nx),
        *(size.n + k for k in inputs),
        *(size.n + size.nu + k for k in (*open_, *closed)),
        *range(size.nx, size.n),
    ]
    return rows, columns


def _core(size: Layout, jac: Array, inputs: list[int], closed: Sequence[int]) -> SchurComplement:
    """Return the Jacobian over [x, inputs, delays' outputs], unknowns and delays of 0 s eliminated."""
    rows, columns = _order(size, inputs, closed)
    jac = jac.copy()
    for k in closed:  # the delayed signal is the signal itself
        jac[size.n + k, size.n + size.nu + k] -= 1.0
    count = size.ne - len(closed)
    return eliminate(jac[np.ix_(rows, columns)], size.nx + size.no + count, size.nx + len(inputs) + count)


@dataclass(frozen=True, eq=False)
class DelayFreePart:
    """matrix: rows [x', outputs, delayed], columns [x, inputs, delays' outputs], unknowns eliminated."""

    matrix: Array
    nx: int
    no: int
    nu: int
    channels: tuple[Channel, ...]

    @classmethod
    def of(
        cls, size: Layout, jac: Array, inputs: list[int], found: tuple[Channel, ...], closed: Sequence[int] = ()
    ) -> DelayFreePart:
        """Return the core of a Jacobian (main rows, columns). closed: delays of 0 s by their place, which are none."""
        reduced = _core(size, jac, inputs, closed)
        if not np.isfinite(reduced.condition):
            raise LinearizationError("the algebraic part is singular", got="no solution for its unknowns")
        kept = tuple(c for k, c in enumerate(found) if k not in closed)
        return cls(reduced.result, size.nx, size.no, len(inputs), kept)

    @staticmethod
    def derivative(size: Layout, jac: Array, djac: Array, inputs: list[int], closed: Sequence[int] = ()) -> Array:
        """Return (directions, ...) the derivative of the core's matrix. closed: as in `of`."""
        rows, columns = _order(size, inputs, closed)
        count = size.ne - len(closed)
        r, c = size.nx + size.no + count, size.nx + len(inputs) + count
        d = djac[:, np.array(rows)[:, None], columns]
        return _core(size, jac, inputs, closed).derivative(d[:, :r, :c], d[:, :r, c:], d[:, r:, :c], d[:, r:, c:])

    def without_zero_delays(self) -> DelayFreePart:
        """Return the core in which what a delay of 0 s gives is what it gets. Raises LinearizationError for a loop of gain 1."""
        closed = [k for k, c in enumerate(self.channels) if c.total == 0.0]
        if not closed:
            return self
        kept = [k for k in range(len(self.channels)) if k not in closed]
        r, c = self.nx + self.no, self.nx + self.nu
        matrix = self.matrix.copy()
        matrix[[r + k for k in closed], [c + k for k in closed]] -= 1.0
        rows = [*range(r), *(r + k for k in (*kept, *closed))]
        columns = [*range(c), *(c + k for k in (*kept, *closed))]
        reduced = eliminate(matrix[np.ix_(rows, columns)], r + len(kept), c + len(kept))
        if not np.isfinite(reduced.condition):
            raise LinearizationError("the loop through a delay of 0 s is singular", got="no solution for its signals")
        return replace(self, matrix=reduced.result, channels=tuple(self.channels[k] for k in kept))

    def response(self, s: Array) -> Array:
        """Return (frequencies, outputs, inputs) exact transfer matrix at complex frequencies s, rad/s."""
        try:
            return self._solve(s)
        except LinearizationError:
            if not (s == 0).any():
                raise
        # A sliding mean is 0/0 at s = 0: the even part of the response beside it is its limit there, to 1e-10.
        beside = 1e-5j / (max(c.total for c in self.channels) or 1.0)
        found = self._solve(np.where(s == 0, beside, s))
        found[s == 0] = found[s == 0].real
        return found

    def response_along(self, s: Array, change: Array, times: tuple[Array, ...]) -> Array:
        """Return the derivative of the response for a derivative of the matrix and of each channel's times."""
        slopes = np.zeros((len(self.channels), s.size), dtype=complex)
        for i, c in enumerate(self.channels):
            by_time, by_compute = response_slopes(c.kind, c.time, c.compute, s)
            slopes[i] = by_time * times[i][0] + (by_compute * times[i][1] if len(times[i]) > 1 else 0.0)
        return self._solve(s, (change, slopes, 0.0))

    def response_by_s(self, s: Array) -> Array:
        """Return the derivative of the response by s."""
        slopes = [response_by_s(c.kind, c.time, c.compute, s) for c in self.channels]
        return self._solve(s, (np.zeros_like(self.matrix), np.array(slopes), 1.0))

    def _solve(self, s: Array, along: tuple[Array, Array, float] | None = None) -> Array:
        """Return the response, or its derivative along a change of the matrix, of each delay's factor, and of s."""
        n, o, u, e = self.nx, self.no, self.nu, len(self.channels)
        m = self.matrix
        exact = np.array([response(c.kind, c.time, c.compute, s) for c in self.channels])  # (e, f)
        k = s.size
        x, inp, fed = slice(0, n), slice(n, n + u), slice(n + u, n + u + e)
        out, src = slice(n, n + o), slice(n + o, n + o + e)
        unknown = np.zeros((k, n + e, n + e), dtype=complex)
        unknown[:, :n, :n] = m[x, x] - s[:, None, None] * np.eye(n)
        unknown[:, :n, n:] = m[x, fed]
        factor = exact.T[:, :, None]
        unknown[:, n:, :n] = factor * m[src, x]
        unknown[:, n:, n:] = factor * m[src, fed] - np.eye(e)
        given = np.concatenate([np.broadcast_to(m[x, inp], (k, n, u)), factor * m[src, inp]], axis=1)
        read = np.concatenate([m[out, x], m[out, fed]], axis=1)
        try:
            right = np.linalg.solve(unknown, given)
        except np.linalg.LinAlgError:
            raise LinearizationError("a frequency lies exactly on a pole", hint="leave this frequency out") from None
        if along is None:
            return np.asarray(m[out, inp] - read @ right)
        change, slopes, by_s = along
        dfactor = slopes.T[:, :, None]
        d_unknown = np.zeros_like(unknown)
        d_unknown[:, :n, :n], d_unknown[:, :n, n:] = change[x, x] - by_s * np.eye(n), change[x, fed]
        d_unknown[:, n:, :n] = factor * change[src, x] + dfactor * m[src, x]
        d_unknown[:, n:, n:] = factor * change[src, fed] + dfactor * m[src, fed]
        d_given = np.concatenate(
            [np.broadcast_to(change[x, inp], (k, n, u)), factor * change[src, inp] + dfactor * m[src, inp]], axis=1
        )
        d_read = np.concatenate([change[out, x], change[out, fed]], axis=1)
        d_right = np.linalg.solve(unknown, d_given - d_unknown @ right)
        return np.asarray(change[out, inp] - d_read @ right - read @ d_right)


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
