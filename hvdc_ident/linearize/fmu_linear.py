"""Operating point and linear model of a model-exchange FMU: Newton on its derivatives, its own Jacobian where that agrees.

Effects at the FMU's ends are linearised by themselves and put in series with it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from hvdc_ident.errors import (
    LinearizationError,
    ModelError,
    SimulationError,
    SteadyStateError,
    require_known,
    unknown_name,
)
from hvdc_ident.fmu import FmuModel, FmuPoint, at_point, smooth_inputs
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize.equilibrium import At, newton
from hvdc_ident.linearize.linear_model import Gradient, LinearModel
from hvdc_ident.linearize.point import OperatingPoint
from hvdc_ident.linearize.system import Array
from hvdc_ident.model import External

ACCURACY = 1e-9
"""Largest scaled derivative that counts as rest: an FMU's own loops are solved no better."""
NUDGE = 1e-3
"""Change of a parameter, in its sizes, by which derivatives of A, B, C, D are taken; extrapolated from half of it."""


def fmu_of(model: External) -> FmuModel:
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
    return model


def find_point(
    given: External,
    fixed: Mapping[str, float],
    free: Collection[str],
    bounds: Mapping[str, tuple[float, float]],
    guess: Mapping[str, float],
    at: At,
    moving: Collection[str],
    time: float,
) -> OperatingPoint:
    """Return the operating point; arguments as `find_operating_point`. The search begins where the FMU's initialisation ends.

    at="start": the FMU stays there. Raises SteadyStateError, with the worst equation, where there is none.
    """
    model = fmu_of(given)
    return _FmuSearch(model, dict(fixed), tuple(free), bounds, dict(guess), at, tuple(moving), time).point()


