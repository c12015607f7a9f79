"""The compiled recursion behind a signature: a time-varying linear system run for many disturbances at the same slots."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})
def propagate(phi, g0, g1, gw0, gw1, cs, ds, csw, co, do, dow, cf, df, dfw, rows, before, share, x0, w0, d, u, y):  # type: ignore[no-untyped-def]
    """Writes into u (m, K, nc) what the m slots see of the disturbances d (m, K, nc) put on them, into y the outputs.

    x' = phi x + g0 d + g1 d_next + gw0 w + gw1 w_next over each interval; slots see cs x + ds d + csw w, outputs at the
    instants with rows[k] >= 0 show co x + do d + dow w. w are delayed or sampled values: w_k lies `share` of the way
    from the source's value at instant before[k] to that at before[k] + 1 (before[k] < 0: the start's value); the source
    is cf x + df d + dfw w. x0 (nx, nc), w0 (nw, nc): the start; y (o, R, nc). Disturbances lie side by side in memory.
    """
    m, count, nc = d.shape
    nx, nw, no = x0.shape[0], w0.shape[0], y.shape[0]
    x, after, w, w_next = x0.copy(), x0.copy(), w0.copy(), w0.copy()
    history = np.zeros((nw, count, nc))
    for k in range(count):
        for i in range(m):
            _sum(cs[k, i], x, ds[k, i], d[:, k], csw[k, i], w, u[i, k])
        r = rows[k]
        if r >= 0:
            for o in range(no):
                _sum(co[r, o], x, do[r, o], d[:, k], dow[r, o], w, y[o, r])
        for q in range(nw):
            _sum(cf[k, q], x, df[k, q], d[:, k], dfw[k, q], w, history[q, k])
        if k + 1 == count:
            break
        for q in range(nw):
            b = before[k + 1, q]
            if b >= 0:
                low, high, s = min(b, k), min(b + 1, k), share[k + 1, q]
                for c in range(nc):
                    w_next[q, c] = history[q, low, c] + s * (history[q, high, c] - history[q, low, c])
        for i in range(nx):
            _sum(phi[k, i], x, g0[k, i], d[:, k], gw0[k, i], w, after[i])
            for j in range(m):
                a = g1[k, i, j]
                if a != 0.0:
                    for c in range(nc):
                        after[i, c] += a * d[j, k + 1, c]
            for j in range(nw):
                a = gw1[k, i, j]
                if a != 0.0:
                    for c in range(nc):
                        after[i, c] += a * w_next[j, c]
        x, after = after, x
        for q in range(nw):
            for c in range(nc):
                w[q, c] = w_next[q, c]


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _sum(a, x, b, d, e, w, out):  # type: ignore[no-untyped-def]
    """Writes a x + b d + e w into out (nc,): a (nx,), x (nx, nc) and so on."""
    nc = out.size
    for c in range(nc):
        out[c] = 0.0
    for j in range(a.size):
        f = a[j]
        if f != 0.0:
            for c in range(nc):
                out[c] += f * x[j, c]
    for j in range(b.size):
        f = b[j]
        if f != 0.0:
            for c in range(nc):
                out[c] += f * d[j, c]
    for j in range(e.size):
        f = e[j]
        if f != 0.0:
            for c in range(nc):
                out[c] += f * w[j, c]


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})
def replaced(y, columns, whole, size, moved):  # type: ignore[no-untyped-def]
    """Puts y (o, R, nc) into columns of whole (o, R, C); adds up into size (nc,) its squares, into moved those of the change."""
    for o in range(y.shape[0]):
        for r in range(y.shape[1]):
            for k in range(y.shape[2]):
                new, c = y[o, r, k], columns[k]
                change = new - whole[o, r, c]
                size[k] += new * new
                moved[k] += change * change
                whole[o, r, c] = new
