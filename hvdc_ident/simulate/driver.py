"""The integration loop: segments between breaks, steps under error control, events, samples, delays, outputs.

Compiled once for an installation: it knows no model, only addresses of generated functions and sizes.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from hvdc_ident.simulate.call import call
from hvdc_ident.simulate.exogenous import NODES, delayed, enter_segment, inputs, quartic
from hvdc_ident.simulate.linear import lu, solve, solve_rows
from hvdc_ident.simulate.steps import (
    FS,
    FT,
    HESS,
    JAC,
    MODES,
    OUT,
    OUTS,
    SRC,
    SRCD,
    SRCS,
    SW,
    SWD,
    SWS,
    F,
    dopri_dense,
    dopri_error,
    dopri_point,
    error_norm,
    interpolate,
    rodas_dense,
    rodas_matrix,
    rodas_point,
    rodas_stage,
    rodas_stages,
    stage_time,
)

CONVERGED, STEP_LIMIT, NOT_FINITE, CHATTER, INCONSISTENT, STIFF = range(6)
EXPLICIT, ROSENBROCK = 0, 1
ACCEPTED, REJECTED, EVENTS, EVALUATIONS, SEGMENTS, FORCED = range(6)


@njit(cache=True, error_model="numpy")
def consistent(live, y, w, loop):  # type: ignore[no-untyped-def]
    """Solves the unknowns z (and their sensitivities) for the present states, with modes found from the values where `live`.

    loop: what stays the same over a run. Returns whether Newton's method converged.
    """
    address, yd, wd, p, m, nx, nz, width, out, jac, small, pivots = loop
    n = nx + nz
    if live:
        call(address[MODES], y, yd, w, wd, p, m, m)
    if nz == 0:
        return True
    converged = False
    for iteration in range(60):
        call(address[F], y, yd, w, wd, p, m, out)
        call(address[JAC], y, yd, w, wd, p, m, jac)
        for i in range(nz):
            for j in range(nz):
                small[i, j] = jac[nx + i, nx + j]
        if not lu(small, pivots):
            return False
        solve(small, pivots, out[nx:n])
        largest = 0.0
        damping = 1.0 if iteration < 20 else 0.5
        for i in range(nz):
            y[nx + i] -= damping * out[nx + i]
            largest = max(largest, abs(out[nx + i]) / (1.0 + abs(y[nx + i])))
        if not largest < np.inf:
            return False
        if live:
            call(address[MODES], y, yd, w, wd, p, m, m)
        if largest < 1e-14 or (converged and largest < 1e-12):
            break
        converged = largest < 1e-12
    if not largest < 1e-10:
        return False
    if width:
        for q in range(n + nx * width, n + n * width):
            y[q] = 0.0
        call(address[FS], y, yd, w, wd, p, m, out)
        rows = out[n + nx * width : n + n * width].reshape(nz, width)
        solve_rows(small, pivots, rows)
        for i in range(nz):
            for c in range(width):
                y[n + (nx + i) * width + c] = -rows[i, c]
    return True


@njit(cache=True, error_model="numpy")
def rates(address, y, w, wd, p, m, nx, nz, yd, out, jac, small, pivots):  # type: ignore[no-untyped-def]
    """Writes the rates of states and unknowns into yd; needs modes and values that are consistent."""
    n = nx + nz
    call(address[F], y, yd, w, wd, p, m, out)
    for i in range(nx):
        yd[i] = out[i]
    if nz == 0:
        return True
    call(address[JAC], y, yd, w, wd, p, m, jac)
    call(address[FT], y, yd, w, wd, p, m, out)
    for i in range(nz):
        total = -out[nx + i]
        for j in range(nx):
            total -= jac[nx + i, j] * yd[j]
        out[nx + i] = total
        for j in range(nz):
            small[i, j] = jac[nx + i, nx + j]
    if not lu(small, pivots):
        return False
    solve(small, pivots, out[nx:n])
    for i in range(nz):
        yd[nx + i] = out[nx + i]
    return True


@njit(cache=True, error_model="numpy")
def outside(t, ta, tb, still, sources, count, h_t, h_h, h_c, w, wd):  # type: ignore[no-untyped-def]
    """Writes all that comes from outside at t, within the segment that ends at tb, into w and wd.

    sources: what stays the same over a run, in one tuple, because the compiler's time grows with the arguments of a call.
    """
    pointer, times, values, at, start, before, lag, lag_p, width, first, total = sources
    w[0] = t
    if not still:
        inputs(t, tb, pointer, times, values, at, w, wd)
    if lag.size:
        delayed(t, ta, tb, start, count, h_t, h_h, h_c, before, lag, lag_p, width, first, total, w, wd)


@njit(cache=True, error_model="numpy")
def next_stop(t, end, breaks, i_break, echo_t, echoes, tick, publish):  # type: ignore[no-untyped-def]
    """The next instant after t at which a step has to end: a break of an input, a returning jump, a sample, the end."""
    stop = end
    if i_break < breaks.size:
        stop = min(stop, breaks[i_break])
    for i in range(echoes):
        if echo_t[i] > t:
            stop = min(stop, echo_t[i])
    for i in range(tick.size):
        if tick[i] > t:
            stop = min(stop, tick[i])
        if publish[i] > t:
            stop = min(stop, publish[i])
    return stop


@njit(cache=True, error_model="numpy")
def violation(values, m, slack):  # type: ignore[no-untyped-def]
    """The switch that is furthest beyond its mode, or -1."""
    worst, which = 0.0, -1
    for k in range(values.size):
        over = (values[k] if m[k] > 0.5 else -values[k]) - slack[k]
        if over > worst:
            worst, which = over, k
    return which


@njit(cache=True, error_model="numpy")
def longer(array, count):  # type: ignore[no-untyped-def]
    """The vector with room for at least one more element than count."""
    if count < array.size:
        return array
    larger = np.empty(2 * array.size)
    for i in range(count):  # a slice would make the compiler carry its error texts
        larger[i] = array[i]
    return larger


@njit(cache=True, error_model="numpy")
def deeper(array, count):  # type: ignore[no-untyped-def]
    """The table (rows, columns) with room for at least one more row than count."""
    if count < array.shape[0]:
        return array
    larger = np.empty((2 * array.shape[0], array.shape[1]))
    for i in range(count):
        for j in range(array.shape[1]):
            larger[i, j] = array[i, j]
    return larger


@njit(cache=True, error_model="numpy")
def integrate(address, dims, hess_row, hess_column, method, p, y, w, wd, constants, start, end, breaks, pointer, times, values, t_out, out, scale, rtol, atol, max_steps, counts, modes_out):  # type: ignore[no-untyped-def]
    """Integrates from start to end; writes the outputs and their rows into out (n_out, no (1 + width)).

    y: the flat start vector, consistent to solver tolerance, overwritten with the end vector. constants: delay times,
    sampling periods and compute times with their rows. Returns (status, time reached).
    """
    nx, nz, nu, nd, nq, ns, np_, width = dims[0], dims[1], dims[2], dims[3], dims[4], dims[5], dims[7], dims[8]
    n = nx + nz
    size = n * (1 + width)
    nw = 1 + nu + nd + nq
    stages = 8 if method == ROSENBROCK else 7
    k = np.zeros((stages, size))
    u, yn, e, scratch = np.zeros(size), np.zeros(size), np.zeros(size), np.zeros(size)
    dense = np.zeros((4, size))
    ft = np.zeros(size)
    yd = np.zeros(max(n, 1))
    jac, matrix, small = np.zeros((n, n)), np.zeros((n, n)), np.zeros((nz, nz))
    pivots, small_pivots = np.zeros(n, np.int64), np.zeros(max(nz, 1), np.int64)
    hess = np.zeros((max(hess_row.size, 1), max(width, 1)))
    totals, floors = np.zeros(width), np.zeros(width)
    factors, shift, kind = np.zeros(max(dims[11], 1)), np.zeros(1), 0
    mass, c_sum = np.zeros(size), np.zeros(size)
    for q in range(nx):
        mass[q] = 1.0
    for q in range(nx * width):
        mass[n + q] = 1.0
    m = np.zeros(max(ns, 1))
    slack, sv, top = np.zeros(ns), np.zeros(ns), np.zeros(ns)
    sws = np.zeros(ns * (1 + width) + 1)
    f_before, f_after = np.zeros(size), np.zeros(size)
    at = pointer[:-1].copy()
    jump_p = np.zeros(width)
    # Delays and samples.
    lag, lag_p, before = np.zeros(nd), np.zeros((nd, width)), np.zeros((nd, 1 + width))
    row0 = nd + 2 * nq
    shortest = np.inf
    for i in range(nd):
        lag[i] = constants[i]
        shortest = min(shortest, lag[i])
        before[i, 0] = w[1 + nu + i]
        for c in range(width):
            lag_p[i, c] = constants[row0 + i * width + c]
            before[i, 1 + c] = w[nw + i * width + c]
    loop = (address, yd, wd, p, m, nx, nz, width, scratch, jac, small, small_pivots)
    sources = (pointer, times, values, at, start, before, lag, lag_p, width, 1 + nu, nw)
    count = 0
    h_t, h_h, h_c = np.empty(64 if nd else 1), np.empty(64 if nd else 1), np.empty((64 if nd else 1, nd, NODES, 1 + width))
    node_values = np.zeros((NODES, nd, 1 + width))
    src, src_rate, src_left = np.zeros((nd + nq) * (1 + width) + 1), np.zeros(nd + nq + 1), np.zeros(nd + nq + 1)
    tick, publish = np.zeros(nq), np.zeros(nq)
    ticks, pending, pending_p, publish_p = np.zeros(nq), np.zeros(nq), np.zeros((nq, width)), np.zeros((nq, width))
    for i in range(nq):
        tick[i], publish[i] = start, np.inf
    # Jumps and corners that reach the equations again through a delay: instant, order, rows of its derivative.
    echo_t, echo_o, echo_p, echoes = np.empty(16), np.empty(16), np.empty((16, width)), 0

    t = start
    i_break, i_out = 0, 0
    while i_break < breaks.size and breaks[i_break] <= start:
        i_break += 1
    h = 0.0
    steps, stiff, chatter = 0, 0, 0
    last_event, last_switch = -np.inf, -1
    first, echo_now, disturbed = True, False, False
    order = 0.0
    aim = -1
    while True:
        # --- a segment begins: what comes from outside is seen after its jump ---
        tb = next_stop(t, end, breaks, i_break, echo_t, echoes, tick, publish)
        final = not t < end
        segment_end = tb if not final else t + 1.0
        whole = enter_segment(t, segment_end, pointer, times, values, at)
        wd[0] = 1.0
        outside(t, t, segment_end, False, sources, count, h_t, h_h, h_c, w, wd)
        if not consistent(True, y, w, loop):
            return INCONSISTENT, t
        if not first and width and echo_now:
            call(address[FS], y, yd, w, wd, p, m, f_after)
            for r in range(nx):
                for c in range(width):
                    y[n + r * width + c] += (f_before[r] - f_after[r]) * jump_p[c]
            consistent(False, y, w, loop)
        echo_now = False
        # --- samples are taken and published ---
        for i in range(nq):
            if tick[i] == t and not final:
                call(address[SRCS if width else SRC], y, yd, w, wd, p, m, src)
                rates(address, y, w, wd, p, m, nx, nz, yd, u, jac, small, small_pivots)
                call(address[SRCD], y, yd, w, wd, p, m, src_rate)
                pending[i] = src[nd + i]
                for c in range(width):
                    own = ticks[i] * constants[row0 + (nd + i) * width + c]
                    pending_p[i, c] = src[nd + nq + (nd + i) * width + c] + src_rate[nd + i] * own
                    publish_p[i, c] = own + constants[row0 + (nd + nq + i) * width + c]
                publish[i] = t + constants[nd + nq + i]
                ticks[i] += 1
                tick[i] = start + ticks[i] * constants[nd + i]
        published = False
        for i in range(nq):
            if publish[i] == t and not final:
                if width:
                    call(address[F], y, yd, w, wd, p, m, f_before)
                w[1 + nu + nd + i] = pending[i]
                for c in range(width):
                    w[nw + (nd + i) * width + c] = pending_p[i, c]
                if not consistent(True, y, w, loop):
                    return INCONSISTENT, t
                if width:
                    call(address[F], y, yd, w, wd, p, m, f_after)
                    for r in range(nx):
                        for c in range(width):
                            y[n + r * width + c] += (f_before[r] - f_after[r]) * publish_p[i, c]
                publish[i] = np.inf
                published = True
        if published and not consistent(False, y, w, loop):
            return INCONSISTENT, t
        if nq:
            tb = next_stop(t, end, breaks, i_break, echo_t, echoes, tick, publish)
        # --- jumps and corners of a delayed signal's source come back after the delay ---
        if nd and (first or published or disturbed):
            call(address[SRC], y, yd, w, wd, p, m, src)
            for i in range(nd):
                source_before = before[i, 0] if first else src_left[i]
                following = 0.0 if abs(src[i] - source_before) > 1e-12 * (1.0 + abs(src[i])) else order + 1.0
                if following <= 4.0 and t + lag[i] < end:
                    echo_t, echo_o, echo_p = longer(echo_t, echoes), longer(echo_o, echoes), deeper(echo_p, echoes)
                    echo_t[echoes] = t + lag[i]
                    echo_o[echoes] = following
                    for c in range(width):
                        echo_p[echoes, c] = jump_p[c] + lag_p[i, c]
                    echoes += 1
                    tb = min(tb, t + lag[i])
        for c in range(width):
            jump_p[c] = 0.0
        while i_out < t_out.size and t_out[i_out] <= t:
            call(address[OUTS if width else OUT], y, yd, w, wd, p, m, out[i_out])
            i_out += 1
        if final:
            break
        counts[SEGMENTS] += 1
        whole = enter_segment(t, tb, pointer, times, values, at)
        still = whole
        for i in range(nu):
            still = still and wd[1 + i] == 0.0
        quiet = still and nd == 0  # only time itself changes within the segment
        forced = dims[10] > 0 or nd > 0 or not still
        if not forced:
            for q in range(size):
                ft[q] = 0.0
        if ns:
            call(address[SW], y, yd, w, wd, p, m, sv)
            for i in range(ns):
                if abs(sv[i]) < np.inf:
                    top[i] = max(top[i], abs(sv[i]))
                slack[i] = 0.01 * rtol * top[i] + 1e-14

        # --- the first step's length ---
        call(address[FS if width else F], y, yd, w, wd, p, m, k[0])
        counts[EVALUATIONS] += 1
        d0, d1 = 0.0, 0.0
        for i in range(nx):
            weight = atol + rtol * abs(y[i])
            d0 += (y[i] / weight) ** 2
            d1 += (k[0, i] / weight) ** 2
            for c in range(np_):
                q = n + i * width + c
                weight_s = atol / scale[c] + rtol * abs(y[q])
                d0 += (y[q] / weight_s) ** 2
                d1 += (k[0, q] / weight_s) ** 2
        guess = 0.01 * np.sqrt(d0 / d1) if d1 > 0.0 and d0 > 0.0 else 0.1 * (end - start)
        h = min(max(guess, 1e-9 * (end - start)), 0.1 * (end - start)) if h == 0.0 or guess < h else min(h, guess)
        fresh = True  # k[0] holds the derivative at (t, y)
        rejected = False

        # --- steps to the segment's end ---
        while t < tb:
            steps += 1
            if steps > max_steps:
                return STEP_LIMIT, t
            if nd:
                h = min(h, shortest)
            last = t + 1.000001 * h >= tb
            step_end = tb if last else t + h
            hs = step_end - t
            if last and not hs > 1e-15 * max(abs(t), abs(end)):
                t = tb  # two breaks that differ by rounding alone
                break
            if not hs > 4e-16 * max(abs(t), abs(end)) or h < 1e-14 * (end - start):
                return NOT_FINITE, t
            # An unknown may have an infinite slope for an instant, as sqrt(1.1^2 - i^2) where i meets its limit. The
            # states pass it; very short steps are judged by them alone.
            rows = n if hs > 1e-6 * (end - start) or nx == 0 else nx
            # One step into yn, with the error in e.
            regular = True
            if method == ROSENBROCK:
                if quiet:
                    w[0] = t
                else:
                    outside(t, t, tb, still, sources, count, h_t, h_h, h_c, w, wd)
                if not rejected:
                    call(address[JAC], y, yd, w, wd, p, m, jac)
                    if forced:
                        call(address[FT], y, yd, w, wd, p, m, ft)
                    if hess_row.size:
                        call(address[HESS], y, yd, w, wd, p, m, hess)
                kind = rodas_matrix(address, dims[11], hs, nx, jac, factors, shift, yd, m, matrix, pivots)
                regular = kind > 0
            if regular:
                if quiet and method == ROSENBROCK:
                    counts[EVALUATIONS] += 8
                    rodas_stages(address, hs, forced, n, width, mass, hess_row, hess_column, hess, ft, kind, factors, matrix, pivots, y, u, k, c_sum, yd, w, wd, p, m, t, step_end)
                for s in range(stages if not (quiet and method == ROSENBROCK) else 0):
                    if method == EXPLICIT and s == 0:
                        if not fresh:
                            for q in range(size):
                                k[0, q] = k[6, q]
                        continue
                    share = stage_time(method, s)
                    ts = step_end if share == 1.0 else t + share * hs
                    if s < 6 or method == EXPLICIT:
                        if quiet:
                            w[0] = ts
                        else:
                            outside(ts, t, tb, still, sources, count, h_t, h_h, h_c, w, wd)
                    counts[EVALUATIONS] += 1
                    if method == ROSENBROCK:
                        rodas_point(s, y, k, u)
                        rodas_stage(address, s, hs, forced, n, width, mass, hess_row, hess_column, hess, ft, kind, factors, matrix, pivots, u, k, c_sum, yd, w, wd, p, m)
                    else:
                        dopri_point(s, hs, y, k, u)
                        if s == 5:
                            for q in range(nx):
                                e[q] = u[q]
                        call(address[FS if width else F], u, yd, w, wd, p, m, k[s])
                if method == ROSENBROCK:
                    for q in range(size):
                        yn[q] = u[q] + k[7, q]
                    error = error_norm(k[7], y, yn, n, rows, width, np_, rtol, atol, scale, totals, floors)
                else:
                    top_change, bottom_change = 0.0, 0.0
                    for q in range(nx):
                        top_change += (k[6, q] - k[5, q]) ** 2
                        bottom_change += (u[q] - e[q]) ** 2
                    for q in range(size):
                        yn[q] = u[q]
                    dopri_error(hs, k, e)
                    error = error_norm(e, y, yn, n, rows, width, np_, rtol, atol, scale, totals, floors)
            else:
                error = np.inf
            if error > 1.0 and hs <= 1e-10 * (end - start) and error < np.inf and counts[FORCED] < 50:
                # A slope that is infinite for an instant cannot be followed to tolerance: pass it, and count it.
                counts[FORCED] += 1
                error = 0.05
            if not error <= 1.0:
                counts[REJECTED] += 1
                h = hs * (max(0.2, 0.9 * error**-0.2) if error < np.inf else 0.2)
                fresh = rejected = True  # the derivatives at (t, y) stand
                continue
            factor = 0.9 * error**-0.2 if error > 1e-10 else 8.0
            factor = min(max(factor, 0.2), 1.0 if rejected else 8.0)
            if method == EXPLICIT and bottom_change > 0.0 and hs * hs * top_change > 3.25 * 3.25 * bottom_change:
                stiff += 1
                if stiff > 25:
                    return STIFF, t
            elif stiff > 0:
                stiff -= 1
            rejected = False

            # --- what happens within the step ---
            needs_dense = nd > 0 or (i_out < t_out.size and t_out[i_out] <= step_end) or ns > 0
            if needs_dense:
                if method == ROSENBROCK:
                    rodas_dense(k, y, yn, dense)
                else:
                    dopri_dense(k, y, yn, hs, dense)
            event = -1
            if ns:
                bad = 0.0
                for share in (0.5, 1.0):
                    interpolate(y, dense, share, n, u)
                    if share == 1.0:
                        for q in range(n):
                            u[q] = yn[q]
                    ts = step_end if share == 1.0 else t + share * hs
                    if quiet:
                        w[0] = ts
                    else:
                        outside(ts, t, tb, still, sources, count, h_t, h_h, h_c, w, wd)
                    call(address[SW], u, yd, w, wd, p, m, sv)
                    event = violation(sv, m, slack)
                    if event >= 0:
                        bad = share
                        break
                if event >= 0:
                    # Bisection on "some switch is beyond its mode", on the dense output.
                    good = 0.0 if bad == 0.5 else 0.5
                    for _ in range(60):
                        middle = 0.5 * (good + bad)
                        interpolate(y, dense, middle, n, u)
                        if quiet:
                            w[0] = t + middle * hs
                        else:
                            outside(t + middle * hs, t, tb, still, sources, count, h_t, h_h, h_c, w, wd)
                        call(address[SW], u, yd, w, wd, p, m, sv)
                        which = violation(sv, m, slack)
                        if which >= 0:
                            bad, event = middle, which
                            if abs(sv[which]) <= 2.0 * slack[which]:
                                break
                        else:
                            good = middle
                        if (bad - good) * hs <= 1e-15 * max(1.0, abs(t)):
                            break
                    if bad < 0.98 and bad * hs > 1e-12 * (end - start):
                        # Step again up to the switch itself: the dense output is less exact than the step.
                        h, aim = bad * hs, event
                        fresh = rejected = True
                        counts[REJECTED] += 1
                        continue
                    if bad < 1.0:
                        # Near the step's end or its start: cut on the dense output.
                        interpolate(y, dense, bad, size, yn)
                        step_end = t + bad * hs
                        last = False
                elif aim >= 0 and abs(sv[aim]) <= 100.0 * slack[aim]:
                    event = aim  # the step aimed at this switch and met it
                aim = -1
            # --- outputs ---
            while i_out < t_out.size and (t_out[i_out] < step_end or (t_out[i_out] == step_end and step_end < tb)):
                interpolate(y, dense, (t_out[i_out] - t) / hs, size, u)
                if quiet:
                    w[0] = t_out[i_out]
                else:
                    outside(t_out[i_out], t, tb, still, sources, count, h_t, h_h, h_c, w, wd)
                call(address[OUTS if width else OUT], u, yd, w, wd, p, m, out[i_out])
                i_out += 1
            # --- the history of delayed signals ---
            if nd:
                for j in range(NODES):
                    share = j / (NODES - 1.0) * (step_end - t) / hs
                    interpolate(y, dense, share, size, u)
                    ts = min(t + share * hs, step_end)
                    if quiet:
                        w[0] = ts
                    else:
                        outside(ts, t, tb, still, sources, count, h_t, h_h, h_c, w, wd)
                    call(address[SRCS if width else SRC], u, yd, w, wd, p, m, src)
                    for i in range(nd):
                        node_values[j, i, 0] = src[i]
                        for c in range(width):
                            node_values[j, i, 1 + c] = src[nd + nq + i * width + c]
                h_t, h_h = longer(h_t, count), longer(h_h, count)
                if count >= h_c.shape[0]:
                    h_more = np.empty((2 * h_c.shape[0], nd, NODES, 1 + width))
                    for i in range(count):
                        for j in range(nd):
                            for r in range(NODES):
                                for q in range(1 + width):
                                    h_more[i, j, r, q] = h_c[i, j, r, q]
                    h_c = h_more
                h_t[count] = t
                h_h[count] = step_end - t
                for i in range(nd):
                    quartic(node_values[:, i], h_c[count, i])
                count += 1
            counts[ACCEPTED] += 1
            t = step_end
            y, yn = yn, y
            fresh = False
            h = max(h, hs * factor) if last and factor >= 1.0 else hs * factor
            if ns:
                for i in range(ns):
                    if abs(sv[i]) < np.inf and abs(sv[i]) > top[i]:
                        top[i] = abs(sv[i])
                        slack[i] = 0.01 * rtol * top[i] + 1e-14
            if event < 0:
                continue

            # --- a switch: sensitivities jump by (f- - f+) dt*/dp, unknowns are solved anew ---
            counts[EVENTS] += 1
            if event == last_switch and t - last_event < 1e-9 * (end - start):
                chatter += 1
                if chatter > 40:
                    return CHATTER, t
            else:
                chatter = 0
            last_event, last_switch = t, event
            if quiet:
                w[0] = t
            else:
                outside(t, t, tb, still, sources, count, h_t, h_h, h_c, w, wd)
            consistent(False, y, w, loop)
            if width:
                rates(address, y, w, wd, p, m, nx, nz, yd, f_before, jac, small, small_pivots)
                for i in range(nx):
                    f_before[i] = yd[i]
                call(address[SWS], y, yd, w, wd, p, m, sws)
                call(address[SWD], y, yd, w, wd, p, m, sv)
                speed = sv[event]
            m[event] = 1.0 - m[event]
            for _ in range(ns):
                if not consistent(False, y, w, loop):
                    return INCONSISTENT, t
                call(address[SW], y, yd, w, wd, p, m, sv)
                also = violation(sv, m, slack)
                if also < 0 or also == event:
                    break
                m[also] = 1.0 - m[also]
            if width:
                call(address[F], y, yd, w, wd, p, m, f_after)
                biggest = 0.0
                for i in range(nx):
                    biggest = max(biggest, abs(f_before[i] - f_after[i]) / (1e-9 + abs(f_before[i]) + abs(f_after[i])))
                if biggest > 1e-7 and speed != 0.0:
                    for c in range(width):
                        jump_p[c] = -sws[ns + event * width + c] / speed
                    for i in range(nx):
                        for c in range(width):
                            y[n + i * width + c] += (f_before[i] - f_after[i]) * jump_p[c]
                    consistent(False, y, w, loop)
            if nd:
                for i in range(nd):
                    if t + lag[i] < end:
                        echo_t, echo_o, echo_p = longer(echo_t, echoes), longer(echo_o, echoes), deeper(echo_p, echoes)
                        echo_t[echoes] = t + lag[i]
                        echo_o[echoes] = 1.0
                        for c in range(width):
                            echo_p[echoes, c] = jump_p[c] + lag_p[i, c]
                        echoes += 1
                        tb = min(tb, t + lag[i])
            for c in range(width):
                jump_p[c] = 0.0
            call(address[FS if width else F], y, yd, w, wd, p, m, k[0])
            fresh = True
            h = min(h, hs)

        # --- the segment's end, seen from before its jump ---
        outside(t, start, t, False, sources, count, h_t, h_h, h_c, w, wd)
        if nd:
            call(address[SRC], y, yd, w, wd, p, m, src_left)
        while i_out + 1 < t_out.size and t_out[i_out] == t and t_out[i_out + 1] == t:
            call(address[OUTS if width else OUT], y, yd, w, wd, p, m, out[i_out])
            i_out += 1
        order, disturbed = 0.0, i_break < breaks.size and breaks[i_break] <= t
        kept = 0
        for i in range(echoes):
            if echo_t[i] == t:
                echo_now, disturbed = True, True
                order = max(order, echo_o[i])
                for c in range(width):
                    jump_p[c] = echo_p[i, c]
            elif echo_t[i] > t:
                echo_t[kept], echo_o[kept] = echo_t[i], echo_o[i]
                for c in range(width):
                    echo_p[kept, c] = echo_p[i, c]
                kept += 1
        echoes = kept
        if echo_now and width:
            call(address[F], y, yd, w, wd, p, m, f_before)
        while i_break < breaks.size and breaks[i_break] <= t:
            i_break += 1
        first = False
    for i in range(ns):
        modes_out[i] = m[i]
    return CONVERGED, t
