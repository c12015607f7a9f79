"""What is known about an unknown before the data are looked at."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.errors import StudyError


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
    """Residuals (theta - mean)/std, (k,), and their derivatives, (k, p), of the unknowns that have a prior."""
    chosen = [(i, priors[n]) for i, n in enumerate(names) if n in priors]
    residual = np.array([(theta[i] - p.mean) / p.std for i, p in chosen])
    jacobian = np.zeros((len(chosen), len(names)))
    for row, (i, p) in enumerate(chosen):
        jacobian[row, i] = 1.0 / p.std
    return residual, jacobian
