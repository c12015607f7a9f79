"""The integration: segments between breaks, steps under error control, rows of outputs.

Compiled once for an installation: it knows no model, only the addresses of generated functions and sizes.
"""

from __future__ import annotations

import numpy as np

from hvdc_ident.simulate.codegen import LANES
from hvdc_ident.simulate.events import (
    AGAIN,
    add_echo,
    find_switch,
    shift_rows,
    switch,
    widen,
)
from hvdc_ident.simulate.exogenous import enter_segment, outside, quartic
from hvdc_ident.simulate.native import (
    address,
    address_of,
    call,
    indices,
    integers,
    kernel,
    length,
    numbers,
    record,
    table,
    vector,
)
from hvdc_ident.simulate.run_state import (
    CONVERGED,
    INCONSISTENT,
    NODES,
    NOT_FINITE,
    STEP_LIMIT,
    STIFF,
)
from hvdc_ident.simulate.sliding import NONE, force, settle, stay, use
from hvdc_ident.simulate.steps import attempt, evaluate, interpolate, interpolate_four, make_dense
from hvdc_ident.simulate.unknowns import consistent, rates

# --- the workspace ---


@kernel()
def _take(r, count):  # type: ignore[no-untyped-def]
    """The address of the next `count` doubles of the workspace, rounded up for loops by four."""
    address = r.free
    r.free += 8 * ((count + 3) // 4 * 4 + 4)
    return address


@kernel()
def arrange(r):  # type: ignore[no-untyped-def]
    """Give every vector of the workspace its place from r.free on; returns the end, so that from 0 it is the size."""
    rows = 1 + r.width
    r.y, r.yn, r.u = _take(r, r.size), _take(r, r.size), _take(r, r.size)
    r.k, r.e, r.dense = _take(r, 8 * r.stride), _take(r, r.size), _take(r, 4 * r.stride)
    r.add, r.mass, r.ft = _take(r, r.size), _take(r, r.size), _take(r, r.size)
    r.f_before, r.f_after = _take(r, r.size), _take(r, r.size)
    r.yd, r.m = _take(r, r.n), _take(r, r.ns)
    r.w = _take(r, r.nw + (r.nd + r.nq) * r.width)
    r.wd = _take(r, r.nw + (r.nd + r.nq) * r.width)
    r.jac, r.matrix, r.small = _take(r, r.n * r.n), _take(r, r.n * r.n), _take(r, r.nz * r.nz)
    r.hessian, r.factor, r.shift = _take(r, r.hessians * r.width), _take(r, r.factors + 1), _take(r, 1)
    r.pivots, r.small_pivots = _take(r, r.n), _take(r, r.nz)
    r.floors, r.totals = _take(r, r.width), _take(r, r.width)
    r.z_before, r.z_from, r.z_step, r.side = _take(r, r.nz), _take(r, r.nz), _take(r, r.nz), _take(r, r.ns)
    r.sv, r.top, r.slack, r.sws = _take(r, r.ns), _take(r, r.ns), _take(r, r.ns), _take(r, r.ns * rows)
    r.src, r.src_rate = _take(r, (r.nd + r.nq) * rows), _take(r, r.nd + r.nq)
    r.src_left = _take(r, r.nd + r.nq)
    r.lag, r.lag_p, r.before = _take(r, r.nd), _take(r, r.nd * r.width), _take(r, r.nd * rows)
    r.nodes = _take(r, NODES * r.nd * rows)
    r.tick, r.publish, r.ticks, r.pending = _take(r, r.nq), _take(r, r.nq), _take(r, r.nq), _take(r, r.nq)
    r.pending_p, r.publish_p = _take(r, r.nq * r.width), _take(r, r.nq * r.width)
    r.jump_p, r.at = _take(r, r.width), _take(r, r.nu)
    r.surface = _take(r, 3 + r.nx + r.width)
    r.instants, r.block = _take(r, 4), _take(r, 4 * r.stride)
    return r.free


# --- rows of outputs and the history of delayed signals ---


@kernel()
def write_row(r, y):  # type: ignore[no-untyped-def]
    """Write the next row of outputs from the flat vector at the address y, with what comes from outside as it stands."""
    evaluate(r, r.do_observe, y, r.out + 8 * r.i_out * max(r.no * (1 + r.width), 1))
    r.i_out += 1


@kernel()
def write_rows(r):  # type: ignore[no-untyped-def]
    """Write the rows of outputs within the present step, from its dense output."""
    t_out = vector(r.t_out, r.n_out)
    while True:
        count = 0
        while count < LANES and r.i_out + count < r.n_out:
            at = t_out[r.i_out + count]
            if not (at < r.step_end or (at == r.step_end and r.step_end < r.tb)):
                break
            count += 1
        if count == 0:
            return
        if r.quiet and count > 2 and r.i_out + LANES <= r.n_out:  # four at once cost about as much as two alone
            _write_four(r, t_out, count)
        else:
            for _ in range(count):
                at = t_out[r.i_out]
                interpolate(r, (at - r.t) / r.hs, r.size, r.u)
                outside(r, at, r.t)
                write_row(r, r.u)


@kernel()
def _write_four(r, t_out, count):  # type: ignore[no-untyped-def]
    """Write the next `count` rows in one go; the rows up to the fourth get the last one's values, until their turn comes."""
    instants, first, last = vector(r.instants, LANES), r.i_out, count - 1
    for k in range(LANES):
        instants[k] = t_out[first + min(k, last)]
    scale = 1.0 / r.hs
    x0, x1 = (instants[0] - r.t) * scale, (instants[1] - r.t) * scale
    x2, x3 = (instants[2] - r.t) * scale, (instants[3] - r.t) * scale
    interpolate_four(r, x0, x1, x2, x3)
    if r.do_rows:
        call(r.do_rows, r.block, r.instants, r.w, r.wd, r.p, r.m, r.out + 8 * first * max(r.no, 1))
        r.i_out += count
    else:
        for k in range(count):
            outside(r, instants[k], r.t)
            write_row(r, r.block + 8 * r.stride * k)


@kernel()
def remember(r):  # type: ignore[no-untyped-def]
    """Add the present step to the history of delayed signals."""
    nd, width = r.nd, r.width
    rows = 1 + width
    src, nodes = vector(r.src, (nd + r.nq) * rows), vector(r.nodes, NODES * nd * rows)
    for j in range(NODES):
        share = j / (NODES - 1.0) * (r.step_end - r.t) / r.hs
        interpolate(r, share, r.size, r.u)
        outside(r, min(r.t + share * r.hs, r.step_end), r.t)
        evaluate(r, r.do_sources, r.u, r.src)
        for i in range(nd):
            place = (i * NODES + j) * rows
            nodes[place] = src[i]
            for c in range(width):
                nodes[place + 1 + c] = src[nd + r.nq + i * width + c]
    line = 2 + nd * NODES * rows
    step = r.history + 8 * line * r.kept
    head = vector(step, 2)
    head[0], head[1] = r.t, r.step_end - r.t
    for i in range(nd):
        offset = 8 * i * NODES * rows
        quartic(table(r.nodes + offset, NODES, rows), table(step + 16 + offset, NODES, rows))
    r.kept += 1


# --- segments between breaks ---


@kernel()
def next_stop(r):  # type: ignore[no-untyped-def]
    """The next instant at which a step has to end: a break of an input, a returning jump, a sample, the end."""
    stop = r.end
    if r.i_break < r.n_breaks:
        stop = min(stop, vector(r.breaks, r.n_breaks)[r.i_break])
    line = 2 + r.width
    echo, tick, publish = vector(r.echo, r.echoes * line), vector(r.tick, r.nq), vector(r.publish, r.nq)
    for i in range(r.echoes):
        if echo[i * line] > r.t:
            stop = min(stop, echo[i * line])
    for i in range(r.nq):
        if tick[i] > r.t:
            stop = min(stop, tick[i])
        if publish[i] > r.t:
            stop = min(stop, publish[i])
    return stop


@kernel()
def begin_segment(r):  # type: ignore[no-untyped-def]
    """Begin a segment at r.t: inputs jump, samples are taken and published, outputs are written. False: no solution there."""
    final = not r.t < r.end
    r.tb = r.t + 1.0 if final else next_stop(r)
    enter_segment(r)
    vector(r.wd, 1)[0] = 1.0
    r.still = r.quiet = 0
    outside(r, r.t, r.t)  # what comes from outside is seen after its jump
    if not settle(r):
        return False
    if not r.first and r.width and r.echo_now:
        evaluate(r, r.do_fs, r.y, r.f_after)
        shift_rows(r, r.f_before, r.f_after, r.jump_p)
        consistent(r, False)
    r.echo_now = r.published = 0
    if r.nq and not final:
        if not _sample(r) or not _publish(r):
            return False
        r.tb = next_stop(r)
    if r.nd and (r.first or r.published or r.disturbed):
        _echo_sources(r)
    jump, t_out = vector(r.jump_p, r.width), vector(r.t_out, r.n_out)
    for c in range(r.width):
        jump[c] = 0.0
    while r.i_out < r.n_out and t_out[r.i_out] <= r.t:
        write_row(r, r.y)
    return True


@kernel()
def _sample(r):  # type: ignore[no-untyped-def]
    """Take the samples that are due: value and rows, at the instant's own dependence on the parameters.

    A sample whose compute time is the whole period is published first, but all are taken from the signals before that.
    False: the unknowns have no solution with what is published.
    """
    nd, nq, width = r.nd, r.nq, r.width
    tick, publish, ticks = vector(r.tick, nq), vector(r.publish, nq), vector(r.ticks, nq)
    constants = vector(r.constants, (nd + 2 * nq) * (1 + width))
    src, rate = vector(r.src, (nd + nq) * (1 + width)), vector(r.src_rate, nd + nq)
    pending = vector(r.pending, nq)
    pending_p, publish_p = vector(r.pending_p, nq * width), vector(r.publish_p, nq * width)
    row0 = nd + 2 * nq
    due, whole = False, False
    for i in range(nq):
        if tick[i] == r.t:
            due = True
            whole = whole or publish[i] == r.t
    if not due:
        return True
    evaluate(r, r.do_sources, r.y, r.src)
    rates(r)
    evaluate(r, r.do_srcd, r.y, r.src_rate)
    if whole and not _publish(r):
        return False
    for i in range(nq):
        if tick[i] != r.t:
            continue
        pending[i] = src[nd + i]
        for c in range(width):
            own = ticks[i] * constants[row0 + (nd + i) * width + c]
            pending_p[i * width + c] = src[nd + nq + (nd + i) * width + c] + rate[nd + i] * own
            publish_p[i * width + c] = own + constants[row0 + (nd + nq + i) * width + c]
        publish[i] = r.t + constants[nd + nq + i]
        ticks[i] += 1.0
        tick[i] = r.start + ticks[i] * constants[nd + i]
        if abs(publish[i] - tick[i]) <= 1e-13 * max(1.0, abs(r.t)):
            publish[i] = tick[i]  # one instant, so that rounding does not decide which comes first
    return True


@kernel()
def _publish(r):  # type: ignore[no-untyped-def]
    """Publish the samples that are due. False: the unknowns have no solution with them."""
    nd, nq, width = r.nd, r.nq, r.width
    publish, pending, pending_p = vector(r.publish, nq), vector(r.pending, nq), vector(r.pending_p, nq * width)
    w = vector(r.w, r.nw + (nd + nq) * width)
    for i in range(nq):
        if publish[i] != r.t:
            continue
        if width:
            evaluate(r, r.do_f, r.y, r.f_before)
        w[1 + r.nu + nd + i] = pending[i]
        for c in range(width):
            w[r.nw + (nd + i) * width + c] = pending_p[i * width + c]
        if not settle(r):
            return False
        if width:
            evaluate(r, r.do_f, r.y, r.f_after)
            shift_rows(r, r.f_before, r.f_after, r.publish_p + 8 * i * width)
        publish[i] = np.inf
        r.published = 1
    return not r.published or consistent(r, False)


@kernel()
def _echo_sources(r):  # type: ignore[no-untyped-def]
    """Jumps and corners of a delayed signal's source come back after the delay."""
    nd, rows = r.nd, 1 + r.width
    src, left, before = vector(r.src, nd), vector(r.src_left, nd), vector(r.before, nd * rows)
    evaluate(r, r.do_src, r.y, r.src)
    for i in range(nd):
        was = before[i * rows] if r.first else left[i]
        following = 0.0 if abs(src[i] - was) > 1e-12 * (1.0 + abs(src[i])) else r.order + 1.0
        if following <= 4.0:
            add_echo(r, i, following)


@kernel()
def prepare_segment(r):  # type: ignore[no-untyped-def]
    """Set the constants of the segment, the switches' tolerances and the first step's length."""
    r.segments += 1
    still = enter_segment(r)
    slopes = vector(r.wd, 1 + r.nu)
    for i in range(r.nu):
        still = still and slopes[1 + i] == 0.0
    r.still = still
    r.quiet = still and r.nd == 0
    force(r)
    if r.ns:
        evaluate(r, r.do_sw, r.y, r.sv)
        values, top, slack = vector(r.sv, r.ns), vector(r.top, r.ns), vector(r.slack, r.ns)
        for i in range(r.ns):
            if abs(values[i]) < np.inf:
                top[i] = max(top[i], abs(values[i]))
            slack[i] = 0.01 * r.rtol * top[i] + 1e-14
    evaluate(r, r.do_rhs, r.y, r.k)
    r.evaluations += 1
    _first_step(r)
    r.fresh, r.again = 1, 0


@kernel()
def _first_step(r):  # type: ignore[no-untyped-def]
    """The length that changes the states by a hundredth of themselves, in the error's weights, or the last step's if shorter."""
    n, width, span = r.n, r.width, r.end - r.start
    y, slope, floors = vector(r.y, r.size), vector(r.k, r.size), vector(r.floors, width)
    d0, d1 = 0.0, 0.0
    for i in range(r.nx):
        weight = r.atol + r.rtol * abs(y[i])
        d0 += (y[i] / weight) ** 2
        d1 += (slope[i] / weight) ** 2
        for c in range(r.np):
            q = n + i * width + c
            weight = floors[c] + r.rtol * abs(y[q])
            d0 += (y[q] / weight) ** 2
            d1 += (slope[q] / weight) ** 2
    guess = 0.01 * np.sqrt(d0 / d1) if d1 > 0.0 and d0 > 0.0 else 0.1 * span
    r.h = min(max(guess, 1e-9 * span), 0.1 * span) if r.h == 0.0 or guess < r.h else min(r.h, guess)


@kernel()
def end_segment(r):  # type: ignore[no-untyped-def]
    """The segment's end, seen from before its jump: outputs of the left side, what comes back now, what comes next."""
    width, line = r.width, 2 + r.width
    r.still = r.quiet = 0
    r.tb = r.t
    outside(r, r.t, r.start)
    if r.nd:
        evaluate(r, r.do_src, r.y, r.src_left)
    t_out = vector(r.t_out, r.n_out)
    while r.i_out + 1 < r.n_out and t_out[r.i_out] == r.t and t_out[r.i_out + 1] == r.t:
        write_row(r, r.y)
    breaks, echo, jump = vector(r.breaks, r.n_breaks), vector(r.echo, r.echoes * line), vector(r.jump_p, width)
    r.order = 0.0
    r.disturbed = 0
    kept = 0
    for i in range(r.echoes):
        at = echo[i * line]
        if at == r.t:
            r.echo_now = r.disturbed = 1
            r.order = max(r.order, echo[i * line + 1])
            for c in range(width):
                jump[c] = echo[i * line + 2 + c]
        elif at > r.t:
            for q in range(line):
                echo[kept * line + q] = echo[i * line + q]
            kept += 1
    r.echoes = kept
    if r.echo_now and width:
        evaluate(r, r.do_f, r.y, r.f_before)
    returns = vector(r.breaks + 8 * r.n_breaks, r.n_breaks)
    while r.i_break < r.n_breaks and breaks[r.i_break] <= r.t:
        if returns[r.i_break] > 0.0:
            r.disturbed = 1
        r.i_break += 1
    r.first = 0


# --- the run ---


@kernel()
def longer(rows, count, room):  # type: ignore[no-untyped-def]
    """The table with room for `room` more rows than `count`."""
    if count + room <= rows.shape[0]:
        return rows
    larger = np.empty((2 * rows.shape[0] + room, rows.shape[1]))
    for i in range(count):
        for j in range(rows.shape[1]):
            larger[i, j] = rows[i, j]
    return larger


@kernel()
def _begin(r, y, w):  # type: ignore[no-untyped-def]
    """Fill the workspace for a run from the flat start vector y and what comes from outside, w."""
    nd, nq, width = r.nd, r.nq, r.width
    start, outside = vector(r.y, y.size), vector(r.w, w.size)
    for i in range(y.size):
        start[i] = y[i]
    for i in range(w.size):
        outside[i] = w[i]
    scale, floors = vector(r.scale, max(r.np, 1)), vector(r.floors, width)
    for c in range(width):
        floors[c] = r.atol / scale[c] if c < r.np else np.inf
    constants = vector(r.constants, (nd + 2 * nq) * (1 + width))
    lag, lag_p, before = vector(r.lag, nd), vector(r.lag_p, nd * width), vector(r.before, nd * (1 + width))
    r.shortest = np.inf
    for i in range(nd):
        lag[i] = constants[i]
        r.shortest = min(r.shortest, lag[i])
        before[i * (1 + width)] = w[1 + r.nu + i]
        for c in range(width):
            lag_p[i * width + c] = constants[nd + 2 * nq + i * width + c]
            before[i * (1 + width) + 1 + c] = w[r.nw + i * width + c]
    tick, publish = vector(r.tick, nq), vector(r.publish, nq)
    for i in range(nq):
        tick[i], publish[i] = r.start, np.inf
    breaks = vector(r.breaks, r.n_breaks)
    while r.i_break < r.n_breaks and breaks[r.i_break] <= r.start:
        r.i_break += 1
    r.t, r.first = r.start, 1
    r.last_event, r.last_switch, r.aim = -np.inf, -1, NONE


@kernel()
def _step(r):  # type: ignore[no-untyped-def]
    """Try one step, and what follows if it is good: outputs, history, a switch at its end. Returns a status."""
    r.steps += 1
    if r.steps > r.max_steps:
        return STEP_LIMIT
    if r.nd:
        r.h = min(r.h, r.shortest)
    span, largest = r.end - r.start, max(abs(r.t), abs(r.end))
    r.last = r.t + 1.000001 * r.h >= r.tb
    r.step_end = r.tb if r.last else r.t + r.h
    r.hs = r.step_end - r.t
    if r.last and not r.hs > 1e-15 * largest:
        r.t = r.tb  # two breaks that differ by rounding alone
        return CONVERGED
    if not r.hs > 4e-16 * largest or r.h < 1e-14 * span:
        return NOT_FINITE
    attempt(r)
    if r.error > 1.0 and r.hs <= 1e-10 * span and r.error < np.inf and r.forced_steps < 50:
        # A slope that is infinite for an instant cannot be followed to tolerance: pass it, and count it.
        r.forced_steps += 1
        r.error = 0.05
    # Steps at the edge of stability are accepted and rejected by turns: a third of them beyond it is enough.
    if not r.rosenbrock and r.stiffness > 3.25 * 3.25:
        r.stiff += 2
        if r.stiff > 50:
            return STIFF
    elif r.stiff > 0:
        r.stiff -= 1
    if not r.error <= 1.0:
        r.rejected += 1
        r.h = r.hs * (max(0.2, 0.9 * r.error**-0.2) if r.error < np.inf else 0.2)
        r.fresh = r.again = 1  # the derivatives at (t, y) stand
        return CONVERGED
    factor = 0.9 * r.error**-0.2 if r.error > 1e-10 else 8.0
    factor = min(max(factor, 0.2), 1.0 if r.again else 8.0)
    r.again = 0
    return _accept(r, factor)


@kernel()
def _accept(r, factor):  # type: ignore[no-untyped-def]
    """Accept a step and set the next one's length to `factor` times its own; return a status."""
    if r.nd or r.ns or (r.i_out < r.n_out and vector(r.t_out, r.n_out)[r.i_out] <= r.step_end):
        make_dense(r)
    event = find_switch(r) if r.ns else NONE
    if event == AGAIN:
        return CONVERGED
    write_rows(r)
    if r.nd:
        remember(r)
    r.accepted += 1
    r.t = r.step_end
    r.y, r.yn = r.yn, r.y
    r.fresh = 0
    r.h = max(r.h, r.hs * factor) if r.last and factor >= 1.0 else r.hs * factor
    if r.ns:
        widen(r)
    if event != NONE:
        return switch(r, event)
    if r.sliding != NONE:
        stay(r)
    return CONVERGED


def integrate(a):  # type: ignore[no-untyped-def]
    """Integrate from start to end; write the outputs and their rows into out (n_out, no (1 + width)). Status, and 1.

    a: state, a RUN record as integers, with sizes, functions and method; on return it holds the counts. work, zeros, as
    many doubles as `arrange` asks for. span, start and end; on return its first is the time reached. tolerance: relative,
    absolute. y, the flat start vector, consistent to solver tolerance, w and p. constants: delay times, sampling periods
    and compute times with their rows. breaks, (2, n): instants at which a step ends, and whether delays bring them back; then
    pointer, times and values of the inputs' pieces. t_out, out. scale of each parameter. heads, (switches + 1, HEAD): functions
    and sizes of the slide on each switch, 0 where it is not compiled, then those without a slide; in a they are large enough for
    all of them.
    """
    r = record(address(a, 0))
    r.free = address(a, 1)
    span, tolerance, y, w, pointer = numbers(a, 2), numbers(a, 3), numbers(a, 4), numbers(a, 5), integers(a, 9)
    r.start, r.end, r.rtol, r.atol = span[0], span[1], tolerance[0], tolerance[1]
    arrange(r)
    r.p, r.constants, r.scale = address(a, 6), address(a, 7), address(a, 14)
    r.breaks, r.n_breaks = address(a, 8), length(a, 8, 1)
    r.pointer, r.times, r.values = address(a, 9), address(a, 10), address(a, 11)
    r.t_out, r.n_out, r.out = address(a, 12), length(a, 12, 0), address(a, 13)
    r.heads, r.here = address(a, 15), address(a, 0)
    use(r, r.ns)
    at = indices(r.at, r.nu)
    for i in range(r.nu):
        at[i] = pointer[i]
    _begin(r, y, w)
    status = _run(r)
    span[0] = r.t
    return 1 + status


@kernel()
def _run(r):  # type: ignore[no-untyped-def]
    """Run from segment to segment; return a status."""
    # What has no size known beforehand: steps for delayed signals to look back to, jumps that will come back.
    history = np.empty((64 if r.nd else 1, 2 + r.nd * NODES * (1 + r.width)))
    echo = np.empty((16, 2 + r.width))
    r.history = address_of(history)
    while True:
        echo = longer(echo, r.echoes, r.nd)
        r.echo = address_of(echo)
        if not begin_segment(r):
            return INCONSISTENT
        if not r.t < r.end:
            return CONVERGED
        prepare_segment(r)
        while r.t < r.tb:
            if r.nd:
                history, echo = longer(history, r.kept, 1), longer(echo, r.echoes, r.nd)
                r.history, r.echo = address_of(history), address_of(echo)
            status = _step(r)
            if status != CONVERGED:
                return status
        end_segment(r)


def room(a):  # type: ignore[no-untyped-def]
    """Return 1 and the number of doubles of workspace that a run takes. a: state, a RUN record as integers."""
    r = record(address(a, 0))
    r.free = 0
    return 1 + arrange(r) // 8
