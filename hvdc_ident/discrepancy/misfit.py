"""Misfit of a refit: how much more than noise it leaves, of the fitted records and of the others, and whether that has a shape."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.hypothesis import Refit
from hvdc_ident.discrepancy.nominal import Nominal, noise_left, of_held_out
from hvdc_ident.discrepancy.options import REFUTED, DiagnosisOptions
from hvdc_ident.discrepancy.residual_checks import is_louder_after_breaks, residual_tests
from hvdc_ident.fit.adequacy import MATTERS
from hvdc_ident.fit.noise import SURE, freedom_of

MAX_NOISE_POWER = 1.4
"""Times the noise's power up to which what is left may be noise that is louder than it was taken for."""
STRUCTURE_P = 0.01
"""Chance under noise of sums over time below which what is left has a shape: as small as for an effect to be named."""
MAX_LAG1_AUTOCORRELATION = 0.1
"""Correlation of neighbours up to which nothing is made of it: records that stand still are rounded alike."""


@lru_cache(maxsize=512)
def misfit_of(refit: Refit) -> Misfit:
    """Return the misfit of a refit, worked out once."""
    return Misfit(refit)


@dataclass(frozen=True, eq=False)
class Misfit:
    """The misfit of a refit, in units of the noise."""

    refit: Refit

    @property
    def power(self) -> float:
        """Mean square of the fitted residuals."""
        return self.refit.chi2 / self.refit.rows

    @property
    def level_error(self) -> float:
        """Relative standard error of the noise's power, where its level is estimated; 0 where it is stated."""
        return float(np.sqrt(2.0 / freedom_of(self.refit.noise, self.refit.problem.outputs)))

    @property
    def power_error(self) -> float:
        """Standard error of the mean square of noise over its level: of the rows, and of a level that is estimated (F distribution)."""
        return float(np.hypot(np.sqrt(2.0 / self.refit.effective), self.level_error))

    @property
    def beyond(self) -> float:
        """Mean square beyond noise, of the fitted records or of the others, whichever is larger."""
        return max(self.power, (self.refit.predicted or 0.0) ** 2) - 1.0

    @property
    def is_loud(self) -> bool:
        """True where it is more than noise, by its size."""
        return self.power > 1.0 + SURE * self.power_error

    @property
    def is_louder_unseen(self) -> bool:
        """True where more is left of unseen data than of those that were fitted, by more than chance."""
        seen, now = max(self.power, 1.0), self.refit.predicted
        return now is not None and now**2 > seen * (1.0 + SURE * self.power_error)

    def is_louder_than(self, share: float) -> bool:
        """Return True where it is larger than the noise by more than a share of it, in amplitude, and by more than an estimated noise
        may be off."""
        return self.power > (1.0 + share) ** 2 + SURE * self.level_error

    @cached_property
    def has_shape(self) -> bool:
        """True where sums of the residual over time are unlike those of noise."""
        return not _is_unstructured(self.refit.nominal())

    @cached_property
    def is_noise(self) -> bool:
        """True where it is noise, or noise somewhat louder than it was taken for: without a shape, in the held-out records too."""
        if not self.is_loud and not self.is_louder_unseen:
            return not self.has_shape
        r = self.refit
        seen, now = max(self.power, 1.0), r.predicted
        if (
            seen > MAX_NOISE_POWER
            or r.correlation > MAX_LAG1_AUTOCORRELATION
            or (now is not None and now**2 > MAX_NOISE_POWER * seen)
        ):
            return False
        if is_louder_after_breaks(r.nominal()) or self.has_shape:
            return False
        if not self.is_louder_unseen:
            return True
        held = of_held_out(r.problem)
        return held is not None and _is_unstructured(Nominal(held, r.theta[: len(held.free)], r.noise))

    def refutes(self, before: Misfit) -> bool:
        """Return True where it refutes what was added: it is more than noise, and more than a small share of the misfit before."""
        return (self.is_loud or self.is_louder_unseen) and self.beyond > REFUTED * before.beyond and not self.is_noise

    @cached_property
    def floor(self) -> float:
        """Mean square that counts as noise: of the rows at rest before the events, or of all where they look like noise."""
        floor = noise_left(self.refit.nominal())
        # What looks like noise is the noise, as loud as it is: that of rounded records is not known beforehand.
        return floor if self.has_shape else max(floor, self.power)

    @cached_property
    def power_by_output(self) -> dict[str, float]:
        """Mean square of the residual of each output."""
        each: dict[str, list[Array]] = {}
        for b in self.refit.nominal().blocks:
            each.setdefault(b.output, []).append(b.residual)
        return {o: float(np.mean(np.concatenate(parts) ** 2)) for o, parts in each.items()}

    @property
    def matters(self) -> bool:
        """True where an output's residual is so much louder than its noise that intervals by the noise are wrong."""
        return max(self.power_by_output.values(), default=0.0) > MATTERS

    @cached_property
    def largest_rmse(self) -> dict[str, float]:
        """The largest RMSE of each output over all experiments, in its unit."""
        table = self.refit.problem.rmse(self.refit.theta)
        known = {o: [v for v in row.values() if v is not None] for o, row in table.items()}
        return {o: max(values) for o, values in known.items() if values}

    @cached_property
    def as_recorded(self) -> dict[str, float]:
        """By role of the experiments the misfit in standard deviations of the noise, pooled and not whitened."""
        roles = {e.name: e.role for e in self.refit.problem.experiments}
        squares: dict[str, list[float]] = {}
        for output, row in self.refit.problem.rmse(self.refit.theta).items():
            std = self.refit.noise[output].std
            for name, rmse in row.items():
                if rmse is not None and std:
                    squares.setdefault(roles[name], []).append((rmse / std) ** 2)
        return {role: float(np.sqrt(np.mean(parts))) for role, parts in squares.items()}

    def keeps(self, tolerance: Mapping[str, float]) -> bool:
        """Return True where a tolerance is stated and every signal that has one keeps it."""
        return bool(tolerance) and all(self.largest_rmse.get(o, np.inf) <= band for o, band in tolerance.items())

    def is_material(self, tolerance: Mapping[str, float], options: DiagnosisOptions) -> bool:
        """Return True where it is more than the tolerance, or where none is stated clearly more than the noise."""
        if tolerance:
            return any(self.largest_rmse.get(o, 0.0) > band for o, band in tolerance.items())
        unseen = self.refit.unseen
        return self.is_louder_than(options.holdout_share) or (
            unseen is not None and unseen - 1.0 > options.holdout_share
        )

    def is_fall_material(self, before: Misfit, tolerance: Mapping[str, float], options: DiagnosisOptions) -> bool:
        """Return True where the fall from the misfit before is of interest: held out, in noise units; or by output beyond its
        tolerance."""
        share = options.holdout_share
        if tolerance:
            was, now = before.largest_rmse, self.largest_rmse
            return any(was[o] > band and was[o] - now[o] > share * band for o, band in tolerance.items() if o in was)
        return is_material_fall(before.refit.predicted, self.refit.predicted, share)


def is_material_fall(before: float | None, after: float | None, share: float) -> bool:
    """Return True where the fall of a pooled misfit, in noise units, is of interest."""
    return before is not None and after is not None and before - after > share


def _is_unstructured(nominal: Nominal) -> bool:
    """Return True where sums of the residual over time are like those of noise."""
    return all(b.p > STRUCTURE_P for b in residual_tests(nominal, {}, bootstraps=200, seed=0))
