"""Uncertainty from the scatter between experiments: the cluster bootstrap and the cluster sandwich.

Both hold with model error and with correlated samples, for they take whole experiments as the independent units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hvdc_ident.errors import SimulationError, StudyError
from hvdc_ident.fit.nuisance import unknown_of
from hvdc_ident.fit.objective import LeastSquares, descend
from hvdc_ident.fit.problem import Problem
from hvdc_ident.fit.residual import Block
from hvdc_ident.trajectory import Array

FEWEST = 3
"""Fewer experiments have no scatter worth the name."""


@dataclass(frozen=True, eq=False)
class Bootstrap:
    """Estimates from resampled experiments. values: (n, p), one row a sample, in the parameters' units.

    names: p parameters. failed: samples whose fit failed and that are not in `values`.
    """

    names: tuple[str, ...]
    values: Array
    failed: int

    def std(self) -> dict[str, float]:
        """The standard deviation of each parameter over the samples, in its unit."""
        return dict(zip(self.names, self.values.std(axis=0, ddof=1).tolist(), strict=True))

    def ci95(self) -> dict[str, tuple[float, float]]:
        """The percentile interval of each parameter, in its unit."""
        low, high = np.percentile(self.values, [2.5, 97.5], axis=0)
        return {n: (float(a), float(b)) for n, a, b in zip(self.names, low, high, strict=True)}


def bootstrap(problem: Problem, theta: Array, *, samples: int = 200, seed: int = 0) -> Bootstrap:
    """Estimates from experiments drawn anew, with replacement, each sample fitted from the optimum theta, (p,).

    Every experiment brings its own nuisances. Raises StudyError with fewer than three experiments.
    """
    units = problem.fitted_experiments
    _need(len(units))
    random = np.random.default_rng(seed)
    at = dict(zip(problem.names, theta, strict=True))
    rows, failed = [], 0
    for _ in range(samples):
        drawn = [units[i] for i in random.integers(len(units), size=len(units))]
        named = tuple(e.with_(name=f"{e.name}#{k}") for k, e in enumerate(drawn))
        again = replace(problem, experiments=named)
        begin = [at[f.name] for f in problem.free]
        begin += [at[unknown_of(e.name, n)] for e in drawn for n in e.nuisance]
        none = np.zeros(len(begin), dtype=bool)
        try:
            end = descend(LeastSquares.of(again), np.array(begin), none, enough=1e-4)
        except SimulationError:
            failed += 1
            continue
        rows.append(end.theta[: len(problem.free)])
    if not rows:
        raise SimulationError("no sample of the bootstrap could be fitted", got=f"{failed} failures")
    return Bootstrap(tuple(f.name for f in problem.free), np.array(rows), failed)


def cluster_sandwich(blocks: Sequence[Block]) -> tuple[Array, int]:
    """(p, p) covariance of the unknowns from the scatter of the experiments' scores, and its degrees of freedom, n - 1.

    (J'J)^-1 (sum g_e g_e') (J'J)^-1 n/(n - 1), with g_e the gradient of experiment e alone at the common optimum
    (Liang and Zeger 1986); intervals use Student's t. Raises StudyError with fewer than three experiments.
    """
    scores, matrix = _scores(blocks)
    n = scores.shape[0]
    _need(n)
    d = np.sqrt(np.diag(matrix))
    d = np.where(d > 0, d, 1.0)
    inverse = np.linalg.pinv(matrix / np.outer(d, d), hermitian=True) / np.outer(d, d)
    return inverse @ (scores.T @ scores) @ inverse * (n / (n - 1.0)), n - 1


def _scores(blocks: Sequence[Block]) -> tuple[Array, Array]:
    """(n, p) gradients by experiment and (p, p) J'J."""
    names = list(dict.fromkeys(b.experiment for b in blocks))
    scores = np.zeros((len(names), blocks[0].jacobian.shape[1]))
    matrix = np.zeros((scores.shape[1],) * 2)
    for b in blocks:
        scores[names.index(b.experiment)] += b.jacobian.T @ b.residual
        matrix += b.jacobian.T @ b.jacobian
    return scores, matrix


def _need(count: int) -> None:
    if count < FEWEST:
        raise StudyError(
            "too few experiments to take their scatter as the uncertainty",
            expected=f"at least {FEWEST} experiments of role 'fit'",
            got=str(count),
            hint="the intervals of the profile instead",
        )
