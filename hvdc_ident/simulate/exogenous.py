"""What comes into the equations from outside at an instant: time, inputs, delayed signals, held samples."""

from __future__ import annotations

import numpy as np
from numba import njit

NODES = 5  # a delayed signal is kept as a quartic in each step, through five equidistant values


@njit(cache=True, error_model="numpy")
def enter_segment(t, tb, pointer, times, values, at):  # type: ignore[no-untyped-def]
    """Moves every input's place `at` to the piece right of t; says whether that piece reaches to tb for all of them."""
    whole = True
    for i in range(at.size):
        first, last = pointer[i], pointer[i + 1]
        k = at[i]
        while k + 1 < last and times[k + 1] <= t:
            k += 1
        while k > first and times[k] > t:
            k -= 1
        at[i] = k
        end = times[k + 1] if k + 1 < last else np.inf
        if times[k] > t:  # before the first point
            end = times[k]
        whole = whole and end >= tb
    return whole


@njit(cache=True, error_model="numpy")
def inputs(t, tb, pointer, times, values, at, w, wd):  # type: ignore[no-untyped-def]
    """Writes the inputs and their slopes at t into w and wd: at tb, the segment's end, the values before a jump."""
    for i in range(at.size):
        first, last = pointer[i], pointer[i + 1]
        k = at[i]
        while k + 1 < last and (times[k + 1] < t or (times[k + 1] == t and t < tb)):
            k += 1
        while k > first and (times[k] > t or (times[k] == t and t >= tb and k > first)):
            k -= 1
        if k + 1 < last and t >= times[k] and times[k + 1] > times[k]:
            slope = (values[k + 1] - values[k]) / (times[k + 1] - times[k])
            w[1 + i] = values[k] + slope * (t - times[k])
            wd[1 + i] = slope
        else:
            w[1 + i] = values[k]
            wd[1 + i] = 0.0


@njit(cache=True, error_model="numpy")
def delayed(t, ta, tb, start, count, h_t, h_h, h_c, before, lag, slope_p, width, first, total, w, wd):  # type: ignore[no-untyped-def]
    """Writes the delayed signals, their rates and their rows over the parameters at t into w and wd.

    The history is (count) steps from h_t of length h_h with polynomials h_c (step, delay, 5, 1 + width). Before the start
    the signals are constant: `before` (delay, 1 + width). `lag` (delay,) s; slope_p (delay, width): its derivatives.
    Instants are kept just inside the segment [ta, tb], so that a jump at its ends is seen from the inside.
    """
    inside = 1e-13 * max(1.0, abs(tb))
    for i in range(lag.size):
        s = min(max(t, ta + inside), tb - inside) - lag[i]
        value_row, rate_row = total + i * width, total + i * width
        if s <= start or count == 0:
            w[first + i] = before[i, 0]
            wd[first + i] = 0.0
            for c in range(width):
                w[value_row + c] = before[i, 1 + c]
                wd[rate_row + c] = 0.0
            continue
        low, high = 0, count - 1
        while low < high:
            middle = (low + high + 1) // 2
            if h_t[middle] <= s:
                low = middle
            else:
                high = middle - 1
        x = (s - h_t[low]) / h_h[low]
        c = h_c[low, i]
        scale = 1.0 / h_h[low]
        w[first + i] = c[0, 0] + x * (c[1, 0] + x * (c[2, 0] + x * (c[3, 0] + x * c[4, 0])))
        rate = scale * (c[1, 0] + x * (2 * c[2, 0] + x * (3 * c[3, 0] + x * 4 * c[4, 0])))
        bend = scale * scale * (2 * c[2, 0] + x * (6 * c[3, 0] + x * 12 * c[4, 0]))
        wd[first + i] = rate
        for k in range(width):
            j = 1 + k
            w[value_row + k] = c[0, j] + x * (c[1, j] + x * (c[2, j] + x * (c[3, j] + x * c[4, j]))) - rate * slope_p[i, k]
            wd[rate_row + k] = scale * (c[1, j] + x * (2 * c[2, j] + x * (3 * c[3, j] + x * 4 * c[4, j]))) - bend * slope_p[i, k]


@njit(cache=True, error_model="numpy")
def quartic(v, c):  # type: ignore[no-untyped-def]
    """Writes into c (5, k) the power coefficients of the quartics through v (5, k) at 0, 1/4, 1/2, 3/4, 1."""
    for j in range(v.shape[1]):
        a, b, d, e, f = v[0, j], v[1, j], v[2, j], v[3, j], v[4, j]
        c[0, j] = a
        c[1, j] = (-25 * a + 48 * b - 36 * d + 16 * e - 3 * f) / 3
        c[2, j] = (70 * a - 208 * b + 228 * d - 112 * e + 22 * f) / 3
        c[3, j] = (-80 * a + 288 * b - 384 * d + 224 * e - 48 * f) / 3
        c[4, j] = (32 * a - 128 * b + 192 * d - 128 * e + 32 * f) / 3
