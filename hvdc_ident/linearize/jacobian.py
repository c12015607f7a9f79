"""Linearisation at an operating point: exact A, B, C, D from the model's expression graph, and their derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from hvdc_ident.errors import LinearizationError, require_known
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize.delays import Blocks, DelayFreePart, SchurComplement, channels, eliminate
from hvdc_ident.linearize.limits import in_use, nodes_in_use, structure_roots
from hvdc_ident.linearize.linear_model import Gradient, LinearModel
from hvdc_ident.linearize.operating_point import OperatingPoint, find_operating_point
from hvdc_ident.linearize.stability import Characteristic
from hvdc_ident.linearize.system import Array, CompiledSystem, system
from hvdc_ident.model import AnyModel, Model

Side = Literal["refuse", "below", "above"]
WELL_POSED = 1e12
"""Largest condition number of the algebraic part that is eliminated; beyond it the model stays a descriptor."""
ON_KINK = 1e-9


def linearize(
    model: AnyModel,
    point: OperatingPoint | None = None,
    *,
    inputs: Sequence[str] | str | None = None,
    outputs: Sequence[str] | str | None = None,
    pade_order: int = 5,
    sensitivities: Sequence[str] = (),
    side: Side = "refuse",
    descriptor: bool = False,
) -> LinearModel:
    """Return the linear model between inputs and outputs (of outputs or named signals; default all) at an operating point.

    point: default, the steady state found from the model's values. pade_order: of every delay in the state space (the
    frequency response takes the delays exactly). sensitivities: parameters whose exact total derivatives of A, B, C, D
    come along, the shift of the operating point included. side: what to do where the point lies on a kink: "refuse",
    or the Jacobian "below" or "above" the limit. descriptor: keep the algebraic unknowns as states, with E.

    Raises UnknownNameError, and LinearizationError on a kink, for an ill-posed loop, or Jacobian entries not finite.

    >>> from hvdc_ident import linearize, load_model
    >>> linear = linearize(load_model("vsc-hvdc-link"), inputs="Vdcref1", outputs="Irorder1")
    >>> linear.A.shape, linear.D.shape
    ((6, 6), (1, 1))
    >>> [round(mode.frequency_hz, 2) for mode in linear.modes() if mode.frequency_hz > 0.1]
    [4.87, 4.87]
    """
    at = find_operating_point(model) if point is None else point
    model, at = _with_constants_as_inputs(model, at)
    inputs = [inputs] if isinstance(inputs, str) else inputs
    outputs = [outputs] if isinstance(outputs, str) else outputs
    if not isinstance(model, Model):
        from hvdc_ident.linearize.fmu_linear import linear_model

        return linear_model(model, at, inputs, outputs, sensitivities)
    s = system(model, outputs)
    chosen = _chosen(s, inputs, model.name)
    require_known("parameter", sensitivities, s.parameters, f"model '{model.name}'")
    modes, jac, parts, reduced = _eliminated(model, s, at.y, at.w, at.p, side, pade_order)
    keep = descriptor or reduced.condition > WELL_POSED
    if keep and parts.channels:
        raise LinearizationError(
            "the algebraic loop through a delay's direct part is ill-posed",
            where=f"model '{model.name}'",
            got=f"condition number {reduced.condition:.2g}",
            hint="choose another pade_order, or open the loop at a signal in it",
        )
    names = sensitivities if not keep else ()
    closed = _closed(s, at.p, parts, names)
    gradient = _gradient(s, at, parts, jac, modes, reduced, names, chosen, closed) if names else {}
    return _model(model, s, at, parts, jac, reduced, chosen, keep, gradient, side, closed)


def _with_constants_as_inputs(model: AnyModel, at: OperatingPoint) -> tuple[AnyModel, OperatingPoint]:
    """Return the model and its point with states that never move as inputs: a reference that the start is found with is no mode."""
    if not isinstance(model, Model):
        return model, at
    constants = _constants(model)
    if not constants:
        return model, at
    held = model.with_values({**at.parameters, **at.inputs}).driven(constants)
    values = {n: at.states[n] for n in constants}
    guess = {n: v for n, v in (at.states | at.unknowns).items() if n not in constants}
    return held.with_values(values), find_operating_point(held.with_values(values), guess=guess)


def _constants(model: Model) -> list[str]:
    """Return the states of the model as it was given that stand where the start puts them; those of effects are their memory."""
    given = model.origin.root.states if model.origin else model.states
    return [n for n, s in model.states.items() if n in given and s.is_reference]


def _closed(s: CompiledSystem, p: Array, parts: Blocks, names: Sequence[str]) -> tuple[int, ...]:
    """Return the places of the delays of 0 s that none of the named parameters changes: they are no delays."""
    if not parts.closed or not names:
        return parts.closed
    by_p = s.timing_by_parameters(p)[:, [s.parameters.index(n) for n in names]]
    return tuple(k for k in parts.closed if not by_p[list(parts.channels[k].places)].any())


def _eliminated(
    model: Model, s: CompiledSystem, y: Array, w: Array, p: Array, side: Side, pade_order: int
) -> tuple[Array, Array, Blocks, SchurComplement]:
    """Return the switches' modes, the Jacobian, its blocks with delays, and these without the algebraic unknowns.

    Raises LinearizationError on a kink, and where an entry of the Jacobian is not finite.
    """
    modes = modes_at(s, y, w, p, side)
    jac = s.jacobian(y, w, p, modes)[: s.layout.main]
    if not np.isfinite(jac).all():
        raise _not_finite(s, jac, model.name)
    _refuse_flat_roots(s, y, w, p, modes, model.name)
    parts = Blocks(s, channels(model, s, p), pade_order)
    return modes, jac, parts, eliminate(parts.matrix(jac), parts.rows, parts.columns)


def state_matrix(model: Model, s: CompiledSystem, y: Array, w: Array, p: Array, pade_order: int = 5) -> Array:
    """Return A, (states, states), at a point given by its vectors, without states that never move. Raises as `linearize` does."""
    _, _, parts, reduced = _eliminated(model, s, y, w, p, "refuse", pade_order)
    if reduced.condition > WELL_POSED:
        raise LinearizationError(
            "the algebraic part is ill-conditioned",
            where=f"model '{model.name}'",
            got=f"condition number {reduced.condition:.2g}",
            hint="use linearize(), which keeps it as a descriptor",
        )
    constant = [s.states.index(n) for n in _constants(model)]
    return np.delete(np.delete(reduced.result[: parts.n, : parts.n], constant, 0), constant, 1)


def characteristic(model: Model, s: CompiledSystem, y: Array, w: Array, p: Array) -> Characteristic:
    """Return the characteristic equation at a point given by its vectors, delays exact, with all inputs and outputs.

    Raises as `linearize` does.
    """
    modes = modes_at(s, y, w, p, "refuse")
    jac = s.jacobian(y, w, p, modes)[: s.layout.main]
    if not np.isfinite(jac).all():
        raise _not_finite(s, jac, model.name)
    _refuse_flat_roots(s, y, w, p, modes, model.name)
    found = channels(model, s, p)
    closed = [k for k, c in enumerate(found) if c.total == 0.0]
    return Characteristic.of(DelayFreePart.of(s.layout, jac, list(range(s.layout.nu)), found, closed))


def _refuse_flat_roots(s: CompiledSystem, y: Array, w: Array, p: Array, modes: Array, model: str) -> None:
    """Raise LinearizationError where a square root in use stands at 0 and moves: its slope is infinite there."""
    flat = s.flat_roots(y, w, p, modes)
    if not flat:
        return
    g = s.structure.graph
    used = nodes_in_use(s.structure, structure_roots(s.structure), modes > 0.5)
    for n in set(flat) & used:
        if _moves(s, g.nodes[n][1], modes):
            names = [name for name, k in s.structure.nodes.items() if k == n]
            raise LinearizationError(
                f"the square root{f' of {names[0]!r}' if names else ''} stands at 0, where its slope is infinite",
                where=f"model '{model}'",
                hint="move an input a little",
            )


def _moves(s: CompiledSystem, node: int, modes: Array) -> bool:
    """Return whether a node's value comes from more than the parameters, which stay where they are."""
    nodes = s.structure.graph.nodes
    inner = nodes_in_use(s.structure, [node], modes > 0.5)
    return any(nodes[k][0] == "leaf" and nodes[k][1] != "p" for k in inner)


