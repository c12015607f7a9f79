"""Switches: where a step crosses one, and what changes there."""

from __future__ import annotations

import numpy as np

from hvdc_ident.simulate.exogenous import outside
from hvdc_ident.simulate.native import kernel, vector
from hvdc_ident.simulate.run_state import CHATTER, CONVERGED, INCONSISTENT
from hvdc_ident.simulate.sliding import NEAR, NONE, begin_slide, end_slide, leads_back, slides_on, to_surface
from hvdc_ident.simulate.steps import evaluate, interpolate
from hvdc_ident.simulate.unknowns import consistent, rates

AGAIN = -2


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
        if aim >= 0 and abs(values[aim]) <= NEAR * slack[aim]:
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
    if event == r.sliding:  # the field is continuous there: nothing jumps
        to_surface(r)
        if not end_slide(r):
            return INCONSISTENT
    else:
        status = _cross(r, event)
        if status != CONVERGED:
            return status
    if r.nd:
        add_echoes(r, 1.0)
    jump = vector(r.jump_p, r.width)
    for c in range(r.width):
        jump[c] = 0.0
    evaluate(r, r.do_rhs, r.y, r.k)
    r.fresh = 1
    r.h = min(r.h, r.hs)
    return CONVERGED


@kernel()
def _cross(r, event):  # type: ignore[no-untyped-def]
    """Change a switch and those that follow from it; where the new side leads back, slide on it. Returns a status."""
    width, ns = r.width, r.ns
    m, speed = vector(r.m, ns), 0.0
    if width:
        rates(r)
        evaluate(r, r.do_sws, r.y, r.sws)
        evaluate(r, r.do_swd, r.y, r.sv)
        speed = vector(r.sv, ns)[event]
    evaluate(r, r.do_f, r.y, r.f_before)
    evaluate(r, r.do_sw, r.y, r.sv)
    value = vector(r.sv, ns)[event]
    m[event] = 1.0 - m[event]
    for _ in range(ns):
        if not consistent(r, False):
            return INCONSISTENT
        if r.sliding != NONE and not slides_on(r) and not end_slide(r):
            return INCONSISTENT
        also = violation(r, r.y)
        if also < 0 or also == event:
            break
        m[also] = 1.0 - m[also]
    evaluate(r, r.do_f, r.y, r.f_after)
    before, after = vector(r.f_before, r.nx), vector(r.f_after, r.nx)
    biggest = 0.0
    for i in range(r.nx):
        biggest = max(biggest, abs(before[i] - after[i]) / (1e-9 + abs(before[i]) + abs(after[i])))
    if width and speed != 0.0:
        _jump(r, event, speed, biggest > 1e-7)
    if r.slides and biggest > 1e-7 and leads_back(r, event, value):
        return begin_slide(r, event)
    return CONVERGED


@kernel()
def _jump(r, event, speed, jumped):  # type: ignore[no-untyped-def]
    """The jump condition: r.jump_p, and where the right-hand side jumps at all the sensitivities, the unknowns' too.

    What jumps may be the source of a delay alone, whose jump comes back later with the same r.jump_p.
    """
    width = r.width
    jump, row = vector(r.jump_p, width), vector(r.sws + 8 * (r.ns + event * width), width)
    for c in range(width):
        jump[c] = -row[c] / speed
    if jumped:
        shift_rows(r, r.f_before, r.f_after, r.jump_p)
        consistent(r, False)
