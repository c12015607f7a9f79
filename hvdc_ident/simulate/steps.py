"""One step of each integrator over states and sensitivities as one flat vector, with its error and its dense output."""

from __future__ import annotations

import numpy as np
from numba import njit

from hvdc_ident.simulate.call import call
from hvdc_ident.simulate.linear import lu, solve, solve_rows
from hvdc_ident.simulate.tableaus import (
    DOPRI_A,
    DOPRI_DENSE,
    DOPRI_E,
    DOPRI_TIME,
    RODAS_A,
    RODAS_C,
    RODAS_D,
    RODAS_GAMMA,
    RODAS_H,
    RODAS_TIME,
)

# Addresses, in the order of structure.NAMES.
F, FS, JAC, HESS, FT, SW, SWS, SWD, MODES, OUT, OUTS, SRC, SRCS, SRCD, REST, REST_JAC, REST_P, CONST, LU, SOLVE, SOLVES = range(21)


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def error_norm(e, y, yn, n, rows, width, count, rtol, atol, scale, totals, floors):  # type: ignore[no-untyped-def]
    """The largest weighted RMS error over the first `rows` of the n unknowns and of each parameter's sensitivities; > 1 is a rejection."""
    if rows == 0:
        return 0.0
    total = 0.0
    for k in range(rows):
        r = e[k] / (atol + rtol * max(abs(y[k]), abs(yn[k])))
        total += r * r
    worst = total
    if width:
        es, ys, yns = e[n:].reshape(n, width), y[n:].reshape(n, width), yn[n:].reshape(n, width)
        for c in range(width):
            totals[c] = 0.0
            floors[c] = atol / scale[c] if c < count else np.inf
        for i in range(rows):
            for c in range(width):
                a, b = abs(ys[i, c]), abs(yns[i, c])
                r = es[i, c] / (floors[c] + rtol * (a if a > b else b))
                totals[c] += r * r
        for c in range(count):
            if not totals[c] <= worst:
                worst = totals[c]
    return np.sqrt(worst / rows)


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def interpolate(y, dense, x, size, u):  # type: ignore[no-untyped-def]
    """Writes the first `size` elements of y + x (c1 + x (c2 + x (c3 + x c4))), the rows of dense, into u."""
    a, b, c, d = dense[0], dense[1], dense[2], dense[3]
    for k in range(size):
        u[k] = y[k] + x * (a[k] + x * (b[k] + x * (c[k] + x * d[k])))


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def rodas_point(stage, y, k, u):  # type: ignore[no-untyped-def]
    """Writes y + sum a_ij k_j of the stage into u; stages 6 and 7 add to what stage 5 left there."""
    if stage >= 6:
        for q in range(u.size):
            u[q] += k[stage - 1, q]
        return
    for q in range(u.size):
        u[q] = y[q]
    for j in range(0, stage - 1, 2):  # two at a time: half the traffic
        a, b = RODAS_A[stage, j], RODAS_A[stage, j + 1]
        for q in range(u.size):
            u[q] += a * k[j, q] + b * k[j + 1, q]
    if stage % 2:
        a = RODAS_A[stage, stage - 1]
        for q in range(u.size):
            u[q] += a * k[stage - 1, q]


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def rodas_matrix(address, factor_count, h, nx, jac, factors, shift, yd, m, matrix, pivots):  # type: ignore[no-untyped-def]
    """Factors M/(h gamma) - J: 1 by the generated elimination, 2 by dense partial pivoting into `matrix`, 0 if it is singular.

    The generated one takes its pivots as they come: it is trusted where none is small against its row.
    """
    n = jac.shape[0]
    shift[0] = 1.0 / (h * RODAS_GAMMA)
    if factor_count:
        call(address[LU], jac, yd, shift, yd, yd, m, factors)
        trusted = True
        for i in range(n):
            largest = shift[0] if i < nx else 0.0
            for j in range(n):
                largest = max(largest, abs(jac[i, j]))
            trusted = trusted and abs(factors[i]) * largest < 1e7
        if trusted:
            return 1
    for i in range(n):
        for j in range(n):
            matrix[i, j] = -jac[i, j]
    for i in range(nx):
        matrix[i, i] += shift[0]
    return 2 if lu(matrix, pivots) else 0


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def rodas_stage(address, stage, h, forced, n, width, mass, hess_row, hess_column, hess, ft, kind, factors, matrix, pivots, u, k, c, yd, w, wd, p, m):  # type: ignore[no-untyped-def]
    """Computes k[stage] from the stage's values u, with w set for the stage's time; mass is 1 where a row has a derivative."""
    row = k[stage]
    call(address[FS if width else F], u, yd, w, wd, p, m, row)
    if stage > 0:
        inverse = 1.0 / h
        for q in range(c.size):
            c[q] = 0.0
        for j in range(0, stage - 1, 2):
            a, b = RODAS_C[stage, j], RODAS_C[stage, j + 1]
            for q in range(c.size):
                c[q] += a * k[j, q] + b * k[j + 1, q]
        if stage % 2:
            a = RODAS_C[stage, stage - 1]
            for q in range(c.size):
                c[q] += a * k[stage - 1, q]
        for q in range(c.size):
            k[stage, q] += inverse * mass[q] * c[q]
    if forced and RODAS_D[stage] != 0.0:
        factor = h * RODAS_D[stage]
        for q in range(c.size):
            k[stage, q] += factor * ft[q]
    if kind == 1:
        call(address[SOLVE], yd, yd, w, wd, factors, m, row)
    else:
        solve(matrix, pivots, row[:n])
    if width:
        rows = row[n:].reshape(n, width)
        for q in range(hess_row.size):
            value = row[hess_column[q]]
            if value != 0.0:
                i = hess_row[q]
                for r in range(width):
                    rows[i, r] += hess[q, r] * value
        if kind == 1:
            call(address[SOLVES], yd, yd, w, wd, factors, m, rows)
        else:
            solve_rows(matrix, pivots, rows)


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def rodas_stages(address, h, forced, n, width, mass, hess_row, hess_column, hess, ft, kind, factors, matrix, pivots, y, u, k, c, yd, w, wd, p, m, t, step_end):  # type: ignore[no-untyped-def]
    """All stages of a step over which nothing comes from outside but time."""
    for stage in range(8):
        w[0] = step_end if RODAS_TIME[stage] == 1.0 else t + RODAS_TIME[stage] * h
        rodas_point(stage, y, k, u)
        rodas_stage(address, stage, h, forced, n, width, mass, hess_row, hess_column, hess, ft, kind, factors, matrix, pivots, u, k, c, yd, w, wd, p, m)


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def rodas_dense(k, y, yn, dense):  # type: ignore[no-untyped-def]
    """Writes the four rows of the step's quartic."""
    size = y.size
    for q in range(size):
        dense[0, q] = yn[q] - y[q]
        dense[1, q] = 0.0
        dense[2, q] = 0.0
        dense[3, q] = 0.0
    d0, d1, d2, d3 = dense[0], dense[1], dense[2], dense[3]
    for s in range(8):
        a, b, c = RODAS_H[0, s], RODAS_H[1, s], RODAS_H[2, s]
        ks = k[s]
        for q in range(size):
            v = ks[q]
            d0[q] += a * v
            d1[q] += (b - a) * v
            d2[q] += (c - b) * v
            d3[q] -= c * v


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def dopri_dense(k, y, yn, h, dense):  # type: ignore[no-untyped-def]
    """Writes the four rows of the step's quartic."""
    for q in range(y.size):
        change = yn[q] - y[q]
        bend = h * k[0, q] - change
        curl = change - h * k[6, q] - bend
        last = 0.0
        for s in range(7):
            last += DOPRI_DENSE[s] * k[s, q]
        last *= h
        dense[0, q] = change + bend
        dense[1, q] = -bend + curl + last
        dense[2, q] = -curl - 2.0 * last
        dense[3, q] = last


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def dopri_point(stage, h, y, k, u):  # type: ignore[no-untyped-def]
    """Writes y + h sum a_ij k_j of the stage into u."""
    for q in range(u.size):
        u[q] = y[q]
    for j in range(stage):
        factor = h * DOPRI_A[stage, j]
        if factor != 0.0:
            for q in range(u.size):
                u[q] += factor * k[j, q]


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def dopri_error(h, k, e):  # type: ignore[no-untyped-def]
    """Writes the embedded error into e."""
    for q in range(e.size):
        e[q] = 0.0
    for s in range(7):
        factor = h * DOPRI_E[s]
        if factor != 0.0:
            for q in range(e.size):
                e[q] += factor * k[s, q]


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def stage_time(method, stage):  # type: ignore[no-untyped-def]
    """The stage's share of the step."""
    return RODAS_TIME[stage] if method == 1 else DOPRI_TIME[stage]
