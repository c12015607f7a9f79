"""Switches: where a step crosses one, what changes there, and the algebraic unknowns that are solved for anew."""

from __future__ import annotations

import numpy as np

from hvdc_ident.simulate.exogenous import outside
from hvdc_ident.simulate.native import indices, kernel, lu, solve, solve_rows, table, vector
from hvdc_ident.simulate.run_state import CHATTER, CONVERGED, INCONSISTENT
from hvdc_ident.simulate.steps import evaluate, interpolate

NONE, AGAIN = -1, -2


@kernel()
def violation(r, y):  # type: ignore[no-untyped-def]
    """The switch that is furthest beyond its mode at y (an address), or -1; leaves the switches' values in r.sv."""
    evaluate(r, r.do_sw, y, r.sv)
    values, m, slack = vector(r.sv, r.ns), vector(r.m, r.ns), vector(r.slack, r.ns)
    beyond = 0
    for k in range(r.ns):  # without a branch: nearly always there is none
        beyond += (2.0 * m[k] - 1.0) * values[k] > slack[k]
    if beyond == 0:
        return NONE
    worst, which = 0.0, NONE
    for k in range(r.ns):
        over = (2.0 * m[k] - 1.0) * values[k] - slack[k]
        if over > worst:
            worst, which = over, k
    return which


@kernel()
def widen(r):  # type: ignore[no-untyped-def]
    """Keep the largest value of every switch so far, which its tolerance is relative to."""
    values, top, slack = vector(r.sv, r.ns), vector(r.top, r.ns), vector(r.slack, r.ns)
    for i in range(r.ns):
        size = abs(values[i])
        largest = size if size > top[i] and size < np.inf else top[i]
        top[i] = largest
        slack[i] = 0.01 * r.rtol * largest + 1e-14


@kernel()
def find_switch(r):  # type: ignore[no-untyped-def]
    """The switch that ends the present step, whose end it may move; NONE, or AGAIN where the step is to be redone with r.h."""
    bad, event = 0.5, NONE
    interpolate(r, 0.5, r.n, r.u)
    outside(r, r.t + 0.5 * r.hs, r.t)
    event = violation(r, r.u)
    if event == NONE:
        bad = 1.0
        outside(r, r.step_end, r.t)
        event = violation(r, r.yn)
    aim, r.aim = r.aim, NONE
    if event == NONE:
        values, slack = vector(r.sv, r.ns), vector(r.slack, r.ns)
        if aim >= 0 and abs(values[aim]) <= 100.0 * slack[aim]:
            return aim  # the step aimed at this switch and met it
        return NONE
    bad, event = _bisect(r, bad, event)
    if bad < 0.98 and bad * r.hs > 1e-12 * (r.end - r.start):
        # Step again up to the switch itself: the dense output is less exact than the step.
        r.h, r.aim = bad * r.hs, event
        r.fresh = r.again = 1
        r.rejected += 1
        return AGAIN
    if bad < 1.0:
        # Near the step's end or its start: cut on the dense output.
        interpolate(r, bad, r.size, r.yn)
        r.step_end = r.t + bad * r.hs
        r.last = 0
    return event


@kernel()
def _bisect(r, bad, event):  # type: ignore[no-untyped-def]
    """Bisection on "some switch is beyond its mode", on the dense output: the share of the step, and the switch."""
    values, slack = vector(r.sv, r.ns), vector(r.slack, r.ns)
    good = 0.0 if bad == 0.5 else 0.5
    for _ in range(60):
        middle = 0.5 * (good + bad)
        interpolate(r, middle, r.n, r.u)
        outside(r, r.t + middle * r.hs, r.t)
        which = violation(r, r.u)
        if which >= 0:
            bad, event = middle, which
            if abs(values[which]) <= 2.0 * slack[which]:
                break
        else:
            good = middle
        if (bad - good) * r.hs <= 1e-15 * max(1.0, abs(r.t)):
            break
    return bad, event


