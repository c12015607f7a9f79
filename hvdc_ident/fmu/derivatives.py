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
from numpy.typing import NDArray

from hvdc_ident.data import Array
from hvdc_ident.fmu.fmi import FATAL, FmiError, Vector
from hvdc_ident.fmu.instance import Instance, RunFailed

CENTRAL_STEP = float(np.cbrt(np.finfo(float).eps))  # of a central difference, in sizes of the variable
AGREEMENT = 1e-5  # of a row's largest entry: directional derivatives that differ by more from differences are not used
KINK = 1e-3  # share of a row's largest entry by which differences of two steps disagree beside a limit
SHORT_STEP = 1e-3  # of the differences that show a run's noise, in sizes of the parameter: as long as those of a search
SECOND_STEP = 4.0  # the second pair's step, in those of the first
LEAST_STEP, LARGEST_STEP = 1e-6, 5e-2  # that are chosen from, in sizes of the parameter
SUFFICIENT = 1e-3
"""Relative error of a derivative that one-sided differences may leave. It turns a Gauss-Newton step by as much and
changes a standard error by as much, a tenth of what the second figure of an interval shows."""


class DirectionalDerivative:
    """Derivatives of some unknowns along directions of some knowns.

    An unknown that is itself a known (an output that is a state, the derivative of a position that is the velocity's
    state) has the identity, whatever the FMU answers: some answer 0. A value reference that stands twice is asked for once.
    """

    def __init__(self, instance: Instance, unknowns: Sequence[int], knowns: Sequence[int]) -> None:
        self._library = instance.library
        index = {r: i for i, r in reversed(list(enumerate(knowns)))}
        asked = list(dict.fromkeys(r for r in unknowns if r not in index))
        self._identities = [(i, index[r]) for i, r in enumerate(unknowns) if r in index]
        self._rows = [i for i, r in enumerate(unknowns) if r not in index]
        self._columns = [asked.index(r) for r in unknowns if r not in index]
        self._n, self._m, self._count = len(asked), len(knowns), len(unknowns)
        self._unknowns, self._knowns = self._library.references(asked), self._library.references(knowns)
        self._seed, self._result = Vector(self._m), Vector(self._n)

    def along(self, seed: Array) -> Array:
        """(unknowns,) their change for the change `seed` of the knowns."""
        result = np.zeros(self._count)
        if self._n and self._m:
            self._seed.values[:] = seed
            self._library.directional(self._unknowns, self._n, self._knowns, self._m, self._seed, self._result)
            result[self._rows] = self._result.values[self._columns]
        for i, k in self._identities:
            result[i] = seed[k]
        return result

    def matrix(self) -> Array:
        """(unknowns, knowns): every unit direction."""
        return np.column_stack([self.along(row) for row in np.eye(self._m)]) if self._m else np.zeros((self._count, 0))


class SensitivityEquations:
    """S' = A S + df/dp and dy/dp of a run, by parameters or by constants added to inputs, from directional derivatives."""

    def __init__(
        self, instance: Instance, parameters: Sequence[str], sizes: Sequence[float], outputs: Sequence[str]
    ) -> None:
        d = instance.description
        states = [v.reference for v in d.states.values()]
        recorded = [d.variable(n).reference for n in outputs]
        varied = {**d.inputs, **d.parameters}
        self.sizes = tuple(sizes)
        self.count = len(parameters)
        self._a = DirectionalDerivative(instance, d.derivatives, states)
        knowns = [[*states, varied[n].reference] for n in parameters]
        self._derivatives = [DirectionalDerivative(instance, d.derivatives, k) for k in knowns]
        self._outputs = [DirectionalDerivative(instance, recorded, k) for k in knowns]

    def state_matrix(self) -> Array:
        """(nx, nx) A."""
        return self._a.matrix()

    def derivatives(self, j: int, s: Array) -> Array:
        """(nx,) dS/dt of the column of parameter j."""
        return self._derivatives[j].along(np.append(s, 1.0))

    def outputs(self, j: int, s: Array) -> Array:
        """(outputs,) dy/dp of parameter j."""
        return self._outputs[j].along(np.append(s, 1.0))


