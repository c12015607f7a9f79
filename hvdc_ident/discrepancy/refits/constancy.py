"""Test that an effect has one size in all experiments: one named in another's stead has a size of its own in each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.refits.begin import Placed
from hvdc_ident.discrepancy.refits.nominal import Nominal, unit_columns
from hvdc_ident.discrepancy.refits.refit import Refit
from hvdc_ident.effects import effects

TOLD = 1e-4
"""Share of a slope that has to be left by all the parameters for the data to tell of a size in one experiment alone."""


@dataclass(frozen=True)
class Constancy:
    """Gain of one size per experiment. told: the fall of chi2; p: the chance of such a fall under noise."""

    told: float
    p: float


NOTHING = Constancy(0.0, 1.0)


def constancy(refit: Refit, left: Nominal, placed: Placed) -> Constancy:
    """F test, to first order, that the experiments ask for different sizes of an effect.

    p = 1 where only one experiment tells of it, and for effects whose answer has steps in their size: those have
    no slopes. left: the refit's residuals.

    Source: Chow, Econometrica 28 (1960), as a score test.
    """
    names = left.problem.names
    own = [names.index(n) for n in placed.names.values() if n in names]
    if effects()[placed.candidate.effect].needs_grid or not own:
        return NOTHING
    more = _by_experiment(left, own)
    spare = refit.effective - left.basis.shape[1] - more.shape[1]
    if not more.shape[1] or spare < 1.0:
        return NOTHING
    remains = left.projected(left.residual)
    told = float(np.sum((more.T @ remains) ** 2))
    share = told / max(float(remains @ remains) - told, np.finfo(float).tiny)
    return Constancy(told, float(fdtrc(more.shape[1], spare, share * spare / more.shape[1])))


def _by_experiment(left: Nominal, own: list[int]) -> Array:
    """(N, k) orthonormal, and to the basis: what other sizes in single experiments can make of the residual."""
    slopes = np.vstack([b.jacobian for b in left.blocks])[:, own]
    experiment = np.concatenate([np.full(b.residual.size, b.experiment) for b in left.blocks])
    each = np.hstack([np.where((experiment == e)[:, None], slopes, 0.0) for e in dict.fromkeys(experiment.tolist())])
    u, s, _ = np.linalg.svd(left.projected(unit_columns(each)), full_matrices=False)
    return np.asarray(u[:, s > TOLD])
