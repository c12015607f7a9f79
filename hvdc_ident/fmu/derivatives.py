"""Derivatives of an FMU: directional derivatives and the Jacobian at a point, and differences of whole runs.

Directional derivatives are used where the FMU offers them and they agree with differences. In worker processes only.

A run has noise (its integrator's, and that of rows which an event passes): fourth differences over short steps of all
parameters at once show it. A pair of runs around a parameter then gives its derivative, and the curvature from which the
best step of a one-sided difference follows: from the second time on, a derivative costs one run. Where one side cannot be
accurate, the step of a central difference is chosen against the noise. J. J. More and S. M. Wild, ACM TOMS 38 (2012) 19.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.fmu.fmi import FmiError, Vector
from hvdc_ident.fmu.instance import Instance, RunFailed

STEP = float(np.cbrt(np.finfo(float).eps))  # of a central difference, in sizes of the variable
AGREES = 1e-5  # of a row's largest entry: directional derivatives that differ by more from differences are not used


class DirectionalDerivative:
    """Derivatives of some unknowns along directions of some knowns.

    An unknown that is itself a known (an output that is a state, the derivative of a position that is the velocity's
    state) has the identity, whatever the FMU says: some answer 0 there. A value reference that stands twice is asked for once.
    """

    def __init__(self, instance: Instance, unknowns: Sequence[int], knowns: Sequence[int]) -> None:
        self._library = instance.library
        place = {r: i for i, r in reversed(list(enumerate(knowns)))}
        asked = list(dict.fromkeys(r for r in unknowns if r not in place))
        self._own = [(i, place[r]) for i, r in enumerate(unknowns) if r in place]
        self._rows = [i for i, r in enumerate(unknowns) if r not in place]
        self._from = [asked.index(r) for r in unknowns if r not in place]
        self._n, self._m, self._count = len(asked), len(knowns), len(unknowns)
        self._unknowns, self._knowns = self._library.references(asked), self._library.references(knowns)
        self._seed, self._found = Vector(self._m), Vector(self._n)

    def along(self, seed: Array) -> Array:
        """(unknowns,) their change for the change `seed` of the knowns."""
        result = np.zeros(self._count)
        if self._n and self._m:
            self._seed.values[:] = seed
            self._library.directional(self._unknowns, self._n, self._knowns, self._m, self._seed, self._found)
            result[self._rows] = self._found.values[self._from]
        for i, k in self._own:
            result[i] = seed[k]
        return result

    def matrix(self) -> Array:
        """(unknowns, knowns): every unit direction."""
        return np.column_stack([self.along(row) for row in np.eye(self._m)]) if self._m else np.zeros((self._count, 0))


class VariationalEquations:
    """Directional derivatives for the sensitivities of a run by some parameters, or by constants added to inputs."""

    def __init__(
        self, instance: Instance, parameters: Sequence[str], sizes: Sequence[float], outputs: Sequence[str]
    ) -> None:
        d = instance.description
        states = [v.reference for v in d.states.values()]
        shown = [d.variable(n).reference for n in outputs]
        varied = {**d.inputs, **d.parameters}
        self.sizes = tuple(sizes)
        self.count = len(parameters)
        self._a = DirectionalDerivative(instance, d.derivatives, states)
        knowns = [[*states, varied[n].reference] for n in parameters]
        self._slopes = [DirectionalDerivative(instance, d.derivatives, k) for k in knowns]
        self._outputs = [DirectionalDerivative(instance, shown, k) for k in knowns]

    def state_matrix(self) -> Array:
        """(nx, nx) A."""
        return self._a.matrix()

    def slopes(self, j: int, s: Array) -> Array:
        """(nx,) dS/dt of the column of parameter j."""
        return self._slopes[j].along(np.append(s, 1.0))

    def outputs(self, j: int, s: Array) -> Array:
        """(outputs,) dy/dp of parameter j."""
        return self._outputs[j].along(np.append(s, 1.0))


@dataclass(frozen=True, eq=False)
class PointJacobian:
    """The Jacobian of [x', y] by [x, u, p] at a point. directional: by column, whether it is the FMU's own.

    error: the largest difference from central differences (or, where those are used, between two step sizes), in
    shares of each row's largest entry. near: whether differences of two step sizes disagree, as beside a limit.
    """

    matrix: Array
    directional: Array
    error: float
    near: bool


class PointEvaluation:
    """The FMU at a point of parameters, states, inputs and time; its events settled there."""

    def __init__(
        self,
        instance: Instance,
        values: Mapping[str, float],
        x: Array | None,
        u: Array,
        t: float,
        outputs: Sequence[str],
    ):
        self.instance, self.values, self.u, self.t = instance, dict(values), np.array(u, dtype=float), t
        self.names = tuple(outputs)
        self.seen = instance.block(self.names)
        self.smooth = [k for k, v in enumerate(instance.description.inputs.values()) if v.continuous]
        self._now = self.u
        instance.begin(values, self.u, t, None, None)
        self.x = instance.library.get_states() if x is None else np.array(x, dtype=float)
        if x is not None:
            self._settle()

    def _settle(self) -> None:
        b = self.instance.library
        b.set_time(self.t)
        b.set_states(self.x)
        b.enter_events()
        self.instance.inputs.set(self.u)
        changed = self.instance.iterate(self.t)
        b.enter_continuous()
        if changed and not np.allclose(b.get_states(), self.x, rtol=1e-12, atol=1e-12):
            raise RunFailed("an event of the FMU sets the states elsewhere at this point", self.t)

    def _again(self, values: Mapping[str, float]) -> None:
        self.instance.begin(values, self.u, self.t, None, None)
        self._settle()
        self._now = self.u

    def evaluate(self) -> tuple[Array, Array]:
        """x' (nx,) and y (outputs,)."""
        return self._at(self.x, self.u)

    def _at(self, x: Array, u: Array) -> tuple[Array, Array]:
        b = self.instance.library
        b.set_states(x)
        if (u != self._now).any():
            self.instance.inputs.set(u)
            self._now = u
        return b.get_slopes().copy(), self.seen.get().copy()

    def derivatives(self, parameters: Sequence[str], sizes: Sequence[float], *, check: bool = True) -> PointJacobian:
        """The Jacobian: columns of the states, of the continuous inputs, of the parameters. sizes: of the parameters.

        check: whether directional derivatives of states and inputs that once agreed are compared again.
        """
        if not check and not parameters and self.instance.agreed:
            own = self._directional([])
            if own is not None and np.isfinite(own).all():
                return PointJacobian(own, np.ones(own.shape[1], dtype=bool), 0.0, False)
        nx = self.x.size
        typical = np.array([v.nominal for v in self.instance.description.inputs.values()])
        u_scale = np.maximum(np.abs(self.u), typical)[self.smooth]
        scale = np.concatenate([np.maximum(np.abs(self.x), self.instance.nominals()), u_scale])
        columns = [self._difference(k, STEP * s) for k, s in enumerate(scale)]
        finer = [self._difference(k, 0.25 * STEP * s) for k, s in enumerate(scale)]
        own = self._directional(list(parameters))
        if parameters:  # some FMUs move a parameter as they give a derivative by it
            self.instance.renew()
        for name, size in zip(parameters, sizes, strict=True):
            columns.append(self._by_parameter(name, STEP * size))
            finer.append(self._by_parameter(name, 4.0 * STEP * size))
        if parameters:  # the instance stands at other values: back to the point
            self._again(self.values)
        numeric = np.column_stack(columns) if columns else np.zeros((nx + len(self.names), 0))
        doubt = np.abs(numeric - np.column_stack(finer)) if columns else numeric
        sizes_of_rows = self._row_sizes(numeric, scale, sizes)
        width = np.concatenate([scale, np.asarray(sizes, dtype=float)])
        share = doubt * width / sizes_of_rows[:, None]
        near = bool((share > 1e-3).any())
        if own is None:
            return PointJacobian(numeric, np.zeros(numeric.shape[1], dtype=bool), float(share.max(initial=0.0)), near)
        apart = np.abs(own - numeric) * width / sizes_of_rows[:, None]
        apart = np.where(np.isfinite(apart), apart, np.inf)
        good = (apart <= AGREES + 10.0 * share).all(axis=0)
        matrix = np.where(good, own, numeric)
        self.instance.agreed = bool(good[: scale.size].all())
        error = np.where(good, apart, share).max(initial=0.0)
        return PointJacobian(matrix, good, float(error), near)

    def _row_sizes(self, matrix: Array, scale: Array, sizes: Sequence[float]) -> Array:
        """(rows,) what each row is measured by: its largest entry times the size of its variable."""
        width = np.concatenate([scale, np.asarray(sizes, dtype=float)])
        largest = np.abs(matrix * width).max(axis=1, initial=0.0)
        return np.where(largest > 0.0, largest, 1.0)

    def _difference(self, k: int, h: float) -> Array:
        nx = self.x.size
        ends = []
        for sign in (1.0, -1.0):
            x, u = self.x.copy(), self.u.copy()
            if k < nx:
                x[k] += sign * h
            else:
                u[self.smooth[k - nx]] += sign * h
            ends.append(np.concatenate(self._at(x, u)))
        self._at(self.x, self.u)
        return (ends[0] - ends[1]) / (2.0 * h)

    def _by_parameter(self, name: str, h: float) -> Array:
        ends = []
        at = self.values.get(name, self.instance.description.parameters[name].start or 0.0)
        for sign in (1.0, -1.0):
            self._again({**self.values, name: at + sign * h})
            ends.append(np.concatenate(self.evaluate()))
        return (ends[0] - ends[1]) / (2.0 * h)

    def _directional(self, parameters: list[str]) -> Array | None:
        """The FMU's own Jacobian; None where it offers none, NaN in columns that it refuses."""
        d = self.instance.description
        if not d.directional:
            return None
        unknowns = [*d.derivatives, *(d.variable(n).reference for n in self.names)]
        inputs = list(d.inputs.values())
        knowns = [v.reference for v in (*d.states.values(), *(inputs[k] for k in self.smooth))]
        try:
            main = DirectionalDerivative(self.instance, unknowns, knowns).matrix()
        except FmiError as e:
            if e.status > 3:
                raise
            main = np.full((len(unknowns), len(knowns)), np.nan)
        columns = [main]
        for name in parameters:
            # Among all states as knowns: an unknown that is a state does not move with the parameter at a fixed point.
            states = [v.reference for v in d.states.values()]
            try:
                one = DirectionalDerivative(self.instance, unknowns, [*states, d.parameters[name].reference])
                columns.append(one.along(np.append(np.zeros(len(states)), 1.0))[:, None])
            except FmiError as e:
                if e.status > 3:
                    raise
                columns.append(np.full((len(unknowns), 1), np.nan))
        return np.column_stack(columns)


SHORT = 1e-3  # step of the differences that show the noise, in sizes of the parameter: as long as those of a search
FARTHER = 4.0  # the second pair's step, in those of the first
LEAST, MOST = 1e-6, 5e-2  # steps that are chosen from, in sizes of the parameter
ENOUGH = 1e-3
"""Relative error of a derivative that one-sided differences may leave. It turns a Gauss-Newton step by as much and
changes a standard error by as much, a tenth of what the second figure of an interval shows."""

Runs = Callable[[float], Array]
"""A run at a value of the parameter: (n, outputs)."""


@dataclass(frozen=True)
class DifferenceStep:
    """A difference step. h: step in the parameter's unit. error: relative, that it leaves. sides: 1 or 2."""

    h: float
    error: float
    sides: int = 2


def noise_of(runs: Runs, middle: Array) -> Array:
    """Return the noise of each output, (outputs,) rms over rows, from six runs.

    runs: runs at a number of short steps, all parameters moved at once: one that changes nothing shows no noise. Fourth
    differences over half a step and over a whole one hold the same noise, and the bend 16 times: their squares tell
    both. So what jumps over a few steps, as a row does that an event passes, counts as noise, and what bends does not.
    """
    at = {0.0: middle, **{k: runs(k) for k in (0.5, 1.0, 1.5, 2.0, 3.0, 4.0)}}
    half, whole = (at[0.0] - 4.0 * at[k] + 6.0 * at[2 * k] - 4.0 * at[3 * k] + at[4 * k] for k in (0.5, 1.0))
    rounding = np.finfo(float).eps * np.abs(middle).max(axis=0, initial=0.0)
    # 1 + 16 + 36 + 16 + 1 times the square of one run's noise.
    square = (256.0 * np.mean(half**2, axis=0) - np.mean(whole**2, axis=0)) / (255.0 * 70.0)
    return np.asarray(np.sqrt(np.maximum(square, rounding**2)))


def first(
    runs: Runs, at: float, size: float, low: float, high: float, middle: Array, noise: Array
) -> tuple[Array, DifferenceStep]:
    """Return the derivative (n, outputs) at `at` within [low, high], from two runs or four, and the step for later.

    size: a typical size of the parameter. middle: the run at `at`. noise: (outputs,). Errors are those of the output
    that is worst off, rms over rows and in its range.
    """
    room = max(at - low, high - at)
    size = min(size, 10.0 * room) if np.isfinite(room) and room > 0 else size
    scale = _scale(middle)
    level = float((noise / scale).max(initial=0.0))
    # A pair's best step is cbrt(3 level) sizes where the third derivative is as large as the parameter's size makes it:
    # that is the second pair's. The first, closer one bears a third derivative sixteen times as large.
    close = _clipped(float(np.cbrt(3.0 * level)) * size, size) / FARTHER
    near, bend = pair(runs, at, close, low, high, middle)
    strength, curve = _norm(near, scale), _norm(bend, scale)
    if strength == 0.0:
        return near, DifferenceStep(close, 0.0, 1)
    h = _clipped(2.0 * float(np.sqrt(level / curve)) if curve > 0.0 else MOST * size, size)
    error = (0.5 * curve * h + 2.0 * level / h) / strength
    own = level / (close * strength) + (close / size) ** 2 / 6.0
    if max(error, own) <= ENOUGH:
        return near, DifferenceStep(h, float(max(error, own)), 1)
    far, _ = pair(runs, at, FARTHER * close, low, high, middle)
    twist = _norm(near - far, scale) / ((FARTHER**2 - 1.0) * close**2)
    h = _clipped(float(np.cbrt(level / (2.0 * twist))) if twist > 0.0 else MOST * size, size)
    step = DifferenceStep(h, float((twist * h * h + level / h) / strength))
    apart = [abs(float(np.log(h / c))) for c in (close, FARTHER * close)]
    if min(apart) < np.log(2.0):  # within a factor of two of the best step the error is within twice the least
        return (near if apart[0] < apart[1] else far), step
    return derivative(runs, at, step, low, high, middle), step


def derivative(runs: Runs, at: float, step: DifferenceStep, low: float, high: float, middle: Array) -> Array:
    """Return the derivative (n, outputs) at `at`, to the order of the step: from one run, or from two."""
    h = step.h
    if step.sides == 1:
        side = h if at + h <= high else -h
        return np.asarray((runs(at + side) - middle) / side)
    return pair(runs, at, h, low, high, middle)[0]


def pair(runs: Runs, at: float, h: float, low: float, high: float, middle: Array) -> tuple[Array, Array]:
    """Return first and second derivative from two more runs: on both sides, or on one where a bound is near."""
    if at - h >= low and at + h <= high:
        up, down = runs(at + h), runs(at - h)
        return np.asarray((up - down) / (2.0 * h)), np.asarray((up - 2.0 * middle + down) / h**2)
    side = h if at + 2.0 * h <= high else -h
    one, two = runs(at + side), runs(at + 2.0 * side)
    return np.asarray((-3.0 * middle + 4.0 * one - two) / (2.0 * side)), np.asarray(
        (middle - 2.0 * one + two) / side**2
    )


def _clipped(h: float, size: float) -> float:
    return float(np.clip(h, LEAST * size, MOST * size))


def _scale(runs: Array) -> Array:
    """Return the range of each output, (outputs,), or its size where it stands still, or 1."""
    spread = np.ptp(runs, axis=0)
    size = np.abs(runs).max(axis=0, initial=0.0)
    return np.where(spread > 1e-9 * size, spread, np.where(size > 0.0, size, 1.0))


def _norm(change: Array, scale: Array) -> float:
    """Return the root mean square over rows of the output that changes most, in its range."""
    if not change.size:
        return 0.0
    return float(rms(change / scale).max())


def rms(rows: Array) -> Array:
    """Return the root mean square over rows, (outputs,)."""
    return np.asarray(np.sqrt(np.mean(rows**2, axis=0)))
