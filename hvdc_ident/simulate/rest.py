"""The steady start: Newton's method on the rest equations, compiled, with its sensitivities."""

from __future__ import annotations

import numpy as np
from numba import njit

from hvdc_ident.simulate.call import call
from hvdc_ident.simulate.kernel import kernel, stamp
from hvdc_ident.simulate.linear import lu, orientation, solve, solve_rows
from hvdc_ident.simulate.structure import NAMES, TINY

FOUND, SINGULAR, NOT_FOUND = range(3)
MODES, RESIDUAL, REST_JAC, REST_P = (NAMES.index(n) for n in ("modes", "rest", "rest_jac", "rest_p"))


@kernel()
def residual(address, y, w, wd, p, m, n, inner, first, total, r):  # type: ignore[no-untyped-def]
    """Writes the rest residual at the total unknowns into r, with modes from the values; unknowns beyond y live in w."""
    for i in range(n - inner):
        w[first + i] = total[inner + i]
    for i in range(inner):
        y[i] = total[i]
    call(address[MODES], y, y, w, wd, p, m, m)
    call(address[RESIDUAL], y, y, w, wd, p, m, r)


def _entry(stamp):  # type: ignore[no-untyped-def]
    """Return the function that Python calls, for the present state of the kernels' files."""

    @njit(cache=True, error_model="numpy")
    def rest(address, dims, p, y, w, wd, m, jac, worst, rule):  # type: ignore[no-untyped-def]
        """Finds the steady state from y[:n] and w's delays and samples on; writes it there, with its rows over the parameters.

        jac (k, k): zeros where the Jacobian has none, on return the Jacobian at the solution. worst: index and size of the
        largest scaled residual. Returns FOUND, SINGULAR or NOT_FOUND; rows are valid only for FOUND.

        rule (2,): by how much at most each correction may shrink to the next, and the sign that the Jacobian's determinant
        has to have at the solution (0: any); with inf instead of the first, steps are halved until the residual falls.
        On return rule[1] is the sign found. Where undamped corrections at least halve, Kantorovich's condition holds
        (h <= 1/2 gives h / (2 (1 - h)) <= 1/2, Deuflhard 2004, Newton Methods, 2.1): the solution is the one that the
        start is connected with, no fold lies between.
        """
        worst[1] = stamp  # used so that the cache knows of it
        nx, nz, nu, nd, nq, width = dims[0], dims[1], dims[2], dims[3], dims[4], dims[8]
        inner, first = nx + nz, 1 + nu
        n = inner + nd + nq
        v, trial, r, rt, delta = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
        matrix, pivots = np.zeros((n, n)), np.zeros(max(n, 1), np.int64)
        for i in range(inner):
            v[i] = y[i]
        for i in range(nd + nq):
            v[inner + i] = w[first + i]
        residual(address, y, w, wd, p, m, n, inner, first, v, r)
        small = 0
        status = NOT_FOUND
        guarded, wanted, moved = rule[0] < np.inf, rule[1], np.inf
        extent = np.zeros(n)
        for i in range(n):
            extent[i] = max(abs(v[i]), TINY)
        for _ in range(80):
            call(address[REST_JAC], y, y, w, wd, p, m, jac)
            weight, worst[1] = np.zeros(n), 0.0
            norm = 0.0
            for i in range(n):
                for j in range(n):
                    weight[i] = max(weight[i], abs(jac[i, j]) * max(abs(v[j]), 1e-3))
                    matrix[i, j] = jac[i, j]
                if weight[i] == 0.0:
                    weight[i] = 1.0
                share = abs(r[i]) / weight[i]
                if not share <= worst[1]:
                    worst[0], worst[1] = i, share
                norm = max(norm, share)
                delta[i] = r[i]
            if not norm < np.inf:
                return NOT_FOUND
            if not lu(matrix, pivots):
                return SINGULAR
            solve(matrix, pivots, delta)
            change = 0.0
            for i in range(n):
                change = max(change, abs(delta[i]) / (abs(v[i]) + 1e-3))
            if not change < 1e12:
                return SINGULAR
            if guarded:
                before, moved = moved, 0.0
                for i in range(n):
                    moved = max(moved, abs(delta[i]) / extent[i])
                if moved > 1e-9 and moved > rule[0] * before:
                    return NOT_FOUND
            damping = 1.0
            for _ in range(12):
                for i in range(n):
                    trial[i] = v[i] - damping * delta[i]
                residual(address, y, w, wd, p, m, n, inner, first, trial, rt)
                after = 0.0
                for i in range(n):
                    share = abs(rt[i]) / weight[i]
                    if not share <= after:
                        after = share
                if guarded or after < norm or after < 1e-13 or (change < 1e-9 and after < np.inf):
                    break
                damping *= 0.5
            for i in range(n):
                v[i] = trial[i]
                r[i] = rt[i]
            if change < 1e-13 and damping == 1.0:
                small += 2
            elif change < 1e-10 and damping == 1.0:
                small += 1
            if small >= 2:
                status = FOUND
                break
        if status != FOUND:
            return NOT_FOUND
        rule[1] = orientation(matrix, pivots)
        if wanted * rule[1] < 0.0:
            return NOT_FOUND
        if width:
            call(address[REST_JAC], y, y, w, wd, p, m, jac)
            for i in range(n):
                for j in range(n):
                    matrix[i, j] = jac[i, j]
            if not lu(matrix, pivots):
                return SINGULAR
            rows = np.zeros((n, width))
            call(address[REST_P], y, y, w, wd, p, m, rows)
            solve_rows(matrix, pivots, rows)
            nw = 1 + nu + nd + nq
            for i in range(n):
                for c in range(width):
                    if i < inner:
                        y[inner + i * width + c] = -rows[i, c]
                    else:
                        w[nw + (i - inner) * width + c] = -rows[i, c]
        return FOUND

    return rest


rest = _entry(stamp(NAMES))
# The types of its arguments, so that it can be made before the first run.
REST = (
    "int64(int64[::1], int64[::1], float64[::1], float64[::1], float64[::1], float64[::1], float64[::1], "
    "float64[:, ::1], float64[::1], float64[::1])"
)
