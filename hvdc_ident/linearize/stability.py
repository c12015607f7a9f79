"""Stability of linear models with delays, decided on the exact characteristic equation.

The equation falls into parts that act on one another only one way. Of each part the roots are found and counted
(`characteristic`); a discretisation of the delays is refined until the roots found are as many as are counted.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy.linalg
from scipy.sparse.csgraph import connected_components

from hvdc_ident.codec import Coded, stored_as
from hvdc_ident.errors import LinearizationError
from hvdc_ident.linearize.characteristic import NEUTRAL, Part, Undecided, reaches, spectral_radius
from hvdc_ident.linearize.delays import EPS, Channel, SchurComplement, eliminate
from hvdc_ident.linearize.sampling import multipliers
from hvdc_ident.linearize.system import Array

EIGENVALUES = "eigenvalues of A"
COUNTED = "roots of the exact characteristic equation, counted by the argument principle"
MULTIPLIERS = "multipliers over the period of the sampled blocks (modes: without aliases)"
ON_AXIS = 1e-9
"""Damping below which rounding may hide on which side of the imaginary axis an eigenvalue lies."""
TOLERANCES = (1e-12, 1e-10, 1e-8)
"""Distances from the imaginary axis, relative to the radius that bounds the roots, within which one counts as on it."""
PER_DELAY = 5
"""Roots of each delay among the modes, as its usual approximant has states: roots of a delay may stand right of those of states."""
ON_CIRCLE = 1e-9
"""Distance from the unit circle within which rounding hides on which side a multiplier lies."""
CERTAIN = 1e-4
"""Share of the first root's real part by which another one may lie right of it unseen."""
ORDERS = (12, 24, 48, 96, 192)
"""Collocation points of a delay that are tried one after the other until the roots found are as many as are counted."""
ALIKE = 1e-7
"""Roots nearer to each other than this share of their size are taken for one of several times."""
DISCRETISATION_ROWS = 900
"""Rows of the largest discretisation."""


@dataclass(frozen=True, eq=False)
class Roots:
    """Roots of a characteristic equation, by falling real part, with the numbers counted for it; what rounding leaves of a 0 is 0.

    unstable: right of the imaginary axis, None where it cannot be told and infinite for a neutral equation past its
    limit. axis: on it, as far as rounding errors tell. reason: why `unstable` is None or infinite. certain: whether it is
    shown that no root lies right of the first one. averaged: the roots with sampled blocks as their transfer functions, without
    aliases, where `values` has the logarithms of their multipliers.
    """

    values: Array
    unstable: float | None
    axis: int
    reason: str = ""
    certain: bool = True
    averaged: Array | None = None


@dataclass(frozen=True, eq=False)
class Change:
    """The derivative of a characteristic equation's matrices by a parameter, and of each delay's times, s."""

    matrix: Array
    given: Array
    read: Array
    through: Array
    times: tuple[Array, ...]


