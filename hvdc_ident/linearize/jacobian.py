"""The linear model at an operating point: exact A, B, C, D from the model's expression graph, and their derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hvdc_ident.errors import LinearizationError, SteadyStateError, require_known
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize.branches import equation_at, notes_of
from hvdc_ident.linearize.delays import Approximants, Channel, channels, without_unknowns, without_unknowns_along
from hvdc_ident.linearize.derivatives import PADE_ORDER, WELL_POSED, Side, constants, jacobian_at
from hvdc_ident.linearize.equilibrium import EquilibriumSearch, PointOptions, Root, solved, weights
from hvdc_ident.linearize.kinds import LinearOptions
from hvdc_ident.linearize.linear_model import Gradient, LinearModel
from hvdc_ident.linearize.point import Branch, OperatingPoint
from hvdc_ident.linearize.stability import Change, Characteristic, quartered
from hvdc_ident.linearize.system import Array, CompiledSystem, system
from hvdc_ident.model import Model
from hvdc_ident.simulate import equilibria, resting


@dataclass(frozen=True)
class EquationModel:
    """A model with equations, as `kinds.Kind` has it: its points on its graph, its linear model by exact derivatives."""

    model: Model

    def point(self, asked: PointOptions) -> OperatingPoint:
        """Return an operating point: of inputs and parameters alone the steady state that a simulation starts from."""
        model = self.model
        search = EquilibriumSearch.of_model(model, asked)
        if search.is_plain and not asked.guess:
            return OperatingPoint.of(self, search, *steady(model, search))
        own = _own(model, search)
        root = solved(model.name, search, asked.guess, own)
        if not search.is_plain:
            return OperatingPoint.of(self, search, root, "trimmed")
        same = own is not None and np.allclose(
            root.v, own, rtol=1e-6, atol=1e-6 * max(1.0, float(np.abs(own).max(initial=0.0)))
        )
        return OperatingPoint.of(self, search, root, "own" if own is None or same else "other")

    def linear(self, point: OperatingPoint, asked: LinearOptions) -> LinearModel:
        """Return the linear model at a point, states that never move as inputs: a reference that the start is found with is no mode."""
        fixed = constants(self.model)
        if not fixed:
            return _linear_at(self.model, point, asked)
        held = self.model.with_values({**point.parameters, **point.inputs}).driven(fixed)
        held = held.with_values({n: point.states[n] for n in fixed})
        guess = {n: v for n, v in (point.states | point.unknowns).items() if n not in fixed}
        return _linear_at(held, EquationModel(held).point(PointOptions(guess=guess)), asked)

    def equation(self, point: OperatingPoint) -> Characteristic | None:
        """Return the characteristic equation at a point; None on a kink."""
        return equation_at(self.model, point, point.y, point.w)

    def notes(self, point: OperatingPoint) -> tuple[str, ...]:
        """Return sentences on a steady state that is unstable, not the model's own one, or far off."""
        return notes_of(self.model, point)

    def jacobian_error(self, point: OperatingPoint, outputs: Sequence[str] | None) -> float:
        """Return the largest difference from the Jacobian by complex steps, relative to each row's largest entry."""
        s = system(self.model, outputs)
        y, w, p = point.y, point.w, point.p
        exact = s.jacobian(y, w, p, s.modes(y, w, p))[: s.layout.main]
        scale = np.maximum(np.abs(exact).max(axis=1, initial=0.0), 1e-300)
        return float((np.abs(exact - s.complex_step(y, w, p)) / scale[:, None]).max(initial=0.0))


def steady(model: Model, search: EquilibriumSearch) -> tuple[Root, Branch]:
    """Return the steady state that a simulation of the same inputs and parameters starts from, and its branch."""
    free = model if search.at == "start" else resting(model)
    try:
        at = equilibria(free)
        start = at.start(free, search.p, search.u, search.time)
    except SteadyStateError as e:
        raise SteadyStateError(
            e.what,
            where=e.where,
            expected=e.expected,
            got=e.got,
            hint=f"{e.hint}; states that need not rest can be named in `moving`",
        ) from None
    v = start.v
    with np.errstate(all="ignore"):
        r, jac = search.equations(v)
        shares = np.abs(r) / weights(jac, v)
    return Root(v, r, shares, 0, "newton"), start.branch


def _own(model: Model, search: EquilibriumSearch) -> Array | None:
    """Return the model's own steady state at the search's inputs and parameters; None where it has none there."""
    free = model if search.at == "start" else resting(model)
    at = equilibria(free)
    try:
        return at.start(free, search.p, search.u, search.time).v
    except SteadyStateError:
        return None


