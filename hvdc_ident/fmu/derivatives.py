"""Derivatives of an FMU as it computes them itself, and its Jacobian at a point. In worker processes only.

Directional derivatives are used where the FMU offers them and they agree with differences.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array
from hvdc_ident.fmu.differences import SHORT_STEP
from hvdc_ident.fmu.fmi import FATAL, FmiError, Vector
from hvdc_ident.fmu.instance import Instance, RunFailed
from hvdc_ident.fmu.request import FmuPoint

CENTRAL_STEP = float(np.cbrt(np.finfo(float).eps))  # of a central difference, in sizes of the variable
AGREEMENT = 1e-5  # of a row's largest entry: directional derivatives that differ by more from differences are not used
KINK = 1e-3  # share of a row's largest entry by which differences of two steps disagree beside a limit


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
        changed = self.instance.handle_event(self.t, self.u)
        if changed and not np.allclose(library.get_states(), self.x, rtol=1e-12, atol=1e-12):
            raise RunFailed("an event of the FMU sets the states elsewhere at this point", self.t)

    def _begin_again(self, values: Mapping[str, float]) -> None:
        self.instance.begin(values, self.u, self.t, None, None)
        self._enter()
        self._current_u = self.u

    def beside(self) -> Array:
        """(nx + outputs,) x' and y a little beside the point, in every state and input: what stands still shows there."""
        x, u = self.x.copy(), self.u.copy()
        x += SHORT_STEP * np.maximum(np.abs(x), self.instance.nominals())
        u[self._continuous] += SHORT_STEP * self._input_sizes()
        return self._at(x, u)

    def _input_sizes(self) -> Array:
        """(continuous inputs,) sizes of the inputs that a Jacobian has columns for."""
        typical = np.array([v.nominal for v in self.instance.description.inputs.values()])
        return np.maximum(np.abs(self.u), typical)[self._continuous]

    def _at(self, x: Array, u: Array) -> Array:
        """(nx + outputs,) x' and y."""
        library = self.instance.library
        library.set_states(x)
        if (u != self._current_u).any():
            self.instance.inputs.set(u)
            self._current_u = u
        return np.concatenate([library.get_derivatives(), self._outputs.get()])

    def found(self, parameters: Sequence[str], sizes: Sequence[float], *, check: bool = True) -> FmuPoint:
        """Return the FMU here, with the Jacobian by states, continuous inputs and parameters. sizes: of the parameters.

        check: whether directional derivatives of states and inputs that once agreed are compared again.
        """
        here, nx = self._at(self.x, self.u), self.x.size

        def point(matrix: Array, own: NDArray[np.bool_], error: float, near: bool) -> FmuPoint:
            return FmuPoint(self.x, here[:nx], here[nx:], matrix, own, error, near)

        if not check and not parameters and self.instance.directional_confirmed:
            directional = self._directional([])
            if directional is not None and np.isfinite(directional).all():
                return point(directional, np.ones(directional.shape[1], dtype=bool), 0.0, False)
        scale = np.concatenate([np.maximum(np.abs(self.x), self.instance.nominals()), self._input_sizes()])
        columns = [self._difference(k, CENTRAL_STEP * s) for k, s in enumerate(scale)]
        others = [self._difference(k, 0.25 * CENTRAL_STEP * s) for k, s in enumerate(scale)]
        directional = self._directional(list(parameters))
        if parameters:  # some FMUs move a parameter as they give a derivative by it
            self.instance.renew(parameters)
        for name, size in zip(parameters, sizes, strict=True):
            columns.append(self._difference(name, CENTRAL_STEP * size))
            others.append(self._difference(name, 4.0 * CENTRAL_STEP * size))
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
            return point(numeric, np.zeros(numeric.shape[1], dtype=bool), float(doubt.max(initial=0.0)), near)
        apart = np.abs(directional - numeric) * relative
        apart = np.where(np.isfinite(apart), apart, np.inf)
        agrees: NDArray[np.bool_] = np.all(apart <= AGREEMENT + 10.0 * doubt, axis=0)
        self.instance.directional_confirmed = bool(agrees[: scale.size].all())
        error = np.where(agrees, apart, doubt).max(initial=0.0)
        return point(np.where(agrees, directional, numeric), agrees, float(error), near)

    def _difference(self, by: int | str, h: float) -> Array:
        """Return the central difference by a state or continuous input of this number, or a parameter of this name."""
        up, down = self._displaced(by, h), self._displaced(by, -h)
        if not isinstance(by, str):
            self._at(self.x, self.u)
        return (up - down) / (2.0 * h)

    def _displaced(self, by: int | str, h: float) -> Array:
        x, u = self.x.copy(), self.u.copy()
        if isinstance(by, str):
            value = self.values.get(by, self.instance.description.parameters[by].start or 0.0)
            self._begin_again({**self.values, by: value + h})
        elif by < x.size:
            x[by] += h
        else:
            u[self._continuous[by - x.size]] += h
        return self._at(x, u)

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
