"""Signs that the model lacks an effect: experiments that disagree on a parameter, residuals larger than the noise.

And what the noise alone would let the records tell of a parameter that such a misfit hides.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from scipy.special import chdtrc

from hvdc_ident.data import Array
from hvdc_ident.fit import FitParameter
from hvdc_ident.fit.adequacy import LEVEL
from hvdc_ident.fit.uncertainty import TWO_SIDED, score_covariance
from hvdc_ident.identifiability.pilot_fit import LocalAnalysis
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.next_step import NextStep
from hvdc_ident.sensitivity import independent, normalised, pivoted_order, standard_deviations
from hvdc_ident.text import percentage, span, times_text

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


def heterogeneity(optimum: LocalAnalysis) -> FrozenMap[Heterogeneity]:
    """Return the test by parameter, for those on which at least two experiments tell something.

    A score test: at the common optimum the gradients g_e of the experiments alone have the covariance of noise that a
    common fit leaves; AR(1) within a record is allowed for as in the standard deviations. What a single parameter of
    its own per experiment would gain is g' V^+ g, chi-square under agreement.
    """
    names = list(dict.fromkeys(b.experiment for b in optimum.blocks))
    scores, informations, covariance = _stacked(optimum, names)
    result: dict[str, Heterogeneity] = {}
    for i, name in enumerate(optimum.names):
        bounds = optimum.problem.free[i]
        if not bounds.min < optimum.value(name) < bounds.max:
            continue  # on a bound its gradients need not cancel
        diagonal = np.array([f[i, i] for f in informations])
        informative = np.flatnonzero(diagonal > TELLS * diagonal.sum())
        if informative.size < 2:
            continue
        rows = informative * scores.shape[1] + i
        score, variance = scores[informative, i], covariance[np.ix_(rows, rows)]
        scaled, scale = normalised(variance)
        values, vectors = np.linalg.eigh(scaled)
        good = values > 1e-6 * values[-1]
        q = float(np.sum((vectors[:, good].T @ (score / scale)) ** 2 / values[good]))
        dof = int(good.sum())
        moves = -score / diagonal[informative] * optimum.slope[i]
        weights = diagonal[informative] / diagonal[informative].sum()
        spread = float(np.sqrt(weights @ (moves - weights @ moves) ** 2))
        estimates = {names[e]: optimum.value(name) + float(m) for e, m in zip(informative, moves, strict=True)}
        i2 = max(0.0, (q - dof) / q) if q > 0 else 0.0
        result[name] = Heterogeneity(q, dof, float(chdtrc(dof, q)), i2, spread, FrozenMap(estimates))
    return FrozenMap(result)


def _stacked(optimum: LocalAnalysis, names: list[str]) -> tuple[Array, list[Array], Array]:
    """Return (E, p) scores, E informations, and the (E p, E p) covariance of the scores that a common fit leaves."""
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
    """Signs in words that the model lacks something, and the test of whether the experiments agree, by parameter."""

    signs: tuple[str, ...] = ()
    heterogeneity: FrozenMap[Heterogeneity] = field(default_factory=FrozenMap)
    stored_properties: ClassVar[tuple[str, ...]] = ("next",)

    @property
    def flag(self) -> bool:
        """True where the model lacks something."""
        return bool(self.signs)

    @property
    def next(self) -> NextStep | None:
        """The diagnosis, which looks for what the model lacks; None where nothing shows that it does."""
        return NextStep("diagnose") if self.signs else None


def misspecification(
    optimum: LocalAnalysis, tests: FrozenMap[Heterogeneity], units: dict[str, str]
) -> Misspecification:
    """Return the signs: experiments that disagree on a parameter, or residuals larger than the noise given.

    LEVEL is that of the test of all parameters together (Bonferroni). With noise of 1e-4 everything is significant: so each sign is
    given with its size, in the parameter's unit.
    """
    signs = []
    for name, h in tests.items():
        if h.p < LEVEL / len(tests) and h.i2 > 0.5:
            ends = span(min(h.estimates.values()), max(h.estimates.values()), units.get(name, ""), word="to")
            signs.append(
                f"the experiments disagree on {name}: alone they would put it at {ends} "
                f"(Q {h.q:.0f} for {h.dof} degree{'' if h.dof == 1 else 's'} of freedom, I2 {percentage(h.i2)})"
            )
    if optimum.excess > 1.0:
        signs.append(f"the residuals are {times_text(float(np.sqrt(optimum.excess)))} the noise")
    return Misspecification(tuple(signs), tests)


def noise_half_widths(whole: LocalAnalysis, fitted: Sequence[str], others: Sequence[str]) -> dict[str, float]:
    """Return the half-width of the 95 % interval that the noise alone would leave each of `others`, in its unit.

    whole: all candidates free. fitted: those fitted anyway. Only those are in it that can be estimated beside them: the best
    determined first, as long as no direction is lost and every interval is narrower than its bounds. The misfit has no
    part in it, so this is what the records could tell of a model that explains them (Cramer and Rao's bound, at first order).
    """
    free = {f.name: f for f in whole.problem.free}
    names = [n for n in whole.names if n in fitted or n in others]
    matrix = whole.information.select(names).matrix
    slope = dict(zip(whole.problem.names, whole.slope.tolist(), strict=True))
    order = [names[i] for i in pivoted_order(matrix)]
    selected, widths = [n for n in order if n in fitted], dict[str, float]()
    for n in (n for n in order if n in others):
        proposal = [*selected, n]
        part = whole.information.select(proposal).matrix
        if len(independent(part, whole.error)) < len(proposal):
            continue
        halves = np.sqrt(2.0 * TWO_SIDED) * standard_deviations(part)
        if all(h * slope[m] < _room(free[m], whole.value(m)) for m, h in zip(proposal, halves.tolist(), strict=True)):
            selected = proposal
            widths[n] = float(halves[-1] * slope[n])
    return widths


def _room(free: FitParameter, value: float) -> float:
    """Return half of the range between the bounds as the unknown is scaled, in its unit at `value`; infinite without bounds."""
    return 0.5 * (value * math.log(free.max / free.min) if free.log else free.max - free.min)
