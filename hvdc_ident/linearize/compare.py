"""Two linear models against each other: nu-gap, H-infinity and H2 norms."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.linalg
from scipy.optimize import minimize_scalar

from hvdc_ident.errors import LinearizationError
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.linearize.arrays import Array
from hvdc_ident.linearize.frequency import default_omega, transfer
from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.reduce import without_sliding_means


@dataclass(frozen=True)
class Peak:
    """The largest singular value over all frequencies and where it is, rad/s (0 and infinity are places)."""

    value: float
    omega: float


@dataclass(frozen=True)
class NuGap:
    """The nu-gap between two models: value in [0, 1], where the largest chordal distance is, and the winding condition.

    winding: the count that must be 0; where it is not, no controller that suits one model is sure to suit the other
    and the value is 1.
    """

    value: float
    omega: float
    winding: int
    distance: float

    def to_dict(self) -> dict[str, Any]:
        """The gap as plain numbers."""
        return {"nu_gap": self.value, "omega": self.omega, "winding": self.winding, "chordal_distance": self.distance}


def hinf_norm(model: LinearModel, tolerance: float = 1e-13) -> Peak:
    """The H-infinity norm by two-step bisection on the Hamiltonian (Bruinsma and Steinbuch 1990), to tolerance.

    A model with delays is searched on its exact response. Raises LinearizationError for an unstable one.
    """
    a, b, c, d = without_sliding_means(model)
    poles = np.linalg.eigvals(a) if a.shape[0] else np.zeros(0)
    if (poles.real >= 0).any():
        raise LinearizationError(
            "an unstable model has no H-infinity norm",
            where=f"linear model '{model.name}'",
            got=f"eigenvalue {poles[np.argmax(poles.real)]:.6g}",
            hint="compare with nu_gap, which takes unstable models",
        )

    if model.delay_free is not None:
        return _peak_on_grid(model)

    def gain(w: float) -> float:
        value = c @ np.linalg.solve(1j * w * np.eye(a.shape[0]) - a, b) + d if a.shape[0] else d
        return float(np.linalg.norm(value, 2))

    best, where = float(np.linalg.norm(d, 2)) if d.size else 0.0, float("inf")
    for w in [0.0, *np.abs(poles), *np.abs(poles.imag)]:
        best, where = max((best, where), (gain(float(w)), float(w)))
    if best == 0.0:
        return Peak(0.0, 0.0)
    for _ in range(60):
        level = best * (1.0 + 2.0 * max(tolerance, 1e-12))
        crossings = _axis_crossings(a, b, c, d, level)
        if crossings.size < 2:
            break
        middles = (
            np.sqrt(crossings[:-1] * crossings[1:]) if crossings[0] > 0 else 0.5 * (crossings[:-1] + crossings[1:])
        )
        value, w = max((gain(float(x)), float(x)) for x in middles)
        if value <= best * (1.0 + tolerance):
            break
        best, where = value, w
    return _refined(gain, best, where)


def _axis_crossings(a: Array, b: Array, c: Array, d: Array, level: float) -> Array:
    """Frequencies at which a singular value equals the level."""
    r = level**2 * np.eye(d.shape[1]) - d.T @ d
    inner = np.linalg.solve(r, d.T @ c)
    f = a + b @ inner
    top = b @ np.linalg.solve(r, b.T)
    bottom = -(c.T @ c + c.T @ d @ inner)
    values = np.linalg.eigvals(np.block([[f, top], [bottom, -f.T]]))
    on_axis = np.abs(values.real) < 1e-8 * np.maximum(np.abs(values), 1e-3 * np.abs(values).max(initial=0.0) * 1e-6)
    return np.unique(np.abs(values[on_axis].imag))


def _refined(gain: Any, best: float, where: float) -> Peak:
    if not 0.0 < where < np.inf:
        return Peak(best, where)
    found = minimize_scalar(
        lambda x: -gain(float(np.exp(x))), bounds=(np.log(where) - 0.01, np.log(where) + 0.01), method="bounded",
        options={"xatol": 1e-12},
    )  # fmt: skip
    return Peak(-float(found.fun), float(np.exp(found.x))) if -found.fun > best else Peak(best, where)


def _peak_on_grid(model: LinearModel) -> Peak:
    grid = np.concatenate([[0.0], default_omega(model, 4000)])

    def gain(w: float) -> float:
        return float(np.linalg.norm(transfer(model, np.array([1j * w]))[0], 2))

    values = np.linalg.svd(transfer(model, 1j * grid), compute_uv=False)[:, 0]
    k = int(np.argmax(values))
    return _refined(gain, float(values[k]), float(grid[k]))


def h2_norm(model: LinearModel) -> float:
    """The H2 norm, by a Gramian. Raises LinearizationError where it is infinite: unstable, or D not 0."""
    a, b, c, d = without_sliding_means(model)
    if np.any(d):
        raise LinearizationError("the H2 norm is infinite: D is not 0", where=f"linear model '{model.name}'")
    if a.shape[0] == 0:
        return 0.0
    if (np.linalg.eigvals(a).real >= 0).any():
        raise LinearizationError(
            "the H2 norm is infinite: the model is not stable", where=f"linear model '{model.name}'"
        )
    gramian = scipy.linalg.solve_continuous_lyapunov(a, -b @ b.T)
    return float(np.sqrt(max(np.trace(c @ gramian @ c.T), 0.0)))


def difference(first: LinearModel, second: LinearModel) -> LinearModel:
    """The model first - second. Raises LinearizationError where their inputs or outputs differ."""
    _same_channels(first, second)
    a1, b1, c1, d1 = without_sliding_means(first)
    a2, b2, c2, d2 = without_sliding_means(second)
    names = (*_names("1", first, a1.shape[0]), *_names("2", second, a2.shape[0]))
    return replace(
        first,
        A=scipy.linalg.block_diag(a1, a2) if names else np.zeros((0, 0)),
        B=np.concatenate([b1, b2]),
        C=np.concatenate([c1, -c2], axis=1),
        D=d1 - d2,
        E=np.eye(len(names)),
        state_names=names,
        state_units=(),
        x0=(0.0,) * len(names),
        point=None,
        gradients=FrozenMap(),
        delay_free=None,
        name=f"{first.name} - {second.name}",
    )


def _names(prefix: str, model: LinearModel, count: int) -> tuple[str, ...]:
    """The states' names; numbers where some states have been projected out."""
    known = model.state_names if count == len(model.state_names) else [f"x{k + 1}" for k in range(count)]
    return tuple(f"{prefix}.{n}" for n in known)


