"""The likelihood of a residual: least squares, robust losses, quantised noise, and priors beside the data.

Each is put as least squares of a changed residual s(r) with s^2/2 = the loss, so that every optimiser and profile
serves all. Tuning constants of the losses are those of 95 % efficiency in white normal noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import special

from hvdc_ident.data import Array
from hvdc_ident.errors import StudyError, require_known


@dataclass(frozen=True)
class Loss:
    """A loss of the residual in units of sigma.

    summary: in words, for the reference. rho: from r, (n,), to the loss, r^2/2 for small r. psi: its derivative. slope: the derivative
    of that.
    """

    name: str
    summary: str
    rho: Callable[[Array], Array]
    psi: Callable[[Array], Array]
    slope: Callable[[Array], Array]

    @property
    def linear(self) -> bool:
        """True for least squares."""
        return self.name == "linear"

    def applied(self, residual: Array, jacobian: Array) -> tuple[Array, Array]:
        """Return s(r), (n,), and ds/dtheta, (n, p), from r and dr/dtheta."""
        if self.linear:
            return residual, jacobian
        s = np.sign(residual) * np.sqrt(2.0 * self.rho(residual))
        near = np.abs(s) < 1e-9
        factor = np.where(near, 1.0, self.psi(residual) / np.where(near, 1.0, s))
        return s, factor[:, None] * jacobian

    def __reduce__(self) -> tuple[Callable[[str], Loss], tuple[str]]:
        return loss, (self.name,)  # functions do not travel to other processes, names do

    def efficiency(self, residual: Array) -> float:
        """Return mean(psi')^2 / mean(psi^2), a sample's information relative to that of least squares with this sigma.

        The inverse is the factor of the estimates' variance (Huber 1964, doi 10.1214/aoms/1177703732).
        """
        power = float(np.mean(self.psi(residual) ** 2))
        return float(np.mean(self.slope(residual))) ** 2 / power if power > 0 else 1.0


HUBER, SOFT, CAUCHY = 1.345, 1.287, 2.385
"""Sizes of the losses, in sigma."""

LOSSES = {
    loss.name: loss
    for loss in (
        Loss("linear", "half the square: least squares", lambda r: 0.5 * r**2, lambda r: r, np.ones_like),
        Loss(
            "huber",
            f"the square up to {HUBER:g} sigma, then a line",
            lambda r: np.asarray(special.huber(HUBER, r)),
            lambda r: np.clip(r, -HUBER, HUBER),
            lambda r: (np.abs(r) <= HUBER).astype(float),
        ),
        Loss(
            "soft-l1",
            f"a smooth way from the square to a line about {SOFT:g} sigma",
            lambda r: np.asarray(special.pseudo_huber(SOFT, r)),
            lambda r: r / np.sqrt(1.0 + (r / SOFT) ** 2),
            lambda r: (1.0 + (r / SOFT) ** 2) ** -1.5,
        ),
        Loss(
            "cauchy",
            f"the logarithm beyond {CAUCHY:g} sigma; may have several optima",
            lambda r: 0.5 * CAUCHY**2 * np.log1p((r / CAUCHY) ** 2),
            lambda r: r / (1.0 + (r / CAUCHY) ** 2),
            lambda r: (1.0 - (r / CAUCHY) ** 2) / (1.0 + (r / CAUCHY) ** 2) ** 2,
        ),
    )
}


def loss(name: str) -> Loss:
    """Return the loss of that name. Raises UnknownNameError."""
    require_known("loss", [name], LOSSES, "")
    return LOSSES[name]


@dataclass(frozen=True)
class Prior:
    """A normal distribution: mean and standard deviation, in the unknown's unit. It adds one residual."""

    mean: float
    std: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.mean) and math.isfinite(self.std) and self.std > 0):
            raise StudyError(
                "a prior is wrong",
                expected="a finite mean and a finite standard deviation above 0",
                got=f"mean {self.mean:g}, std {self.std:g}",
            )