@dataclass(frozen=True, eq=False)
class Characteristic:
    """The characteristic equation of a model, delays exact, with its inputs and outputs.

    matrix: as in `Part`, whole. given: (rows, inputs) what the inputs add to its rows; read: (outputs, columns) and
    through: (outputs, inputs) the outputs. error: of the matrix, relative to its size: rounding, or that of differences.
    """

    matrix: Array
    nx: int
    channels: tuple[Channel, ...]
    given: Array
    read: Array
    through: Array
    error: float = EPS

    @classmethod
    def of(cls, reduced: SchurComplement, nx: int, channels: tuple[Channel, ...]) -> Characteristic:
        """Return the equation of a Jacobian without its unknowns (`without_unknowns`) and the delays that are in it.

        Raises LinearizationError where the unknowns have no solution.
        """
        if not np.isfinite(reduced.condition):
            raise LinearizationError("the algebraic part is singular", got="no solution for its unknowns")
        matrix, given, read, through = quartered(reduced.result, nx + len(channels))
        return cls(matrix, nx, channels, given, read, through)

    @classmethod
    def rational(cls, a: Array, b: Array, c: Array, d: Array, error: float = EPS) -> Characteristic:
        """Return the equation of a state space without delays."""
        return cls(a, a.shape[0], (), b, c, d, error)

    @property
    def matrices(self) -> tuple[Array, Array, Array, Array]:
        """A, B, C and D where there are no delays; with them what leaves the delays is among the states."""
        return self.matrix, self.given, self.read, self.through

    def without_zero_delays(self) -> Characteristic:
        """Return the equation in which what a delay of 0 s gives is what it gets. Raises LinearizationError for a loop of gain 1."""
        closed = [self.nx + k for k, c in enumerate(self.channels) if c.total == 0.0]
        if not closed:
            return self
        rows = self.matrix.shape[0]
        kept = [k for k in range(rows) if k not in closed]
        whole = np.block([[self.matrix, self.given], [self.read, self.through]])
        whole[closed, closed] -= 1.0
        order = (
            [*kept, *range(rows, whole.shape[0]), *closed],
            [*kept, *range(rows, whole.shape[1]), *closed],
        )
        reduced = eliminate(whole[np.ix_(*order)], whole.shape[0] - len(closed), whole.shape[1] - len(closed))
        if not np.isfinite(reduced.condition):
            raise LinearizationError("the loop through a delay of 0 s is singular", got="no solution for its signals")
        matrix, given, read, through = quartered(reduced.result, len(kept))
        channels = tuple(c for c in self.channels if c.total > 0.0)
        return replace(self, matrix=matrix, channels=channels, given=given, read=read, through=through)

    def closed(self, gains: Array) -> Characteristic:
        """Return the equation with every output fed back to the input of its place, with a gain and negative sign."""
        return self.fed_back(-np.diag(gains))

    def fed_back(self, feedback: Array) -> Characteristic:
        """Return the equation with `feedback`, (inputs, outputs), times the outputs added to the inputs."""
        through = np.eye(self.through.shape[0]) - self.through @ feedback
        read, direct = np.linalg.solve(through, self.read), np.linalg.solve(through, self.through)
        given = self.given + self.given @ feedback @ direct
        return replace(self, matrix=self.matrix + self.given @ feedback @ read, given=given, read=read, through=direct)

    def between(self, inputs: Array, outputs: Array) -> Characteristic:
        """Return the equation with combinations of the inputs, (inputs, new ones), and of the outputs, (new ones, outputs)."""
        through = outputs @ self.through @ inputs
        return replace(self, given=self.given @ inputs, read=outputs @ self.read, through=through)

    def beside(self, other: Characteristic) -> Characteristic:
        """Return the equation of both side by side, inputs and outputs of this one first."""
        n, k = self.nx, self.matrix.shape[0]
        places = [*range(n), *range(k, k + other.nx), *range(n, k), *range(k + other.nx, k + other.matrix.shape[0])]

        def both(first: Array, second: Array) -> Array:
            return scipy.linalg.block_diag(first, second)

        return Characteristic(
            both(self.matrix, other.matrix)[np.ix_(places, places)], n + other.nx, (*self.channels, *other.channels),
            both(self.given, other.given)[places], both(self.read, other.read)[:, places],
            both(self.through, other.through), max(self.error, other.error),
        )  # fmt: skip

    def visible(self) -> Characteristic:
        """Return the equation of what the inputs reach and the outputs see, by structure."""
        links = self.matrix != 0
        reached, seen = (self.given != 0).any(axis=1), (self.read != 0).any(axis=0)
        for _ in range(links.shape[0]):
            reached, seen = reached | (links & reached).any(axis=1), seen | (links & seen[:, None]).any(axis=0)
        keep = np.flatnonzero(reached & seen)
        return self._of(keep)

    def without_states(self, places: Sequence[int]) -> Characteristic:
        """Return the equation with some states held where they are."""
        return self._of(np.delete(np.arange(self.matrix.shape[0]), places)) if places else self

    def _of(self, keep: Array) -> Characteristic:
        own = self.part(keep)
        return replace(
            self, matrix=own.matrix, nx=own.nx, channels=own.channels, given=self.given[keep], read=self.read[:, keep]
        )

    def response(self, s: Array) -> Array:
        """Return (frequencies, outputs, inputs) exact transfer matrix at complex frequencies s, rad/s; at 0 its limit."""
        part = self.whole
        if self.channels and (s == 0).any() and sliding_means(self):
            # A sliding mean is 0/0 at 0: the even part of the response beside it is its limit there, to 1e-10.
            beside = self.response(np.where(s == 0, 1e-5j / float(part.lengths.max()), s))
            return np.where((s == 0)[:, None, None], beside.real, beside)
        return np.asarray(self.through + self.read @ np.linalg.solve(*self.pencil(s)))

    def response_by_s(self, s: Array) -> tuple[Array, Array]:
        """Return the transfer matrix at complex frequencies s, rad/s, and its derivative by s."""
        pencil, drive = self.pencil(s)
        d_pencil, d_drive = self.pencil_by_s(s)
        right = np.linalg.solve(pencil, drive)
        slope = self.read @ np.linalg.solve(pencil, d_drive - d_pencil @ right)
        return np.asarray(self.through + self.read @ right), np.asarray(slope)

    def pencil(self, s: Array) -> tuple[Array, Array]:
        """Return the pencil and what the inputs add to its rows, (frequencies, rows, inputs)."""
        return self.whole.pencil(s), self.whole.factors(s)[:, :, None] * self.given

    def pencil_by_s(self, s: Array) -> tuple[Array, Array]:
        """Return the derivatives of both by s."""
        return self.whole.pencil_by_s(s), self.whole.factors_by_s(s)[:, :, None] * self.given

    def pencil_along(self, s: Array, change: Change) -> tuple[Array, Array]:
        """Return the derivatives of both by a parameter."""
        factors, moved = self.whole.factors(s), self.whole.factors_along(s, change.times)
        drive = factors[:, :, None] * change.given + moved[:, :, None] * self.given
        return self.whole.pencil_along(s, change.matrix, change.times), drive

    @property
    def whole(self) -> Part:
        """All of it as one part, for the pencil."""
        return Part(self.matrix, self.nx, self.channels)

    def part(self, places: Array) -> Part:
        """Return some of the unknowns as a part, not balanced."""
        channels = tuple(self.channels[i - self.nx] for i in places if i >= self.nx)
        return Part(self.matrix[np.ix_(places, places)], len(places) - len(channels), channels)

    def parts(self) -> Iterator[tuple[Part, Array]]:
        """Return the parts that determine one another's unknowns only one way, balanced, with the places of their unknowns."""
        m = self.matrix
        links = np.abs(m) > 0
        _, label = connected_components(links, directed=True, connection="strong")
        for k in range(label.max(initial=-1) + 1):
            places = np.flatnonzero(label == k)
            own = self.part(places)
            if own.matrix.shape[0] > 1:
                _, (scale, _) = scipy.linalg.matrix_balance(own.matrix, permute=False, separate=True)
                own = replace(own, matrix=own.matrix * scale[None, :] / scale[:, None])
            yield own, places

    @cached_property
    def roots_by_part(self) -> tuple[tuple[Array, Roots], ...]:
        """The places of the unknowns of each part, and its roots."""
        return tuple((places, self._roots_of(part)) for part, places in self.parts())

    @cached_property
    def roots(self) -> Roots:
        """The rightmost roots, at least one for each state and `PER_DELAY` for each delay, and the number that is unstable."""
        by_part = [r for _, r in self.roots_by_part]
        unstable: float | None = 0.0
        for r in by_part:
            unstable = _sum(unstable, r.unstable)
        axis = sum(r.axis for r in by_part)
        reasons = dict.fromkeys(r.reason for r in by_part if r.reason)
        grows = 0.0 if unstable is None else unstable
        least = max(self.nx + PER_DELAY * len(self.whole.channels), axis + int(grows)) if np.isfinite(grows) else None
        averaged = first_roots([r.values if r.averaged is None else r.averaged for r in by_part], least)
        values = first_roots([r.values for r in by_part], least)
        return Roots(values, unstable, axis, "; ".join(reasons), all(r.certain for r in by_part), averaged)

    def counts(self) -> tuple[float | None, int]:
        """Return the numbers of roots right of the imaginary axis and on it, as in `Roots`, without looking for the roots."""
        by_part = [self._counts_of(part) for part, _ in self.parts()]
        total: float | None = 0.0
        for unstable, _ in by_part:
            total = _sum(total, unstable)
        return total, sum(axis for _, axis in by_part)

    def is_stable(self) -> bool:
        """Return whether `stability` says "stable", without looking for the roots."""
        unstable, axis = self.counts()
        return unstable == 0 and axis <= sliding_means(self)

    def _roots_of(self, part: Part) -> Roots:
        if not part.channels:
            return eigenvalues(part.matrix, self.error)
        if not part.matrix.any():  # a delay outside any loop
            return Roots(np.zeros(0, dtype=complex), 0, 0)
        if any(c.kind == "sampled" for c in part.channels):
            return _sampled(part)
        return _delayed(part)

    def _counts_of(self, part: Part) -> tuple[float | None, int]:
        if any(c.kind == "sampled" for c in part.channels):
            over_period = multipliers(part.matrix, part.nx, part.channels) if part.matrix.any() else (np.zeros(0), 1.0)
            return (None, 0) if isinstance(over_period, str) else _on_circle(over_period[0])
        if not part.channels or not part.matrix.any() or spectral_radius(part.direct) >= 1.0 - NEUTRAL:
            roots = self._roots_of(part)
            return roots.unstable, roots.axis
        try:
            _, total, right = _counted(part)
        except Undecided:
            return None, 0
        return right, total - right