def one_sided(
    model: Model,
    point: OperatingPoint,
    *,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    pade_order: int = 5,
    sensitivities: Sequence[str] = (),
    descriptor: bool = False,
) -> tuple[LinearModel, LinearModel]:
    """Return the linear models below and above the limit on which a point lies; equal where it lies on none."""

    def at(side: Side) -> LinearModel:
        return linearize(
            model,
            point,
            inputs=inputs,
            outputs=outputs,
            pade_order=pade_order,
            sensitivities=sensitivities,
            side=side,
            descriptor=descriptor,
        )

    return at("below"), at("above")


def jacobian_error(model: AnyModel, point: OperatingPoint, outputs: Sequence[str] | None = None) -> float:
    """Return the largest difference between the Jacobian and one by complex steps, relative to each row's largest entry."""
    if not isinstance(model, Model):
        from hvdc_ident.linearize.fmu_linear import error_of

        return error_of(model, point, outputs)
    s = system(model, outputs)
    y, w, p = point.y, point.w, point.p
    exact = s.jacobian(y, w, p, s.modes(y, w, p))[: s.layout.main]
    other = s.complex_step(y, w, p)
    scale = np.maximum(np.abs(exact).max(axis=1, initial=0.0), 1e-300)
    return float((np.abs(exact - other) / scale[:, None]).max(initial=0.0))


