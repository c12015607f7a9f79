"""Predictions of data that a refit has not seen: the held-out experiments, or each part of the fitted ones from the others.

A prediction is scored by -2 log p of the rows under the refitted model (to first order, Gaussian), less that of noise alone at 0:
e' S^-1 e + log det S, with the error e in noise units and its covariance S = I + J C J'. C is that of the unknowns by the data of the
fit and a prior that is worth one row of them (unit information, Kass and Wasserman 1995, of which BIC is the logarithm), for a part
left out may be the only one that determines an unknown. So an error counts for as much as the prediction is sure of it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.nominal import of_held_out
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit import Problem
from hvdc_ident.fit.residual import ResidualBlock

PARTS = 4
"""Stretches of a single record, each predicted from the others."""


def held_out(problem: Problem, theta: Array) -> tuple[ResidualBlock, ...] | None:
    """Return the residuals of the held-out experiments; None where there are none, () where one cannot be run."""
    others = of_held_out(problem)
    if others is None:
        return None
    try:
        blocks = others.blocks(theta[: len(problem.free)])
    except SimulationError:
        return ()
    # An output that was never fitted has no weight of its own; its records then judge nothing.
    return tuple(b for b in blocks if b.output in problem.outputs)


def root_mean_square(blocks: Sequence[ResidualBlock] | None) -> float | None:
    """Return the root mean square of held-out residuals, in noise units, whitened; infinite where a held-out run fails."""
    if blocks is None:
        return None
    if not blocks:
        return float("inf")
    return float(np.sqrt(_squares(blocks) / sum(b.residual.size for b in blocks)))


def root_mean_square_by_record(problem: Problem, theta: Array) -> dict[str, float]:
    """Return the same of each held-out record; empty where there are none, or one cannot be run."""
    own: dict[str, list[ResidualBlock]] = {}
    for b in held_out(problem, theta) or ():
        own.setdefault(b.experiment, []).append(b)
    return {name: float(root_mean_square(blocks) or 0.0) for name, blocks in own.items()}


def _squares(blocks: Sequence[ResidualBlock]) -> float:
    # What unknown starts took is what chance would have left there.
    return sum(b.chi2 + b.taken for b in blocks)


def predictive_score(fitted: Sequence[ResidualBlock], others: Sequence[ResidualBlock] | None) -> float | None:
    """Return the root mean score of the held-out records; where there are none, of the parts of the fitted ones.

    fitted, others: residuals with their derivatives at the optimum of the fitted ones; others: as `held_out` has them. None where
    nothing can be left out, infinite where a held-out run fails.
    """
    if others is not None and not others:
        return float("inf")
    pieces = _parts(fitted)
    rows = sum(r.size for r, _ in pieces)
    if not rows:
        return None
    coordinates = _unit_coordinates(np.asarray(sum(j.T @ j for _, j in pieces)))
    whole = (1.0 + 1.0 / rows) * np.eye(coordinates.shape[1])
    if others is not None:
        return _of_held_out(others, coordinates, whole)
    score = 0.0
    for r, j in pieces:
        slopes = j @ coordinates
        rest = whole - slopes.T @ slopes
        # The optimum of the others: there the gradient of all, which is 0 here, is that of this part.
        error = r + slopes @ np.linalg.solve(rest, slopes.T @ r)
        score += float(error @ error) + _spread(error, slopes, rest)
    score += sum(b.spare * b.residual.size for b in fitted)
    return float(np.sqrt(score / rows))


def _of_held_out(others: Sequence[ResidualBlock], coordinates: Array, information: Array) -> float:
    error = np.concatenate([b.residual for b in others])
    slopes = np.vstack([b.jacobian for b in others])
    # The unknowns of held-out records are the free parameters; nuisances of the fitted ones do not move them.
    known = min(slopes.shape[1], coordinates.shape[0])
    score = _squares(others) + _spread(error, slopes[:, :known] @ coordinates[:known], information)
    return float(np.sqrt(score / error.size))


def _unit_coordinates(information: Array) -> Array:
    """Return (p, k) the unknowns, by coordinates in which an information matrix (p, p) is I; what it does not know is left out."""
    scale = np.sqrt(np.where(np.diag(information) > 0, np.diag(information), 1.0))
    values, directions = np.linalg.eigh(information / np.outer(scale, scale))
    known = values > 1e-9 * max(values[-1], 1e-300)
    return np.asarray(directions[:, known] / np.sqrt(values[known]) / scale[:, None])


def _spread(error: Array, slopes: Array, information: Array) -> float:
    """Return e' S^-1 e + log det S - e' e for S = I + J M^-1 J', with slopes J (n, k) and information M (k, k)."""
    after = information + slopes.T @ slopes
    gradient = slopes.T @ error
    growth = np.linalg.slogdet(after)[1] - np.linalg.slogdet(information)[1]
    return float(growth - gradient @ np.linalg.solve(after, gradient))


def _parts(blocks: Sequence[ResidualBlock]) -> list[tuple[Array, Array]]:
    """Return the residuals and their Jacobian of each experiment; of a single one, of stretches of its rows."""
    names = list(dict.fromkeys(b.experiment for b in blocks))
    if len(names) > 1:
        cuts = [[(b, slice(None)) for b in blocks if b.experiment == n] for n in names]
    else:
        cuts = [
            [(b, slice(k * b.residual.size // PARTS, (k + 1) * b.residual.size // PARTS)) for b in blocks]
            for k in range(PARTS)
        ]
    return [
        (np.concatenate([b.residual[c] for b, c in cut]), np.vstack([b.jacobian[c] for b, c in cut])) for cut in cuts
    ]
