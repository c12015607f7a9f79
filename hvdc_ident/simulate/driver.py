"""The integration: segments between breaks, steps under error control, switches, samples, delays, outputs.

Compiled once for an installation: it knows no model, only the addresses of generated functions and sizes.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from hvdc_ident.simulate.kernel import kernel, stamp
from hvdc_ident.simulate.memory import address_of, indices, record, vector
from hvdc_ident.simulate.outputs import remember, write_rows
from hvdc_ident.simulate.segments import begin_segment, end_segment, prepare_segment
from hvdc_ident.simulate.state import NODES, RUN, arrange
from hvdc_ident.simulate.status import CONVERGED, INCONSISTENT, NOT_FINITE, STEP_LIMIT, STIFF
from hvdc_ident.simulate.steps import attempt, make_dense
from hvdc_ident.simulate.switches import AGAIN, NONE, find_switch, switch, widen


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
    """Fills the workspace for a run from the flat start vector y and what comes from outside, w."""
    nd, nq, width = r.nd, r.nq, r.width
    start, outside, mass = vector(r.y, y.size), vector(r.w, w.size), vector(r.mass, r.size)
    for i in range(y.size):
        start[i] = y[i]
    for i in range(w.size):
        outside[i] = w[i]
    for i in range(r.nx):
        mass[i] = 1.0
        for c in range(width):
            mass[r.n + i * width + c] = 1.0
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
    """Tries one step, and what follows if it is good: outputs, history, a switch at its end. Returns a status."""
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
    if not r.error <= 1.0:
        r.rejected += 1
        r.h = r.hs * (max(0.2, 0.9 * r.error**-0.2) if r.error < np.inf else 0.2)
        r.fresh = r.again = 1  # the derivatives at (t, y) stand
        return CONVERGED
    factor = 0.9 * r.error**-0.2 if r.error > 1e-10 else 8.0
    factor = min(max(factor, 0.2), 1.0 if r.again else 8.0)
    r.again = 0
    if not r.rosenbrock and r.stiffness > 3.25 * 3.25:
        r.stiff += 1
        if r.stiff > 25:
            return STIFF
    elif r.stiff > 0:
        r.stiff -= 1
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
    return CONVERGED if event == NONE else switch(r, event)


def _entries(stamp):  # type: ignore[no-untyped-def]
    """Return the functions that Python calls, for the present state of the kernels' files."""

    @njit(cache=True, error_model="numpy")
    def integrate(state, work, span, tolerance, max_steps, y, w, p, constants, breaks, pointer, times, values, t_out, out, scale, hess_row, hess_column):  # type: ignore[no-untyped-def]
        """Integrates from start to end; writes the outputs and their rows into out (n_out, no (1 + width)).

        state: a RUN record as integers, with sizes, functions and method; on return it holds the counts. work: zeros, as many
        doubles as `arrange` asks for. span: start and end. tolerance: relative, absolute. y: the flat start vector, consistent
        to solver tolerance. constants: delay times, sampling periods and compute times with their rows.
        Returns a status and the time reached.
        """
        r = record(address_of(state))
        r.stamp = stamp
        r.start, r.end = span
        r.rtol, r.atol = tolerance
        r.max_steps = max_steps
        r.free = address_of(work)
        arrange(r)
        r.p, r.constants, r.scale = address_of(p), address_of(constants), address_of(scale)
        r.breaks, r.n_breaks = address_of(breaks), breaks.size
        r.pointer, r.times, r.values = address_of(pointer), address_of(times), address_of(values)
        r.t_out, r.n_out, r.out = address_of(t_out), t_out.size, address_of(out)
        r.hess_row, r.hess_column = address_of(hess_row), address_of(hess_column)
        at = indices(r.at, r.nu)
        for i in range(r.nu):
            at[i] = pointer[i]
        _begin(r, y, w)
        # What has no size known beforehand: steps for delayed signals to look back to, jumps that will come back.
        history = np.empty((64 if r.nd else 1, 2 + r.nd * NODES * (1 + r.width)))
        echo = np.empty((16, 2 + r.width))
        r.history = address_of(history)
        while True:
            echo = longer(echo, r.echoes, r.nd)
            r.echo = address_of(echo)
            if not begin_segment(r):
                return INCONSISTENT, r.t
            if not r.t < r.end:
                return CONVERGED, r.t
            prepare_segment(r)
            while r.t < r.tb:
                if r.nd:
                    history, echo = longer(history, r.kept, 1), longer(echo, r.echoes, r.nd)
                    r.history, r.echo = address_of(history), address_of(echo)
                status = _step(r)
                if status != CONVERGED:
                    return status, r.t
            end_segment(r)

    @njit(cache=True, error_model="numpy")
    def room(state):  # type: ignore[no-untyped-def]
        """Number of doubles of workspace that a run of these sizes takes."""
        r = record(address_of(state))
        r.stamp = stamp
        r.free = 0
        return arrange(r) // 8

    return integrate, room


integrate, room = _entries(stamp(RUN.descr))
# The types of the arguments of `integrate` and `room`, so that both can be made before the first run.
ROOM = "int64(int64[::1])"
INTEGRATE = (
    "Tuple((int64, float64))(int64[::1], float64[::1], UniTuple(float64, 2), UniTuple(float64, 2), int64, "
    "float64[::1], float64[::1], float64[::1], float64[::1], float64[::1], int64[::1], float64[::1], float64[::1], "
    "float64[::1], float64[:, ::1], float64[::1], int64[::1], int64[::1])"
)
