"""Modes of a linear model with delays: the roots of its exact characteristic equation, with what takes part in them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hvdc_ident.errors import LinearizationError
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize.characteristic import Part
from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.mode import Mode, damping_of, kind_of_mode
from hvdc_ident.linearize.stability import ALIKE, Change, Characteristic, reached, sliding_means, times_at
from hvdc_ident.linearize.system import Array

Along = tuple[Array, Sequence[Array]]
"""The change of a part's matrix with a parameter, and of each of its delays' times, s."""
CONTOUR = 32
"""Points of the circle around roots that are not apart; the trapezoidal rule converges geometrically on it."""


def modes(model: LinearModel) -> tuple[Mode, ...]:
    """Return the rightmost modes, at least one for each state and five for each delay; conjugates follow each other, the upper one first.

    With u P(s) = 0 and P(s) v = 0 at a root, the share of a state is u v and that of a delay u v times its time (the content
    of the delay); they sum to 1 over both before their moduli are taken. The derivative by a parameter is
    -u dP v / (u P' v). Both depend on the part of the equation alone that the root belongs to, and are taken from it: what a
    fast root leaves in a delay behind it is exp(-s T) times as large as its states, and would hide them.
    """
    assert model.exact is not None
    zero_delays = [c.name for c in model.exact.channels if c.total == 0.0]
    if zero_delays:
        raise LinearizationError(
            "modes have no computed derivative by a delay of 0 s",
            where=f"linear model '{model.name}'",
            got=", ".join(zero_delays),
            hint="leave its parameters out of the sensitivities, or take a small delay",
        )
    equation = model.characteristic
    assert isinstance(equation, Characteristic)
    found_roots = equation.roots
    roots = found_roots.values if found_roots.averaged is None else found_roots.averaged
    whole, means = equation.whole, sliding_means(equation)
    names = (*model.state_names[: equation.nx], *(c.name for c in equation.channels))
    slowest = np.argsort(np.abs(roots), kind="stable")[:means]
    rightmost = []
    for k, root in enumerate(roots):
        apart = np.abs(roots - root) > ALIKE * max(abs(root), 1e-3 * whole.unit)
        place = int((~apart[:k]).sum())  # among the roots that are alike
        right, left = whole.null_vectors(complex(root), int((~apart).sum()))
        shape = _shape(right, place)
        own, times, place_of_own = _owner(equation, complex(root), whole.unit, place)
        part = equation.part(own)
        right_of_own, left_of_own = part.null_vectors(complex(root), times)
        share = np.zeros(len(names))
        share[own] = _participation(part, complex(root), right_of_own, left_of_own)
        radius = 0.3 * float(np.abs(roots - root)[apart].min(initial=whole.unit))
        slopes = {
            name: _slope(
                part, _of_part(g.exact, own, part.nx), complex(root), right_of_own, left_of_own, place_of_own, radius
            )
            for name, g in model.gradients.items()
            if g.exact is not None
        }
        mean = k in slowest and root == 0
        rightmost.append(
            Mode(
                complex(root),
                abs(float(root.imag)) / (2 * np.pi),
                damping_of(complex(root)),
                FrozenMap(zip(names, (float(x) for x in share), strict=True)),
                FrozenMap(zip(names, (complex(x) for x in shape), strict=True)),
                FrozenMap(slopes),
                "sliding mean (cancelled by its delay)"
                if mean
                else kind_of_mode(complex(root), *reached(equation, complex(root), (right, left))),
            )
        )
    return tuple(rightmost)


def _owner(equation: Characteristic, root: complex, unit: float, place: int) -> tuple[Array, int, int]:
    """Return the unknowns of the part that a root belongs to, how many times it has it, and which of these it is.

    place: of the root among those that are alike, which may be of several parts: the first ones are of the first part.
    """
    for places, own in equation.roots_by_part:
        values = own.values if own.averaged is None else own.averaged
        times = times_at(values, root, unit)
        if place < times:
            return places, times, place
        place -= times
    return np.arange(equation.matrix.shape[0]), place + 1, place


def _participation(part: Part, root: complex, right: Array, left: Array) -> Array:
    """Return the shares of the part's states and delays."""
    slope = part.pencil_by_s(np.array([root]))[0]
    with np.errstate(all="ignore"):
        share = np.abs(np.diag(slope @ right @ np.linalg.pinv(left @ slope @ right) @ left))
    if not share.sum() > 0:
        share = np.abs(right[:, 0] * left[0])
    return np.asarray(share / max(float(share.sum()), 1e-300))


def _shape(right: Array, place: int) -> Array:
    """Return the unknowns of one of the roots that are alike, the largest 1."""
    v = right[:, min(place, right.shape[1] - 1)]
    return np.asarray(v / v[np.argmax(np.abs(v))])


def _of_part(change: Change, places: Array, nx: int) -> Along:
    """Return the change of a part's matrix and of its delays' times. nx: states of the part, which come first."""
    first = change.matrix.shape[0] - len(change.times)
    return change.matrix[np.ix_(places, places)], tuple(change.times[i - first] for i in places[nx:])


def _slope(part: Part, along: Along, root: complex, right: Array, left: Array, place: int, radius: float) -> complex:
    """Return the derivative of a root by a parameter; of roots that are one and not apart, the mean."""
    s = np.array([root])
    inner = left @ part.pencil_by_s(s)[0] @ right
    if np.linalg.cond(inner) < 1e6:
        values = np.linalg.eigvals(-np.linalg.solve(inner, left @ part.pencil_along(s, *along)[0] @ right))
        return complex(np.sort_complex(values)[min(place, values.size - 1)])
    around = root + radius * np.exp(2j * np.pi * np.arange(CONTOUR) / CONTOUR)
    pencil, slope, change = part.pencil(around), part.pencil_by_s(around), part.pencil_along(around, *along)
    count = np.trace(np.linalg.solve(pencil, slope), axis1=1, axis2=2) @ (around - root)
    moved = np.trace(np.linalg.solve(pencil, change), axis1=1, axis2=2) @ (around - root)
    return complex(-moved / count)
