"""Derivatives of an FMU at a point: directional where it offers them and they agree with differences. In the worker alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.fmu.binding import Failure, Vector
from hvdc_ident.fmu.plant import Plant, RunFailed

STEP = float(np.cbrt(np.finfo(float).eps))  # of a central difference, in sizes of the variable
AGREES = 1e-5  # of a row's largest entry: directional derivatives that differ by more from differences are not used


class Directional:
    """Derivatives of some unknowns along directions of some knowns.

    What is its own known (an output that is a state, the derivative of a position that is the velocity's state) has
    the identity, whatever the FMU says: some answer 0 there. A value reference that stands twice is asked for once.
    """

    def __init__(self, plant: Plant, unknowns: Sequence[int], knowns: Sequence[int]) -> None:
        self._binding = plant.binding
        place = {r: i for i, r in reversed(list(enumerate(knowns)))}
        asked = list(dict.fromkeys(r for r in unknowns if r not in place))
        self._own = [(i, place[r]) for i, r in enumerate(unknowns) if r in place]
        self._rows = [i for i, r in enumerate(unknowns) if r not in place]
        self._from = [asked.index(r) for r in unknowns if r not in place]
        self._n, self._m, self._count = len(asked), len(knowns), len(unknowns)
        self._unknowns, self._knowns = self._binding.references(asked), self._binding.references(knowns)
        self._seed, self._found = Vector(self._m), Vector(self._n)

    def along(self, seed: Array) -> Array:
        """(unknowns,) their change for the change `seed` of the knowns."""
        result = np.zeros(self._count)
        if self._n and self._m:
            self._seed.values[:] = seed
            self._binding.directional(self._unknowns, self._n, self._knowns, self._m, self._seed, self._found)
            result[self._rows] = self._found.values[self._from]
        for i, k in self._own:
            result[i] = seed[k]
        return result

    def matrix(self) -> Array:
        """(unknowns, knowns): every unit direction."""
        return np.column_stack([self.along(row) for row in np.eye(self._m)]) if self._m else np.zeros((self._count, 0))


class Tangent:
    """Directional derivatives for the sensitivities of a run by some parameters, or by constants added to inputs."""

    def __init__(self, plant: Plant, parameters: Sequence[str], sizes: Sequence[float], outputs: Sequence[str]) -> None:
        d = plant.description
        states = [v.reference for v in d.states.values()]
        shown = [d.variable(n).reference for n in outputs]
        varied = {**d.inputs, **d.parameters}
        self.sizes = tuple(sizes)
        self.count = len(parameters)
        self._a = Directional(plant, d.derivatives, states)
        knowns = [[*states, varied[n].reference] for n in parameters]
        self._slopes = [Directional(plant, d.derivatives, k) for k in knowns]
        self._outputs = [Directional(plant, shown, k) for k in knowns]

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
class Derivatives:
    """The Jacobian of [x', y] by [x, u, p] at a point. directional: by column, whether it is the FMU's own.

    error: the largest difference from central differences (or, where those are used, between two step sizes), in
    shares of each row's largest entry. near: whether differences of two step sizes disagree, as beside a limit.
    """

    matrix: Array
    directional: Array
    error: float
    near: bool


class Point:
    """The FMU at a point of parameters, states, inputs and time; its events settled there."""

    def __init__(
        self, plant: Plant, values: Mapping[str, float], x: Array | None, u: Array, t: float, outputs: Sequence[str]
    ):
        self.plant, self.values, self.u, self.t = plant, dict(values), np.array(u, dtype=float), t
        self.names = tuple(outputs)
        self.seen = plant.block(self.names)
        self.smooth = [k for k, v in enumerate(plant.description.inputs.values()) if v.continuous]
        self._now = self.u
        plant.begin(values, self.u, t, None, None)
        self.x = plant.binding.get_states() if x is None else np.array(x, dtype=float)
        if x is not None:
            self._settle()

    def _settle(self) -> None:
        b = self.plant.binding
        b.set_time(self.t)
        b.set_states(self.x)
        b.enter_events()
        self.plant.inputs.set(self.u)
        changed = self.plant.iterate(self.t)
        b.enter_continuous()
        if changed and not np.allclose(b.get_states(), self.x, rtol=1e-12, atol=1e-12):
            raise RunFailed("an event of the FMU sets the states elsewhere at this point", self.t)

    def _again(self, values: Mapping[str, float]) -> None:
        self.plant.begin(values, self.u, self.t, None, None)
        self._settle()
        self._now = self.u

    def evaluate(self) -> tuple[Array, Array]:
        """x' (nx,) and y (outputs,)."""
        return self._at(self.x, self.u)

    def _at(self, x: Array, u: Array) -> tuple[Array, Array]:
        b = self.plant.binding
        b.set_states(x)
        if (u != self._now).any():
            self.plant.inputs.set(u)
            self._now = u
        return b.get_slopes().copy(), self.seen.get().copy()

    def derivatives(self, parameters: Sequence[str], sizes: Sequence[float], *, check: bool = True) -> Derivatives:
        """The Jacobian: columns of the states, of the continuous inputs, of the parameters. sizes: of the parameters.

        check: whether directional derivatives of states and inputs that once agreed are compared again.
        """
        if not check and not parameters and self.plant.agreed:
            own = self._directional([])
            if own is not None and np.isfinite(own).all():
                return Derivatives(own, np.ones(own.shape[1], dtype=bool), 0.0, False)
        nx = self.x.size
        typical = np.array([v.nominal for v in self.plant.description.inputs.values()])
        u_scale = np.maximum(np.abs(self.u), typical)[self.smooth]
        scale = np.concatenate([np.maximum(np.abs(self.x), self.plant.nominals()), u_scale])
        columns = [self._difference(k, STEP * s) for k, s in enumerate(scale)]
        finer = [self._difference(k, 0.25 * STEP * s) for k, s in enumerate(scale)]
        own = self._directional(list(parameters))
        if parameters:  # some FMUs move a parameter as they give a derivative by it
            self.plant.renew()
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
            return Derivatives(numeric, np.zeros(numeric.shape[1], dtype=bool), float(share.max(initial=0.0)), near)
        apart = np.abs(own - numeric) * width / sizes_of_rows[:, None]
        apart = np.where(np.isfinite(apart), apart, np.inf)
        good = (apart <= AGREES + 10.0 * share).all(axis=0)
        matrix = np.where(good, own, numeric)
        self.plant.agreed = bool(good[: scale.size].all())
        error = np.where(good, apart, share).max(initial=0.0)
        return Derivatives(matrix, good, float(error), near)

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
        at = self.values.get(name, self.plant.description.parameters[name].start or 0.0)
        for sign in (1.0, -1.0):
            self._again({**self.values, name: at + sign * h})
            ends.append(np.concatenate(self.evaluate()))
        return (ends[0] - ends[1]) / (2.0 * h)

    def _directional(self, parameters: list[str]) -> Array | None:
        """The FMU's own Jacobian; None where it offers none, NaN in columns that it refuses."""
        d = self.plant.description
        if not d.directional:
            return None
        unknowns = [*d.derivatives, *(d.variable(n).reference for n in self.names)]
        inputs = list(d.inputs.values())
        knowns = [v.reference for v in (*d.states.values(), *(inputs[k] for k in self.smooth))]
        try:
            main = Directional(self.plant, unknowns, knowns).matrix()
        except Failure as e:
            if e.status > 3:
                raise
            main = np.full((len(unknowns), len(knowns)), np.nan)
        columns = [main]
        for name in parameters:
            # Among all states as knowns: an unknown that is a state does not move with the parameter at a fixed point.
            states = [v.reference for v in d.states.values()]
            try:
                one = Directional(self.plant, unknowns, [*states, d.parameters[name].reference])
                columns.append(one.along(np.append(np.zeros(len(states)), 1.0))[:, None])
            except Failure as e:
                if e.status > 3:
                    raise
                columns.append(np.full((len(unknowns), 1), np.nan))
        return np.column_stack(columns)
