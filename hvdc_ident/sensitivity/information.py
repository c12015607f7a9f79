"""Fisher information of experiments about parameters, and what follows from it to first order.

Collinear subsets, null directions, inflation and the order in which parameters are determined.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations

import numpy as np

from hvdc_ident.codec import stored_as
from hvdc_ident.data import Array
from hvdc_ident.immutable import FrozenMap

EQUAL = 1e-9
"""Share of the largest magnitude by which two entries of a direction differ and are still equal."""


def leading(direction: Array) -> int:
    """Return the index of the first entry that is as large in magnitude as any, to EQUAL. direction: (n,).

    That entry is scaled to 1: an index that rounding cannot change from one machine to another.
    """
    size = np.abs(direction)
    return int(np.argmax(size >= (1.0 - EQUAL) * size.max()))


SENSITIVITY_ERROR = 1e-6
"""Singular values of normalised columns below this share of the largest are the sensitivities' own error."""
ENUMERATED = 10
"""Up to so many parameters every subset is looked at; beyond, subsets grow from the worst pairs."""
TIE = 1e-3
"""Columns whose remaining length differs by less than this share are equals: the earlier listed is taken."""


@dataclass(frozen=True, eq=False)
class Information:
    """The information on p parameters, in their scaled coordinates.

    names: of the parameters. by_experiment: (p, p) F_e = J_e'J_e by experiment; F is their sum.
    """

    names: tuple[str, ...]
    by_experiment: FrozenMap[Array]

    @cached_property
    def matrix(self) -> Array:
        """(p, p): the sum over the experiments."""
        p = len(self.names)
        return sum(self.by_experiment.values(), np.zeros((p, p)))

    @property
    def norms(self) -> FrozenMap[float]:
        """The length of each parameter's column: how much the outputs move, in noise units, when it doubles or so."""
        return FrozenMap(zip(self.names, np.sqrt(np.diag(self.matrix)).tolist(), strict=True))

    def shares(self) -> FrozenMap[FrozenMap[float]]:
        """By experiment and parameter the share of F_ii that the experiment gives; 0 where nobody tells anything."""
        total = np.diag(self.matrix)
        safe = np.where(total > 0, total, 1.0)
        return FrozenMap(
            {
                e: FrozenMap(zip(self.names, (np.diag(f) / safe).tolist(), strict=True))
                for e, f in self.by_experiment.items()
            }
        )

    def select(self, names: Sequence[str]) -> Information:
        """The information on some of the parameters, the others known."""
        rows = np.ix_([self.names.index(n) for n in names], [self.names.index(n) for n in names])
        return Information(tuple(names), FrozenMap({e: f[rows] for e, f in self.by_experiment.items()}))


def marginal(matrix: Array, kept: Sequence[int]) -> Array:
    """The information on the kept unknowns when the others have to be estimated too: the Schur complement."""
    kept = list(kept)
    nuisances = [i for i in range(matrix.shape[0]) if i not in kept]
    inner = matrix[np.ix_(kept, kept)]
    if not nuisances:
        return inner
    cross = matrix[np.ix_(kept, nuisances)]
    return inner - cross @ np.linalg.pinv(matrix[np.ix_(nuisances, nuisances)], hermitian=True) @ cross.T


def standard_deviations(matrix: Array) -> Array:
    """Return the standard deviations, (p,), that a regular information matrix bounds from below (Cramer and Rao)."""
    scaled, lengths = normalised(matrix)
    return np.sqrt(np.diag(np.linalg.inv(scaled))) / lengths


def rise_over_range(information_of_one: float, width: float) -> float:
    """F_ii (max - min)^2/2: what moving one parameter over its whole range adds to the cost, to second order.

    information_of_one: F_ii per squared unit of the parameter. A parameter is insensitive where this is below 1.92.
    """
    return 0.5 * information_of_one * width**2


def normalised(matrix: Array) -> tuple[Array, Array]:
    """Return a symmetric (p, p) matrix scaled to a diagonal of ones, and the scales, (p,): the roots of its diagonal.

    Where an entry of the diagonal is not above 0 the scale is 1, and the entry stays.
    """
    d = np.diag(matrix)
    scales = np.sqrt(np.where(d > 0, d, 1.0))
    return matrix / np.outer(scales, scales), scales


def collinearity_index(matrix: Array) -> float:
    """gamma = 1/sqrt(smallest eigenvalue) of the columns scaled to length 1; 1 for orthogonal ones, inf where singular.

    10 is a warning, 20 is bad: a change of one parameter can be made good by the others up to 1/gamma of its effect.
    """
    scaled, _ = normalised(matrix)
    if not (np.diag(scaled) > 0).all():
        return float("inf")
    smallest = float(np.linalg.eigvalsh(scaled)[0])
    return 1.0 / np.sqrt(smallest) if smallest > SENSITIVITY_ERROR**2 else float("inf")


