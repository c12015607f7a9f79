"""The algebraic unknowns at an instant: values and sensitivities that fit the states, and their rates."""

from __future__ import annotations

import numpy as np

from hvdc_ident.simulate.kernel import kernel
from hvdc_ident.simulate.linear import lu, solve, solve_rows
from hvdc_ident.simulate.memory import indices, table, vector
from hvdc_ident.simulate.steps import evaluate


@kernel()
def _loop_matrix(r):  # type: ignore[no-untyped-def]
    """Factors the Jacobian of the unknowns' equations by the unknowns; r.jac has to be up to date."""
    nx, nz, n = r.nx, r.nz, r.n
    jac, small = table(r.jac, n, n), table(r.small, nz, nz)
    for i in range(nz):
        for j in range(nz):
            small[i, j] = jac[nx + i, nx + j]
    return lu(small, indices(r.small_pivots, nz))


@kernel()
def consistent(r, live):  # type: ignore[no-untyped-def]
    """Solves the unknowns (and their sensitivities) for the present states, with modes found from the values where `live`.

    Returns whether Newton's method converged. Uses r.e as scratch.
    """
    nx, nz, n, width = r.nx, r.nz, r.n, r.width
    if live:
        evaluate(r, r.do_modes, r.y, r.m)
    if nz == 0:
        return True
    y, left = vector(r.y, r.size), vector(r.e, r.size)
    small, pivots = table(r.small, nz, nz), indices(r.small_pivots, nz)
    converged = False
    for iteration in range(60):
        evaluate(r, r.do_f, r.y, r.e)
        evaluate(r, r.do_jac, r.y, r.jac)
        if not _loop_matrix(r):
            return False
        solve(small, pivots, left[nx:n])
        largest = 0.0
        damping = 1.0 if iteration < 20 else 0.5
        for i in range(nx, n):
            y[i] -= damping * left[i]
            largest = max(largest, abs(left[i]) / (1.0 + abs(y[i])))
        if not largest < np.inf:
            return False
        if live:
            evaluate(r, r.do_modes, r.y, r.m)
        if largest < 1e-14 or (converged and largest < 1e-12):
            break
        converged = largest < 1e-12
    if not largest < 1e-10:
        return False
    if width:
        for q in range(n + nx * width, r.size):
            y[q] = 0.0
        evaluate(r, r.do_fs, r.y, r.e)
        rows = table(r.e + 8 * (n + nx * width), nz, width)
        solve_rows(small, pivots, rows)
        for i in range(nz):
            for c in range(width):
                y[n + (nx + i) * width + c] = -rows[i, c]
    return True


@kernel()
def rates(r):  # type: ignore[no-untyped-def]
    """Writes the rates of states and unknowns into r.yd; needs modes and values that are consistent. Uses r.e as scratch."""
    nx, nz, n = r.nx, r.nz, r.n
    yd, left = vector(r.yd, n), vector(r.e, r.size)
    evaluate(r, r.do_f, r.y, r.e)
    for i in range(nx):
        yd[i] = left[i]
    if nz == 0:
        return True
    evaluate(r, r.do_jac, r.y, r.jac)
    evaluate(r, r.do_ft, r.y, r.e)
    jac = table(r.jac, n, n)
    for i in range(nx, n):
        total = -left[i]
        for j in range(nx):
            total -= jac[i, j] * yd[j]
        left[i] = total
    if not _loop_matrix(r):
        return False
    solve(table(r.small, nz, nz), indices(r.small_pivots, nz), left[nx:n])
    for i in range(nx, n):
        yd[i] = left[i]
    return True