def _same_channels(first: LinearModel, second: LinearModel) -> None:
    shapes = [(len(m.output_names), len(m.input_names)) for m in (first, second)]
    if shapes[0] != shapes[1]:
        raise LinearizationError("the models have other inputs or outputs", expected=f"{shapes[0]}", got=f"{shapes[1]}")


def nu_gap(first: LinearModel, second: LinearModel) -> NuGap:
    """The nu-gap metric with its winding condition (Vinnicombe 1993, doi 10.1109/9.231459); delays exact on the axis.

    Scale inputs and outputs first so that 1 has equal weight in each. Raises LinearizationError where channels differ.
    """
    _same_channels(first, second)
    grid = np.unique(np.concatenate([default_omega(first, 2000), default_omega(second, 2000)]))
    far = 1e6 * grid[-1]
    grid = np.concatenate([grid[0] * np.logspace(-8, -0.01, 100), grid, [far]])

    def distances(w: Array) -> Array:
        return _chordal(transfer(first, 1j * w), transfer(second, 1j * w))

    values = distances(grid)
    k = int(np.argmax(values))
    low, high = np.log(grid[max(k - 1, 0)]), np.log(grid[min(k + 1, grid.size - 1)])
    found = minimize_scalar(
        lambda x: -float(distances(np.array([np.exp(x)]))[0]),
        bounds=(low, high),
        method="bounded",
        options={"xatol": 1e-10},
    )
    value, omega = max((float(values[k]), float(grid[k])), (-float(found.fun), float(np.exp(found.x))))
    winding = winding_count(first, second)
    value = min(value, 1.0)
    return NuGap(1.0 if winding else value, omega, winding, value)


def _chordal(p1: Array, p2: Array) -> Array:
    """(points,) largest singular value of (1 + P2 P2*)^-1/2 (P1 - P2) (1 + P1* P1)^-1/2."""
    h1, h2 = np.conj(np.swapaxes(p1, 1, 2)), np.conj(np.swapaxes(p2, 1, 2))
    left = np.linalg.cholesky(np.eye(p2.shape[1]) + p2 @ h2)
    right = np.linalg.cholesky(np.eye(p1.shape[2]) + h1 @ p1)
    inner = np.linalg.solve(left, p1 - p2)
    both = np.linalg.solve(right, np.conj(np.swapaxes(inner, 1, 2)))
    return np.asarray(np.linalg.svd(both, compute_uv=False)[:, 0])


def winding_count(first: LinearModel, second: LinearModel) -> int:
    """wno det(1 + P2~ P1) + eta(P1) - eta(P2) - eta0(P2), the count that must be 0; delays in their Pade form."""
    a1, b1, c1, d1 = without_sliding_means(first)
    a2, b2, c2, d2 = without_sliding_means(second)
    # P2~(s) = P2(-s)^T, in series behind P1, with unit negative feedback.
    at, bt, ct, dt = -a2.T, -c2.T, b2.T, d2.T
    through = np.eye(d1.shape[1]) + dt @ d1
    if np.linalg.cond(through) > 1e12:
        return 1_000_000
    series_a = np.block([[a1, np.zeros((a1.shape[0], at.shape[0]))], [bt @ c1, at]])
    series_b = np.concatenate([b1, bt @ d1])
    series_c = np.concatenate([dt @ c1, ct], axis=1)
    closed = series_a - series_b @ np.linalg.solve(through, series_c)
    zeros_right, _ = _count(closed)
    poles_right = _count(a1)[0] + _count(at)[0]
    right2, axis2 = _count(a2)
    return zeros_right - poles_right + _count(a1)[0] - right2 - axis2


def _count(a: Array) -> tuple[int, int]:
    """(eigenvalues right of the axis, eigenvalues on it)."""
    if a.shape[0] == 0:
        return 0, 0
    values = np.linalg.eigvals(a)
    on_axis = np.abs(values.real) <= 1e-9 * np.maximum(np.abs(values), 1e-3)
    return int(((values.real > 0) & ~on_axis).sum()), int(on_axis.sum())