def modes_at(s: CompiledSystem, y: Array, w: Array, p: Array, side: Side) -> Array:
    """Return the branch of every switch at a point. Raises LinearizationError on a kink unless a side is chosen.

    A condition of parameters alone, as an option of a model, is decided and no kink.
    """
    values = s.switches(y, w, p)
    modes = s.modes(y, w, p)
    near = np.flatnonzero(np.abs(values) <= ON_KINK)
    if near.size == 0:
        return modes
    used = in_use(s.structure, structure_roots(s.structure), values < 0.0)
    switches = s.structure.graph.switches
    kinks = [k for k in near if k in used and _moves(s, switches[k], modes) and _matters(s, y, w, p, modes, int(k))]
    if kinks and side == "refuse":
        c = s.conditions[kinks[0]]
        raise LinearizationError(
            f"the operating point lies on a kink: '{c.signal}' is just at its limit",
            where=f"model '{s.structure.model.name}'",
            expected=f"{c.expression} clear of {c.level}",
            got=f"a distance of {values[kinks[0]]:.3g}",
            hint='move an input a little, or ask for one side of the limit: [linearize] side = "below" or "above" in a '
            "study, side= in Python (one_sided gives both)",
        )
    modes = modes.copy()
    for k in kinks:
        # A switch is negative beyond a limiter's end, whose margin is sign * value.
        inside = 0.0 if s.conditions[k].sign > 0 else 1.0
        beyond = 1.0 - inside
        upper = s.conditions[k].kind == "upper"
        modes[k] = (inside if upper else beyond) if side == "below" else (beyond if upper else inside)
    return modes


def _matters(s: CompiledSystem, y: Array, w: Array, p: Array, modes: Array, k: int) -> bool:
    other = modes.copy()
    other[k] = 1.0 - other[k]
    with np.errstate(all="ignore"):
        a, b = s.jacobian(y, w, p, modes), s.jacobian(y, w, p, other)
    main = s.layout.main
    return not np.allclose(a[:main], b[:main], rtol=1e-12, atol=1e-12)


def _gradient(
    s: CompiledSystem,
    at: OperatingPoint,
    parts: Blocks,
    jac: Array,
    modes: Array,
    reduced: SchurComplement,
    names: Sequence[str],
    chosen: list[int],
    closed: Sequence[int],
) -> dict[str, Gradient]:
    """Return the total derivatives of A, B, C, D by parameters. closed: delays of 0 s that none of them changes."""
    which = [s.parameters.index(n) for n in names]
    directions = shift(s, at, which)
    djac = s.jacobian_along(at.y, at.w, at.p, modes, directions)
    by_p = s.timing_by_parameters(at.p)[:, which] if parts.channels else np.zeros((0, len(which)))
    dtime = np.array([c.weights @ by_p[list(c.places)] for c in parts.channels]).reshape(
        len(parts.channels), len(which)
    )
    along = parts.matrix_along(djac, jac, dtime)
    r, c = parts.rows, parts.columns
    changes = reduced.derivative(along[:, :r, :c], along[:, :r, c:], along[:, r:, :c], along[:, r:, c:])
    kept = [ch for k, ch in enumerate(parts.channels) if k not in closed]
    core = DelayFreePart.derivative(s.layout, jac, djac, chosen, closed) if kept else None
    found = {}
    for k, name in enumerate(names):
        a, b, c_, d = parts.split(changes[k], chosen)
        free = None if core is None else core[k]
        found[name] = Gradient(a, b, c_, d, free, tuple(by_p[list(ch.places), k] for ch in kept))
    return found


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


