"""Equations and linear model of a model-exchange FMU, on its derivatives, and on its own Jacobian where that agrees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hvdc_ident.errors import LinearizationError, ModelError, SimulationError, SteadyStateError, require_known
from hvdc_ident.fmu import FmuModel, FmuPoint, at_point, smooth_inputs
from hvdc_ident.fmu.differences import ParameterRuns, extrapolated_difference, together
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize.delays import EPS
from hvdc_ident.linearize.equilibrium import EquilibriumSearch, PointOptions, solved
from hvdc_ident.linearize.kinds import LinearOptions
from hvdc_ident.linearize.limits import Limit
from hvdc_ident.linearize.linear_model import Gradient, LinearModel
from hvdc_ident.linearize.point import OperatingPoint, unstable_by
from hvdc_ident.linearize.stability import Characteristic, quartered
from hvdc_ident.linearize.system import Array, Layout
from hvdc_ident.model import External

ACCURACY = 1e-9
"""Largest scaled derivative that counts as rest: an FMU's own loops are solved no better."""
NUDGE = 1e-3
"""Change of a parameter, in its sizes, by which derivatives of A, B, C, D are taken; extrapolated from half of it."""


class FmuSystem:
    """An FMU as a search for a point sees it (`equilibrium.System`): no unknowns, no delays, switches as they stand."""

    unknowns: tuple[str, ...] = ()
    extras: tuple[str, ...] = ()
    with_rest: tuple[int, ...] = ()
    with_start: tuple[int, ...] = ()
    accuracy = ACCURACY

    def __init__(self, model: FmuModel) -> None:
        self.model = model
        self.states, self.inputs = tuple(model.states), tuple(model.inputs)
        self.parameters, self.outputs = tuple(model.parameters), tuple(model.outputs)
        self.layout = Layout(len(self.states), 0, len(self.inputs), 0, len(self.outputs), len(self.parameters), 0, 0)
        self._smooth = [self.inputs.index(n) for n in smooth_inputs(model)]

    def evaluate(self, y: Array, w: Array, p: Array, parameters: Sequence[int] = ()) -> tuple[Array, Array]:
        """Return values (rows,) and Jacobian (rows, columns + parameters), 0 by inputs that change in steps.

        Both are nan where the FMU refuses the point. Raises SimulationError where it cannot be run.
        """
        size = self.layout
        jac = np.zeros((size.rows, size.columns + len(parameters)))
        given = dict(zip((*self.parameters, *self.inputs), (*p.tolist(), *w[1:].tolist()), strict=True))
        names = [self.parameters[k] for k in parameters]
        try:
            at = at_point(self.model, given, y, self.outputs, names, float(w[0]), check=False)
        except SimulationError as e:
            if "returned" not in e.what:  # the FMU refused the point, which ends nothing: Newton takes a shorter step
                raise
            return np.full(size.rows, np.nan), np.full(jac.shape, np.nan)
        places = [*range(size.nx), *(size.nx + k for k in self._smooth), *range(size.columns, jac.shape[1])]
        jac[:, places] = at.jacobian
        return np.concatenate([at.derivatives, at.outputs]), jac

    def limits(self, y: Array, w: Array, p: Array) -> tuple[Limit, ...]:
        """Return none: an FMU does not show them."""
        return ()