def _linear_at(model: Model, at: OperatingPoint, asked: LinearOptions) -> LinearModel:
    """Return the linear model at a point, states that never move among its states."""
    s = system(model, asked.outputs)
    chosen = _chosen(s, asked.inputs, model.name)
    require_known("parameter", asked.sensitivities, s.parameters, f"model '{model.name}'")
    modes, jac = jacobian_at(model, s, at.y, at.w, at.p, asked.side)
    delays = channels(model, s, at.p)
    which = [s.parameters.index(n) for n in asked.sensitivities]
    closed = _closed(s, at.p, delays, which)
    kept = tuple(c for k, c in enumerate(delays) if k not in closed)
    reduced = without_unknowns(s.layout, jac, chosen, closed)
    approximants = Approximants.of(kept, PADE_ORDER if asked.pade_order is None else asked.pade_order)
    whole = approximants.closed(reduced.result, s.layout.nx)
    condition = max(reduced.condition, whole.condition)
    descriptor = asked.descriptor or condition > WELL_POSED
    if descriptor and delays:
        raise LinearizationError(
            "the algebraic loop through a delay's direct part is ill-posed",
            where=f"model '{model.name}'",
            got=f"condition number {condition:.2g}",
            hint="choose another pade_order, or open the loop at a signal in it",
        )
    gradients: dict[str, Gradient] = {}
    if which and not descriptor:
        directions = shift(s, at, which)
        djac = s.jacobian_along(at.y, at.w, at.p, modes, directions)
        change = without_unknowns_along(s.layout, jac, djac, chosen, closed)
        by_p = s.timing_by_parameters(at.p)[:, which] if kept else np.zeros((0, len(which)))
        total = np.array([c.weights @ by_p[list(c.places)] for c in kept]).reshape(len(kept), len(which))
        along = approximants.closed_along(whole, change, s.layout.nx, total)
        for k, name in enumerate(asked.sensitivities):
            exact = None
            if kept:
                times = tuple(by_p[list(c.places), k] for c in kept)
                exact = Change(*quartered(change[k], s.layout.nx + len(kept)), times)
            a, b, c, d = quartered(along[k], s.layout.nx + len(approximants.names))
            gradients[name] = Gradient(a, b, c, d, exact)
    names = (*s.states, *(s.unknowns if descriptor else approximants.names))
    if descriptor:
        z = s.layout
        through = [z.n + k for k in chosen]
        a, b, c, d = jac[: z.n, : z.n], jac[: z.n, through], jac[z.n :, : z.n], jac[z.n :, through]
        e = np.diag([1.0] * z.nx + [0.0] * z.nz)
    else:
        a, b, c, d = quartered(whole.result, len(names))
        e = np.eye(len(names))
    units = {n: x.unit for n, x in model.states.items()} | {n: x.unit for n, x in model.algebraic.items()}
    shown = {n: x.unit for n, x in model.signals.items()} | {n: x.unit for n, x in model.outputs.items()}
    return LinearModel(
        a, b, c, d, e,
        names,
        tuple(s.inputs[k] for k in chosen),
        s.outputs,
        tuple(units.get(n, "") for n in names),
        tuple(model.inputs[s.inputs[k]].unit for k in chosen),
        tuple(shown.get(n, "") for n in s.outputs),
        point=at,
        name=model.name,
        provenance=FrozenMap(_provenance(s, asked.side, condition, descriptor, approximants)),
        gradients=FrozenMap(gradients),
        exact=Characteristic.of(reduced, s.layout.nx, kept) if kept else None,
    )  # fmt: skip


def _provenance(
    s: CompiledSystem, side: Side, condition: float, descriptor: bool, approximants: Approximants
) -> dict[str, str]:
    """Return how a linear model was made."""
    notes = {
        "method": "symbolic",
        "condition of the algebraic part": f"{condition:.3g}",
        "algebraic part": "kept, descriptor" if descriptor else "eliminated" if s.layout.nz else "none",
        "limits": "held as at the point" if side == "refuse" else f"one-sided: {side} the limit",
    }
    if approximants.names:
        notes["delays"] = f"Pade of order {approximants.order} in A, B, C, D; exact in the frequency response"
        if any(c.kind == "sampled" for c in approximants.channels):
            notes["sampled blocks"] = (
                "a delay of half a period (the hold) plus the compute time: 1.5 periods when computing takes one"
            )
    return notes


def _closed(s: CompiledSystem, p: Array, delays: Sequence[Channel], which: list[int]) -> tuple[int, ...]:
    """Return the places of the delays of 0 s that none of some parameters changes: they are no delays."""
    zero = tuple(k for k, c in enumerate(delays) if c.total == 0.0)
    if not zero or not which:
        return zero
    by_p = s.timing_by_parameters(p)[:, which]
    return tuple(k for k in zero if not by_p[list(delays[k].places)].any())


def shift(s: CompiledSystem, at: OperatingPoint, which: list[int]) -> Array:
    """Return (columns + parameters, k) how the point and the parameters move for each of the chosen parameters."""
    size = s.layout
    total = np.zeros((size.columns + size.np, len(which)))
    total[[size.columns + k for k in which], range(len(which))] = 1.0
    search = at.search
    if search is None:
        return total
    v = np.concatenate(
        [
            at.y,
            at.w[1 + size.nu :],
            at.w[[1 + k for k in search.freed_u]],
            at.p[list(search.freed_p)],
            np.zeros(len(search.bounded_rows)),
        ]
    )
    slope = search.by_parameters(v, which)
    inner = size.n + size.ne
    total[: size.n] = slope[: size.n]
    total[size.n + size.nu : size.columns] = slope[size.n : inner]
    for i, k in enumerate(search.freed_u):
        total[size.n + k] = slope[inner + i]
    for i, k in enumerate(search.freed_p):
        total[size.columns + k] += slope[inner + len(search.freed_u) + i]
    return total


def _chosen(s: CompiledSystem, inputs: Sequence[str] | None, model: str) -> list[int]:
    names = s.inputs if inputs is None else tuple(inputs)
    require_known("input", names, s.inputs, f"model '{model}'")
    return [s.inputs.index(n) for n in names]