def prior_rows(priors: Mapping[str, Prior], names: Sequence[str], theta: Array) -> tuple[Array, Array]:
    """Return the residuals (theta - mean)/std, (k,), and their derivatives, (k, p), of the unknowns that have a prior."""
    chosen = [(i, priors[n]) for i, n in enumerate(names) if n in priors]
    residual = np.array([(theta[i] - p.mean) / p.std for i, p in chosen])
    jacobian = np.zeros((len(chosen), len(names)))
    for row, (i, p) in enumerate(chosen):
        jacobian[row, i] = 1.0 / p.std
    return residual, jacobian


REACH = 10.0
"""Standard deviations beyond half a step to which the mean of g^2 is integrated."""
POINTS = 4001
HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)
NEAR = 1e-4
"""Misfits below this share of the noise, where the difference of two logarithms has no digits left, take the tangent at 0."""
FAR = 1e3
"""Standard deviations beyond half a step from which the tail's expansion stands for logarithms that differ by less than their own error."""


def log_chances(z: Array, step: float) -> Array:
    """Return log(Phi(z + step/2) - Phi(z - step/2)) of every row, (n,), for z >= 0 in units of the noise, also where that is below
    the smallest number."""
    upper, lower = special.log_ndtr(0.5 * step - z), special.log_ndtr(-0.5 * step - z)
    d = lower - upper
    # log(1 - exp(d)) with all digits on either side
    near = d > -math.log(2.0)
    with np.errstate(divide="ignore"):
        small = np.log(-np.expm1(np.where(near, np.minimum(d, -1e-300), -1.0)))
    return np.asarray(upper + np.where(near, small, np.log1p(-np.exp(np.where(near, -1.0, d)))))


def quantised_residuals(misfit: Array, step: float, noise: float) -> tuple[Array, Array]:
    """Return g and dg/dz of every row, (n,), from misfit (n,), step and noise, all in the output's unit."""
    z = misfit / noise
    size, wide = np.abs(z), step / noise
    half = 0.5 * wide
    none = float(log_chances(np.zeros(1), wide)[0])
    tangent = math.sqrt(math.exp(-0.5 * half * half - HALF_LOG_2PI - none) * wide)
    g, slope = tangent * z, np.full(z.size, tangent / noise)
    far = size - half > FAR
    # Phi(-x) = phi(x)/x (1 - 1/x^2 ...), so that dlog Phi(-x)/dx = -(x + 1/x ...)
    x = size[far] - half
    more = np.sqrt(1.0 + (2.0 * (none + np.log(x)) + 2.0 * HALF_LOG_2PI) / x / x)
    g[far], slope[far] = np.copysign(x * more, z[far]), (1.0 + 1.0 / x / x) / more / noise
    log_p = np.full(z.size, none)
    log_p[~far] = log_chances(size[~far], wide)
    root = np.sqrt(np.maximum(2.0 * (none - log_p), 0.0))
    between = ~far & (size >= NEAR) & (root > 0.0)
    x = size[between] - half
    falls = np.exp(-0.5 * x * x - HALF_LOG_2PI - log_p[between]) * -np.expm1(-size[between] * wide)
    g[between], slope[between] = np.copysign(root[between], z[between]), falls / root[between] / noise
    return g, slope


@dataclass(frozen=True)
class QuantisedNoise:
    """White noise of standard deviation `noise`, its values rounded to multiples of `step`; both in the output's unit.

    A value z away from the model's was rounded from anywhere within half a step D of it, so its likelihood is
    P(z) = Phi((z + D/2)/s) - Phi((z - D/2)/s) with s the noise. Taken for white noise of D/sqrt(12) instead, a steady
    stretch, where the rounding error is the same in every row, would reward whatever moves the model by that error. As a
    residual: g(z) = sign(z) sqrt(-2 log(P(z)/P(0))), whose squares add up to the deviance.
    """

    step: float
    noise: float

    def residual(self, misfit: Array) -> tuple[Array, Array]:
        """Return g, without unit, and dg/dz, per unit of the output, of measured - simulated, any shape.

        For noise much above the step g is z/sqrt(noise^2 + step^2/12); for noise much below it is 0 within half a step
        and (|z| - step/2)/noise beyond.
        """
        rows = np.asarray(misfit, dtype=float)
        g, slope = quantised_residuals(rows.ravel(), self.step, self.noise)
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
    g, _ = quantised_residuals(z, step, 1.0)
    return 1.0 - 2.0 * float(np.trapezoid(np.exp(log_chances(z, step)) * g**2, z)) / step