def quartered(matrix: Array, size: int) -> tuple[Array, Array, Array, Array]:
    """Return the blocks of a matrix, or of a stack of them, after so many rows and columns: its corners, row by row."""
    return matrix[..., :size, :size], matrix[..., :size, size:], matrix[..., size:, :size], matrix[..., size:, size:]


def first_roots(values: list[Array], least: int | None) -> Array:
    """Return so many values by falling real part, conjugates together and the upper one first; all of them for None."""
    roots = np.concatenate([np.zeros(0, dtype=complex), *values])
    roots = roots[np.lexsort((-roots.imag, np.abs(roots.imag), -roots.real))]
    count = roots.size if least is None else least
    if 0 < count < roots.size and roots[count - 1].imag > 0:
        count += 1
    return roots[:count]


def _on_circle(z: Array) -> tuple[int, int]:
    """Return the numbers of multipliers outside the unit circle and on it."""
    growth = np.abs(z) - 1.0
    return int((growth > ON_CIRCLE).sum()), int((np.abs(growth) <= ON_CIRCLE).sum())


def _sum(first: float | None, second: float | None) -> float | None:
    """Return the sum of two counts; one that is known to be positive makes an unknown one a number from below."""
    if first is None or second is None:
        known = (first or 0.0) + (second or 0.0)
        return known if known > 0 else None
    return first + second


