"""Residuals of records that are rounded to steps: what a rounded value says of the value before rounding, and no more.

A value z away from the model's was rounded from anywhere within half a step of it, so with white noise of standard
deviation s below a step D its likelihood is P(z) = Phi((z + D/2)/s) - Phi((z - D/2)/s). Taken for white noise of
D/sqrt(12) instead, a steady stretch, where the rounding error is the same in every row, would reward whatever moves the
model by that error. As a residual: g(z) = sign(z) sqrt(-2 log(P(z)/P(0))), whose squares add up to the deviance.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.special import log_ndtr

from hvdc_ident.trajectory import Array

NEAR = 1e-4
"""Misfits below this share of the noise, where the difference of two logarithms has no digits left, take the tangent at 0."""
FAR = 1e3
"""Standard deviations beyond half a step from which the tail's expansion stands for logarithms that differ by less than their own error."""
REACH = 10.0
"""Standard deviations beyond half a step to which the mean of g^2 is integrated."""
POINTS = 4001


@dataclass(frozen=True)
class Rounding:
    """Rounding to multiples of `step`, of values with white noise of standard deviation `noise`; both in the output's unit."""

    step: float
    noise: float

    def residual(self, misfit: Array) -> tuple[Array, Array]:
        """g, without unit, and dg/dz, per unit of the output, of measured - simulated, any shape.

        For noise much above the step g is z/sqrt(noise^2 + step^2/12); for noise much below it is 0 within half a step
        and (|z| - step/2)/noise beyond.
        """
        return _residual(np.asarray(misfit, dtype=float) / self.noise, self.step / self.noise, self.noise)

    @property
    def spare(self) -> float:
        """1 less the mean of g^2 where only noise and rounding are left, all levels between two steps being as likely.

        Added to every square, it makes a sum of squares of nothing but noise as large as the number of rows.
        """
        return _spare(self.step / self.noise)


def _log_chance(z: Array, step: float) -> Array:
    """log P for z >= 0 in units of the noise, also where P itself is below the smallest number."""
    upper, lower = log_ndtr(0.5 * step - z), log_ndtr(-0.5 * step - z)
    d = lower - upper
    # log(1 - exp(d)) with all digits on either side
    with np.errstate(divide="ignore"):
        rest = np.where(d > -np.log(2.0), np.log(-np.expm1(np.minimum(d, -1e-300))), np.log1p(-np.exp(d)))
    return np.asarray(upper + rest)


def _residual(z: Array, step: float, noise: float) -> tuple[Array, Array]:
    """g and dg/dz from misfit and step in units of the noise."""
    whole = np.abs(z)
    size = np.minimum(whole, FAR + 0.5 * step)
    log_p = _log_chance(size, step)
    none = float(_log_chance(np.zeros(1), step)[0])
    tangent = float(np.sqrt(np.exp(_log_density(0.5 * step) - none) * step))
    g = np.sqrt(np.maximum(2.0 * (none - log_p), 0.0))
    falls = np.exp(_log_density(size - 0.5 * step) - log_p) * -np.expm1(-size * step)
    near = (size < NEAR) | (g == 0.0)
    slope = np.where(near, tangent, falls / np.where(near, 1.0, g))
    # Phi(-x) = phi(x)/x (1 - 1/x^2 ...), so that dlog Phi(-x)/dx = -(x + 1/x ...)
    x = np.maximum(whole - 0.5 * step, FAR)
    more = np.sqrt(1.0 + (2.0 * (none + np.log(x)) + np.log(2.0 * np.pi)) / x / x)
    far = whole - 0.5 * step > FAR
    g, slope = np.where(far, x * more, g), np.where(far, (1.0 + 1.0 / x / x) / more, slope)
    return np.where(near, tangent * z, np.sign(z) * g), slope / noise


def _log_density(x: Array | float) -> Array:
    return np.asarray(-0.5 * np.square(x) - 0.5 * np.log(2.0 * np.pi))


@lru_cache(maxsize=256)
def _spare(step: float) -> float:
    """1 - (1/D) integral of P g^2 over all misfits, in units of the noise: each level's rounded values, over all levels."""
    z = np.linspace(0.0, 0.5 * step + REACH, POINTS)
    g, _ = _residual(z, step, 1.0)
    return 1.0 - 2.0 * float(np.trapezoid(np.exp(_log_chance(z, step)) * g**2, z)) / step
