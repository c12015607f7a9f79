"""The characteristic equation of a loop of states and delays: its roots, and how many of them lie right of a line.

With x the states and v the delays' outputs, s x = A x + B v and v = E(s) (C x + D v), where E(s) = diag(exp(-s T)) for
delays. The roots of det [s - A, -B; -E C, 1 - E D] = 0 decide on stability. They are found from a discretisation of the
delays (Chebyshev collocation, Breda, Maset and Vermiglio 2005) and refined by Newton's method on this determinant; how
many there must be is counted by the argument principle on the same determinant, so that none is missed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
import scipy.linalg

from hvdc_ident.errors import LinearizationError
from hvdc_ident.linearize.delays import Channel, response, response_by_s, response_slopes
from hvdc_ident.linearize.system import Array

STEP = 0.9
"""Largest change of the pencil in one step of the contour, in the nuclear norm relative to the pencil: ln det(1 + X) is then
at most -ln(1 - 0.9) = 2.3 < pi in size, so that the phase of the determinant cannot turn unseen between two points."""
MOST_POINTS = 500_000
MOST_WORK = 100_000_000
"""Points of the contour, and points times entries of the pencil, after which counting is given up: some seconds."""
NEUTRAL = 1e-9
"""Distance from 1 within which rounding hides on which side a gain around a delay without states lies."""
FARTHEST = 200.0
"""Largest -Re(s) T of a delay's root that is looked for: its factor there, e^200, is far beyond what rounding leaves of the others."""
T = TypeVar("T")


class Undecided(LinearizationError):
    """A count of roots that is not possible, with the reason."""


