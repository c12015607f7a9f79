"""How well an optimum is known: covariance, its inflation by autocorrelated residuals, directions not determined."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import solve_banded

from hvdc_ident.data import Array
from hvdc_ident.fit.noise import MISFIT
from hvdc_ident.fit.problem import stacked
from hvdc_ident.fit.residual import ResidualBlock
from hvdc_ident.immutable import FrozenMap

if TYPE_CHECKING:
    from hvdc_ident.fit.rough import Trend

SINGULAR = 1e-7
"""Singular values of the normalised columns below this share of the largest are the sensitivities' own error."""
UNSEEN = 1e-9
"""A parameter whose whole range moves the residual by less than this has no effect."""

FEWEST_ROWS = 4
"""From fewer rows no autocorrelation is estimated; with a few tens it is a rough guess and errs to the wide side."""


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """What the curvature of the cost says about p unknowns, each in its unit.

    raw: (p, p) inverse of J'J, as if the residuals were independent; corrected: the same for AR(1) residuals.
    Rows of unknowns in `reasons` mean nothing. singular: whether only combinations of some are determined.
    rho: AR(1) coefficient by output (0 where not significant). effective: the number of independent samples by output.
    dof: degrees of freedom of Student's t for the intervals; infinite where the noise is known and white.
    dof_independent: the same if the residuals were independent. rows: all compared ones. excess: what `corrected` was
    multiplied by, for the misfit is larger than the noise.
    """

    names: tuple[str, ...]
    raw: Array
    corrected: Array
    reasons: FrozenMap[str]
    singular: bool
    rho: FrozenMap[float]
    effective: FrozenMap[float]
    dof: float
    dof_independent: float = np.inf
    rows: int = 0
    excess: float = 1.0

    def std(self, name: str, *, raw: bool = False) -> float | None:
        """Standard deviation in the unknown's unit; None where there is a reason against it."""
        if name in self.reasons:
            return None
        i = self.names.index(name)
        return float(np.sqrt((self.raw if raw else self.corrected)[i, i]))

    def widened(self, factor: float) -> Uncertainty:
        """The same with the corrected variances multiplied; what the noise was then comes from the residuals."""
        if factor == 1.0:
            return self
        dof = max(1.0, sum(self.effective.values()) - len(self.names))
        alone = min(self.dof_independent, float(max(1, self.rows - len(self.names))))
        corrected = self.corrected * factor
        return replace(self, corrected=corrected, dof=min(self.dof, dof), dof_independent=alone, excess=factor)

    def on_trend(self, trend: Trend | None, names: Sequence[str]) -> Uncertainty:
        """The same with what the roughness of the cost adds. trend: None where there is none; names: of its unknowns."""
        if trend is None:
            return self
        places = [list(names).index(n) for n in self.names]
        return replace(self, raw=trend.widened(self.raw, places), corrected=trend.widened(self.corrected, places))

    def correlation(self) -> dict[str, dict[str, float]]:
        """Correlation of the estimates between those that have a standard deviation."""
        known = [i for i, n in enumerate(self.names) if n not in self.reasons]
        d = np.sqrt(np.diag(self.corrected))
        return {self.names[i]: {self.names[j]: float(self.corrected[i, j] / d[i] / d[j]) for j in known} for i in known}


def autocorrelation(residuals: Sequence[Array], unknowns: float) -> float:
    """The AR(1) coefficient of several records together, 0 where it is not significant (5 %, one-sided) or negative.

    unknowns: how many parameters were fitted to them; a fit lowers the coefficient by about (k + (k + 2) rho)/n
    (Marriott and Pope 1954, for k = 1 and 2), which is added back.
    """
    n = sum(r.size for r in residuals)
    power = sum(float(r @ r) for r in residuals)
    if power == 0.0 or n < FEWEST_ROWS:
        return 0.0
    rho = sum(float(r[1:] @ r[:-1]) for r in residuals) / power
    if rho < 1.645 / np.sqrt(n):
        return 0.0
    return float(min(rho + (unknowns + (unknowns + 2.0) * rho) / n, 1.0 - 2.0 / n))