@kernel()
def shift_rows(r, before, after, jump):  # type: ignore[no-untyped-def]
    """Sensitivities of the states at a jump of the right-hand side: + (f before - f after) d(instant)/dp; all addresses."""
    width, n = r.width, r.n
    y, left, right, slope = vector(r.y, r.size), vector(before, r.nx), vector(after, r.nx), vector(jump, width)
    for i in range(r.nx):
        for c in range(width):
            y[n + i * width + c] += (left[i] - right[i]) * slope[c]


@kernel()
def add_echoes(r, order):  # type: ignore[no-untyped-def]
    """Note that what happens now comes back after every delay, whose room the caller has made."""
    for i in range(r.nd):
        add_echo(r, i, order)


@kernel()
def add_echo(r, i, order):  # type: ignore[no-untyped-def]
    """Note that a jump (order 0) or a corner of delay i's source comes back after the delay."""
    width = r.width
    at = r.t + vector(r.lag, r.nd)[i]
    if not at < r.end:
        return
    echo = vector(r.echo + 8 * r.echoes * (2 + width), 2 + width)
    jump, lag_p = vector(r.jump_p, width), vector(r.lag_p + 8 * i * width, width)
    echo[0], echo[1] = at, order
    for c in range(width):
        echo[2 + c] = jump[c] + lag_p[c]
    r.echoes += 1
    r.tb = min(r.tb, at)


@kernel()
def switch(r, event):  # type: ignore[no-untyped-def]
    """At a switch: sensitivities jump by (f- - f+) dt*/dp, unknowns are solved anew. Returns a status."""
    r.events += 1
    if event == r.last_switch and r.t - r.last_event < 1e-9 * (r.end - r.start):
        r.chatter += 1
        if r.chatter > 40:
            return CHATTER
    else:
        r.chatter = 0
    r.last_event, r.last_switch = r.t, event
    outside(r, r.t, r.t)
    consistent(r, False)
    width, ns = r.width, r.ns
    m, speed = vector(r.m, ns), 0.0
    if width:
        rates(r)
        before, yd = vector(r.f_before, r.nx), vector(r.yd, r.nx)
        for i in range(r.nx):
            before[i] = yd[i]
        evaluate(r, r.do_sws, r.y, r.sws)
        evaluate(r, r.do_swd, r.y, r.sv)
        speed = vector(r.sv, ns)[event]
    m[event] = 1.0 - m[event]
    for _ in range(ns):
        if not consistent(r, False):
            return INCONSISTENT
        also = violation(r, r.y)
        if also < 0 or also == event:
            break
        m[also] = 1.0 - m[also]
    if width:
        _jump(r, event, speed)
    if r.nd:
        add_echoes(r, 1.0)
    jump = vector(r.jump_p, width)
    for c in range(width):
        jump[c] = 0.0
    evaluate(r, r.do_rhs, r.y, r.k)
    r.fresh = 1
    r.h = min(r.h, r.hs)
    return CONVERGED


@kernel()
def _jump(r, event, speed):  # type: ignore[no-untyped-def]
    """The jump condition: r.jump_p, and where the right-hand side jumps at all the sensitivities, the unknowns' too.

    What jumps may be the source of a delay alone, whose jump comes back later with the same r.jump_p.
    """
    width = r.width
    evaluate(r, r.do_f, r.y, r.f_after)
    before, after = vector(r.f_before, r.nx), vector(r.f_after, r.nx)
    biggest = 0.0
    for i in range(r.nx):
        biggest = max(biggest, abs(before[i] - after[i]) / (1e-9 + abs(before[i]) + abs(after[i])))
    if speed != 0.0:
        jump, row = vector(r.jump_p, width), vector(r.sws + 8 * (r.ns + event * width), width)
        for c in range(width):
            jump[c] = -row[c] / speed
        if biggest > 1e-7:
            shift_rows(r, r.f_before, r.f_after, r.jump_p)
            consistent(r, False)


# --- the algebraic unknowns ---


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
