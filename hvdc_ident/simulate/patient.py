"""The ways to a steady state that Newton's method does not find, compiled: along a path of values from a known one, steps of
least norm, and following the model.

What follows it takes one Newton step for each in time, or solves each, which is slower and ends on the edge of a jump too.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from hvdc_ident.simulate.call import call
from hvdc_ident.simulate.kernel import kernel, stamp
from hvdc_ident.simulate.linear import lu, orientation, solve
from hvdc_ident.simulate.rest import REST_JAC, residual
from hvdc_ident.simulate.structure import ACCURACY, TINY

EPSILON = float(np.finfo(float).eps)
NEAR = (
    0.1  # radians, or of a value above 1: how far a step across a limit may lead; a sine is its tangent to 0.2 % there
)
SAME = 1e-6  # of a value: places nearer than this are one steady state, reached by different arithmetic
SHORTEST = 2.0**-16  # of a path: a step that has to be shorter means that the path ends


@kernel()
def equations(address, y, w, wd, p, m, inner, first, v, r, jac):  # type: ignore[no-untyped-def]
    """Writes the rest residual at the unknowns v into r (n,), and its Jacobian into jac (n, n), zeros where that has none."""
    residual(address, y, w, wd, p, m, v.size, inner, first, v, r)
    call(address[REST_JAC], y, y, w, wd, p, m, jac)


@kernel()
def measures(jac, v, size, weight):  # type: ignore[no-untyped-def]
    """Writes what each equation's residual is measured by, size (n,) being the most that an unknown counts for."""
    for i in range(v.size):
        total = 0.0
        for j in range(v.size):
            total += abs(jac[i, j]) * min(max(abs(v[j]), TINY), size[j])
        weight[i] = total if total > 0.0 else 1.0


@kernel()
def norm(r, weight):  # type: ignore[no-untyped-def]
    """The residual's norm, each equation by its own measure."""
    total = 0.0
    for i in range(r.size):
        total += (r[i] / weight[i]) ** 2
    return np.sqrt(total)


@kernel()
def advancing(jac, h, nx, matrix):  # type: ignore[no-untyped-def]
    """Writes the Jacobian (n, n) of an implicit Euler step of length h, jac being that of the rest residual; it may be matrix."""
    for i in range(jac.shape[0]):
        for j in range(jac.shape[0]):
            matrix[i, j] = -jac[i, j]
        if i < nx:
            matrix[i, i] += 1.0 / h


@kernel()
def unsolved(r, x, v, h, nx, off):  # type: ignore[no-untyped-def]
    """Writes into off (n,) what an implicit Euler step of length h from v to x leaves, r being the residual at x."""
    for i in range(x.size):
        off[i] = -r[i]
        if i < nx:
            off[i] += (x[i] - v[i]) / h


@kernel()
def stepped(address, inner, nu, nx, y, w, wd, p, m, size, v, h, x):  # type: ignore[no-untyped-def]
    """Writes the end of an implicit Euler step of length h from v into x (n,); whether it was found.

    Newton's method; a change that leads past a jump is halved until it leads nearer, so that it ends within the edge.
    """
    n = v.size
    r, off, ahead, trial, weight = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    matrix, pivots = np.zeros((n, n)), np.zeros(n, np.int64)
    goal = 1e-2 * ACCURACY
    x[:] = v
    for k in range(60):
        equations(address, y, w, wd, p, m, inner, 1 + nu, x, r, matrix)
        advancing(matrix, h, nx, matrix)
        unsolved(r, x, v, h, nx, off)
        measures(matrix, x, size, weight)
        before = norm(off, weight)
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
            residual(address, y, w, wd, p, m, n, inner, 1 + nu, trial, r)
            unsolved(r, trial, v, h, nx, ahead)
            better = norm(ahead, weight) < before
            damping /= 2
        if not better:
            return False
        x[:] = trial
    return False


