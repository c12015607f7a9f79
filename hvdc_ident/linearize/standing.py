"""Where an operating point stands: whether it is stable, whether it is the model's own one, and which others there are."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from hvdc_ident.errors import LinearizationError, SteadyStateError
from hvdc_ident.linearize.arrays import Array
from hvdc_ident.linearize.jacobian import state_matrix
from hvdc_ident.linearize.modal import ZERO
from hvdc_ident.linearize.operating_point import OperatingPoint
from hvdc_ident.model.definition import Model
from hvdc_ident.simulate.steady_state import Equilibria, equilibria, resting


def is_stable(point: OperatingPoint) -> bool | None:
    """Return whether no eigenvalue lies right of the imaginary axis, but for rounding; None for an FMU and on a kink."""
    return None if point.search is None else _stable(point, point.y, point.w)


def notes(point: OperatingPoint) -> tuple[str, ...]:
    """Sentences on a point that is unstable, not the model's own steady state, or far outside its states' own range.

    Each names the other steady state where one is found: the model's own one, or those that the model runs to from here.
    """
    model = point.model
    if point.search is None or point.at != "steady" or not isinstance(model, Model):
        return ()
    model = resting(model)
    at = equilibria(model)
    v = np.array([*point.y, *point.extras.values()])
    found = []
    if point.branch == "unconnected":
        found.append(
            "Followed from the model's own values, its steady state ends at a jump before these: this one is from a new search."
        )
    if point.branch == "other":
        found.append(f"This is not the model's own steady state, which stands at {at.text(_own(at, model, point))}.")
    far = at.far(v)
    if far:
        shown = ", ".join(f"'{n}' at {point.states[n]:.4g} (guess {model.states[n].guess:g})" for n in far)
        found.append(f"Far outside the states' own range: {shown}.")
    if point.stable is False:
        found.append(f"Unstable: {_fastest(point)}. {_elsewhere(at, point, v)}")
    return tuple(found)


def _own(at: Equilibria, model: Model, point: OperatingPoint) -> Array:
    return at.unknowns(at.start(model, point.p, point.w[1 : 1 + len(point.inputs)], point.time))


def _matrix(point: OperatingPoint, y: Array, w: Array) -> Array | None:
    assert point.search is not None and isinstance(point.model, Model)
    try:
        return state_matrix(point.model, point.search.system, y, w, point.p)
    except LinearizationError:
        return None


def _stable(point: OperatingPoint, y: Array, w: Array) -> bool | None:
    matrix = _matrix(point, y, w)
    if matrix is None or not matrix.size:
        return None if matrix is None else True
    values = np.linalg.eigvals(matrix)
    return bool(values.real.max() <= ZERO * max(1.0, float(np.abs(values).max())))


def _fastest(point: OperatingPoint) -> str:
    matrix = _matrix(point, point.y, point.w)
    assert matrix is not None
    values = np.linalg.eigvals(matrix)
    worst = values[np.argmax(values.real)]
    turning = f" +- {abs(worst.imag):.3g}j" if worst.imag else ""
    return f"the eigenvalue {worst.real:.3g}{turning} 1/s grows"


def _elsewhere(at: Equilibria, point: OperatingPoint, v: Array) -> str:
    """The nearest of the stable steady states that the model runs to from here, or that its guesses lead to."""
    matrix = _matrix(point, point.y, point.w)
    assert matrix is not None
    values, vectors = np.linalg.eig(matrix)
    nx = len(point.states)
    direction = vectors[:nx, np.argmax(values.real)].real
    size = np.maximum(np.abs(point.y[:nx]), 1e-2)
    direction = 1e-2 * direction / max(float(np.abs(direction / size).max()), 1e-300)
    u = point.w[1 : 1 + len(point.inputs)]
    others = at.neighbours(point.p, u, point.time, v, direction)
    with suppress(SteadyStateError):  # then the guesses offer none
        others.append(at.unknowns(at.search(point.p, u, point.time)))
    stable = [
        x for x in others if not np.allclose(x, v, rtol=1e-6, atol=1e-6) and _stable(point, *_split(at, point, x))
    ]
    stable.sort(key=lambda x: float(np.abs((x[:nx] - v[:nx]) / size).max()))  # of a machine's turns the nearest
    if not stable:
        return "No stable steady state was found nearby."
    return f"A stable one stands at {at.text(stable[0])}; a `guess` there in the model's states leads to it."


def _split(at: Equilibria, point: OperatingPoint, x: Array) -> tuple[Array, Array]:
    n = at.n
    return x[:n].copy(), np.concatenate([point.w[: 1 + len(point.inputs)], x[n:]])