class _FmuSearch:
    """Search for an operating point of an FMU: values held, values sought and their equations."""

    def __init__(
        self,
        model: FmuModel,
        fixed: dict[str, float],
        free: tuple[str, ...],
        bounds: Mapping[str, tuple[float, float]],
        guess: dict[str, float],
        at: At,
        moving: tuple[str, ...],
        time: float,
    ) -> None:
        self.at, self.time = at, time
        known = [*model.parameters, *model.inputs]
        model = self.model = model.recording(n for n in fixed if n not in known and model.records(n))
        for name in (*fixed, *guess, *bounds):
            if name not in known and name not in model.states and name not in model.outputs:
                everything = [*known, *model.states, *model.outputs]
                raise unknown_name("variable", name, everything, where=f"model '{model.name}'")
        require_known("parameter or input", free, known, f"model '{model.name}', free")
        require_known("state", moving, model.states, f"model '{model.name}', moving")
        self.states, self.outputs = list(model.states), list(model.outputs)
        self.values = {n: v for n, v in fixed.items() if n in known}
        self.held = {n: v for n, v in fixed.items() if n in model.states}
        self.wanted = {n: v for n, v in fixed.items() if n in model.outputs and n not in self.held}
        self.free_inputs = [n for n in free if n in model.inputs]
        self.free_parameters = [n for n in free if n in model.parameters]
        smooth = smooth_inputs(model)
        for name in self.free_inputs:
            if name not in smooth:
                raise SteadyStateError(f"'{name}' changes in steps only and cannot be sought", where="free")
        self.inputs = list(smooth)
        self.rest = [] if at == "start" else [n for n in self.states if n not in moving]
        self.open = [] if at == "start" else [n for n in self.states if n not in self.held]
        self.guess, self.bounds = guess, bounds
        self.last: FmuPoint | None = None

    def point(self) -> OperatingPoint:
        first = self._evaluate(self.values, None)
        x0 = first.x.copy()
        for name, value in {**self.guess, **self.held}.items():
            if name in self.states:
                x0[self.states.index(name)] = value
        self.x, sought = x0, [*self.open, *self.free_inputs, *self.free_parameters]
        if not sought:
            found = self._evaluate(self.values, x0 if self.held or self.guess else None)
            return self._made(found, self.values, 0.0, 0)
        own = self.model.values | {n: i.value for n, i in self.model.inputs.items()}
        start = {**own, **dict(zip(self.states, x0.tolist(), strict=True)), **self.values, **self.guess}
        v = np.array([start[n] for n in sought])
        low, high = (np.array([self.bounds.get(n, (-np.inf, np.inf))[k] for n in sought]) for k in (0, 1))
        with np.errstate(all="ignore"):
            root = newton(self._equations, v, low, high)
        assert self.last is not None
        if not (root.shares < ACCURACY).all():
            raise self._not_found(root.residual, root.shares)
        values, x = self._placed(root.v)
        return self._made(self._evaluate(values, x), values, float(root.shares.max(initial=0.0)), root.iterations)

    def _placed(self, v: Array) -> tuple[dict[str, float], Array]:
        n = len(self.open)
        x = self.x.copy()
        x[[self.states.index(s) for s in self.open]] = v[:n]
        return {**self.values, **dict(zip([*self.free_inputs, *self.free_parameters], v[n:].tolist(), strict=True))}, x

    def _equations(self, v: Array) -> tuple[Array, Array]:
        values, x = self._placed(v)
        try:
            p = self.last = self._evaluate(values, x)
        except SimulationError as e:
            if "returned" not in e.what:  # the FMU refused the point, which ends nothing: Newton takes a shorter step
                raise
            count = len(self.rest) + len(self.wanted)
            return np.full(count, np.nan), np.full((count, v.size), np.nan)
        rows = [self.states.index(n) for n in self.rest]
        lower = [len(self.states) + self.outputs.index(n) for n in self.wanted]
        nx, nu = len(self.states), len(self.inputs)
        columns = [
            *(self.states.index(n) for n in self.open),
            *(nx + self.inputs.index(n) for n in self.free_inputs),
            *(nx + nu + k for k in range(len(self.free_parameters))),
        ]
        shown = [p.outputs[self.outputs.index(n)] - value for n, value in self.wanted.items()]
        return np.concatenate([p.derivatives[rows], shown]), p.jacobian[np.ix_([*rows, *lower], columns)]

    def _evaluate(self, values: Mapping[str, float], x: Array | None) -> FmuPoint:
        return at_point(self.model, values, x, self.outputs, self.free_parameters, self.time, check=False)

    def _not_found(self, residual: Array, shares: Array) -> SteadyStateError:
        names = [*(f"d({n})/dt" for n in self.rest), *(f"output {n}" for n in self.wanted)]
        worst = int(np.argmax(shares))
        return SteadyStateError(
            "no operating point was found",
            where=f"model '{self.model.name}'",
            expected=f"every derivative at rest to {ACCURACY:g} of its terms",
            got=f"{names[worst]} left with {residual[worst]:.3g} (scaled {shares[worst]:.2g})",
            hint="check the fixed values, give a guess near the solution, or name states that need not rest in `moving`",
        )

    def _made(self, p: FmuPoint, values: Mapping[str, float], residual: float, iterations: int) -> OperatingPoint:
        m = self.model
        return OperatingPoint(
            m,
            FrozenMap(zip(self.states, p.x.tolist(), strict=True)),
            FrozenMap(),
            FrozenMap(),
            FrozenMap({n: float(values.get(n, i.value)) for n, i in m.inputs.items()}),
            FrozenMap(zip(self.outputs, p.outputs.tolist(), strict=True)),
            FrozenMap({n: float(values.get(n, q.value)) for n, q in m.parameters.items()}),
            residual,
            (),
            iterations,
            "newton" if iterations else "as initialised",
            self.at,
            self.time,
        )


