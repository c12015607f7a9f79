"""The compiled steps through an effect's own memory, many sizes at a time: states, linear in each step and exact for signals
of straight pieces; and samples."""

from __future__ import annotations

import numpy as np
from numba import njit

from hvdc_ident.simulate import call, lu, solve


@njit(cache=True, error_model="numpy")
def march(address, time, driven, constants, start, fine, most, path):  # type: ignore[no-untyped-def]
    """Writes the states into path (n, K, nc), from start (nc, n), driven (nc, q, K) and constants (nc, r).

    The function at the address gives, of [states, driven, constants], the n derivatives and their (n, n + q) rows.
    x' = f is stepped by h phi_1 f + h^2 phi_2 f_t in the (1, 2) Padé form, no interval longer than `fine`, in `most` parts at most.
    """
    nc, q, count = driven.shape
    n, r = start.shape[1], constants.shape[1]
    y, out = np.zeros(n + q + r), np.zeros(n + n * (n + q))
    z, z2, below = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n))
    ahead, rate, pivots = np.zeros(n), np.zeros(n), np.zeros(n, np.int64)
    for c in range(nc):
        for i in range(n):
            y[i] = start[c, i]
        for i in range(r):
            y[n + q + i] = constants[c, i]
        for k in range(count - 1):
            width = time[k + 1] - time[k]
            if width > 0.0:
                parts = 1
                while width / parts > fine and parts < most:
                    parts += 1
                h = width / parts
                for part in range(parts):
                    for i in range(q):
                        y[n + i] = driven[c, i, k] + part / parts * (driven[c, i, k + 1] - driven[c, i, k])
                    out[:] = 0.0
                    call(address, y, y, y, y, y, y, out)
                    for i in range(n):
                        rate[i] = 0.0
                        for j in range(n):
                            z[i, j] = h * out[n + i * (n + q) + j]
                        for j in range(q):
                            rate[i] += out[n + i * (n + q) + n + j] * (driven[c, j, k + 1] - driven[c, j, k]) / width
                    for i in range(n):
                        ahead[i] = h * out[i] + 0.5 * h * h * rate[i]
                        for j in range(n):
                            ahead[i] -= z[i, j] * (h * out[j] + h * h * rate[j]) / 6.0
                            total = 0.0
                            for m in range(n):
                                total += z[i, m] * z[m, j]
                            z2[i, j] = total
                    for i in range(n):
                        for j in range(n):
                            below[i, j] = z2[i, j] / 6.0 - 2.0 / 3.0 * z[i, j]
                        below[i, i] += 1.0
                    if n == 1:
                        y[0] += ahead[0] / below[0, 0]
                    else:
                        lu(below, pivots)
                        solve(below, pivots, ahead)
                        for i in range(n):
                            y[i] += ahead[i]
            for i in range(n):
                path[i, k + 1, c] = y[i]


@njit(cache=True)
def hold(time, signal, period, compute, y):  # type: ignore[no-untyped-def]
    """Writes into y (K, nc) what signal (K, nc) was at the last sample, taken every period, (nc,), from the first instant on,
    that is `compute`, (nc,), old at least; of a doubled instant the later value, before the first sample the first."""
    count, columns = signal.shape
    at, value, due = np.zeros(columns, np.int64), signal[0].copy(), np.full(columns, -np.inf)
    for k in range(count):
        for c in range(columns):
            if time[k] >= due[c]:  # one instant of many
                whole = np.floor((time[k] - time[0] - compute[c]) / period[c] + 1e-9)
                sample = time[0] + whole * period[c]
                j = at[c]
                while j + 1 < count and time[j + 1] <= sample:
                    j += 1
                at[c], value[c] = j, signal[j, c]
                due[c] = time[0] + compute[c] + (whole + 1.0 - 1e-9) * period[c]
                if sample > time[j] and j + 1 < count:
                    value[c] += (sample - time[j]) / (time[j + 1] - time[j]) * (signal[j + 1, c] - signal[j, c])
            y[k, c] = value[c]
