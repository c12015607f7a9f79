"""Whether the experiments agree on the parameters: the first sign of an effect the model lacks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from hvdc_ident.data import Array
from hvdc_ident.fit.adequacy import times_text
from hvdc_ident.fit.uncertainty import score_covariance
from hvdc_ident.identifiability.pilot import Optimum
from hvdc_ident.immutable import FrozenMap

LEVEL = 0.01
TELLS = 0.01
"""An experiment with less than this share of a parameter's information is not asked for its own estimate of it."""


@dataclass(frozen=True)
class Heterogeneity:
    """Cochran's Q for one parameter: q, its degrees of freedom and p; i2: the share of the scatter that is not noise.

    estimates: what each telling experiment would move the parameter to, the others held, in the parameter's unit.
    spread: their standard deviation, weighted by information, in the same unit.
    """

    q: float
    dof: int
    p: float
    i2: float
    spread: float
    estimates: FrozenMap[float]


def heterogeneity(optimum: Optimum) -> FrozenMap[Heterogeneity]:
    """The test by parameter, for those on which at least two experiments tell something.

    A score test: at the common optimum the gradients g_e of the experiments alone have the covariance of noise that a
    common fit leaves; AR(1) within a record is allowed for as in the standard deviations. What a single parameter of
    its own per experiment would gain is g' V^+ g, chi-square under agreement.
    """
    names = list(dict.fromkeys(b.experiment for b in optimum.blocks))
    scores, informations, covariance = _stacked(optimum, names)
    found: dict[str, Heterogeneity] = {}
    for i, name in enumerate(optimum.names):
        bounds = optimum.problem.free[i]
        if not bounds.min < optimum.value(name) < bounds.max:
            continue  # on a bound its gradients need not cancel
        own = np.array([f[i, i] for f in informations])
        tell = np.flatnonzero(own > TELLS * own.sum()) if own.sum() > 0 else np.array([], dtype=int)
        if tell.size < 2:
            continue
        rows = tell * scores.shape[1] + i
        v, spread = scores[tell, i], covariance[np.ix_(rows, rows)]
        d = np.sqrt(np.clip(np.diag(spread), 1e-300, None))
        values, vectors = np.linalg.eigh(spread / np.outer(d, d))
        good = values > 1e-6 * values[-1]
        q = float(np.sum((vectors[:, good].T @ (v / d)) ** 2 / values[good]))
        dof = int(good.sum())
        moves = -v / own[tell] * optimum.slope[i]
        weights = own[tell] / own[tell].sum()
        scatter = float(np.sqrt(weights @ (moves - weights @ moves) ** 2))
        estimates = {names[e]: optimum.value(name) + float(m) for e, m in zip(tell, moves, strict=True)}
        found[name] = Heterogeneity(
            q, dof, float(chdtrc(dof, q)), max(0.0, (q - dof) / q) if q > 0 else 0.0, scatter, FrozenMap(estimates)
        )
    return FrozenMap(found)


def _stacked(optimum: Optimum, names: list[str]) -> tuple[Array, list[Array], Array]:
    """(E, p) scores, E informations, and the (E p, E p) covariance of the scores that a common fit leaves."""
    p = optimum.theta.size
    scores = np.zeros((len(names), p))
    informations = [np.zeros((p, p)) for _ in names]
    meats = [np.zeros((p, p)) for _ in names]
    for b in optimum.blocks:
        e, j = names.index(b.experiment), b.jacobian * optimum.slope
        scores[e] += j.T @ b.residual
        informations[e] += j.T @ j
        meats[e] += score_covariance(j, optimum.uncertainty.rho[b.output])
    whole = np.linalg.pinv(sum(informations, np.zeros((p, p))), hermitian=True)
    size = len(names) * p
    project, meat = np.eye(size), np.zeros((size, size))
    for e, f in enumerate(informations):
        row = slice(e * p, (e + 1) * p)
        project[row] -= np.tile(f @ whole, (1, len(names)))
        meat[row, row] = meats[e]
    return scores, informations, project @ meat @ project.T


@dataclass(frozen=True)
class Misspecification:
    """Whether the model lacks something, and the signs of it in words."""

    flag: bool
    signs: tuple[str, ...]
    pointer: str = ""


def misspecification(optimum: Optimum, found: FrozenMap[Heterogeneity], units: dict[str, str]) -> Misspecification:
    """The flag and its reasons: experiments that disagree on a parameter, or residuals larger than the noise given.

    With noise of 1e-4 everything is significant: so each sign is given with its size, in the parameter's unit.
    """
    signs = []
    for name, h in found.items():
        if h.p < LEVEL / len(found) and h.i2 > 0.5:
            low, high = min(h.estimates.values()), max(h.estimates.values())
            unit = f" {units[name]}" if units.get(name) else ""
            signs.append(
                f"the experiments disagree on {name}: alone they would put it at {low:.4g} to {high:.4g}{unit} "
                f"(Q {h.q:.0f} for {h.dof} degree{'' if h.dof == 1 else 's'} of freedom, I2 {100 * h.i2:.0f} %)"
            )
    if optimum.excess > 1.0:
        signs.append(f"the residuals are {times_text(float(np.sqrt(optimum.excess)))} the noise")
    pointer = "the model may lack an effect; hvdc-ident diagnose STUDY looks for it" if signs else ""
    return Misspecification(bool(signs), tuple(signs), pointer)
