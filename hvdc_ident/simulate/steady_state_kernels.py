"""Compiled ways to a steady state: Newton's method with sensitivities, a path of values, steps of least norm, following the model.

Each entry takes a tuple of arrays, the first seven being the fields of `SteadyEquations`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from hvdc_ident.simulate.codegen import NAMES
from hvdc_ident.simulate.equations import ACCURACY, SHORTEST, TINY
from hvdc_ident.simulate.native import call, integers, kernel, lu, matrix_of, numbers, orientation, solve, solve_rows

MODES, RESIDUAL, REST_JAC, REST_P = (NAMES.index(n) for n in ("modes", "rest", "rest_jac", "rest_p"))
EPSILON = float(np.finfo(float).eps)
NEAR = 0.1  # radians, or of a value above 1: the longest step across a limit; a sine is its tangent to 0.2 % there
SAME = 1e-6  # of a value: places nearer than this are one steady state, reached by different arithmetic


class SteadyEquations(NamedTuple):
    """Generated functions of the steady-state equations, and the vectors that these take.

    sizes: states, elements of y, elements of w before the unknowns in it, unknowns, width of a row over the parameters.
    """

    address: Any
    sizes: Any
    y: Any
    w: Any
    wd: Any
    p: Any
    m: Any


@kernel()
def _equations(a):  # type: ignore[no-untyped-def]
    return SteadyEquations(
        integers(a, 0), integers(a, 1), numbers(a, 2), numbers(a, 3), numbers(a, 4), numbers(a, 5), numbers(a, 6)
    )


@kernel()
def residual(e, v, r):  # type: ignore[no-untyped-def]
    """Write the residual at the unknowns v into r, (n,), with modes from the values; unknowns beyond y live in w."""
    inner, first = e.sizes[1], e.sizes[2]
    for i in range(inner):
        e.y[i] = v[i]
    for i in range(v.size - inner):
        e.w[first + i] = v[inner + i]
    call(e.address[MODES], e.y, e.y, e.w, e.wd, e.p, e.m, e.m)
    call(e.address[RESIDUAL], e.y, e.y, e.w, e.wd, e.p, e.m, r)


@kernel()
def _jacobian(e, jac):  # type: ignore[no-untyped-def]
    """Write the Jacobian where the residual was taken last into jac (n, n), zeros where it has none."""
    call(e.address[REST_JAC], e.y, e.y, e.w, e.wd, e.p, e.m, jac)


@kernel()
def _measures(jac, v, size, weight):  # type: ignore[no-untyped-def]
    """Write what each equation's residual is measured by, size (n,) being the most that an unknown counts for."""
    for i in range(v.size):
        total = 0.0
        for j in range(v.size):
            total += abs(jac[i, j]) * min(max(abs(v[j]), TINY), size[j])
        weight[i] = total if total > 0.0 else 1.0


@kernel()
def _norm(r, weight):  # type: ignore[no-untyped-def]
    """Norm of the residual, each equation by its own measure."""
    total = 0.0
    for i in range(r.size):
        total += (r[i] / weight[i]) ** 2
    return np.sqrt(total)


@kernel()
def _largest(r, weight):  # type: ignore[no-untyped-def]
    """Largest element of r against its weight; not a number where that is none."""
    largest = 0.0
    for i in range(r.size):
        share = abs(r[i]) / weight[i]
        if share > largest or share != share:
            largest = share
    return largest


# --- Newton's method ---