def inflation_index(matrix: Array) -> Array:
    """(p,): by how much each parameter's standard deviation grows because the others are unknown; inf where singular."""
    scaled, _ = normalised(matrix)
    result = np.full(len(scaled), np.inf)
    rows = np.flatnonzero(np.diag(scaled) > 0)
    if rows.size:
        values, vectors = np.linalg.eigh(scaled[np.ix_(rows, rows)])
        good = values > SENSITIVITY_ERROR**2 * values[-1]
        part = (vectors[:, good] ** 2 / values[good]).sum(axis=1)
        lost = (vectors[:, ~good] ** 2).sum(axis=1) > 1e-6
        result[rows] = np.where(lost, np.inf, np.sqrt(part))
    return result


@dataclass(frozen=True)
class Collinear:
    """A set of parameters and its collinearity index."""

    names: tuple[str, ...] = field(metadata=stored_as("parameters"))
    index: float


def collinear_subsets(matrix: Array, names: Sequence[str]) -> tuple[Collinear, ...]:
    """Subsets of two and more with their index, worst first within each size.

    All of them for up to ten parameters; else the pairs, and from the twenty worst of each size the next one up.
    """
    p = len(names)
    indices: list[tuple[tuple[int, ...], float]] = []
    if p <= ENUMERATED:
        sets = [s for k in range(2, p + 1) for s in combinations(range(p), k)]
        indices = [(s, collinearity_index(matrix[np.ix_(s, s)])) for s in sets]
    else:
        pairs: list[tuple[int, ...]] = list(combinations(range(p), 2))
        front = [(s, collinearity_index(matrix[np.ix_(s, s)])) for s in pairs]
        while front:
            indices += front
            worst = sorted(front, key=lambda s: -s[1])[:20]
            grown = {tuple(sorted((*s, i))) for s, _ in worst for i in range(p) if i not in s}
            front = [(s, collinearity_index(matrix[np.ix_(s, s)])) for s in sorted(grown)]
    indices.sort(key=lambda s: (len(s[0]), -s[1]))
    return tuple(Collinear(tuple(names[i] for i in s), float(g)) for s, g in indices)


def pivoted_order(matrix: Array) -> tuple[int, ...]:
    """The parameters from the best determined to the least, each given those before it (QR with column pivoting).

    Works on J'J through its Cholesky steps; equals (TIE) are taken in the order they are listed.
    """
    residual = matrix.copy()
    candidates, order = list(range(matrix.shape[0])), []
    while candidates:
        remaining = np.array([residual[i, i] for i in candidates])
        best = candidates[
            int(np.argmax(remaining >= remaining.max() * (1.0 - TIE) if remaining.max() > 0 else remaining == 0))
        ]
        order.append(best)
        candidates.remove(best)
        if residual[best, best] > 0:
            residual = residual - np.outer(residual[:, best], residual[best]) / residual[best, best]
            np.fill_diagonal(residual, np.clip(np.diag(residual), 0.0, None))
    return tuple(order)


def independent(matrix: Array, error: float = SENSITIVITY_ERROR) -> tuple[int, ...]:
    """The most parameters that are determined together, earlier listed ones first where there is a choice."""
    scaled, _ = normalised(matrix)
    selected: list[int] = []
    for i in pivoted_order(scaled):
        proposal = sorted([*selected, i])
        part = np.linalg.eigvalsh(scaled[np.ix_(proposal, proposal)])
        if scaled[i, i] > 0 and part[0] > (error**2) * max(part[-1], 1.0):
            selected = proposal
    return tuple(selected)


def null_directions(columns: Array, error: float = SENSITIVITY_ERROR) -> Array:
    """(k, p): a sparse basis of the directions in scaled coordinates along which nothing is seen.

    columns: (n, p) whitened sensitivities in scaled coordinates; those that are zero altogether are left out of it.
    """
    p = columns.shape[1]
    norms = np.linalg.norm(columns, axis=0)
    seen = np.flatnonzero(norms > 0)
    if not seen.size:
        return np.zeros((0, p))
    triangle = np.linalg.qr(columns[:, seen] / norms[seen], mode="r")
    _, s, vt = np.linalg.svd(triangle, full_matrices=True)
    s = np.concatenate([s, np.zeros(seen.size - s.size)])
    null = vt[s <= error * s[0]] / norms[seen]
    rows = np.zeros((null.shape[0], p))
    for k in range(null.shape[0]):
        pivot = leading(null[k])
        null[k] /= null[k, pivot]
        others = np.arange(null.shape[0]) != k
        null[others] -= np.outer(null[others, pivot], null[k])
    rows[:, seen] = null
    return rows