def _entries(stamp):  # type: ignore[no-untyped-def]
    """Return the functions that Python calls, for the present state of the kernels' files."""

    @njit(cache=True, error_model="numpy")
    def trace(address, inner, nu, y, w, p, m, ends_p, ends_w, v, sign):  # type: ignore[no-untyped-def]
        """Moves v (n,), a rest at the first of two sets of values, along the straight line between them; the share reached.

        ends_p (2, parameters), ends_w (2, 1 + inputs): the values, time first. sign: of the determinant at the start.

        A step counts where undamped Newton corrections at least halve (`rest` says why), the determinant keeps its sign,
        which a fold changes, the way is no longer than the two slopes at its ends allow: a jump to another branch is; and
        Newton's method leads back to where the step began, which from another branch it does not. (Corrections that halve
        on the way there show the condition in their own direction only.) Else it is halved. Across a limit, where the
        equations have a corner, no such ratio holds, and a long step may end anywhere: there it has to be short, within
        which the pieces are as good as straight.
        """
        kept, n, wd = stamp, v.size, np.zeros(w.size)  # noqa: F841  the stamp is used so that the cache knows of it
        r, x, delta, extent, trial = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
        jac, matrix, pivots, modes = np.zeros((n, n)), np.zeros((n, n)), np.zeros(n, np.int64), np.zeros(m.size)
        share, h = 0.0, 1.0
        while share < 1.0 and h > SHORTEST:
            h = min(h, 1.0 - share)
            ahead = share + h if h < 1.0 - share else 1.0
            p[:] = ends_p[0] + ahead * (ends_p[1] - ends_p[0])
            w[: 1 + nu] = ends_w[0] + ahead * (ends_w[1] - ends_w[0])
            x[:] = v
            for i in range(n):
                extent[i] = max(abs(v[i]), TINY)
            arrived, before, first, across = False, np.inf, 0.0, False
            for k in range(12):
                modes[:] = m
                equations(address, y, w, wd, p, m, inner, 1 + nu, x, r, jac)
                matrix[:] = jac
                delta[:] = r
                if not lu(matrix, pivots):
                    break
                solve(matrix, pivots, delta)
                size = 0.0
                for i in range(n):
                    part = abs(delta[i]) / extent[i]
                    if not part <= size:
                        size = part
                if not size < 1e12:
                    break
                first = size if k == 0 else first
                if size < 1e-11 or (size < 1e-8 and size > 0.5 * before):
                    arrived = orientation(matrix, pivots) == sign
                    break
                cornered = False
                for i in range(m.size):
                    cornered = cornered or (k > 0 and modes[i] != m[i])
                across = across or cornered
                if k > 0 and size > 0.5 * before and not cornered:
                    break
                for i in range(n):
                    x[i] -= delta[i]
                before = size
            if arrived:
                p[:] = ends_p[0] + share * (ends_p[1] - ends_p[0])
                w[: 1 + nu] = ends_w[0] + share * (ends_w[1] - ends_w[0])
                residual(address, y, w, wd, p, m, n, inner, 1 + nu, x, delta)
                solve(matrix, pivots, delta)
                way, back = 0.0, 0.0
                for i in range(n):
                    way = max(way, abs(x[i] - v[i]) / extent[i])
                    back = max(back, abs(delta[i]) / extent[i])
                arrived = way <= first + back + 1e-8
                for i in range(n):
                    if across and abs(x[i] - v[i]) > NEAR * max(abs(v[i]), 1.0):
                        arrived = False
                if arrived and not across:
                    arrived, before = False, np.inf
                    trial[:] = x
                    for k in range(12):
                        equations(address, y, w, wd, p, m, inner, 1 + nu, trial, r, jac)
                        matrix[:] = jac
                        delta[:] = r
                        if not lu(matrix, pivots):
                            break
                        solve(matrix, pivots, delta)
                        size, off = 0.0, 0.0
                        for i in range(n):
                            size = max(size, abs(delta[i]) / extent[i])
                            off = max(off, abs(trial[i] - v[i]) / extent[i])
                        if size < 1e-11 or (size < 1e-8 and size > 0.5 * before):
                            arrived = off < SAME
                            break
                        if k > 0 and not size <= 0.5 * before:
                            break
                        for i in range(n):
                            trial[i] -= delta[i]
                        before = size
            if arrived:
                v[:] = x
                share = ahead
                h *= 2.0
            else:
                h *= 0.5
        p[:] = ends_p[0] + share * (ends_p[1] - ends_p[0])
        w[: 1 + nu] = ends_w[0] + share * (ends_w[1] - ends_w[0])
        return share

    @njit(cache=True, error_model="numpy")
    def follow(address, inner, nu, nx, y, w, p, m, size, v):  # type: ignore[no-untyped-def]
        """Moves v (n,) by implicit Euler steps whose length grows as the residual falls: follows the model to its rest."""
        kept, n, wd = stamp, v.size, np.zeros(w.size)  # noqa: F841  the stamp is used so that the cache knows of it
        r, ahead, step, trial, weight = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
        jac, jac_ahead, matrix, pivots = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n)), np.zeros(n, np.int64)
        equations(address, y, w, wd, p, m, inner, 1 + nu, v, r, jac)
        measures(jac, v, size, weight)
        before, h = norm(r, weight), 1e-4
        for _ in range(300):
            advancing(jac, h, nx, matrix)
            step[:] = r
            if not lu(matrix, pivots):
                h *= 0.3
                continue
            solve(matrix, pivots, step)
            for i in range(n):
                trial[i] = v[i] + step[i]
            equations(address, y, w, wd, p, m, inner, 1 + nu, trial, ahead, jac_ahead)
            measures(jac_ahead, trial, size, weight)
            after = norm(ahead, weight)
            if after < np.inf and (after < 1.5 * before or h < 1e-9):
                h = min(h * max(1.5, before / max(after, 1e-300)), 1e9)
                v[:], r[:], jac[:], before = trial, ahead, jac_ahead, after
                if after < 1e-2 * ACCURACY:
                    break
            else:
                h *= 0.2
                if h < 1e-12:
                    break

    @njit(cache=True, error_model="numpy")
    def nearest(address, inner, nu, y, w, p, m, size, v):  # type: ignore[no-untyped-def]
        """Moves v (n,) by Newton steps of least norm, for a Jacobian that is singular where a state does not matter."""
        kept, n, wd = stamp, v.size, np.zeros(w.size)  # noqa: F841  as above
        r, ahead, right, trial, weight = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
        jac, matrix = np.zeros((n, n)), np.zeros((n, n))
        for _ in range(50):
            equations(address, y, w, wd, p, m, inner, 1 + nu, v, r, jac)
            if not (np.isfinite(r).all() and np.isfinite(jac).all()):
                return
            measures(jac, v, size, weight)
            for i in range(n):
                for j in range(n):
                    matrix[i, j] = jac[i, j] / weight[i]
                right[i] = -r[i] / weight[i]
            step = np.linalg.lstsq(matrix, right, 1e-12)[0]
            before, damping, better = norm(r, weight), 1.0, False
            while damping > 1e-4 and not better:
                for i in range(n):
                    trial[i] = v[i] + damping * step[i]
                residual(address, y, w, wd, p, m, n, inner, 1 + nu, trial, ahead)
                better = norm(ahead, weight) < before or before < 1e-14
                if not better:
                    damping /= 2
            if not better:
                return
            v[:] = trial
            if np.abs(step).max() < 1e-14:
                return

    @njit(cache=True, error_model="numpy")
    def slide(address, inner, nu, nx, y, w, p, m, size, v):  # type: ignore[no-untyped-def]
        """Moves v (n,) by implicit Euler steps that are solved each: to a rest on the edge of a jump too.

        A loop that rests there is driven to it from both sides: a step that is not solved for goes past the edge, and the
        next one back.
        """
        kept, n, wd = stamp, v.size, np.zeros(w.size)  # noqa: F841  as above
        r, jac, weight, end = np.zeros(n), np.zeros((n, n)), np.zeros(n), np.zeros(n)
        h = 1e-3
        for _ in range(200):
            if stepped(address, inner, nu, nx, y, w, wd, p, m, size, v, h, end):
                v[:] = end
                equations(address, y, w, wd, p, m, inner, 1 + nu, v, r, jac)
                measures(jac, v, size, weight)
                if norm(r, weight) < 1e-2 * ACCURACY:
                    return
                h = min(3.0 * h, 1e9)
            else:
                h *= 0.25
                if h < 1e-12:
                    return

    @njit(cache=True, error_model="numpy")
    def judge(address, inner, nu, y, w, p, m, size, v, r, jac, shares):  # type: ignore[no-untyped-def]
        """Writes the rest residual at v (n,) into r (n,), its Jacobian into jac (n, n), zeros where that has none, and into
        shares (n,) the residuals by their own measures, less what rounding alone leaves."""
        kept, n, wd = stamp, v.size, np.zeros(w.size)  # noqa: F841  as above
        equations(address, y, w, wd, p, m, inner, 1 + nu, v, r, jac)
        measures(jac, v, size, shares)
        for i in range(n):
            rounding = 0.0
            for j in range(n):
                rounding += abs(jac[i, j]) * abs(v[j])
            shares[i] = 0.0 if abs(r[i]) <= 16.0 * EPSILON * rounding else abs(r[i]) / shares[i]

    return trace, follow, nearest, slide, judge


trace, follow, nearest, slide, judge = _entries(stamp())