def newton(a):  # type: ignore[no-untyped-def]
    """Find the steady state from y and w's unknowns on; write it there, with its rows over the parameters. 2: found, 1: not.

    a: equations, rule (2,): by how much at most each correction may shrink to the next, and the sign that the Jacobian's
    determinant has to have at the solution (0: any); with inf instead of the first, steps are halved until the residual
    falls. On return rule[1] is the sign found. Where undamped corrections at least halve, Kantorovich's condition holds
    (h <= 1/2 gives h / (2 (1 - h)) <= 1/2, Deuflhard 2004, Newton Methods, 2.1): the solution is the one that the start
    is connected with, no fold lies between.
    """
    e, rule = _equations(a), numbers(a, 7)
    inner, first, n = e.sizes[1], e.sizes[2], e.sizes[3]
    v, trial, r, ahead, delta = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    jac, matrix, pivots = np.zeros((n, n)), np.zeros((n, n)), np.zeros(max(n, 1), np.int64)
    weight, extent, size = np.zeros(n), np.zeros(n), np.zeros(n)
    for i in range(n):
        v[i] = e.y[i] if i < inner else e.w[first + i - inner]
        extent[i] = max(abs(v[i]), TINY)
    residual(e, v, r)
    small, guarded, wanted, moved = 0, rule[0] < np.inf, rule[1], np.inf
    for _ in range(80):
        _jacobian(e, jac)
        for i in range(n):
            weight[i], size[i] = 0.0, abs(v[i]) + 1e-3
            for j in range(n):
                weight[i] = max(weight[i], abs(jac[i, j]) * max(abs(v[j]), TINY))
            weight[i] = weight[i] if weight[i] > 0.0 else 1.0
        before = _largest(r, weight)
        matrix[:], delta[:] = jac, r
        if not before < np.inf or not lu(matrix, pivots):
            return 1
        solve(matrix, pivots, delta)
        change = _largest(delta, size)
        if not change < 1e12:
            return 1
        previous, moved = moved, _largest(delta, extent)
        if guarded and moved > 1e-9 and moved > rule[0] * previous:
            return 1
        damping = 1.0
        for _ in range(12):
            for i in range(n):
                trial[i] = v[i] - damping * delta[i]
            residual(e, trial, ahead)
            after = _largest(ahead, weight)
            if guarded or after < before or after < 1e-13 or (change < 1e-9 and after < np.inf):
                break
            damping *= 0.5
        v[:], r[:] = trial, ahead
        if change < 1e-10 and damping == 1.0:
            small += 2 if change < 1e-13 else 1
        if small >= 2:
            break
    rule[1] = orientation(matrix, pivots)
    return 2 if small >= 2 and wanted * rule[1] >= 0.0 and _rows(e, jac, pivots) else 1


@kernel()
def _rows(e, jac, pivots):  # type: ignore[no-untyped-def]
    """Write the rows over the parameters of the steady state in y and w; False where the Jacobian is singular."""
    inner, first, n, width = e.sizes[1], e.sizes[2], e.sizes[3], e.sizes[4]
    if width:
        _jacobian(e, jac)
        if not lu(jac, pivots):
            return False
        rows = np.zeros((n, width))
        call(e.address[REST_P], e.y, e.y, e.w, e.wd, e.p, e.m, rows)
        solve_rows(jac, pivots, rows)
        for i in range(n):
            for c in range(width):
                if i < inner:
                    e.y[inner + i * width + c] = -rows[i, c]
                else:
                    e.w[first + n - inner + (i - inner) * width + c] = -rows[i, c]
    return True


# --- along a path of values ---


def continuation(a):  # type: ignore[no-untyped-def]
    """Move v (n,), a steady state at the first of two sets of values, along the straight line between them.

    a: equations, values of the parameters (2, parameters), of time and inputs (2, 1 + inputs), v, then way (2,): on entry
    the sign of the determinant at the start, on return the share reached, at which the values stand.

    A step counts where undamped Newton corrections at least halve (`newton` says why), the determinant keeps its sign,
    which a fold changes, the way is no longer than the two slopes at its ends allow: a jump to another branch is; and
    Newton's method leads back to where the step began, which from another branch it does not. (Corrections that halve
    on the way there show the condition in their own direction only.) Else it is halved. Across a limit, where the
    equations have a corner, no such ratio holds, and a long step may end anywhere: there it has to be short, within
    which the pieces are as good as straight.
    """
    e, ends_p, ends_w, v, way = _equations(a), matrix_of(a, 7), matrix_of(a, 8), numbers(a, 9), numbers(a, 10)
    x, sign, share, h = np.zeros(v.size), way[0], 0.0, 1.0
    while share < 1.0 and h > SHORTEST:
        h = min(h, 1.0 - share)
        ahead = share + h if h < 1.0 - share else 1.0
        if _advance(e, ends_p, ends_w, share, ahead, v, x, sign):
            v[:] = x
            share = ahead
            h *= 2.0
        else:
            h *= 0.5
    _set_values(e, ends_p, ends_w, share)
    way[0] = share
    return 1


@kernel()
def _set_values(e, ends_p, ends_w, share):  # type: ignore[no-untyped-def]
    e.p[:] = ends_p[0] + share * (ends_p[1] - ends_p[0])
    e.w[: ends_w.shape[1]] = ends_w[0] + share * (ends_w[1] - ends_w[0])


