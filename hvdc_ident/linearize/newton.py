"""Scaled damped Newton with bounds, and a homotopy, for operating points with something fixed, free or bounded.

A plain steady state is found where simulation finds it, in `hvdc_ident.simulate.steady_state`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hvdc_ident.linearize.arrays import Array

Equations = Callable[[Array], tuple[Array, Array]]
ACCURACY = 1e-10
"""Largest scaled residual that counts as solved: each equation against the size of its own terms."""
SHORTEST = 2.0**-10
"""Of the way of a homotopy: a part that has to be shorter ends it."""


@dataclass(frozen=True)
class Root:
    """Where the iteration ended. shares: (equations,) scaled residuals; method: "newton" or "homotopy"."""

    v: Array
    residual: Array
    shares: Array
    iterations: int
    method: str

    @property
    def found(self) -> bool:
        """Whether every scaled residual is below ACCURACY."""
        return bool((self.shares < ACCURACY).all())


def weights(jacobian: Array, v: Array) -> Array:
    """(equations,) the size of each equation's terms, 1 for an equation without any."""
    if v.size == 0:
        return np.ones(jacobian.shape[0])
    size = np.abs(jacobian) @ np.maximum(np.abs(v), 1e-3)
    return np.where(size > 0.0, size, 1.0)


def newton(equations: Equations, v: Array, low: Array, high: Array, limit: int = 60) -> Root:
    """The root near v within [low, high], or the best point reached: read `found`.

    Steps are exact Newton steps where the Jacobian is square and regular, else of least norm; each is halved until the
    scaled residual falls. A variable on a bound that the step would leave is held there.
    """
    bounded = bool(np.isfinite(low).any() or np.isfinite(high).any())
    v = np.clip(v, low, high) if bounded else v
    r, jac = equations(v)
    small = 0
    k = 0
    for k in range(1, limit + 1):
        if not (np.isfinite(r).all() and np.isfinite(jac).all()):
            break
        weight = weights(jac, v)
        before = np.abs(r / weight).max(initial=0.0)
        step = _step(jac, r, weight, v, low, high) if bounded else _free_step(jac, r, weight)
        change = np.abs(step / (np.abs(v) + 1e-3)).max(initial=0.0)
        damping = 1.0
        while True:
            trial = np.clip(v + damping * step, low, high) if bounded else v + damping * step
            r_new, jac_new = equations(trial)
            after = np.abs(r_new / weight).max(initial=0.0)
            if after < before or after < 1e-13 or (change < 1e-9 and np.isfinite(after)):
                break
            damping /= 2
            if damping < 2e-4:
                return _root(v, r, jac, k, "newton")
        v, r, jac = trial, r_new, jac_new
        if damping == 1.0 and change < 1e-10:
            small += 2 if change < 1e-13 else 1
        if small >= 2 or (change == 0.0):
            break
    return _root(v, r, jac, k, "newton")


def _root(v: Array, r: Array, jac: Array, iterations: int, method: str) -> Root:
    with np.errstate(all="ignore"):
        shares = np.abs(r) / weights(jac, v)
    return Root(v, r, np.where(np.isfinite(shares), shares, np.inf), iterations, method)


def _free_step(jac: Array, r: Array, weight: Array) -> Array:
    if jac.shape[0] == jac.shape[1]:
        try:
            step = np.linalg.solve(jac, -r)
        except np.linalg.LinAlgError:
            pass
        else:
            if np.isfinite(step).all() and np.abs(step).max(initial=0.0) < 1e9:
                return np.asarray(step)
    return np.asarray(np.linalg.lstsq(jac / weight[:, None], -r / weight, rcond=1e-12)[0])


def _step(jac: Array, r: Array, weight: Array, v: Array, low: Array, high: Array) -> Array:
    free = np.ones(v.size, dtype=bool)
    step = np.zeros(v.size)
    for _ in range(v.size + 1):
        step = np.zeros(v.size)
        if not free.any():
            break
        step[free] = _free_step(jac[:, free], r, weight)
        stuck = free & (((v <= low) & (step < 0.0)) | ((v >= high) & (step > 0.0)))
        if not stuck.any():
            break
        free &= ~stuck
    return step


def homotopy(equations: Equations, v: Array, low: Array, high: Array) -> Root:
    """The root that the way from v leads to on which what the equations are off by at v goes to 0: read `found`.

    For what Newton's method does not reach at once from a known operating point: each part of the way is solved from the
    one before, and halved where it is not.
    """
    off, _ = equations(v)
    share, part, steps = 0.0, 0.5, 0
    while share < 1.0 and part > SHORTEST and np.isfinite(off).all():
        ahead = min(share + part, 1.0)
        left = (1.0 - ahead) * off

        def shifted(x: Array, left: Array = left) -> tuple[Array, Array]:
            r, jac = equations(x)
            return r - left, jac

        root = newton(shifted, v, low, high, 20)
        steps += root.iterations
        if root.found:
            v, share, part = root.v, ahead, 2.0 * part
        else:
            part *= 0.5
    polished = newton(equations, v, low, high)
    return Root(polished.v, polished.residual, polished.shares, steps + polished.iterations, "homotopy")
