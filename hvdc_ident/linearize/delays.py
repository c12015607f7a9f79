"""A linear model before its delays are approximated: what its exact frequency response is computed from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hvdc_ident.errors import LinearizationError
from hvdc_ident.linearize.arrays import Array
from hvdc_ident.linearize.pade import response, response_slopes
from hvdc_ident.linearize.schur import eliminate
from hvdc_ident.linearize.system import Layout, System
from hvdc_ident.model.definition import Model


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


def channels(model: Model, s: System, p: Array) -> tuple[Channel, ...]:
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


def _order(size: Layout, inputs: list[int]) -> tuple[list[int], list[int]]:
    rows = [
        *range(size.nx),
        *range(size.n + size.ne, size.main),
        *range(size.n, size.n + size.ne),
        *range(size.nx, size.n),
    ]
    columns = [
        *range(size.nx),
        *(size.n + k for k in inputs),
        *range(size.n + size.nu, size.columns),
        *range(size.nx, size.n),
    ]
    return rows, columns


@dataclass(frozen=True, eq=False)
class DelayFree:
    """matrix: rows [x', outputs, delayed], columns [x, inputs, delays' outputs], unknowns eliminated."""

    matrix: Array
    nx: int
    no: int
    nu: int
    channels: tuple[Channel, ...]

    @classmethod
    def of(cls, size: Layout, jac: Array, inputs: list[int], found: tuple[Channel, ...]) -> DelayFree:
        """The core of a Jacobian (main rows, columns)."""
        rows, columns = _order(size, inputs)
        n_r, n_c = size.nx + size.no + size.ne, size.nx + len(inputs) + size.ne
        reduced = eliminate(jac[np.ix_(rows, columns)], n_r, n_c)
        return cls(reduced.result, size.nx, size.no, len(inputs), found)

    @staticmethod
    def derivative(size: Layout, jac: Array, djac: Array, inputs: list[int]) -> Array:
        """(directions, ...) the derivative of the core's matrix."""
        rows, columns = _order(size, inputs)
        r, c = size.nx + size.no + size.ne, size.nx + len(inputs) + size.ne
        reduced = eliminate(jac[np.ix_(rows, columns)], r, c)
        d = djac[:, np.array(rows)[:, None], columns]
        return reduced.derivative(d[:, :r, :c], d[:, :r, c:], d[:, r:, :c], d[:, r:, c:])

    def response(self, s: Array) -> Array:
        """(frequencies, outputs, inputs) exact transfer matrix at complex frequencies s, rad/s."""
        try:
            return self._solve(s, None, ())
        except LinearizationError:
            if not (s == 0).any():
                raise
        # A sliding mean is 0/0 at s = 0: the even part of the response beside it is its limit there, to 1e-10.
        beside = 1e-5j / max(c.total for c in self.channels)
        found = self._solve(np.where(s == 0, beside, s), None, ())
        found[s == 0] = found[s == 0].real
        return found

    def response_along(self, s: Array, change: Array, times: tuple[Array, ...]) -> Array:
        """The derivative of the response for a derivative of the matrix and of each channel's times."""
        return self._solve(s, change, times)

    def _solve(self, s: Array, change: Array | None, times: tuple[Array, ...]) -> Array:
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
        if change is None:
            return np.asarray(m[out, inp] - read @ right)
        slopes = np.zeros((e, k), dtype=complex)
        for i, c in enumerate(self.channels):
            by_time, by_compute = response_slopes(c.kind, c.time, c.compute, s)
            slopes[i] = by_time * times[i][0] + (by_compute * times[i][1] if len(times[i]) > 1 else 0.0)
        dfactor = slopes.T[:, :, None]
        d_unknown = np.zeros_like(unknown)
        d_unknown[:, :n, :n], d_unknown[:, :n, n:] = change[x, x], change[x, fed]
        d_unknown[:, n:, :n] = factor * change[src, x] + dfactor * m[src, x]
        d_unknown[:, n:, n:] = factor * change[src, fed] + dfactor * m[src, fed]
        d_given = np.concatenate(
            [np.broadcast_to(change[x, inp], (k, n, u)), factor * change[src, inp] + dfactor * m[src, inp]], axis=1
        )
        d_read = np.concatenate([change[out, x], change[out, fed]], axis=1)
        d_right = np.linalg.solve(unknown, d_given - d_unknown @ right)
        return np.asarray(change[out, inp] - d_read @ right - read @ d_right)