@kernel()
def _advance(e, ends_p, ends_w, share, ahead, v, x, sign):  # type: ignore[no-untyped-def]
    """Write the steady state at the share `ahead` of the way into x; True where it is on the branch of v, the one at `share`."""
    n = v.size
    extent, off, matrix, pivots = np.zeros(n), np.zeros(n), np.zeros((n, n)), np.zeros(n, np.int64)
    for i in range(n):
        extent[i] = max(abs(v[i]), TINY)
    _set_values(e, ends_p, ends_w, ahead)
    x[:] = v
    converged, first, across = _correct(e, x, extent, True, matrix, pivots)
    if not converged or orientation(matrix, pivots) != sign:
        return False
    _set_values(e, ends_p, ends_w, share)
    residual(e, x, off)
    solve(matrix, pivots, off)
    if not _largest(x - v, extent) <= first + _largest(off, extent) + 1e-8:
        return False
    if across:
        near = True
        for i in range(n):
            near = near and abs(x[i] - v[i]) <= NEAR * max(abs(v[i]), 1.0)
        return near
    back = x.copy()
    converged, _, _ = _correct(e, back, extent, False, matrix, pivots)
    return converged and _largest(back - v, extent) < SAME


@kernel()
def _correct(e, x, extent, crossing, matrix, pivots):  # type: ignore[no-untyped-def]
    """Correct x (n,) by undamped Newton steps, each at most half of the one before; leave the last Jacobian's factors.

    crossing: whether a step across a limit may be longer. Returns (True where they converged, the size of the first one
    in units of extent (n,), True where a limit was crossed).
    """
    n = x.size
    r, jac, modes = np.zeros(n), np.zeros((n, n)), np.zeros(e.m.size)
    before, first, across = np.inf, 0.0, False
    for k in range(12):
        modes[:] = e.m
        residual(e, x, r)
        _jacobian(e, jac)
        matrix[:] = jac
        if not lu(matrix, pivots):
            break
        solve(matrix, pivots, r)
        size = _largest(r, extent)
        if not size < 1e12:
            break
        first = size if k == 0 else first
        if size < 1e-11 or (size < 1e-8 and size > 0.5 * before):
            return True, first, across
        cornered = False
        for i in range(modes.size):
            cornered = cornered or (crossing and k > 0 and modes[i] != e.m[i])
        across = across or cornered
        if k > 0 and size > 0.5 * before and not cornered:
            break
        x -= r
        before = size
    return False, first, across


# --- slower ways ---


@kernel()
def _euler_matrix(jac, h, nx, matrix):  # type: ignore[no-untyped-def]
    """Write the Jacobian (n, n) of an implicit Euler step of length h, jac being that of the residual; it may be matrix."""
    for i in range(jac.shape[0]):
        for j in range(jac.shape[0]):
            matrix[i, j] = -jac[i, j]
        if i < nx:
            matrix[i, i] += 1.0 / h


@kernel()
def _euler_residual(r, x, v, h, nx, off):  # type: ignore[no-untyped-def]
    """Write into off (n,) what an implicit Euler step of length h from v to x leaves, r being the residual at x."""
    for i in range(x.size):
        off[i] = -r[i]
        if i < nx:
            off[i] += (x[i] - v[i]) / h


@kernel()
def _euler_step(e, size, v, h, x):  # type: ignore[no-untyped-def]
    """Write the end of an implicit Euler step of length h from v into x, (n,); True where it was found.

    Newton's method; a change that leads past a jump is halved until it leads nearer, so that it ends within the edge.
    """
    n, nx = v.size, e.sizes[0]
    r, off, ahead, trial, weight = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    matrix, pivots = np.zeros((n, n)), np.zeros(n, np.int64)
    goal = 1e-2 * ACCURACY
    x[:] = v
    for k in range(60):
        residual(e, x, r)
        _jacobian(e, matrix)
        _euler_matrix(matrix, h, nx, matrix)
        _euler_residual(r, x, v, h, nx, off)
        _measures(matrix, x, size, weight)
        before = _norm(off, weight)
        if not before < np.inf:
            return False
        if k == 0:
            goal = max(goal, 1e-4 * before)
        if before <= goal:
            return True
        if not lu(matrix, pivots):
            return False
        solve(matrix, pivots, off)
        damping, better = 1.0, False
        while damping > 1e-5 and not better:
            for i in range(n):
                trial[i] = x[i] - damping * off[i]
            residual(e, trial, r)
            _euler_residual(r, trial, v, h, nx, ahead)
            better = _norm(ahead, weight) < before
            damping /= 2
        if not better:
            return False
        x[:] = trial
    return False


