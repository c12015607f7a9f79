"""What a residual costs: half its square, or less where it is an outlier.

A robust loss is put as least squares of a changed residual s(r) with s^2/2 = the loss, so that every optimiser, profile
and bootstrap sees it without knowing. Tuning constants are those of 95 % efficiency in white normal noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.errors import unknown_name


@dataclass(frozen=True)
class Loss:
    """A loss of the residual in units of sigma.

    rho: from r, (n,), to the loss, r^2/2 for small r. psi: its derivative. slope: the derivative of that.
    """

    name: str
    summary: str
    rho: Callable[[Array], Array]
    psi: Callable[[Array], Array]
    slope: Callable[[Array], Array]

    @property
    def linear(self) -> bool:
        """Whether it is least squares."""
        return self.name == "linear"

    def applied(self, residual: Array, jacobian: Array) -> tuple[Array, Array]:
        """s(r), (n,), and ds/dtheta, (n, p), from r and dr/dtheta."""
        if self.linear:
            return residual, jacobian
        s = np.sign(residual) * np.sqrt(2.0 * self.rho(residual))
        near = np.abs(s) < 1e-9
        factor = np.where(near, 1.0, self.psi(residual) / np.where(near, 1.0, s))
        return s, factor[:, None] * jacobian

    def __reduce__(self) -> tuple[Callable[[str], Loss], tuple[str]]:
        return loss, (self.name,)  # functions do not travel to other processes, names do

    def efficiency(self, residual: Array) -> float:
        """mean(psi')^2 / mean(psi^2): what information a sample has of that of least squares with this sigma.

        The inverse is the factor of the estimates' variance (Huber 1964, doi 10.1214/aoms/1177703732).
        """
        power = float(np.mean(self.psi(residual) ** 2))
        return float(np.mean(self.slope(residual))) ** 2 / power if power > 0 else 1.0


HUBER, SOFT, CAUCHY = 1.345, 1.287, 2.385


def _huber_rho(r: Array) -> Array:
    a = np.abs(r)
    return np.where(a <= HUBER, 0.5 * r**2, HUBER * (a - 0.5 * HUBER))


LOSSES = {
    loss.name: loss
    for loss in (
        Loss("linear", "half the square: least squares", lambda r: 0.5 * r**2, lambda r: r, np.ones_like),
        Loss(
            "huber",
            f"the square up to {HUBER:g} sigma, then a line",
            _huber_rho,
            lambda r: np.clip(r, -HUBER, HUBER),
            lambda r: (np.abs(r) <= HUBER).astype(float),
        ),
        Loss(
            "soft-l1",
            f"a smooth way from the square to a line about {SOFT:g} sigma",
            lambda r: SOFT**2 * (np.sqrt(1.0 + (r / SOFT) ** 2) - 1.0),
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
    """The loss of that name. Raises UnknownNameError."""
    if name not in LOSSES:
        raise unknown_name("loss", name, LOSSES)
    return LOSSES[name]