def linear_model(
    given: External,
    point: OperatingPoint,
    inputs: Sequence[str] | None,
    outputs: Sequence[str] | None,
    sensitivities: Sequence[str],
) -> LinearModel:
    """Return A, B, C, D of an FMU at a point; derivatives by parameters from differences of points and Jacobians.

    provenance tells the method ("directional", or "finite-difference" where one column is), its error, and whether a
    limit is near. Raises UnknownNameError, or LinearizationError for an input that changes in steps only.
    """
    model = fmu_of(given).recording(outputs or ())
    ins, outs = _names(model, inputs, outputs)
    require_known("parameter", sensitivities, model.parameters, f"model '{model.name}'")
    p = _at(model, point, outs)
    a, b, c, d = _matrices(model, p, ins)
    notes = {
        "method": "directional" if p.directional.all() else "finite-difference",
        "jacobian error": f"{p.error:.2g}, of each row's largest entry",
        "limits": "differences of two step sizes disagree: a limit is near" if p.near else "held as at the point",
    }
    states = tuple(model.states)
    return LinearModel(
        a, b, c, d, np.eye(a.shape[0]),
        states,
        ins,
        outs,
        tuple(model.states[n].unit for n in states),
        tuple(model.inputs[n].unit for n in ins),
        tuple(model.outputs[n].unit for n in outs),
        point=point,
        name=model.name,
        provenance=FrozenMap(notes),
        gradients=FrozenMap({n: _gradient(model, point, n, ins, outs) for n in sensitivities}),
    )  # fmt: skip


def error_of(given: External, point: OperatingPoint, outputs: Sequence[str] | None) -> float:
    """Return the largest difference between the Jacobian and central differences, of each row's largest entry.

    Where differences are the Jacobian, it is that between two step sizes.
    """
    model = fmu_of(given).recording(outputs or ())
    return _at(model, point, _names(model, None, outputs)[1]).error


def _names(
    model: FmuModel, inputs: Sequence[str] | None, outputs: Sequence[str] | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    smooth = smooth_inputs(model)
    ins = smooth if inputs is None else tuple(inputs)
    outs = tuple(model.outputs) if outputs is None else tuple(outputs)
    for n in ins:
        if n not in model.inputs:
            raise unknown_name("input", n, model.inputs, where=f"model '{model.name}'")
        if n not in smooth:
            raise LinearizationError(f"input '{n}' changes in steps only", where=f"model '{model.name}'")
    return ins, outs


def _at(model: FmuModel, point: OperatingPoint, outputs: Sequence[str]) -> FmuPoint:
    values = {**point.parameters, **point.inputs}
    return at_point(model, values, np.array([*point.states.values()], dtype=float), outputs, (), point.time)


def _matrices(model: FmuModel, p: FmuPoint, inputs: Sequence[str]) -> tuple[Array, Array, Array, Array]:
    n = len(model.states)
    smooth = smooth_inputs(model)
    through = [n + smooth.index(i) for i in inputs]
    j = p.jacobian
    return j[:n, :n], j[:n, through], j[n:, :n], j[n:, through]


def _gradient(
    model: FmuModel, point: OperatingPoint, name: str, inputs: Sequence[str], outputs: Sequence[str]
) -> Gradient:
    """Return the total derivatives of A, B, C, D by a parameter, the shift of the operating point included."""
    size = model.parameters[name].size
    held = {**point.parameters, **point.inputs}
    guess = dict(point.states)
    low, high = model.parameters[name].min, model.parameters[name].max

    def at(value: float) -> list[Array]:
        there = find_point(
            model, {**held, name: value}, (), {}, guess if point.at == "steady" else {}, point.at, (), point.time
        )
        return list(_matrices(model, _at(model, there, outputs), inputs))

    def slope(h: float) -> list[Array]:
        here = held[name]
        if here - h >= low and here + h <= high:
            return [(a - b) / (2 * h) for a, b in zip(at(here + h), at(here - h), strict=True)]
        side = h if here + 2 * h <= high else -h
        three = zip(at(here), at(here + side), at(here + 2 * side), strict=True)
        return [(-3.0 * a + 4.0 * b - c) / (2 * side) for a, b, c in three]

    coarse, fine = slope(NUDGE * size), slope(0.5 * NUDGE * size)
    a, b, c, d = ((4.0 * f - k) / 3.0 for f, k in zip(fine, coarse, strict=True))
    return Gradient(a, b, c, d)
