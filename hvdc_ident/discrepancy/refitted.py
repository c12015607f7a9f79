"""How good what refits come to is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hvdc_ident.discrepancy.evidence import CandidateFit, level_error, unseen_rows
from hvdc_ident.discrepancy.implied import TIED, off_given
from hvdc_ident.discrepancy.nominal import Nominal, of_held_out
from hvdc_ident.discrepancy.options import SURE
from hvdc_ident.discrepancy.refit import Refit, unseen
from hvdc_ident.discrepancy.residual_checks import loud_after_breaks, residual_tests

PRICE = 8.0
"""Of a parameter, in units of chi2: the logarithm of a few thousand rows."""
NEAR = 0.05
"""Share of what the model before leaves beyond noise that a good candidate may leave too: its noise is not known better."""
LOUD = 1.4
"""Times the noise's power up to which what is left may be noise that is louder than it was taken for."""
SHAPED = 0.05
"""Chance under noise of sums over time below which what is left has a shape."""
FAINT = 0.1
"""Correlation of neighbours up to which nothing is made of it: records that stand still are rounded alike."""
LOOKED_AT = 3
"""Of the refits the best, of which this is asked."""
TELLING = 0.1
"""Share of what the model before leaves beyond noise from which it is: noise that is louder than was told leaves falls too."""


def telling(before: Refit) -> float:
    """The fall of chi2 from which a refit is more than what noise that is louder than was told leaves to take away."""
    return TELLING * (before.chi2 - before.rows)


def best_each(trials: Sequence[CandidateFit]) -> list[CandidateFit]:
    """Of the trials of each candidate the best, in their order; of those that are as good the one with the values nearest to the
    given ones."""
    kept: dict[int, CandidateFit] = {}
    for t in trials:
        had = kept.get(t.pick.candidate)
        if had is None or had.refit.failure:
            kept[t.pick.candidate] = t
        elif not t.refit.failure:
            first, other = sorted((had, t), key=cost_of)
            tied = cost_of(other) - cost_of(first) <= TIED and off_given(other.refit) < off_given(first.refit)
            kept[t.pick.candidate] = other if tied else first
    return list(kept.values())


def by_cost(trials: Sequence[CandidateFit]) -> list[CandidateFit]:
    """Those that came to a result, the best first."""
    return sorted((t for t in trials if not t.refit.failure), key=cost_of)


def cost_of(trial: CandidateFit) -> float:
    """Chi2 of a refit on all data plus the price of its parameters, before the scale of BIC is known."""
    refit, held = trial.refit, unseen(trial.refit)
    return refit.chi2 + PRICE * refit.count + (held**2 * unseen_rows(refit) if held is not None else 0.0)


def excess(refit: Refit) -> bool:
    """Return True where a model leaves more than noise, by size."""
    return refit.chi2 / refit.rows > 1.0 + SURE * _power_error(refit)


def misses(refit: Refit) -> bool:
    """Return True where a model leaves more of unseen data than of those it was fitted to, by more than chance."""
    seen, now = max(refit.chi2 / refit.rows, 1.0), unseen(refit)
    return now is not None and now**2 > seen * (1.0 + SURE * _power_error(refit))


def _power_error(refit: Refit) -> float:
    """Standard error of the mean square of noise over its level: of the rows, and of a level that is estimated (F distribution)."""
    return float(np.hypot(np.sqrt(2.0 / refit.effective), level_error(refit)))


def left_by(refit: Refit) -> float:
    """Misfit beyond noise per row, of the fitted data or of the others."""
    return max(refit.chi2 / refit.rows, (unseen(refit) or 0.0) ** 2) - 1.0


def all_far(before: Refit, trials: Sequence[CandidateFit], near: float = NEAR) -> bool:
    """Return True where no refit comes near the noise, or to a small share of the misfit before, on fitted and held-out data."""
    far = all(_leaves_much(before, t.refit, near) for t in trials if not t.refit.failure)
    return far and not any(like_noise(t.refit) for t in by_cost(trials)[:LOOKED_AT])


def is_far(before: Refit, refit: Refit) -> bool:
    """Return True where this refit does not come near the noise, or to a small share of the misfit before."""
    return _leaves_much(before, refit, NEAR) and not like_noise(refit)


def _leaves_much(before: Refit, refit: Refit, near: float) -> bool:
    return (excess(refit) or misses(refit)) and left_by(refit) > near * left_by(before)


def like_noise(refit: Refit) -> bool:
    """Return True where the residual is without shape, though somewhat loud: noise is told from few rows.

    Of the held-out data too, where more is left of them: their noise may be louder than that of the others.
    """
    seen, now = max(refit.chi2 / refit.rows, 1.0), unseen(refit)
    if seen > LOUD or refit.correlation > FAINT or (now is not None and now**2 > LOUD * seen):
        return False
    left = refit.nominal()
    if loud_after_breaks(left) or not shapeless(left, 0):
        return False
    if not misses(refit):
        return True
    held = of_held_out(refit.problem)
    return held is not None and shapeless(Nominal(held, refit.theta[: len(held.free)], refit.noise), 0)


def is_noise(refit: Refit, seed: int) -> bool:
    """Return True where the residual is noise, by its size and over time: then there is nothing more to look for."""
    return not excess(refit) and shapeless(refit.nominal(), seed)


def shapeless(nominal: Nominal, seed: int) -> bool:
    """Return True where sums of the residual over time are like those of noise."""
    return all(b.p > SHAPED for b in residual_tests(nominal, {}, bootstraps=100, seed=seed))