class PointEvaluation:
    """The FMU at values of parameters, states, inputs and time, with its events processed there."""

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
        self._outputs = instance.variables(self.names)
        self._continuous = [k for k, v in enumerate(instance.description.inputs.values()) if v.continuous]
        self._current_u = self.u
        instance.begin(values, self.u, t, None, None)
        self.x = instance.library.get_states() if x is None else np.array(x, dtype=float)
        if x is not None:
            self._enter()

    def _enter(self) -> None:
        """Set states and inputs, and process the events there."""
        library = self.instance.library
        library.set_time(self.t)
        library.set_states(self.x)
        library.enter_event_mode()
        self.instance.inputs.set(self.u)
        changed = self.instance.update_discrete_states(self.t)
        library.enter_continuous_time_mode()
        if changed and not np.allclose(library.get_states(), self.x, rtol=1e-12, atol=1e-12):
            raise RunFailed("an event of the FMU sets the states elsewhere at this point", self.t)

    def _begin_again(self, values: Mapping[str, float]) -> None:
        self.instance.begin(values, self.u, self.t, None, None)
        self._enter()
        self._current_u = self.u

    def evaluate(self) -> tuple[Array, Array]:
        """x' (nx,) and y (outputs,)."""
        return self._at(self.x, self.u)

    def beside(self) -> Array:
        """(nx + outputs,) x' and y a little beside the point, in every state and input: what stands still shows there."""
        x, u = self.x.copy(), self.u.copy()
        x += SHORT_STEP * np.maximum(np.abs(x), self.instance.nominals())
        u[self._continuous] += SHORT_STEP * self._input_sizes()
        return np.concatenate(self._at(x, u))

    def _input_sizes(self) -> Array:
        """(continuous inputs,) sizes of the inputs that a Jacobian has columns for."""
        typical = np.array([v.nominal for v in self.instance.description.inputs.values()])
        return np.maximum(np.abs(self.u), typical)[self._continuous]

    def _at(self, x: Array, u: Array) -> tuple[Array, Array]:
        library = self.instance.library
        library.set_states(x)
        if (u != self._current_u).any():
            self.instance.inputs.set(u)
            self._current_u = u
        return library.get_derivatives().copy(), self._outputs.get().copy()

    def jacobian(self, parameters: Sequence[str], sizes: Sequence[float], *, check: bool = True) -> PointJacobian:
        """Return the Jacobian by states, continuous inputs and parameters. sizes: of the parameters.

        check: whether directional derivatives of states and inputs that once agreed are compared again.
        """
        if not check and not parameters and self.instance.directional_confirmed:
            directional = self._directional([])
            if directional is not None and np.isfinite(directional).all():
                return PointJacobian(directional, np.ones(directional.shape[1], dtype=bool), 0.0, False)
        scale = np.concatenate([np.maximum(np.abs(self.x), self.instance.nominals()), self._input_sizes()])
        columns = [self._difference(k, CENTRAL_STEP * s) for k, s in enumerate(scale)]
        others = [self._difference(k, 0.25 * CENTRAL_STEP * s) for k, s in enumerate(scale)]
        directional = self._directional(list(parameters))
        if parameters:  # some FMUs move a parameter as they give a derivative by it
            self.instance.renew(parameters)
        for name, size in zip(parameters, sizes, strict=True):
            columns.append(self._difference_by(name, CENTRAL_STEP * size))
            others.append(self._difference_by(name, 4.0 * CENTRAL_STEP * size))
        if parameters:  # the instance has other values: back to the point
            self._begin_again(self.values)
        numeric = np.column_stack(columns) if columns else np.zeros((self.x.size + len(self.names), 0))
        doubt = np.abs(numeric - np.column_stack(others)) if columns else numeric
        width = np.concatenate([scale, np.asarray(sizes, dtype=float)])
        largest = np.abs(numeric * width).max(axis=1, initial=0.0)
        relative = width / np.where(largest > 0.0, largest, 1.0)[:, None]
        doubt = doubt * relative
        near = bool((doubt > KINK).any())
        if directional is None:
            return PointJacobian(numeric, np.zeros(numeric.shape[1], dtype=bool), float(doubt.max(initial=0.0)), near)
        apart = np.abs(directional - numeric) * relative
        apart = np.where(np.isfinite(apart), apart, np.inf)
        agrees: NDArray[np.bool_] = np.all(apart <= AGREEMENT + 10.0 * doubt, axis=0)
        self.instance.directional_confirmed = bool(agrees[: scale.size].all())
        error = np.where(agrees, apart, doubt).max(initial=0.0)
        return PointJacobian(np.where(agrees, directional, numeric), agrees, float(error), near)

    def _difference(self, k: int, h: float) -> Array:
        """Return the central difference by state or continuous input k."""
        ends = []
        for sign in (1.0, -1.0):
            x, u = self.x.copy(), self.u.copy()
            if k < x.size:
                x[k] += sign * h
            else:
                u[self._continuous[k - x.size]] += sign * h
            ends.append(np.concatenate(self._at(x, u)))
        self._at(self.x, self.u)
        return (ends[0] - ends[1]) / (2.0 * h)

    def _difference_by(self, name: str, h: float) -> Array:
        """Return the central difference by a parameter."""
        ends = []
        value = self.values.get(name, self.instance.description.parameters[name].start or 0.0)
        for sign in (1.0, -1.0):
            self._begin_again({**self.values, name: value + sign * h})
            ends.append(np.concatenate(self.evaluate()))
        return (ends[0] - ends[1]) / (2.0 * h)

    def _directional(self, parameters: list[str]) -> Array | None:
        """Return the FMU's own Jacobian; None where it offers none, NaN in columns that it refuses."""
        d = self.instance.description
        if not d.directional:
            return None
        unknowns = [*d.derivatives, *(d.variable(n).reference for n in self.names)]
        inputs = list(d.inputs.values())
        states = [v.reference for v in d.states.values()]
        knowns = [*states, *(inputs[k].reference for k in self._continuous)]

        def columns(knowns: Sequence[int], seeds: Array) -> Array:
            try:
                derivative = DirectionalDerivative(self.instance, unknowns, knowns)
                return np.array([derivative.along(seed) for seed in seeds]).reshape(len(seeds), len(unknowns)).T
            except FmiError as e:
                if e.status >= FATAL:
                    raise
                return np.full((len(unknowns), len(seeds)), np.nan)

        # Among all states as knowns: an unknown that is a state does not move with the parameter at a fixed point.
        unit = np.append(np.zeros(len(states)), 1.0)[None]
        by_parameters = [columns([*states, d.parameters[n].reference], unit) for n in parameters]
        return np.column_stack([columns(knowns, np.eye(len(knowns))), *by_parameters])


