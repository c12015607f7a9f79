"""Jacobian of a model at a point given by its vectors: the branch of every switch, kinks refused, unknowns eliminated."""

from __future__ import annotations

from typing import Literal

import numpy as np

from hvdc_ident.errors import LinearizationError
from hvdc_ident.linearize.delays import EPS, channels, without_unknowns
from hvdc_ident.linearize.limits import in_use, structure_roots
from hvdc_ident.linearize.stability import Characteristic
from hvdc_ident.linearize.system import Array, CompiledSystem
from hvdc_ident.model import Model

Side = Literal["refuse", "below", "above"]
WELL_POSED = 1e12
"""Largest condition number of the algebraic part that is eliminated; beyond it the model stays a descriptor."""
ON_KINK = 1e-9
SHAKEN = 1e-6
"""Relative change of the point and the parameters by which the size of an entry's terms is seen."""
SHAKES = 4
"""Such changes at random: fewer than one in 10 000 times all of them show less than a tenth of the terms."""
DOUBTFUL = 1e-12
"""Share of the largest entry in its row and column below which an entry may be what rounding leaves of a 0."""
PADE_ORDER = 5
"""Order of the approximants of delays where none is asked for."""


def constants(model: Model) -> list[str]:
    """Return the states of the model as it was given that stand where the start puts them; those of effects are their memory."""
    given = model.origin.root.states if model.origin else model.states
    return [n for n, s in model.states.items() if n in given and s.is_reference]


def jacobian_at(
    model: Model, s: CompiledSystem, y: Array, w: Array, p: Array, side: Side = "refuse"
) -> tuple[Array, Array]:
    """Return the switches' modes and the Jacobian (main rows, columns) at a point given by its vectors.

    An entry that rounding leaves of a 0 is 0. Raises LinearizationError on a kink, and where an entry of the Jacobian is not finite.
    """
    modes = modes_at(s, y, w, p, side)
    jac = s.jacobian(y, w, p, modes)[: s.layout.main]
    if not np.isfinite(jac).all():
        raise _not_finite(s, jac, model.name)
    _refuse_flat_roots(s, y, w, p, modes, model.name)
    return modes, _without_rounding(s, jac, y, w, p, modes)


def _without_rounding(s: CompiledSystem, jac: Array, y: Array, w: Array, p: Array, modes: Array) -> Array:
    """Return a Jacobian whose entries that are no larger than the rounding of their terms are 0.

    3 a - b of a = 0.1 and b = 0.3 is 6e-17, and no slow growth of a state. The terms show in how far relative changes of a, b and the
    point move their sum; rounding is such a change, of the last digit.
    """
    size = np.abs(jac)
    largest = np.maximum(size.max(axis=1, initial=0.0)[:, None], size.max(axis=0, initial=0.0))
    alone = np.count_nonzero(jac, axis=1)[:, None] + np.count_nonzero(jac, axis=0) <= 3  # nothing to compare it with
    if not ((size > 0) & ((size <= DOUBTFUL * largest) | alone)).any():
        return jac
    rng = np.random.default_rng(0)
    moved: Array = np.zeros(jac.shape)
    for _ in range(SHAKES):
        near_y, near_w, near_p = (v * (1.0 + SHAKEN * rng.standard_normal(v.size)) for v in (y, w, p))
        with np.errstate(all="ignore"):
            near = s.jacobian(near_y, near_w, near_p, modes)[: s.layout.main]
            moved = moved + ((near - jac) / SHAKEN) ** 2
    rounding = 10.0 * EPS * np.sqrt(np.where(np.isfinite(moved), moved, 0.0) / SHAKES)
    return np.where(size <= rounding, 0.0, jac)


def characteristic(model: Model, s: CompiledSystem, y: Array, w: Array, p: Array) -> Characteristic:
    """Return the characteristic equation at a point given by its vectors, delays exact, with all inputs and outputs.

    Raises as `linearize` does.
    """
    delays = channels(model, s, p)
    closed = [k for k, c in enumerate(delays) if c.total == 0.0]
    reduced = without_unknowns(s.layout, jacobian_at(model, s, y, w, p)[1], list(range(s.layout.nu)), closed)
    if reduced.condition > WELL_POSED:
        raise LinearizationError(
            "the algebraic part is ill-conditioned",
            where=f"model '{model.name}'",
            got=f"condition number {reduced.condition:.2g}",
            hint="use linearize(), which keeps it as a descriptor",
        )
    return Characteristic.of(reduced, s.layout.nx, tuple(c for c in delays if c.total > 0.0))


def _refuse_flat_roots(s: CompiledSystem, y: Array, w: Array, p: Array, modes: Array, model: str) -> None:
    """Raise LinearizationError where a square root in use stands at 0 and moves: its slope is infinite there."""
    flat = s.flat_roots(y, w, p, modes)
    if not flat:
        return
    g = s.structure.graph
    used, _ = in_use(s.structure, structure_roots(s.structure), modes > 0.5)
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
    inner, _ = in_use(s.structure, [node], modes > 0.5)
    return any(nodes[k][0] == "leaf" and nodes[k][1] != "p" for k in inner)


def modes_at(s: CompiledSystem, y: Array, w: Array, p: Array, side: Side) -> Array:
    """Return the branch of every switch at a point. Raises LinearizationError on a kink unless a side is chosen.

    A condition of parameters alone, as an option of a model, is decided and no kink.
    """
    values = s.switches(y, w, p)
    modes = s.modes(y, w, p)
    near = np.flatnonzero(np.abs(values) <= ON_KINK)
    if near.size == 0:
        return modes
    _, used = in_use(s.structure, structure_roots(s.structure), values < 0.0)
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
