"""Exogenous values of the equations at an instant: time, inputs, delayed signals, held samples."""

from __future__ import annotations

import numpy as np

from hvdc_ident.simulate.native import indices, kernel, table, vector
from hvdc_ident.simulate.run_state import NODES


@kernel()
def outside(r, t, ta):  # type: ignore[no-untyped-def]
    """Write all that comes from outside at t, within the segment from ta to r.tb, into w and wd."""
    vector(r.w, 1)[0] = t
    if r.quiet:
        return
    if not r.still:
        _inputs(r, t)
    if r.nd:
        _delayed(r, t, ta)


@kernel()
def enter_segment(r):  # type: ignore[no-untyped-def]
    """Move every input's place to the piece right of r.t; says whether that piece reaches to r.tb for all of them."""
    pointer, at = indices(r.pointer, r.nu + 1), indices(r.at, r.nu)
    times = vector(r.times, pointer[r.nu])
    whole = True
    for i in range(r.nu):
        first, last = pointer[i], pointer[i + 1]
        k = at[i]
        while k + 1 < last and times[k + 1] <= r.t:
            k += 1
        while k > first and times[k] > r.t:
            k -= 1
        at[i] = k
        end = times[k + 1] if k + 1 < last else np.inf
        if times[k] > r.t:  # before the first point
            end = times[k]
        whole = whole and end >= r.tb
    return whole


@kernel()
def _inputs(r, t):  # type: ignore[no-untyped-def]
    """Write the inputs and their slopes at t into w and wd: at r.tb, the segment's end, the values before a jump."""
    pointer, at = indices(r.pointer, r.nu + 1), indices(r.at, r.nu)
    times, values = vector(r.times, pointer[r.nu]), vector(r.values, pointer[r.nu])
    w, wd = vector(r.w, r.nw), vector(r.wd, r.nw)
    for i in range(r.nu):
        first, last = pointer[i], pointer[i + 1]
        k = at[i]
        while k + 1 < last and (times[k + 1] < t or (times[k + 1] == t and t < r.tb)):
            k += 1
        while k > first and (times[k] > t or (times[k] == t and t >= r.tb)):
            k -= 1
        at[i] = k  # where the next instant is looked for: a record may have thousands of rows
        if k + 1 < last and t >= times[k] and times[k + 1] > times[k]:
            slope = (values[k + 1] - values[k]) / (times[k + 1] - times[k])
            w[1 + i] = values[k] + slope * (t - times[k])
            wd[1 + i] = slope
        else:
            w[1 + i] = values[k]
            wd[1 + i] = 0.0


@kernel()
def _delayed(r, t, ta):  # type: ignore[no-untyped-def]
    """Write the delayed signals, their rates and their rows over the parameters at t into w and wd.

    The history has one row a step: its instant, its length, then polynomials (delay, 5, 1 + width). Before the start the
    signals are constant. Instants are kept just inside the segment, so that a jump at its ends is seen from the inside.
    """
    nd, width, first = r.nd, r.width, 1 + r.nu
    rows = 1 + width
    line = 2 + nd * NODES * rows
    history, before = table(r.history, r.kept, line), table(r.before, nd, rows)
    lag, lag_p = vector(r.lag, nd), table(r.lag_p, nd, width)
    w, wd = vector(r.w, r.nw + nd * width), vector(r.wd, r.nw + nd * width)
    inside = 1e-13 * max(1.0, abs(r.tb))
    for i in range(nd):
        s = min(max(t, ta + inside), r.tb - inside) - lag[i]
        row = r.nw + i * width
        if s <= r.start or r.kept == 0:
            w[first + i], wd[first + i] = before[i, 0], 0.0
            for k in range(width):
                w[row + k], wd[row + k] = before[i, 1 + k], 0.0
            continue
        low, high = 0, r.kept - 1
        while low < high:
            middle = (low + high + 1) // 2
            if history[middle, 0] <= s:
                low = middle
            else:
                high = middle - 1
        scale = 1.0 / history[low, 1]
        x = (s - history[low, 0]) / history[low, 1]
        c = table(r.history + 8 * (low * line + 2 + i * NODES * rows), NODES, rows)
        rate, bend = 0.0, 0.0
        for j in range(rows):
            value = c[0, j] + x * (c[1, j] + x * (c[2, j] + x * (c[3, j] + x * c[4, j])))
            slope = scale * (c[1, j] + x * (2 * c[2, j] + x * (3 * c[3, j] + x * 4 * c[4, j])))
            if j == 0:
                rate = slope
                bend = scale * scale * (2 * c[2, 0] + x * (6 * c[3, 0] + x * 12 * c[4, 0]))
                w[first + i], wd[first + i] = value, slope
            else:  # the delay itself may depend on the parameter
                w[row + j - 1] = value - rate * lag_p[i, j - 1]
                wd[row + j - 1] = slope - bend * lag_p[i, j - 1]


@kernel()
def quartic(v, c):  # type: ignore[no-untyped-def]
    """Write into c (5, k) the power coefficients of the quartics through v (5, k) at 0, 1/4, 1/2, 3/4, 1."""
    for j in range(v.shape[1]):
        a, b, d, e, f = v[0, j], v[1, j], v[2, j], v[3, j], v[4, j]
        c[0, j] = a
        c[1, j] = (-25 * a + 48 * b - 36 * d + 16 * e - 3 * f) / 3
        c[2, j] = (70 * a - 208 * b + 228 * d - 112 * e + 22 * f) / 3
        c[3, j] = (-80 * a + 288 * b - 384 * d + 224 * e - 48 * f) / 3
        c[4, j] = (32 * a - 128 * b + 192 * d - 128 * e + 32 * f) / 3
