"""Steady states of a model with equations beside one another: which one a point is, and where a stable one stands."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from hvdc_ident.errors import LinearizationError, SteadyStateError
from hvdc_ident.linearize.derivatives import characteristic
from hvdc_ident.linearize.point import OperatingPoint, is_stable, unstable_by
from hvdc_ident.linearize.stability import Characteristic
from hvdc_ident.linearize.system import Array, CompiledSystem
from hvdc_ident.model import Model
from hvdc_ident.simulate import Equilibria, equilibria, resting


def notes_of(model: Model, point: OperatingPoint) -> tuple[str, ...]:
    """Return sentences on a steady state that is unstable, not the model's own one, or far outside its states' own range.

    Each names the other steady state where one is found: the model's own one, or those that the model runs to from here.
    """
    free = resting(model)
    at = equilibria(free)
    v = np.array([*point.y, *point.extras.values()])
    sentences = []
    if point.branch == "unconnected":
        sentences.append(
            "Followed from the model's own values, its steady state ends at a jump before these: this one is from a new search."
        )
    if point.branch == "other":
        own = at.start(free, point.p, point.w[1 : 1 + len(point.inputs)], point.time).v
        sentences.append(f"This is not the model's own steady state, which stands at {at.text(own)}.")
    far = at.far(v)
    if far:
        shown = ", ".join(f"'{n}' at {point.states[n]:.4g} (guess {free.states[n].guess:g})" for n in far)
        sentences.append(f"Far outside the states' own range: {shown}.")
    if point.stable is False:
        sentences.append(f"{unstable_by(point.equation)} {_elsewhere(model, at, point, v)}")
    return tuple(sentences)


def equation_at(model: Model, point: OperatingPoint, y: Array, w: Array) -> Characteristic | None:
    """Return the characteristic equation at values about a point; None where the model has no linear model there."""
    s = point.search.system if point.search is not None else None
    assert isinstance(s, CompiledSystem)
    try:
        return characteristic(model, s, y, w, point.p)
    except LinearizationError:
        return None


def _direction(equation: Characteristic) -> Array:
    """Return (states,) the shape of the rightmost mode, a delay's share in it left out."""
    root = equation.roots.values[:1]
    if not root.size:
        return np.ones(equation.nx)
    return np.asarray(np.linalg.svd(equation.whole.pencil(root)[0])[2][-1].conj()[: equation.nx].real)


def _elsewhere(model: Model, at: Equilibria, point: OperatingPoint, v: Array) -> str:
    """Return a sentence on the nearest stable steady state that the model runs to from here, or that its guesses lead to."""
    equation, nx = point.equation, len(point.states)
    assert equation is not None
    direction = _direction(equation)
    size = np.maximum(np.abs(point.y[:nx]), 1e-2)
    direction = 1e-2 * direction / max(float(np.abs(direction / size).max()), 1e-300)
    u = point.w[1 : 1 + len(point.inputs)]
    others = at.neighbours(point.p, u, point.time, v, direction)
    with suppress(SteadyStateError):  # then the guesses offer none
        others.append(at.search(point.p, u, point.time).v)
    apart = [x for x in others if not np.allclose(x, v, rtol=1e-6, atol=1e-6)]
    stable = [x for x in apart if is_stable(equation_at(model, point, *_split(at, point, x)))]
    stable.sort(key=lambda x: float(np.abs((x[:nx] - v[:nx]) / size).max()))  # of a machine's turns the nearest
    if not stable:
        return "No stable steady state was found nearby."
    return f"A stable one stands at {at.text(stable[0])}; a `guess` there in the model's states leads to it."


def _split(at: Equilibria, point: OperatingPoint, x: Array) -> tuple[Array, Array]:
    n = at.n
    return x[:n].copy(), np.concatenate([point.w[: 1 + len(point.inputs)], x[n:]])