@dataclass(frozen=True, eq=False)
class PointJacobian:
    """The Jacobian of [x', y] by [x, u, p] at a point. directional: by column, whether it is the FMU's own.

    error: the largest difference from central differences (or, where those are used, between two step sizes), in
    shares of each row's largest entry. near: whether differences of two step sizes disagree, as beside a limit.
    """

    matrix: Array
    directional: NDArray[np.bool_]
    error: float
    near: bool


# --- differences of runs ---

RunBy = Callable[[float], Array]
"""A run as a function of the parameter: (n, outputs)."""


@dataclass(frozen=True)
class DifferenceStep:
    """A difference step. h: step in the parameter's unit. error: relative, that it leaves. sides: 1 or 2."""

    h: float
    error: float
    sides: int = 2


def noise_of(run: RunBy, middle: Array) -> Array:
    """Return the noise of each output, (outputs,) rms over rows, from six runs.

    run: a run at a number of short steps, all parameters moved at once: one that changes nothing shows no noise. Fourth
    differences over half a step and over a whole one hold the same noise, and the curvature 16 times: their squares tell
    both. So what jumps over a few steps, as a row does that an event passes, counts as noise, and what bends does not.
    """
    at = {0.0: middle, **{k: run(k) for k in (0.5, 1.0, 1.5, 2.0, 3.0, 4.0)}}
    half, whole = (at[0.0] - 4.0 * at[k] + 6.0 * at[2 * k] - 4.0 * at[3 * k] + at[4 * k] for k in (0.5, 1.0))
    rounding = np.finfo(float).eps * np.abs(middle).max(axis=0, initial=0.0)
    # 1 + 16 + 36 + 16 + 1 times the square of one run's noise.
    square = (256.0 * np.mean(half**2, axis=0) - np.mean(whole**2, axis=0)) / (255.0 * 70.0)
    return np.asarray(np.sqrt(np.maximum(square, rounding**2)))