@dataclass(frozen=True, eq=False)
class Part:
    """A characteristic equation that cannot be split: every unknown acts on every other.

    matrix: rows [x', inputs of the delays], columns [x, outputs of the delays].
    """

    matrix: Array
    nx: int
    channels: tuple[Channel, ...]

    @cached_property
    def size(self) -> float:
        """Norm of A; states alone have no eigenvalue beyond it, rad/s."""
        return float(np.linalg.norm(self.matrix[: self.nx, : self.nx], 2)) if self.nx else 0.0

    @cached_property
    def lengths(self) -> Array:
        """(delays,) s from an input until it has left the delay altogether."""
        return np.array([c.time + c.compute for c in self.channels])

    @property
    def direct(self) -> Array:
        """|D| between delays, from one to the next without a state; a hold fades at high frequency and counts for nothing."""
        n = self.nx
        kept = np.array([c.kind == "delay" for c in self.channels], dtype=float)
        return np.asarray(np.abs(self.matrix[n:, n:]) * kept[:, None])

    def factors(self, s: Array) -> Array:
        """Return (frequencies, rows) what the matrix's rows are multiplied by: 1 of a state, E(s) of a delay.

        E is as large as at `FARTHEST` left of it, where only states before a delay have roots.
        """
        return self._by_row(s, 1.0, self._of_delays(response, s))

    def factors_by_s(self, s: Array) -> Array:
        """Return the derivative of the factors by s."""
        return self._by_row(s, 0.0, self._of_delays(response_by_s, s))

    def factors_along(self, s: Array, times: Sequence[Array]) -> Array:
        """Return the derivative of the factors for a derivative of each delay's time, and of its compute time where it has one."""
        slopes = self._of_delays(response_slopes, s)
        moved = [sum(x * t for x, t in zip(by, time, strict=False)) for by, time in zip(slopes, times, strict=True)]
        return self._by_row(s, 0.0, moved)

    def pencil(self, s: Array) -> Array:
        """(frequencies, rows, columns) of the matrix whose determinant is the characteristic function."""
        n, e = self.nx, len(self.channels)
        pencil = -self.factors(s)[:, :, None] * self.matrix
        pencil[:, range(n), range(n)] += s[:, None]
        pencil[:, range(n, n + e), range(n, n + e)] += 1.0
        return np.asarray(pencil)

    def pencil_by_s(self, s: Array) -> Array:
        """The derivative of the pencil by s."""
        n = self.nx
        slope = -self.factors_by_s(s)[:, :, None] * self.matrix
        slope[:, range(n), range(n)] += 1.0
        return np.asarray(slope)

    def pencil_along(self, s: Array, matrix: Array, times: Sequence[Array]) -> Array:
        """Return the derivative of the pencil for a derivative of the matrix and of the delays' times."""
        return -self.factors(s)[:, :, None] * matrix - self.factors_along(s, times)[:, :, None] * self.matrix

    def _by_row(self, s: Array, of_states: float, of_delays: Sequence[Array | complex]) -> Array:
        """Return (frequencies, rows) one number for all states, and those of the delays."""
        rows = np.full((s.size, self.nx + len(of_delays)), of_states, dtype=complex)
        for k, values in enumerate(of_delays):
            rows[:, self.nx + k] = values
        return rows

    def _of_delays(self, function: Callable[[str, float, float, Array], T], s: Array) -> list[T]:
        """Return a function of kind, time, compute time and frequencies for each delay, at the edge of the search left of it."""
        held = (np.maximum(s.real, -FARTHEST / x if x else -np.inf) + 1j * s.imag for x in self.lengths.tolist())
        return [function(c.kind, c.time, c.compute, x) for c, x in zip(self.channels, held, strict=True)]

    # --- counting ---

    def bound(self, line: float) -> float:
        """Return a radius beyond which no root lies right of the line Re s = line.

        For |s| > R the loop through states and delays has a spectral radius below that of the moduli of its entries:
        |E| (|D| + |C| |B| / (R - |A|)), and the pencil is singular nowhere where this is below 1. Raises Undecided
        where D alone reaches 1: a neutral equation, whose roots need not be bounded.
        """
        n = self.nx
        c, b = np.linalg.norm(self.matrix[n:, :n], axis=1), np.linalg.norm(self.matrix[:n, n:], axis=0)
        direct, grown = np.abs(self.matrix[n:, n:]), self._growth(line)
        period = np.array([x.time if x.kind == "sampled" else np.inf for x in self.channels])
        radius = max(2.0 * self.size, 4.0 * abs(line), 0.1 / float(self.lengths.max()))
        for _ in range(200):
            held = np.where(np.isinf(period), grown, np.minimum(grown, (1.0 + grown) / (radius * period)))
            if spectral_radius(held[:, None] * (direct + np.outer(c, b) / (radius - self.size))) < 1.0 - NEUTRAL:
                return radius
            radius *= 2.0
        raise Undecided(
            "the gain around a delay without a state on the way reaches 1",
            got=f"spectral radius {spectral_radius(grown[:, None] * self.direct):.6g}",
            expected="below 1",
            hint="add the lag that is there",
        )

    def _growth(self, line: float) -> Array:
        """The largest |E| right of a line."""
        return np.exp(np.maximum(-line, 0.0) * self.lengths)

    def count(self, line: float) -> int:
        """Return the number of roots with a real part above `line`, by the argument principle.

        The contour is the line and the arc of the radius that bounds the roots. Along the arc the determinant is a
        product of factors 1 - z with |z| < 1, whose phases are known without a walk. Raises Undecided where the
        contour passes through a root or takes too many points.
        """
        n, radius = self.nx, self.bound(line)
        top = float(np.sqrt(radius**2 - line**2))
        s = np.array([complex(line, top)])
        a, b = self.matrix[:n, :n], self.matrix[:n, n:]
        inner = self.matrix[n:, n:] + self.matrix[n:, :n] @ np.linalg.solve(s[0] * np.eye(n) - a, b)
        through = np.linalg.eigvals(self.factors(s)[0, n:, None] * inner)
        phase = n * np.angle(s[0]) + np.angle(1.0 - np.linalg.eigvals(a) / s[0]).sum() if n else 0.0
        phase += np.angle(1.0 - through).sum()
        turns = (phase - self._turned(line, top)) / np.pi
        if abs(turns - round(turns)) > 1e-3:
            raise Undecided("the phase of the characteristic function does not close", got=f"{turns:.6g} turns")
        return round(turns)

    def _turned(self, line: float, top: float) -> float:
        """Return the change of the determinant's phase from `line` to `line + j top`."""
        y = np.concatenate([[0.0], np.geomspace(1e-9 * top, top, 60)])
        cost, angle = self._costs(line, y)
        while True:
            step = np.diff(y)
            grown = self._growth(line)
            moved = np.minimum(step[:, None] * self.lengths * grown, 2.0 * grown)
            change = np.concatenate([step[:, None], moved], axis=1)
            wide = np.minimum((change * cost[:-1]).sum(axis=1), (change * cost[1:]).sum(axis=1)) > STEP
            if not wide.any():
                return float(np.angle(np.exp(1j * np.diff(angle))).sum())
            low, high = y[:-1][wide], y[1:][wide]
            middle = np.where(high > 4.0 * low, np.sqrt(np.maximum(low, 1e-3 * high) * high), 0.5 * (low + high))
            points = y.size + middle.size
            if points > min(MOST_POINTS, MOST_WORK // self.matrix.size) or not ((middle > low) & (middle < high)).all():
                raise Undecided(
                    "the roots cannot be counted", got=f"a root on the line Re s = {line:.3g}, or too near it"
                )
            more, more_angle = self._costs(line, middle)
            order = np.argsort(np.concatenate([y, middle]), kind="stable")
            y = np.concatenate([y, middle])[order]
            cost, angle = np.concatenate([cost, more])[order], np.concatenate([angle, more_angle])[order]

    def _costs(self, line: float, y: Array) -> tuple[Array, Array]:
        """Return what a step in s and one of each delay's factor change the pencil by, relative to it, and the phase.

        det(P + dP) = det P det(1 + diag(ds, -dE) K) with the rows K = [those of P^-1 for the states; [C, D] P^-1]. A
        diagonal similarity T K T^-1 leaves that as it is; this one makes the sum of the rows' norms small.
        """
        n = self.nx
        weight = np.concatenate([np.ones(n), self.lengths * self._growth(line)])
        costs, angles = [], []
        for part in np.array_split(y, 1 + y.size * self.matrix.size // 2_000_000):
            pencil = self.pencil(line + 1j * part)
            try:
                inverse = np.linalg.inv(pencil)
            except np.linalg.LinAlgError:
                raise Undecided("the roots cannot be counted", got=f"a root on the line Re s = {line:.3g}") from None
            k = np.concatenate([np.abs(inverse[:, :n]), np.abs(self.matrix[n:] @ inverse)], axis=1)
            rows, columns = np.linalg.norm(k, axis=2), np.linalg.norm(k, axis=1)
            rows = np.maximum(weight * rows, 1e-30 * rows.max(axis=1, keepdims=True) * weight.min())
            columns = np.maximum(columns, 1e-30 * columns.max(axis=1, keepdims=True))
            scale = np.sqrt(columns / rows)
            rows = np.linalg.norm(k * (scale[:, :, None] / scale[:, None, :]), axis=2)
            costs.append(np.concatenate([rows[:, :n].sum(axis=1)[:, None], rows[:, n:]], axis=1))
            angles.append(np.angle(np.linalg.slogdet(pencil)[0]))
        return np.concatenate(costs), np.concatenate(angles)

    # --- roots ---

    def discretised(self, order: int) -> Array:
        """Return the matrix whose eigenvalues approach the roots: the delays' contents at order + 1 Chebyshev points."""
        n, e = self.nx, len(self.channels)
        points, slope = _chebyshev(order)
        read = np.array([_read(c, points) for c in self.channels])  # what leaves each delay, from its points
        # The first point of each delay is what enters it: C x + D v, with v = read0 (C x + D v) + read others.
        entering = np.linalg.solve(
            np.eye(e) - self.matrix[n:, n:] * read[:, 0],
            np.concatenate([self.matrix[n:, :n], self.matrix[n:, n:] @ scipy.linalg.block_diag(*read[:, 1:])], axis=1),
        )
        inside = np.concatenate([np.zeros((e, n)), scipy.linalg.block_diag(*read[:, 1:])], axis=1)
        leaving = inside + read[:, :1] * entering
        total = np.zeros((n + e * order, n + e * order))
        total[:n] = self.matrix[:n, n:] @ leaving
        total[:n, :n] += self.matrix[:n, :n]
        for i, length in enumerate(self.lengths):
            block = slice(n + i * order, n + (i + 1) * order)
            total[block] += 2.0 / length * np.outer(slope[1:, 0], entering[i])
            total[block, block] += 2.0 / length * slope[1:, 1:]
        return total

    def refined(self, s: Array) -> Array:
        """Return the distinct roots that Newton's method on the determinant finds from some values."""
        s = s.astype(complex)
        with np.errstate(all="ignore"):
            for _ in range(40):
                s = s[np.isfinite(s) & (-s.real * self.lengths.max() < FARTHEST)]
                slope = self._logarithmic(s)
                s = np.where(np.abs(slope) > 0, s - 1.0 / np.where(slope == 0, 1.0, slope), s)
            s = s[np.isfinite(s) & (-s.real * self.lengths.max() < FARTHEST)]
            s = s[np.abs(1.0 / self._logarithmic(s)) <= 1e-9 * (np.abs(s) + 1e-3 * self.unit)] if s.size else s
        return self._distinct(s)

    @cached_property
    def unit(self) -> float:
        """A rate of the part, 1/s."""
        return max(self.size, 1.0 / float(self.lengths.max()))

    def _logarithmic(self, s: Array) -> Array:
        """Return the derivative of ln det; infinite on a root."""
        pencil, slope = self.pencil(s), self.pencil_by_s(s)
        good = np.asarray(np.isfinite(pencil).all(axis=(1, 2)) & np.isfinite(slope).all(axis=(1, 2)))
        derivative = np.full(s.size, np.nan, dtype=complex)
        derivative[good] = np.inf
        good &= np.linalg.slogdet(np.where(good[:, None, None], pencil, np.eye(pencil.shape[1])))[0] != 0
        derivative[good] = np.trace(np.linalg.solve(pencil[good], slope[good]), axis1=1, axis2=2)
        return derivative

    def _distinct(self, s: Array) -> Array:
        """Return the roots once each, real ones and conjugate pairs made exact."""
        s = np.where(np.abs(s.imag) <= 1e-9 * (np.abs(s) + 1e-3 * self.unit), s.real + 0j, s)
        kept: list[complex] = []
        for v in sorted((complex(x) for x in s if x.imag >= 0), key=lambda x: (-x.real, x.imag)):
            if all(abs(v - x) > 1e-7 * (abs(v) + 1e-3 * self.unit) for x in kept[-8:]):
                kept.append(v)
        return np.array([x for v in kept for x in ((v, v.conjugate()) if v.imag else (v,))], dtype=complex)

    def null_vectors(self, root: complex, count: int) -> tuple[Array, Array]:
        """Return the null vectors of the pencil at a root so many times there: the right ones in columns, the left ones in rows."""
        pencil = self.pencil(np.array([root]))[0]
        size = np.abs(pencil)
        rows = np.where(size.max(axis=1) > 1e-13 * size.max(), size.max(axis=1), 1.0)
        size = size / rows[:, None]
        columns = np.where(size.max(axis=0) > 1e-13 * size.max(), size.max(axis=0), 1.0)
        u, sizes, vh = np.linalg.svd(pencil / rows[:, None] / columns)
        dimension = max(1, min(count, int((sizes <= 1e-8 * sizes[0]).sum())))
        right = vh[-dimension:].conj().T / columns[:, None]
        left = u[:, -dimension:].conj().T / rows
        return right / np.linalg.norm(right, axis=0), left / np.linalg.norm(left, axis=1)[:, None]

    def multiplicity(self, root: complex, others: Array) -> int:
        """Return how many roots lie at one place, by an integral around it."""
        near = np.abs(others - root)
        radius = 0.3 * min(float(near[near > 0].min(initial=np.inf)), 1e-2 * (abs(root) + self.unit))
        around = root + radius * np.exp(2j * np.pi * (np.arange(64) + 0.5) / 64)
        return max(1, round(float((self._logarithmic(around) * (around - root)).mean().real)))


VISIBLE = 1e-9
"""Share of the largest gain of inputs or outputs at which a mode is taken for reached by rounding alone."""


def reaches(product: Array, matrix: Array) -> bool:
    """Return whether a mode's vectors of norm 1, multiplied by the matrix of inputs or outputs, leave more than rounding."""
    return bool(np.abs(product).max(initial=0.0) > VISIBLE * np.abs(matrix).max(initial=1e-300))


def spectral_radius(matrix: Array) -> float:
    """Return the largest modulus of the eigenvalues."""
    return float(np.abs(np.linalg.eigvals(matrix)).max(initial=0.0))


def _chebyshev(order: int) -> tuple[Array, Array]:
    """Return the points cos(j pi / order) and the matrix that differentiates values there (Trefethen 2000, chapter 6)."""
    x = np.cos(np.pi * np.arange(order + 1) / order)
    c = np.concatenate([[2.0], np.ones(order - 1), [2.0]]) * (-1.0) ** np.arange(order + 1)
    d = np.outer(c, 1.0 / c) / (x[:, None] - x[None, :] + np.eye(order + 1))
    return x, d - np.diag(d.sum(axis=1))


def _read(channel: Channel, points: Array) -> Array:
    """Return the weights of a delay's contents in its output: the oldest, or the mean over a sampling period."""
    if channel.kind == "delay":
        return np.concatenate([np.zeros(points.size - 1), [1.0]])
    length = channel.time + channel.compute
    nodes, weights = np.polynomial.legendre.leggauss(points.size)
    place = -1.0 + (1.0 + nodes) * channel.time / length
    basis = np.polynomial.chebyshev.chebvander(place, points.size - 1) @ np.linalg.inv(
        np.polynomial.chebyshev.chebvander(points, points.size - 1)
    )
    return np.asarray(0.5 * weights @ basis)
