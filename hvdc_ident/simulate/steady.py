"""The slow way to a steady state, for models on which Newton's method alone fails: pseudo-transient, then least squares."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.errors import SteadyStateError
from hvdc_ident.simulate.structure import Structure
from hvdc_ident.trajectory import Array

Equations = Callable[[Array], tuple[Array, Array]]
ACCURACY = 1e-10  # largest scaled residual that counts as a steady state


def fallback(
    structure: Structure, address: NDArray[np.int64], p: Array, u: Array, guess: Array, time: float = 0.0
) -> tuple[Array, Array]:
    """The flat vectors y and w of the steady state, or SteadyStateError with the worst equation named."""
    from hvdc_ident.simulate.machine import evaluate
    from hvdc_ident.simulate.rest import MODES, RESIDUAL, REST_JAC, REST_P

    s = structure.sizes
    inner, extra = s.nx + s.nz, s.nd + s.nq
    n = inner + extra
    y, w, m = np.zeros(inner * (1 + s.width)), np.zeros(1 + s.nu + extra * (1 + s.width)), np.zeros(max(s.ns, 1))
    w[0], w[1 : 1 + s.nu] = time, u

    def equations(v: Array) -> tuple[Array, Array]:
        y[:inner], w[1 + s.nu : 1 + s.nu + extra] = v[:inner], v[inner:]
        r, jac = np.zeros(n), np.zeros(n * n)
        evaluate(address[MODES], y, w, p, m, m)
        evaluate(address[RESIDUAL], y, w, p, m, r)
        evaluate(address[REST_JAC], y, w, p, m, jac)
        return r, jac.reshape(n, n)

    v = np.concatenate([guess, np.zeros(extra)])
    with np.errstate(all="ignore"):
        v = _pseudo_transient(equations, v, s.nx)
        v = _least_squares(equations, v)
        r, jac = equations(v)
        shares = np.abs(r) / _weights(jac, v)
    if not (shares < ACCURACY).all():
        worst = int(np.argmax(np.where(np.isfinite(shares), shares, np.inf)))
        raise SteadyStateError(
            "no steady state was found",
            where=f"model '{structure.model.name}'",
            expected="every derivative 0",
            got=f"{_equation(structure, worst)} left with {r[worst]:.3g} (scaled {shares[worst]:.2g})",
            hint="check the input levels and limits, give states a `guess` near the solution, or a `start`",
        )
    if s.width:
        rows = np.zeros(n * s.width)
        evaluate(address[REST_P], y, w, p, m, rows)
        slope = np.linalg.lstsq(jac, -rows.reshape(n, s.width), rcond=1e-12)[0]
        y[inner:], w[1 + s.nu + extra :] = slope[:inner].ravel(), slope[inner:].ravel()
    return y, w


def _weights(jac: Array, v: Array) -> Array:
    size = np.abs(jac) @ np.maximum(np.abs(v), 1e-3) if v.size else np.ones(0)
    return np.where(size > 0, size, 1.0)


def _pseudo_transient(equations: Equations, v: Array, nx: int) -> Array:
    """Implicit Euler steps whose length grows as the residual falls: follows the model to its rest."""
    mass = np.zeros(v.size)
    mass[:nx] = 1.0
    r, jac = equations(v)
    h = 1e-4
    for _ in range(300):
        try:
            step = np.linalg.solve(np.diag(mass / h) - jac, r)
        except np.linalg.LinAlgError:
            h *= 0.3
            continue
        r_new, jac_new = equations(v + step)
        before = float(np.linalg.norm(r / _weights(jac, v)))
        after = float(np.linalg.norm(r_new / _weights(jac_new, v + step)))
        if np.isfinite(after) and (after < 1.5 * before or h < 1e-9):
            v, r, jac = v + step, r_new, jac_new
            h = min(h * max(1.5, before / max(after, 1e-300)), 1e9)
            if after < ACCURACY * 1e-2:
                break
        else:
            h *= 0.2
            if h < 1e-12:
                break
    return v


def _least_squares(equations: Equations, v: Array) -> Array:
    """Newton steps of least norm, for a Jacobian that is singular where a state does not matter."""
    for _ in range(50):
        r, jac = equations(v)
        if not (np.isfinite(r).all() and np.isfinite(jac).all()):
            return v
        weight = _weights(jac, v)
        step = np.linalg.lstsq(jac / weight[:, None], -r / weight, rcond=1e-12)[0]
        before, damping = float(np.linalg.norm(r / weight)), 1.0
        while damping > 1e-4:
            r_new = equations(v + damping * step)[0]
            if np.linalg.norm(r_new / weight) < before or before < 1e-14:
                break
            damping /= 2
        else:
            return v
        v = v + damping * step
        if np.abs(step).max(initial=0.0) < 1e-14:
            break
    return v


def _equation(structure: Structure, index: int) -> str:
    m = structure.model
    names = [f"d({n})/dt" for n in structure.states] + [f"unknown '{n}'" for n in structure.unknowns]
    names += [f"delay '{n}'" for n in m.delays] + [f"sampled value '{n}'" for n in m.sampled]
    return names[index]
