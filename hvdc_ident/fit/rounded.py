"""The compiled function behind a rounded record's residuals: a refit asks for it at every row of every run."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)
TAIL = -30.0
"""From where log Phi is by its expansion: erfc is nearly 0 there."""
NEAR = 1e-4
"""Misfits below this share of the noise, where the difference of two logarithms has no digits left, take the tangent at 0."""
FAR = 1e3
"""Standard deviations beyond half a step from which the tail's expansion stands for logarithms that differ by less than their own error."""


@njit(cache=True, error_model="numpy")
def log_ndtr(x):  # type: ignore[no-untyped-def]
    """log Phi(x), to rounding also far in the lower tail (Abramowitz and Stegun 26.2.12)."""
    if x > 0.0:
        return math.log1p(-0.5 * math.erfc(x / math.sqrt(2.0)))
    if x > TAIL:
        return math.log(0.5 * math.erfc(-x / math.sqrt(2.0)))
    s = 1.0 / (x * x)
    series = -s * (1.0 - s * (3.0 - s * (15.0 - s * (105.0 - s * (945.0 - s * 10395.0)))))
    return -0.5 * x * x - HALF_LOG_2PI - math.log(-x) + math.log1p(series)


@njit(cache=True, error_model="numpy")
def log_chance(z, step):  # type: ignore[no-untyped-def]
    """log(Phi(z + step/2) - Phi(z - step/2)) for z >= 0 in units of the noise, also where that is below the smallest number."""
    upper, lower = log_ndtr(0.5 * step - z), log_ndtr(-0.5 * step - z)
    d = lower - upper
    # log(1 - exp(d)) with all digits on either side
    if d > -math.log(2.0):
        return upper + math.log(-math.expm1(min(d, -1e-300)))
    return upper + math.log1p(-math.exp(d))


@njit(cache=True, error_model="numpy")
def log_chances(z, step):  # type: ignore[no-untyped-def]
    """`log_chance` of every row, (n,)."""
    found = np.empty(z.size)
    for k in range(z.size):
        found[k] = log_chance(z[k], step)
    return found


@njit(cache=True, error_model="numpy")
def residuals(misfit, step, noise):  # type: ignore[no-untyped-def]
    """g and dg/dz of every row, (n,), from misfit (n,), step and noise, all in the output's unit."""
    g, slope = np.empty(misfit.size), np.empty(misfit.size)
    wide = step / noise
    half = 0.5 * wide
    none = log_chance(0.0, wide)
    tangent = math.sqrt(math.exp(-0.5 * half * half - HALF_LOG_2PI - none) * wide)
    for k in range(misfit.size):
        z = misfit[k] / noise
        size = abs(z)
        if size - half > FAR:
            # Phi(-x) = phi(x)/x (1 - 1/x^2 ...), so that dlog Phi(-x)/dx = -(x + 1/x ...)
            x = size - half
            more = math.sqrt(1.0 + (2.0 * (none + math.log(x)) + 2.0 * HALF_LOG_2PI) / x / x)
            g[k], slope[k] = math.copysign(x * more, z), (1.0 + 1.0 / x / x) / more / noise
            continue
        log_p = log_chance(size, wide)
        root = math.sqrt(max(2.0 * (none - log_p), 0.0))
        if size < NEAR or root == 0.0:
            g[k], slope[k] = tangent * z, tangent / noise
        else:
            x = size - half
            falls = math.exp(-0.5 * x * x - HALF_LOG_2PI - log_p) * -math.expm1(-size * wide)
            g[k], slope[k] = math.copysign(root, z), falls / root / noise
    return g, slope