@dataclass(frozen=True)
class LinearFmu:
    """A model-exchange FMU, as `kinds.Kind` has it."""

    model: FmuModel

    @classmethod
    def of(cls, model: External) -> LinearFmu:
        """Return the FMU that a model is. Raises ModelError for another kind of model, and for effects at an FMU's ends."""
        if not isinstance(model, FmuModel):
            raise ModelError("this model shows no equations", where=f"model '{model.name}'")
        if model.effects:
            raise ModelError(
                "an FMU with effects at its ends is not linearised",
                where=f"model '{model.name}'",
                expected="the FMU alone",
                hint="linearise it without them; lags and delays can be put in series with the result",
            )
        return cls(model)

    def point(self, asked: PointOptions) -> OperatingPoint:
        """Return an operating point, its search begun where the FMU's initialisation ends.

        at="start": the FMU stays there. Raises UnknownNameError, SteadyStateError for a free input that changes in steps.
        """
        model, search = self._search(asked)
        return OperatingPoint.of(LinearFmu(model), search, solved(model.name, search, asked.guess), "trimmed")

    def equation(self, point: OperatingPoint) -> Characteristic | None:
        """Return the characteristic equation at a point, without the delays that an FMU does not show; None where it is not finite."""
        assert point.search is not None
        n = len(point.states)
        a = point.search.system.evaluate(point.y, point.w, point.p)[1][:n, :n]
        none = np.zeros((n, 0))
        equation = Characteristic.rational(a, none, none.T, np.zeros((0, 0)), ACCURACY)
        return equation if np.isfinite(a).all() else None

    def notes(self, point: OperatingPoint) -> tuple[str, ...]:
        """Return a sentence on a point that is unstable."""
        return (unstable_by(point.equation),) if point.stable is False else ()

    def linear(self, point: OperatingPoint, asked: LinearOptions) -> LinearModel:
        """Return A, B, C, D at a point; derivatives by parameters from differences of points and Jacobians.

        provenance tells the method ("directional", or "finite-difference" where one column is), its error, and whether a
        limit is near. Raises UnknownNameError, and LinearizationError for an input that changes in steps only, and for an
        option about delays, limits or algebraic unknowns, which an FMU does not show.
        """
        _check_shown(self.model, asked)
        model = self.model.recording(asked.outputs or ())
        ins, outs = _names(model, asked.inputs, asked.outputs)
        require_known("parameter", asked.sensitivities, model.parameters, f"model '{model.name}'")
        p = _at(model, point, outs)
        matrix = _matrix(model, p, ins)
        notes = {
            "method": "directional" if p.directional.all() else "finite-difference",
            "jacobian error": f"{p.error:.2g}, of each row's largest entry",
            "limits": "differences of two step sizes disagree: a limit is near" if p.near else "held as at the point",
        }
        states, kind = tuple(model.states), LinearFmu(model)
        return LinearModel(
            *quartered(matrix, len(states)), np.eye(len(states)),
            states,
            ins,
            outs,
            tuple(model.states[n].unit for n in states),
            tuple(model.inputs[n].unit for n in ins),
            tuple(model.outputs[n].unit for n in outs),
            point=point,
            name=model.name,
            provenance=FrozenMap(notes),
            gradients=FrozenMap({n: kind._gradient(point, n, ins, outs, matrix) for n in asked.sensitivities}),
            error=EPS if p.directional.all() else max(EPS, p.error),
        )  # fmt: skip

    def jacobian_error(self, point: OperatingPoint, outputs: Sequence[str] | None) -> float:
        """Return the largest difference between the Jacobian and central differences, of each row's largest entry.

        Where differences are the Jacobian, it is that between two step sizes.
        """
        model = self.model.recording(outputs or ())
        return _at(model, point, _names(model, None, outputs)[1]).error

    def _search(self, asked: PointOptions) -> tuple[FmuModel, EquilibriumSearch]:
        """Return the FMU, with fixed variables recorded, and the search for its point."""
        model, fixed = self.model, asked.fixed
        known = [*model.parameters, *model.inputs]
        model = model.recording(n for n in fixed if n not in known and model.records(n))
        everything = [*known, *model.states, *model.outputs]
        require_known("variable", (*fixed, *asked.guess, *asked.bounds), everything, f"model '{model.name}'")
        for name in asked.free:
            if name in model.inputs and name not in smooth_inputs(model):
                raise SteadyStateError(f"'{name}' changes in steps only and cannot be sought", where="free")
        s = FmuSystem(model)
        given = {n: v for n, v in fixed.items() if n in known}
        begin = at_point(model, given, None, s.outputs, (), asked.time, check=False)
        start = dict(zip(s.states, begin.x.tolist(), strict=True))
        if asked.at == "start":
            held = {**start, **{n: v for n, v in asked.guess.items() if n in start}, **fixed}
            asked = replace(asked, fixed=held, moving=s.states)
        return model, EquilibriumSearch.of(model, s, asked, start)

    def _gradient(
        self, point: OperatingPoint, name: str, inputs: Sequence[str], outputs: Sequence[str], matrix: Array
    ) -> Gradient:
        """Return the total derivatives of A, B, C, D by a parameter, the shift of the operating point included.

        matrix: [A, B; C, D] at the point.
        """
        model, parameter = self.model, self.model.parameters[name]
        held = {**point.parameters, **point.inputs}
        near = dict(point.states) if point.at == "steady" else {}

        def at(value: float) -> Array:
            moved = {**held, name: value}
            search = self._search(PointOptions(moved, guess=near, at=point.at, time=point.time))[1]
            states = solved(model.name, search, near).v
            return _matrix(model, at_point(model, moved, states, outputs, (), point.time), inputs)

        line = ParameterRuns(float, held[name], parameter.size, parameter.min, parameter.max, matrix)
        rule = extrapolated_difference(line, NUDGE * parameter.size)
        (slope,) = together([rule], lambda values: [at(value) for value in values])
        return Gradient(*quartered(slope, len(model.states)))


def _check_shown(model: FmuModel, asked: LinearOptions) -> None:
    """Raise LinearizationError for an option about what an FMU does not show."""
    options = (
        ("pade_order", asked.pade_order is not None, "an FMU does not show its delays"),
        ("side", asked.side != "refuse", "an FMU does not show its limits"),
        ("descriptor", asked.descriptor, "an FMU does not show its algebraic unknowns"),
    )
    for name, given, why in options:
        if given:
            raise LinearizationError(
                f"{why}: {name} has no meaning",
                where=f"model '{model.name}'",
                got=f"{name}={getattr(asked, name)!r}",
                hint=f"leave {name} out, or take the model's equations",
            )


def _names(
    model: FmuModel, inputs: Sequence[str] | None, outputs: Sequence[str] | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    smooth = smooth_inputs(model)
    ins = smooth if inputs is None else tuple(inputs)
    outs = tuple(model.outputs) if outputs is None else tuple(outputs)
    require_known("input", ins, model.inputs, f"model '{model.name}'")
    for n in ins:
        if n not in smooth:
            raise LinearizationError(f"input '{n}' changes in steps only", where=f"model '{model.name}'")
    return ins, outs


def _at(model: FmuModel, point: OperatingPoint, outputs: Sequence[str]) -> FmuPoint:
    values = {**point.parameters, **point.inputs}
    return at_point(model, values, np.array([*point.states.values()], dtype=float), outputs, (), point.time)


def _matrix(model: FmuModel, p: FmuPoint, inputs: Sequence[str]) -> Array:
    """Return [A, B; C, D] between inputs and the outputs at a point."""
    n, smooth = len(model.states), smooth_inputs(model)
    return p.jacobian[:, [*range(n), *(n + smooth.index(i) for i in inputs)]]