def _sampled(part: Part) -> Roots:
    """The multipliers over the sampling period decide; where there are none, it is said what the averaged equation has."""
    averaged = _delayed(part)
    over_period = multipliers(part.matrix, part.nx, part.channels)
    if isinstance(over_period, str):
        said = "an unknown number of" if averaged.unstable is None else f"{averaged.unstable:.0f}"
        reason = f"{over_period}; without their aliases the loop has {said} unstable roots"
        return Roots(averaged.values, None, 0, reason, False)
    z, period = over_period
    unstable, axis = _on_circle(z)
    values = np.log(z[np.abs(z) > 1e-12].astype(complex))
    values[np.abs(values) <= ON_CIRCLE] = 0.0
    return Roots(values / period, unstable, axis, averaged=averaged.values)


def _delayed(part: Part) -> Roots:
    n = part.nx
    direct = spectral_radius(part.direct)
    if direct >= 1.0 - NEUTRAL:
        return _neutral(part, direct)
    try:
        tolerance, total, right = _counted(part)
    except Undecided as e:
        roots = part.refined(np.linalg.eigvals(part.discretised(_orders(part)[-1])))
        grows = int((roots.real > 1e-9 * part.unit).sum())
        return Roots(roots, grows or None, 0, f"{e.what} ({e.got})", False)
    roots = np.zeros(0, dtype=complex)
    for order in _orders(part):
        roots = part.refined(np.concatenate([np.linalg.eigvals(part.discretised(order)), roots]))
        roots[np.abs(roots) <= tolerance] = 0.0
        near = roots[roots.real > -tolerance]
        if near.size < total:
            times = [part.multiplicity(v, roots) for v in near]
            roots = np.concatenate([roots, *(np.full(k - 1, v) for v, k in zip(near, times, strict=True))])
        if (roots.real > tolerance).sum() != right or (roots.real > -tolerance).sum() != total or roots.size < n:
            continue
        if total or not roots.size:
            return Roots(roots, right, total - right)
        first = float(roots.real.max())
        try:
            if part.count(first + CERTAIN * abs(first)) == 0:
                return Roots(roots, 0, 0)
        except Undecided:
            return Roots(roots, 0, 0, certain=False)
    return Roots(roots, right, total - right, certain=False)


def _counted(part: Part) -> tuple[float, int, int]:
    """Return a distance from the imaginary axis, and the numbers of roots right of the axis less it, and plus it.

    The distance is as small as rounding errors of the pencil and roots on the axis let the contour be.
    """
    size = max(part.bound(0.0), part.nx * part.size)
    for share in TOLERANCES:
        try:
            total = part.count(-share * size)
            return share * size, total, part.count(share * size) if total else 0
        except Undecided:
            if share == TOLERANCES[-1]:
                raise
    raise AssertionError  # TOLERANCES is not empty