def uncertainty(
    blocks: Sequence[ResidualBlock],
    names: Sequence[str],
    spans: Array,
    source: Mapping[str, str],
    prior: Array | None = None,
    noise_dof: float = np.inf,
) -> Uncertainty:
    """What the blocks say about the unknowns whose columns they have, and the priors beside them.

    prior: (k, p) derivatives of the priors' residuals, which are independent and of standard deviation 1.
    noise_dof: independent samples behind a given noise that was estimated: the intervals are then Student's (one
    parameter's F quantile).
    spans: (p,) the range of each unknown. source: "given" or "misfit" by output: where sigma comes from.
    The correction is the sandwich (J'J)^-1 J'RJ (J'J)^-1 with R the AR(1) correlation within a record: (1+rho)/(1-rho)
    where the sensitivities are slow against the noise. It is never below the uncorrected variance.
    """
    _, jacobian = stacked(blocks)
    count, p = jacobian.shape
    if prior is not None and prior.size:
        jacobian = np.vstack([jacobian, prior])
    norms = np.linalg.norm(jacobian, axis=0)
    unseen = norms * spans <= UNSEEN
    norms = np.where(unseen, 1.0, norms)
    inverse, null = _inverse(jacobian / norms, ~unseen)
    rho, effective = _samples(blocks, p)
    meat = sum(
        (score_covariance(b.jacobian[part] / norms, rho[b.output]) for b in blocks for part in b.stretches),
        np.zeros((p, p)),
    )
    if prior is not None and prior.size:
        meat = meat + (prior / norms).T @ (prior / norms)
    sandwich = inverse @ meat @ inverse
    from_misfit = any(source[b.output] == MISFIT for b in blocks)
    if from_misfit and count > p:
        sandwich = sandwich * ((count - p) / max(count - float(np.trace(inverse @ meat)), 0.05 * count))
    raw_std, std = np.sqrt(np.diag(inverse)), np.sqrt(np.diag(sandwich))
    lift = np.where(std < raw_std, raw_std / np.where(std > 0, std, 1.0), 1.0)
    corrected = sandwich * np.outer(lift, lift)
    known = not from_misfit and not any(rho.values())
    dof = min(noise_dof, np.inf if known else max(1.0, sum(effective.values()) - p))
    return Uncertainty(
        tuple(names),
        inverse / np.outer(norms, norms),
        corrected / np.outer(norms, norms),
        _reasons(names, unseen, null, too_few=from_misfit and count <= p),
        bool(null.shape[0]),
        FrozenMap(rho),
        FrozenMap(effective),
        float(dof),
        float(min(noise_dof, max(1, count - p) if from_misfit else np.inf)),
        count,
    )


def _inverse(normalised: Array, seen: Array) -> tuple[Array, Array]:
    """The inverse of J'J, (p, p), over the directions that are determined, and a sparse basis (k, p) of the others."""
    p = seen.size
    inverse, null = np.zeros((p, p)), np.zeros((0, p))
    columns = np.flatnonzero(seen)
    if columns.size:
        _, s, vt = np.linalg.svd(np.linalg.qr(normalised[:, columns], mode="r"), full_matrices=True)
        s = np.concatenate([s, np.zeros(columns.size - s.size)])
        good = s > SINGULAR * s[0]
        inverse[np.ix_(columns, columns)] = (vt[good].T / s[good] ** 2) @ vt[good]
        null = np.zeros((int((~good).sum()), p))
        null[:, columns] = _reduced(vt[~good])
    return inverse, null


def _reduced(rows: Array) -> Array:
    """The same row space in reduced echelon form, so that each row names as few unknowns as possible."""
    rows = rows.copy()
    for i in range(rows.shape[0]):
        pivot = int(np.argmax(np.abs(rows[i])))
        rows[i] /= rows[i, pivot]
        others = np.arange(rows.shape[0]) != i
        rows[others] -= np.outer(rows[others, pivot], rows[i])
    return rows


def _samples(blocks: Sequence[ResidualBlock], p: int) -> tuple[dict[str, float], dict[str, float]]:
    """AR(1) coefficient and effective number of samples by output."""
    total = sum(b.residual.size for b in blocks)
    rho, effective = {}, {}
    for output in dict.fromkeys(b.output for b in blocks):
        records = [b.score[part] for b in blocks if b.output == output for part in b.stretches]
        n = sum(r.size for r in records)
        rho[output] = autocorrelation(records, p * n / total)
        effective[output] = n * (1.0 - rho[output]) / (1.0 + rho[output])
    return rho, effective


def score_covariance(jacobian: Array, rho: float) -> Array:
    """J'RJ with R_ij = rho^|i-j|, (p, p)."""
    if rho == 0.0:
        return jacobian.T @ jacobian
    before = np.zeros_like(jacobian)
    before[1:] = rho * jacobian[:-1]
    past = solve_banded((1, 0), np.array([[1.0], [-rho]]).repeat(len(jacobian), axis=1), before, check_finite=False)
    cross = jacobian.T @ past
    return jacobian.T @ jacobian + cross + cross.T


def _reasons(names: Sequence[str], unseen: Array, null: Array, *, too_few: bool) -> FrozenMap[str]:
    """Why an unknown has no standard deviation, by name."""
    if too_few:
        return FrozenMap(dict.fromkeys(names, "not more rows than unknowns: the misfit says nothing about the noise"))
    reasons = {n: "no compared output depends on it here" for n, u in zip(names, unseen, strict=True) if u}
    for direction in null:
        members = [n for n, v in zip(names, direction, strict=True) if abs(v) > 1e-3]
        for n in members:
            others = ", ".join(m for m in members if m != n)
            reasons.setdefault(n, f"only a combination with {others} is determined")
    return FrozenMap(reasons)