def first_difference(
    run: RunBy, value: float, size: float, low: float, high: float, middle: Array, noise: Array
) -> tuple[Array, DifferenceStep]:
    """Return the derivative (n, outputs) at a value within [low, high], from two runs or four, and the step for later.

    size: a typical size of the parameter. middle: the run at the value. noise: (outputs,). Errors are those of the
    output with the largest, rms over rows and in its range.
    """
    room = max(value - low, high - value)
    size = min(size, 10.0 * room) if np.isfinite(room) and room > 0 else size
    scale = _ranges(middle)
    level = float((noise / scale).max(initial=0.0))
    # A pair's best step is cbrt(3 level) sizes where the third derivative is as large as the parameter's size makes it:
    # that is the second pair's. The first, closer one bears a third derivative sixteen times as large.
    close = _clipped(float(np.cbrt(3.0 * level)) * size, size) / SECOND_STEP
    near, second_derivative = difference_pair(run, value, close, low, high, middle)
    strength, curvature = _largest(near, scale), _largest(second_derivative, scale)
    if strength == 0.0:
        return near, DifferenceStep(close, 0.0, 1)
    h = _clipped(2.0 * float(np.sqrt(level / curvature)) if curvature > 0.0 else LARGEST_STEP * size, size)
    error = (0.5 * curvature * h + 2.0 * level / h) / strength
    pair_error = level / (close * strength) + (close / size) ** 2 / 6.0
    if max(error, pair_error) <= SUFFICIENT:
        return near, DifferenceStep(h, float(max(error, pair_error)), 1)
    far, _ = difference_pair(run, value, SECOND_STEP * close, low, high, middle)
    third = _largest(near - far, scale) / ((SECOND_STEP**2 - 1.0) * close**2)
    h = _clipped(float(np.cbrt(level / (2.0 * third))) if third > 0.0 else LARGEST_STEP * size, size)
    step = DifferenceStep(h, float((third * h * h + level / h) / strength))
    ratios = [abs(float(np.log(h / c))) for c in (close, SECOND_STEP * close)]
    if min(ratios) < np.log(2.0):  # within a factor of two of the best step the error is within twice the least
        return (near if ratios[0] < ratios[1] else far), step
    return difference(run, value, step, low, high, middle), step


def difference(run: RunBy, value: float, step: DifferenceStep, low: float, high: float, middle: Array) -> Array:
    """Return the derivative (n, outputs) at a value, to the order of the step: from one run, or from two."""
    h = step.h
    if step.sides == 1:
        side = h if value + h <= high else -h
        return np.asarray((run(value + side) - middle) / side)
    return difference_pair(run, value, h, low, high, middle)[0]


def difference_pair(run: RunBy, value: float, h: float, low: float, high: float, middle: Array) -> tuple[Array, Array]:
    """Return first and second derivative from two more runs: on both sides, or on one where a bound is near."""
    if value - h >= low and value + h <= high:
        up, down = run(value + h), run(value - h)
        return np.asarray((up - down) / (2.0 * h)), np.asarray((up - 2.0 * middle + down) / h**2)
    side = h if value + 2.0 * h <= high else -h
    one, two = run(value + side), run(value + 2.0 * side)
    first = (-3.0 * middle + 4.0 * one - two) / (2.0 * side)
    return np.asarray(first), np.asarray((middle - 2.0 * one + two) / side**2)


def _clipped(h: float, size: float) -> float:
    return float(np.clip(h, LEAST_STEP * size, LARGEST_STEP * size))


def _ranges(outputs: Array) -> Array:
    """Return the range of each output, (outputs,), or its size where it is constant, or 1."""
    spread = np.ptp(outputs, axis=0)
    size = np.abs(outputs).max(axis=0, initial=0.0)
    return np.where(spread > 1e-9 * size, spread, np.where(size > 0.0, size, 1.0))


def _largest(change: Array, scale: Array) -> float:
    """Return the root mean square over rows of the output that changes most, in its range."""
    return float(rms(change / scale).max()) if change.size else 0.0


def rms(rows: Array) -> Array:
    """Return the root mean square over rows, (outputs,)."""
    return np.asarray(np.sqrt(np.mean(rows**2, axis=0)))