def _orders(part: Part) -> Sequence[int]:
    return [k for k in ORDERS if k == ORDERS[0] or part.nx + k * len(part.channels) <= DISCRETISATION_ROWS]


def eigenvalues(matrix: Array, error: float = EPS) -> Roots:
    """Return the eigenvalues of a balanced matrix, in LAPACK's order. error: of its entries, relative to each."""
    return counted_eigenvalues(*with_errors(matrix, error))


def counted_eigenvalues(values: Array, off: Array) -> Roots:
    """Return eigenvalues, in their order, with their numbers; one that its error may have moved from 0 is 0. off: their errors."""
    values = np.where(np.abs(values) <= off, 0.0, values)
    axis = on_axis(values, off)
    return Roots(values, int(((values.real > 0) & ~axis).sum()), int(axis.sum()))


def on_axis(values: Array, off: Array) -> Array:
    """Return a mask of the eigenvalues that may lie on the imaginary axis. off: their errors."""
    return np.asarray(np.abs(values.real) <= ON_AXIS * np.abs(values) + off)


def with_errors(matrix: Array, error: float = EPS) -> tuple[Array, Array]:
    """Return the eigenvalues of a balanced matrix, and how far errors of its entries may have moved each.

    An error e of each entry, relative to it, moves an eigenvalue with vectors y and x by m = e |y| |A| |x| / |y x|, to first
    order. Two that are g apart meet where an error is large enough, and move by its root: by g m / (g/2 + sqrt(g^2/4 + g m)),
    which is m where that is small against g. Rounding in the computation stands for e = n times that of the entries.
    """
    n = len(matrix)
    if n < 2:
        return np.diag(matrix).astype(complex), np.zeros(n)
    values, left, right = scipy.linalg.eig(matrix, left=True, right=True)
    moved = 10.0 * n * error * ((np.abs(left).T @ np.abs(matrix)) * np.abs(right).T).sum(axis=1)
    first = moved / np.maximum(np.abs((left.conj() * right).sum(axis=0)), 1e-300)
    apart = np.abs(values[:, None] - values)
    np.fill_diagonal(apart, np.inf)
    gap = np.maximum(
        apart.min(axis=1), np.sqrt(moved * np.abs(values)) + 1e-300
    )  # of two computed as one, that of their errors
    return values, gap * first / (0.5 * gap + np.sqrt(0.25 * gap**2 + gap * first))


def _neutral(part: Part, direct: float) -> Roots:
    """What can be said where the gain around delays, without a state on the way, reaches 1.

    Around a single ring of delays a gain above 1 leaves infinitely many roots right of the axis, near Re s = ln gain / T. In
    other cases the phases decide, which delays that are a little different turn (Hale and Verduyn Lunel 1993, 9.6).
    """
    roots = part.refined(np.linalg.eigvals(part.discretised(_orders(part)[-1])))
    links = part.direct > 0
    _, label = connected_components(links, directed=True, connection="strong")
    rings = [np.ix_(label == k, label == k) for k in range(label.max() + 1)]
    reached = [r for r in rings if spectral_radius(part.direct[r]) >= 1.0 - NEUTRAL]
    ring = any((links[r].sum(axis=1) == 1).all() and spectral_radius(part.direct[r]) > 1.0 + NEUTRAL for r in reached)
    said = f"the gain around a delay without a state on the way is {direct:.6g}"
    if ring:
        return Roots(roots, np.inf, 0, f"{said}, above 1: infinitely many roots grow", False)
    grows = int((roots.real > 1e-9 * part.unit).sum())
    return Roots(roots, grows or None, 0, f"{said}, and must be below 1 for a count of the roots", False)


@dataclass(frozen=True, eq=False)
class Stability(Coded):
    """The verdict on a model's stability: without delays by its eigenvalues, with delays by its characteristic equation.

    verdict: "stable", "on the limit of stability", "unstable" or "not decided". unstable: roots right of the axis, None
    where not decided, infinite (None in JSON) where there are infinitely many; from below where there is a reason. rightmost: the first
    root, None where there is none or none was found.
    """

    verdict: str
    unstable: float | None = field(metadata=stored_as("unstable_roots"))
    rightmost: complex | None
    reason: str = ""
    method: str = EIGENVALUES

    @property
    def stable(self) -> bool | None:
        """True where it is stable, None where that is not decided; on the limit it is not."""
        return None if self.verdict == "not decided" else self.verdict == "stable"

    @property
    def count_text(self) -> str:
        """How many roots lie right of the imaginary axis, in words."""
        if self.verdict == "not decided":
            return "an unknown number of roots right of the imaginary axis"
        if self.unstable is None or np.isinf(self.unstable):
            return "infinitely many roots right of the imaginary axis"
        number = f"{self.unstable:.0f} root{'' if self.unstable == 1 else 's'} right of the imaginary axis"
        return f"at least {number}" if self.reason else number