def _model(
    model: Model,
    s: CompiledSystem,
    at: OperatingPoint,
    parts: Blocks,
    jac: Array,
    reduced: SchurComplement,
    chosen: list[int],
    keep: bool,
    gradient: dict[str, Gradient],
    side: Side,
    closed: Sequence[int],
) -> LinearModel:
    approximated = [parts.channels[k] for k in parts.approximated]
    names = [*s.states, *(f"{c.name}.pade{k + 1}" for c in approximated for k in range(parts.order))]
    units = [model.states[n].unit for n in s.states] + [""] * parts.n_pade
    if keep:
        z = s.layout
        through = [z.n + k for k in chosen]
        a, b = jac[: z.n, : z.n], jac[: z.n, through]
        c, d = jac[z.n :, : z.n], jac[z.n :, through]
        e = np.diag([1.0] * z.nx + [0.0] * z.nz)
        names = [*s.states, *s.unknowns]
        units = [*units, *(model.algebraic[n].unit for n in s.unknowns)]
    else:
        a, b, c, d = parts.split(reduced.result, chosen)
        e = np.eye(a.shape[0])
    notes = {
        "method": "symbolic",
        "condition of the algebraic part": f"{reduced.condition:.3g}",
        "algebraic part": "kept, descriptor" if keep else "eliminated" if s.layout.nz else "none",
        "limits": "held as at the point" if side == "refuse" else f"one-sided: {side} the limit",
    }
    if approximated:
        kinds = {c.kind for c in approximated}
        notes["delays"] = f"Pade of order {parts.order} in A, B, C, D; exact in the frequency response"
        if "sampled" in kinds:
            notes["sampled blocks"] = (
                "a delay of half a period (the hold) plus the compute time: 1.5 periods when computing takes one"
            )
    outputs = {n: o.unit for n, o in model.outputs.items()} | {
        n: x.unit for n, x in model.signals.items() if n not in model.outputs
    }
    return LinearModel(
        a, b, c, d, e,
        tuple(names),
        tuple(s.inputs[k] for k in chosen),
        s.outputs,
        tuple(units),
        tuple(model.inputs[s.inputs[k]].unit for k in chosen),
        tuple(outputs.get(n, "") for n in s.outputs),
        point=at,
        name=model.name,
        provenance=FrozenMap(notes),
        gradients=FrozenMap(gradient),
        delay_free=DelayFreePart.of(s.layout, jac, chosen, parts.channels, closed)
        if len(parts.channels) > len(closed)
        else None,
    )  # fmt: skip


def _chosen(s: CompiledSystem, inputs: Sequence[str] | None, model: str) -> list[int]:
    names = s.inputs if inputs is None else tuple(inputs)
    require_known("input", names, s.inputs, f"model '{model}'")
    return [s.inputs.index(n) for n in names]


def _not_finite(s: CompiledSystem, jac: Array, model: str) -> LinearizationError:
    i, j = (int(k) for k in np.argwhere(~np.isfinite(jac))[0])
    rows = [f"d({n})/dt" for n in s.states] + [*s.unknowns, *s.extras] + [f"output {n}" for n in s.outputs]
    columns = [*s.states, *s.unknowns, *s.inputs, *s.extras]
    return LinearizationError(
        f"the derivative of {rows[i]} by {columns[j]} is not finite",
        where=f"model '{model}'",
        got=f"{jac[i, j]}",
        hint="the point lies where a root or a quotient has no slope: move an input a little",
    )