def pseudo_transient(a):  # type: ignore[no-untyped-def]
    """Move v (n,) by implicit Euler steps whose length grows as the residual falls, one Newton step each: follow the model.

    a: equations, size (n,), v.
    """
    e, size, v = _equations(a), numbers(a, 7), numbers(a, 8)
    n, nx = v.size, e.sizes[0]
    r, ahead, step, trial, weight = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    jac, jac_ahead, matrix, pivots = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n)), np.zeros(n, np.int64)
    residual(e, v, r)
    _jacobian(e, jac)
    _measures(jac, v, size, weight)
    before, h = _norm(r, weight), 1e-4
    for _ in range(300):
        _euler_matrix(jac, h, nx, matrix)
        step[:] = r
        if not lu(matrix, pivots):
            h *= 0.3
            continue
        solve(matrix, pivots, step)
        for i in range(n):
            trial[i] = v[i] + step[i]
        residual(e, trial, ahead)
        _jacobian(e, jac_ahead)
        _measures(jac_ahead, trial, size, weight)
        after = _norm(ahead, weight)
        if after < np.inf and (after < 1.5 * before or h < 1e-9):
            h = min(h * max(1.5, before / max(after, 1e-300)), 1e9)
            v[:], r[:], jac[:], before = trial, ahead, jac_ahead, after
            if after < 1e-2 * ACCURACY:
                break
        else:
            h *= 0.2
            if h < 1e-12:
                break
    return 1


def implicit_euler(a):  # type: ignore[no-untyped-def]
    """Move v (n,) by implicit Euler steps that are solved each: to a steady state on the edge of a jump too.

    A loop that rests there is driven to it from both sides: a step that is not solved for goes past the edge, and the
    next one back. a: equations, size (n,), v.
    """
    e, size, v = _equations(a), numbers(a, 7), numbers(a, 8)
    n = v.size
    r, jac, weight, end = np.zeros(n), np.zeros((n, n)), np.zeros(n), np.zeros(n)
    h = 1e-3
    for _ in range(200):
        if _euler_step(e, size, v, h, end):
            v[:] = end
            residual(e, v, r)
            _jacobian(e, jac)
            _measures(jac, v, size, weight)
            if _norm(r, weight) < 1e-2 * ACCURACY:
                break
            h = min(3.0 * h, 1e9)
        else:
            h *= 0.25
            if h < 1e-12:
                break
    return 1


def minimum_norm(a):  # type: ignore[no-untyped-def]
    """Move v (n,) by Newton steps of least norm, for a Jacobian that is singular where a state does not matter.

    a: equations, size (n,), v.
    """
    e, size, v = _equations(a), numbers(a, 7), numbers(a, 8)
    n = v.size
    r, ahead, right, trial, weight = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    jac, matrix = np.zeros((n, n)), np.zeros((n, n))
    for _ in range(50):
        residual(e, v, r)
        _jacobian(e, jac)
        if not (np.isfinite(r).all() and np.isfinite(jac).all()):
            break
        _measures(jac, v, size, weight)
        for i in range(n):
            for j in range(n):
                matrix[i, j] = jac[i, j] / weight[i]
            right[i] = -r[i] / weight[i]
        step = np.linalg.lstsq(matrix, right, 1e-12)[0]
        before, damping, better = _norm(r, weight), 1.0, False
        while damping > 1e-4 and not better:
            for i in range(n):
                trial[i] = v[i] + damping * step[i]
            residual(e, trial, ahead)
            better = _norm(ahead, weight) < before or before < 1e-14
            if not better:
                damping /= 2
        if not better:
            break
        v[:] = trial
        if np.abs(step).max() < 1e-14:
            break
    return 1


def judge(a):  # type: ignore[no-untyped-def]
    """Write the residual at v (n,) into r (n,), its Jacobian into jac (n, n) and the scaled residuals into shares (n,).

    A scaled residual is by the equation's own measure, less what rounding alone leaves. a: equations, size (n,), v, r,
    jac (zeros), shares.
    """
    e, size, v, r, jac, shares = (
        _equations(a), numbers(a, 7), numbers(a, 8), numbers(a, 9), matrix_of(a, 10), numbers(a, 11),
    )  # fmt: skip
    residual(e, v, r)
    _jacobian(e, jac)
    _measures(jac, v, size, shares)
    for i in range(v.size):
        rounding = 0.0
        for j in range(v.size):
            rounding += abs(jac[i, j]) * abs(v[j])
        shares[i] = 0.0 if abs(r[i]) <= 16.0 * EPSILON * rounding else abs(r[i]) / shares[i]
    return 1