class Equation(Protocol):
    """An equation with its roots and its delays: all that a verdict on stability rests on."""

    @property
    def channels(self) -> tuple[Channel, ...]: ...
    @property
    def roots(self) -> Roots: ...


def stability(equation: Equation) -> Stability:
    """Return whether the model is stable; what a sliding mean keeps for ever does not count."""
    roots, values = equation.roots, equation.roots.values
    hidden = sliding_means(equation) if isinstance(equation, Characteristic) else 0
    if hidden:
        values = np.delete(values, np.argsort(np.abs(values), kind="stable")[:hidden])
    first = complex(values[0]) if values.size else None
    sampled = any(c.kind == "sampled" for c in equation.channels)
    method = MULTIPLIERS if sampled else COUNTED if equation.channels else EIGENVALUES
    if roots.unstable is None:
        return Stability("not decided", None, first, roots.reason, method)
    if roots.unstable > 0:
        return Stability("unstable", roots.unstable, first, roots.reason, method)
    verdict = "on the limit of stability" if roots.axis > hidden else "stable"
    return Stability(verdict, 0, first if roots.certain else None, roots.reason, method)


def poles_of_transfer(equation: Characteristic, where: str) -> tuple[int, Array]:
    """Return the number of poles of the transfer function right of the imaginary axis, and those on it.

    They are the roots that the inputs reach and the outputs see, sliding means left out. Raises LinearizationError where
    their number is not known or infinite.
    """
    roots = equation.roots
    if roots.unstable is None or np.isinf(roots.unstable):
        raise LinearizationError("the number of unstable poles is not known", where=where, got=roots.reason)
    right = roots.values[: int(roots.unstable)]
    nearest = roots.values[np.argsort(np.abs(roots.values.real), kind="stable")[: roots.axis]]
    axis = nearest[np.argsort(np.abs(nearest), kind="stable")[sliding_means(equation) :]]
    if not any(c.kind == "delay" for c in equation.channels):
        return (
            right.size,
            axis,
        )  # of a minimal realisation; or logarithms of multipliers, which are no roots of the pencil
    whole = equation.whole

    def shown(root: complex) -> bool:
        return all(reached(equation, root, whole.null_vectors(root, times_at(roots.values, root, whole.unit))))

    return sum(shown(v) for v in right), axis[[shown(v) for v in axis]]


def reached(equation: Characteristic, root: complex, vectors: tuple[Array, Array]) -> tuple[bool, bool]:
    """Return whether the inputs drive the mode of a root, and whether the outputs see it. vectors: right and left, of norm 1."""
    right, left = vectors
    given = equation.pencil(np.array([root]))[1][0]
    return reaches(left @ given, given), reaches(equation.read @ right, equation.read)


def times_at(roots: Array, root: complex, unit: float) -> int:
    """Return how many of some roots are the same, as far as can be told. unit: a rate, 1/s."""
    return int((np.abs(roots - root) <= ALIKE * max(abs(root), 1e-3 * unit)).sum())


def sliding_means(equation: Characteristic) -> int:
    """Return how many roots at 0 are sliding means: what stays is a state less what a delay holds, and no input moves it.

    y' = (u - u(t - T))/T keeps y less the mean of u, which is 0 for ever where it is at the start.
    """
    n, m = equation.nx, equation.matrix
    if not equation.channels:
        return 0
    _, (scale, _) = scipy.linalg.matrix_balance(m, permute=False, separate=True)
    at_rest = np.diag([0.0] * n + [1.0] * (m.shape[0] - n)) - m * scale[None, :] / scale[:, None]
    rows = scipy.linalg.null_space(at_rest.T, rcond=1e-13).T
    if rows.shape[0] == 0:
        return 0
    given = equation.given / scale[:, None]
    u, sizes, _ = np.linalg.svd(rows @ given, full_matrices=True)
    rank = int((sizes > 1e-9 * max(float(np.linalg.norm(given)), 1e-300)).sum())
    free = u[:, rank:].T @ rows
    return int(np.linalg.matrix_rank(free[:, n:], tol=1e-9)) if free.size else 0
