"""The algebraic unknowns: solved for the present states and modes, with their sensitivities and their rates."""

from __future__ import annotations

import numpy as np

from hvdc_ident.simulate.native import indices, kernel, lu, solve, solve_rows, table, vector
from hvdc_ident.simulate.steps import evaluate


@kernel()
def _loop_matrix(r):  # type: ignore[no-untyped-def]
    """Factor the Jacobian of the unknowns' equations by the unknowns; r.jac has to be up to date."""
    nx, nz, n = r.nx, r.nz, r.n
    jac, small = table(r.jac, n, n), table(r.small, nz, nz)
    for i in range(nz):
        for j in range(nz):
            small[i, j] = jac[nx + i, nx + j]
    return lu(small, indices(r.small_pivots, nz))


@kernel()
def consistent(r, live):  # type: ignore[no-untyped-def]
    """Solve the unknowns (and their sensitivities) for the present states, with modes found from the values where `live`.

    Returns whether a solution was found. Where Newton's method cycles between the sides of a limit, the way is followed
    from limit to limit, from the values before. Uses r.e as scratch.
    """
    nx, nz, n, width = r.nx, r.nz, r.n, r.width
    if live:
        evaluate(r, r.do_modes, r.y, r.m)
    if nz == 0:
        return True
    y, before = vector(r.y, r.size), vector(r.z_before, nz)
    small, pivots = table(r.small, nz, nz), indices(r.small_pivots, nz)
    for i in range(nz):
        before[i] = y[nx + i]
    if not _solve_unknowns(r, live):
        if not (live and r.ns):
            return False
        for i in range(nz):
            y[nx + i] = before[i]
        if not _solve_from_limit_to_limit(r) or not _solve_unknowns(r, True):
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
def _solve_unknowns(r, live):  # type: ignore[no-untyped-def]
    """Newton's method on the unknowns; leaves the Jacobian's factors. Returns whether it converged."""
    nx, nz, n = r.nx, r.nz, r.n
    y, left = vector(r.y, r.size), vector(r.e, r.size)
    small, pivots = table(r.small, nz, nz), indices(r.small_pivots, nz)
    converged = False
    for iteration in range(20 if live and r.ns else 60):
        damping = 1.0 if iteration < 20 else 0.5
        evaluate(r, r.do_f, r.y, r.e)
        evaluate(r, r.do_jac, r.y, r.jac)
        if not _loop_matrix(r):
            return False
        solve(small, pivots, left[nx:n])
        largest = 0.0
        for i in range(nx, n):
            y[i] -= damping * left[i]
            share = abs(left[i]) / (1.0 + abs(y[i]))
            if not share <= largest:  # also where it is no number
                largest = share
        if not largest < np.inf:
            return False
        if live:
            evaluate(r, r.do_modes, r.y, r.m)
        if largest < 1e-14 or (converged and largest < 1e-12):
            return True
        converged = largest < 1e-12
    return largest < 1e-10


@kernel()
def _solve_from_limit_to_limit(r):  # type: ignore[no-untyped-def]
    """Newton's direction from limit to limit (Katzenelson 1965), for equations in pieces. Returns whether it arrived.

    A step ends where the residual has fallen enough; else just beyond the next limit, with the modes of its other side.
    From side to side the residual falls along one line, so that the way cannot cycle unless the loop's determinant
    changes its sign at a limit.
    """
    nx, nz, n = r.nx, r.nz, r.n
    left, step, origin = vector(r.e, r.size), vector(r.z_step, nz), vector(r.z_from, nz)
    y, m, side = vector(r.y, n), vector(r.m, r.ns), vector(r.side, r.ns)
    for _ in range(200):
        before = _residual(r)
        if before < 1e-13:
            return True
        evaluate(r, r.do_jac, r.y, r.jac)
        if not before < np.inf or not _loop_matrix(r):
            return False
        solve(table(r.small, nz, nz), indices(r.small_pivots, nz), left[nx:n])
        for i in range(nz):
            step[i], origin[i] = left[nx + i], y[nx + i]
        for k in range(r.ns):
            side[k] = m[k]
        share, beyond, accepted = 1.0, 0.0, False
        for _ in range(50):
            after = _move(r, share)
            other = _is_other_side(r)
            accepted = after <= (1.0 - 0.1 * share) * before
            if accepted:
                break
            if other:
                beyond = share
            share *= 0.5
        if beyond > 0.0 and not (accepted and other):
            good = share if accepted else 0.0
            while beyond - good > 1e-13 and beyond - good > 1e-3 * beyond:
                middle = 0.5 * (good + beyond)
                _move(r, middle)
                if _is_other_side(r):
                    beyond = middle
                else:
                    good = middle
            _move(r, beyond)
        elif not accepted:
            return before < 1e-12
    return False


@kernel()
def _residual(r):  # type: ignore[no-untyped-def]
    """The largest residual of the unknowns' equations against their size, left in r.e, with modes from the values."""
    evaluate(r, r.do_modes, r.y, r.m)
    evaluate(r, r.do_f, r.y, r.e)
    y, left = vector(r.y, r.n), vector(r.e, r.n)
    largest = 0.0
    for i in range(r.nx, r.n):
        size = abs(left[i]) / (1.0 + abs(y[i]))
        if not size <= largest:
            largest = size
    return largest


@kernel()
def _move(r, share):  # type: ignore[no-untyped-def]
    """Go that share of the step from its origin; returns the residual there."""
    y, step, origin = vector(r.y, r.n), vector(r.z_step, r.nz), vector(r.z_from, r.nz)
    for i in range(r.nz):
        y[r.nx + i] = origin[i] - share * step[i]
    return _residual(r)


@kernel()
def _is_other_side(r):  # type: ignore[no-untyped-def]
    """True where a mode differs from those at the step's origin."""
    m, side = vector(r.m, r.ns), vector(r.side, r.ns)
    changed = 0
    for k in range(r.ns):
        changed += m[k] != side[k]
    return changed > 0


@kernel()
def rates(r):  # type: ignore[no-untyped-def]
    """Write the rates of states and unknowns into r.yd; needs modes and values that are consistent. Uses r.e as scratch."""
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
