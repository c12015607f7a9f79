"""One step of each integrator over states and sensitivities as one flat vector, with its error and its dense output."""

from __future__ import annotations

import numpy as np

from hvdc_ident.simulate.call import call
from hvdc_ident.simulate.exogenous import outside
from hvdc_ident.simulate.kernel import kernel
from hvdc_ident.simulate.lanes import column_sums, elementwise, weighted
from hvdc_ident.simulate.linear import lu, solve, solve_rows
from hvdc_ident.simulate.memory import indices, table, vector
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

# --- both methods ---


@kernel()
def evaluate(r, function, y, out):  # type: ignore[no-untyped-def]
    """Calls a generated function at the flat vector y; all are addresses."""
    call(function, y, r.yd, r.w, r.wd, r.p, r.m, out)


@elementwise
def _horner(y, a, b, c, d, x):  # type: ignore[no-untyped-def]
    return (y + x * (a + x * (b + x * (c + x * d))),)


@elementwise
def _horner_four(y, a, b, c, d, x0, x1, x2, x3):  # type: ignore[no-untyped-def]
    return tuple(y + x * (a + x * (b + x * (c + x * d))) for x in (x0, x1, x2, x3))


@elementwise
def copy(x):  # type: ignore[no-untyped-def]
    return (x,)


@elementwise
def _difference(a, b):  # type: ignore[no-untyped-def]
    return (a - b,)


@elementwise
def _sum(a, b):  # type: ignore[no-untyped-def]
    return (a + b,)


