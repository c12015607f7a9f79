"""Segments between breaks: what happens where one begins and where it ends, and how long its first step is."""

from __future__ import annotations

import numpy as np

from hvdc_ident.simulate.exogenous import enter_segment, outside
from hvdc_ident.simulate.kernel import kernel
from hvdc_ident.simulate.memory import vector
from hvdc_ident.simulate.outputs import write_row
from hvdc_ident.simulate.steps import evaluate
from hvdc_ident.simulate.switches import add_echo, shift_rows
from hvdc_ident.simulate.unknowns import consistent, rates


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
    if not consistent(r, True):
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
    """Takes the samples that are due: value and rows, at the instant's own dependence on the parameters.

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
    """Publishes the samples that are due. False: the unknowns have no solution with them."""
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
        if not consistent(r, True):
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
    r.forced = r.timed > 0 or r.nd > 0 or not still
    if not r.forced:
        ft = vector(r.ft, r.size)
        for q in range(r.size):
            ft[q] = 0.0
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
    r.disturbed = r.i_break < r.n_breaks and breaks[r.i_break] <= r.t
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
    while r.i_break < r.n_breaks and breaks[r.i_break] <= r.t:
        r.i_break += 1
    r.first = 0
