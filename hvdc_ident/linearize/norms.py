"""Norms of linear models: L-infinity, H-infinity and H2."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
from scipy.optimize import minimize_scalar

from hvdc_ident.errors import LinearizationError
from hvdc_ident.linearize.frequency import default_omega, transfer
from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.matrices import Array
from hvdc_ident.linearize.reduce import on_axis, visible


@dataclass(frozen=True)
class Peak:
    """The largest singular value over all frequencies and where it is, rad/s (0 and infinity are places)."""

    value: float
    omega: float

    def to_dict(self) -> dict[str, float]:
        """The peak as plain numbers."""
        return {"value": self.value, "omega": self.omega}


def linf_norm(model: LinearModel, tolerance: float = 1e-13) -> Peak:
    """Return the L-infinity norm, max over w of the largest singular value of G(jw), stable or not.

    Two-step bisection on the imaginary eigenvalues of the Hamiltonian matrix (Bruinsma and Steinbuch 1990), which needs
    no stability; a model with delays is searched on its exact response instead. Raises LinearizationError where a pole
    that the inputs reach and the outputs see lies on the imaginary axis: the norm is infinite.
    """
    a, b, c, d = visible(model)
    poles = np.linalg.eigvals(a) if a.shape[0] else np.zeros(0)
    axis = poles[on_axis(poles, a)]
    if axis.size:
        raise LinearizationError(
            "the L-infinity norm is infinite: a pole lies on the imaginary axis",
            where=f"linear model '{model.name}'",
            got=f"eigenvalue {axis[0]:.6g}",
            hint="compare with nu_gap, which takes integrators",
        )
    if model.delay_free is not None:
        return _peak_on_grid(model)

    def gain(w: float) -> float:
        value = c @ np.linalg.solve(1j * w * np.eye(a.shape[0]) - a, b) + d if a.shape[0] else d
        return float(np.linalg.norm(value, 2)) if value.size else 0.0

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
    return refined(gain, best, where)


def hinf_norm(model: LinearModel, tolerance: float = 1e-13) -> Peak:
    """Return the H-infinity norm: the L-infinity norm of a stable model.

    Raises LinearizationError where a pole that inputs reach and outputs see is not stable.
    """
    a = visible(model)[0]
    poles = np.linalg.eigvals(a) if a.shape[0] else np.zeros(0)
    if ((poles.real >= 0) | on_axis(poles, a)).any():
        raise LinearizationError(
            "an unstable model has no H-infinity norm",
            where=f"linear model '{model.name}'",
            got=f"eigenvalue {poles[np.argmax(poles.real)]:.6g}",
            hint="linf_norm takes unstable models without poles on the imaginary axis, nu_gap any",
        )
    return linf_norm(model, tolerance)


def h2_norm(model: LinearModel) -> float:
    """Return the H2 norm, by a Gramian. Raises LinearizationError where it is infinite: unstable, or D not 0."""
    a, b, c, d = visible(model)
    if np.any(d):
        raise LinearizationError("the H2 norm is infinite: D is not 0", where=f"linear model '{model.name}'")
    if a.shape[0] == 0:
        return 0.0
    poles = np.linalg.eigvals(a)
    if ((poles.real >= 0) | on_axis(poles, a)).any():
        raise LinearizationError(
            "the H2 norm is infinite: the model is not stable", where=f"linear model '{model.name}'"
        )
    gramian = scipy.linalg.solve_continuous_lyapunov(a, -b @ b.T)
    return float(np.sqrt(max(np.trace(c @ gramian @ c.T), 0.0)))


def norms(model: LinearModel) -> dict[str, Any]:
    """Return H2, H-infinity and L-infinity norms as plain numbers; of one that does not exist, None and the reason."""
    found: dict[str, Any] = {}
    for name, norm in (("h2", h2_norm), ("hinf", hinf_norm), ("linf", linf_norm)):
        try:
            value = norm(model)
        except LinearizationError as e:
            found[name] = None
            found[f"{name}_reason"] = e.what
        else:
            found[name] = value.to_dict() if isinstance(value, Peak) else value
    return found


def _axis_crossings(a: Array, b: Array, c: Array, d: Array, level: float) -> Array:
    """Frequencies at which a singular value equals the level."""
    r = level**2 * np.eye(d.shape[1]) - d.T @ d
    inner = np.linalg.solve(r, d.T @ c)
    f = a + b @ inner
    top = b @ np.linalg.solve(r, b.T)
    bottom = -(c.T @ c + c.T @ d @ inner)
    values = np.linalg.eigvals(np.block([[f, top], [bottom, -f.T]]))
    on_it = np.abs(values.real) < 1e-8 * np.maximum(np.abs(values), 1e-3 * np.abs(values).max(initial=0.0) * 1e-6)
    return np.unique(np.abs(values[on_it].imag))


def refined(gain: Callable[[float], float], best: float, where: float) -> Peak:
    """Return the peak near a frequency at which the gain is already known to be `best`."""
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
    return refined(gain, float(values[k]), float(grid[k]))