@kernel()
def interpolate(r, x, count, out):  # type: ignore[no-untyped-def]
    """Writes the first `count` elements (and up to three more) of the step's quartic at x in 0..1 to the address out."""
    line = 8 * r.stride
    d = r.dense
    _horner((count + 3) // 4 * 4, (r.y, d, d + line, d + 2 * line, d + 3 * line), (out,), (x,))


@kernel()
def interpolate_four(r, x0, x1, x2, x3):  # type: ignore[no-untyped-def]
    """Writes the step's quartic at four places to the rows of r.block."""
    line = 8 * r.stride
    d, b = r.dense, r.block
    places = (b, b + line, b + 2 * line, b + 3 * line)
    _horner_four(r.stride, (r.y, d, d + line, d + 2 * line, d + 3 * line), places, (x0, x1, x2, x3))


@kernel(fastmath={"contract", "reassoc"})
def error_norm(r, e, rows):  # type: ignore[no-untyped-def]
    """The largest weighted RMS of the error e (address) over the first `rows` unknowns and each parameter's rows of these.

    More than 1 is a rejection; infinite where something is no number.
    """
    if rows == 0:
        return 0.0
    y, yn, errors = vector(r.y, rows), vector(r.yn, rows), vector(e, rows)
    rtol, atol = r.rtol, r.atol
    worst = 0.0
    for i in range(rows):
        a, b = abs(y[i]), abs(yn[i])
        share = errors[i] / (atol + rtol * (a if a > b else b))
        worst += share * share
    if r.width:
        head = 8 * r.n
        column_sums(rows, r.width, e + head, r.y + head, r.yn + head, r.floors, rtol, r.totals)
        totals = vector(r.totals, r.width)
        check = worst
        for c in range(r.np):
            check += totals[c]
            worst = max(worst, totals[c])
        if not check < np.inf:
            return np.inf
    return np.sqrt(worst / rows) if worst < np.inf else np.inf


@kernel()
def attempt(r):  # type: ignore[no-untyped-def]
    """One step of length r.hs from (r.t, r.y) into r.yn; r.error says how good it is."""
    # An unknown may have an infinite slope for an instant, as sqrt(1.1^2 - i^2) where i meets its limit. The
    # states pass it; very short steps are judged by them alone.
    rows = r.n if r.hs > 1e-6 * (r.end - r.start) or r.nx == 0 else r.nx
    r.error = _rodas(r, rows) if r.rosenbrock else _dopri(r, rows)


@kernel()
def make_dense(r):  # type: ignore[no-untyped-def]
    """Writes the quartic of the step that ended in r.yn into r.dense."""
    if r.rosenbrock:
        _rodas_dense(r)
    else:
        _dopri_dense(r)


# --- RODAS5P ---


def _rodas_point(stage):  # type: ignore[no-untyped-def]
    """Return the kernel that prepares a stage's right-hand side: the point where it is taken (from stage 5 on, relative to
    the stage before) and the term added to it."""

    @elementwise
    def point(base, mass, ft, *rest):  # type: ignore[no-untyped-def]
        k, (inverse, push) = rest[:stage], rest[stage:]
        weights = RODAS_A[stage, :stage] if stage < 6 else [0.0] * (stage - 1) + [1.0]
        return base + weighted(weights, k), mass * (inverse * weighted(RODAS_C[stage, :stage], k)) + push * ft

    return point


@elementwise
def _rodas_point_0(ft, push):  # type: ignore[no-untyped-def]
    return (push * ft,)


_rodas_point_1, _rodas_point_2, _rodas_point_3, _rodas_point_4 = (_rodas_point(s) for s in (1, 2, 3, 4))
_rodas_point_5, _rodas_point_6, _rodas_point_7 = (_rodas_point(s) for s in (5, 6, 7))


@elementwise
def _rodas_quartic(y, yn, *k):  # type: ignore[no-untyped-def]
    change = yn - y
    a, b, c = (weighted(row, k) for row in RODAS_H)
    return change + a, b - a, c - b, c * -1.0


@kernel()
def _rodas_prepare(r, stage):  # type: ignore[no-untyped-def]
    """Writes r.u, where the stage's right-hand side is taken (r.y at stage 0), and r.add, what is added to it."""
    n, line = r.stride, 8 * r.stride
    k0 = r.k
    k1, k2, k3, k4, k5, k6 = k0 + line, k0 + 2 * line, k0 + 3 * line, k0 + 4 * line, k0 + 5 * line, k0 + 6 * line
    push = r.hs * RODAS_D[stage]
    out, scalars = (r.u, r.add), (1.0 / r.hs, push)
    if stage == 0:
        _rodas_point_0(n, (r.ft,), (r.add,), (push,))
    elif stage == 1:
        _rodas_point_1(n, (r.y, r.mass, r.ft, k0), out, scalars)
    elif stage == 2:
        _rodas_point_2(n, (r.y, r.mass, r.ft, k0, k1), out, scalars)
    elif stage == 3:
        _rodas_point_3(n, (r.y, r.mass, r.ft, k0, k1, k2), out, scalars)
    elif stage == 4:
        _rodas_point_4(n, (r.y, r.mass, r.ft, k0, k1, k2, k3), out, scalars)
    elif stage == 5:
        _rodas_point_5(n, (r.y, r.mass, r.ft, k0, k1, k2, k3, k4), out, scalars)
    elif stage == 6:
        _rodas_point_6(n, (r.u, r.mass, r.ft, k0, k1, k2, k3, k4, k5), out, scalars)
    else:
        _rodas_point_7(n, (r.u, r.mass, r.ft, k0, k1, k2, k3, k4, k5, k6), out, scalars)


@kernel(fastmath={"contract"})
def _rodas_matrix(r):  # type: ignore[no-untyped-def]
    """Factors M/(h gamma) - J: 1 by the generated elimination, 2 by dense partial pivoting, 0 if it is singular.

    The generated one takes its pivots as they come: it is trusted where none is small against its row.
    """
    shift = 1.0 / (r.hs * RODAS_GAMMA)
    vector(r.shift, 1)[0] = shift
    if r.factors:
        call(r.do_lu, r.jac, r.yd, r.shift, r.yd, r.yd, r.m, r.factor)
        if vector(r.factor, r.factors + 1)[r.factors] < 1e7:
            return 1
    n = r.n
    jac, matrix = table(r.jac, n, n), table(r.matrix, n, n)
    for i in range(n):
        for j in range(n):
            matrix[i, j] = -jac[i, j]
    for i in range(r.nx):
        matrix[i, i] += shift
    return 2 if lu(matrix, indices(r.pivots, n)) else 0


@kernel(fastmath={"contract"})
def _rodas_solve(r, k):  # type: ignore[no-untyped-def]
    """Do the work of the generated solve by dense linear algebra: from the right-hand side at the address k to the stage."""
    n, width = r.n, r.width
    _sum(r.stride, (k, r.add), (k,), ())
    matrix, pivots, head = table(r.matrix, n, n), indices(r.pivots, n), vector(k, n)
    solve(matrix, pivots, head)
    if width:
        rows, hessian = table(k + 8 * n, n, width), table(r.hessian, r.hessians, width)
        row, column = indices(r.hess_row, r.hessians), indices(r.hess_column, r.hessians)
        for q in range(r.hessians):
            for c in range(width):
                rows[row[q], c] += hessian[q, c] * head[column[q]]
        solve_rows(matrix, pivots, rows)


@kernel()
def _rodas(r, rows):  # type: ignore[no-untyped-def]
    outside(r, r.t, r.t)
    if not r.again:
        evaluate(r, r.do_jac, r.y, r.jac)
        if r.forced:
            evaluate(r, r.do_ft, r.y, r.ft)
        if r.hessians:
            evaluate(r, r.do_hess, r.y, r.hessian)
    kind = _rodas_matrix(r)
    if kind == 0:
        return np.inf
    r.evaluations += 8
    for stage in range(8):
        if 0 < stage < 6:  # the later ones are taken at the same instant as 5
            outside(r, r.step_end if stage == 5 else r.t + RODAS_TIME[stage] * r.hs, r.t)
        _rodas_prepare(r, stage)
        k = r.k + 8 * r.stride * stage
        evaluate(r, r.do_rhs, r.u if stage else r.y, k)
        if kind == 1:
            call(r.do_solve, r.add, r.hessian, r.w, r.wd, r.factor, r.m, k)
        else:
            _rodas_solve(r, k)
    error = r.k + 8 * r.stride * 7
    _sum(r.stride, (r.u, error), (r.yn,), ())
    return error_norm(r, error, rows)


@kernel()
def _rodas_dense(r):  # type: ignore[no-untyped-def]
    s = 8 * r.stride
    k, d = r.k, r.dense
    stages = (k, k + s, k + 2 * s, k + 3 * s, k + 4 * s, k + 5 * s, k + 6 * s, k + 7 * s)
    _rodas_quartic(r.stride, (r.y, r.yn, *stages), (d, d + s, d + 2 * s, d + 3 * s), ())


# --- DOPRI5 ---


def _dopri_point(stage):  # type: ignore[no-untyped-def]
    @elementwise
    def point(y, *rest):  # type: ignore[no-untyped-def]
        return (y + rest[stage] * weighted(DOPRI_A[stage, :stage], rest[:stage]),)

    return point


_dopri_point_1, _dopri_point_2, _dopri_point_3 = (_dopri_point(s) for s in (1, 2, 3))
_dopri_point_4, _dopri_point_5, _dopri_point_6 = (_dopri_point(s) for s in (4, 5, 6))


@elementwise
def _dopri_error(*rest):  # type: ignore[no-untyped-def]
    return (rest[7] * weighted(DOPRI_E, rest[:7]),)


@elementwise
def _dopri_quartic(y, yn, *rest):  # type: ignore[no-untyped-def]
    k, h = rest[:7], rest[7]
    change = yn - y
    bend = h * k[0] - change
    curl = change - h * k[6] - bend
    last = h * weighted(DOPRI_DENSE, k)
    return change + bend, curl - bend + last, curl * -1.0 - last * 2.0, last


@kernel()
def _dopri_prepare(r, stage):  # type: ignore[no-untyped-def]
    """Writes where the stage's right-hand side is taken into r.u, or into r.yn for the last one; returns that address."""
    n, line = r.stride, 8 * r.stride
    k0 = r.k
    k1, k2, k3, k4, k5 = k0 + line, k0 + 2 * line, k0 + 3 * line, k0 + 4 * line, k0 + 5 * line
    out, scalars = (r.u,), (r.hs,)
    if stage == 1:
        _dopri_point_1(n, (r.y, k0), out, scalars)
    elif stage == 2:
        _dopri_point_2(n, (r.y, k0, k1), out, scalars)
    elif stage == 3:
        _dopri_point_3(n, (r.y, k0, k1, k2), out, scalars)
    elif stage == 4:
        _dopri_point_4(n, (r.y, k0, k1, k2, k3), out, scalars)
    elif stage == 5:
        _dopri_point_5(n, (r.y, k0, k1, k2, k3, k4), out, scalars)
    else:
        _dopri_point_6(n, (r.y, k0, k1, k2, k3, k4, k5), (r.yn,), scalars)
        return r.yn
    return r.u


@kernel(fastmath={"contract", "reassoc"})
def _dopri_stiffness(r):  # type: ignore[no-untyped-def]
    """The square of h times the largest mode, as the last two stages show it (Hairer and Wanner, IV.2)."""
    nx = r.nx
    before, after = vector(r.k + 40 * r.stride, nx), vector(r.k + 48 * r.stride, nx)
    u, yn = vector(r.u, nx), vector(r.yn, nx)
    top, bottom = 0.0, 0.0
    for i in range(nx):
        top += (after[i] - before[i]) ** 2
        bottom += (yn[i] - u[i]) ** 2
    return r.hs * r.hs * top / bottom if bottom > 0.0 else 0.0


@kernel()
def _dopri(r, rows):  # type: ignore[no-untyped-def]
    line = 8 * r.stride
    if not r.fresh:
        copy(r.stride, (r.k + 6 * line,), (r.k,), ())
    r.evaluations += 6
    for stage in range(1, 7):
        outside(r, r.t + DOPRI_TIME[stage] * r.hs if stage < 5 else r.step_end, r.t)
        evaluate(r, r.do_rhs, _dopri_prepare(r, stage), r.k + line * stage)
    r.stiffness = _dopri_stiffness(r)
    k = r.k
    stages = (k, k + line, k + 2 * line, k + 3 * line, k + 4 * line, k + 5 * line, k + 6 * line)
    _dopri_error(r.stride, stages, (r.e,), (r.hs,))
    return error_norm(r, r.e, rows)


@kernel()
def _dopri_dense(r):  # type: ignore[no-untyped-def]
    s = 8 * r.stride
    k, d = r.k, r.dense
    stages = (k, k + s, k + 2 * s, k + 3 * s, k + 4 * s, k + 5 * s, k + 6 * s)
    _dopri_quartic(r.stride, (r.y, r.yn, *stages), (d, d + s, d + 2 * s, d + 3 * s), (r.hs,))
