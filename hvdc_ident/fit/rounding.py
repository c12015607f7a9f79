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

from hvdc_ident.data import Array
from hvdc_ident.fit.rounded import log_chances, residuals

REACH = 10.0
"""Standard deviations beyond half a step to which the mean of g^2 is integrated."""
POINTS = 4001


@dataclass(frozen=True)
class QuantisedNoise:
    """QuantisedNoise to multiples of `step`, of values with white noise of standard deviation `noise`; both in the output's unit."""

    step: float
    noise: float

    def residual(self, misfit: Array) -> tuple[Array, Array]:
        """g, without unit, and dg/dz, per unit of the output, of measured - simulated, any shape.

        For noise much above the step g is z/sqrt(noise^2 + step^2/12); for noise much below it is 0 within half a step
        and (|z| - step/2)/noise beyond.
        """
        rows = np.asarray(misfit, dtype=float)
        g, slope = residuals(rows.ravel(), self.step, self.noise)
        return g.reshape(rows.shape), slope.reshape(rows.shape)

    @property
    def spare(self) -> float:
        """1 less the mean of g^2 where only noise and rounding are left, all levels between two steps being as likely.

        Added to every square, it makes a sum of squares of nothing but noise as large as the number of rows.
        """
        return _spare(self.step / self.noise)


@lru_cache(maxsize=256)
def _spare(step: float) -> float:
    """1 - (1/D) integral of P g^2 over all misfits, in units of the noise: each level's rounded values, over all levels."""
    z = np.linspace(0.0, 0.5 * step + REACH, POINTS)
    g, _ = residuals(z, step, 1.0)
    return 1.0 - 2.0 * float(np.trapezoid(np.exp(log_chances(z, step)) * g**2, z)) / step
