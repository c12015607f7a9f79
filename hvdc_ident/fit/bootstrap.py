"""Uncertainty from the scatter between experiments: the cluster bootstrap and the cluster sandwich.

Both hold with model error and with correlated samples, for they take whole experiments as the independent units.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array
from hvdc_ident.errors import SimulationError, StudyError
from hvdc_ident.executor import Executor, mapped
from hvdc_ident.fit.descent import LeastSquares, bounded_step, descend
from hvdc_ident.fit.problem import Problem
from hvdc_ident.fit.residual import ResidualBlock
from hvdc_ident.sensitivity import normalised

FEWEST = 3
"""Fewer experiments have no scatter worth the name."""


@dataclass(frozen=True, eq=False)
class Bootstrap:
    """Estimates from resampled experiments. values: (n, p), one row a sample, in the parameters' units.

    names: p parameters. failed: samples whose fit failed and that are not in `values`. experiments: how many there are
    to draw from.
    """

    names: tuple[str, ...]
    values: Array
    failed: int
    experiments: int = 0

    def std(self) -> dict[str, float]:
        """Return the standard deviation of each parameter over the samples, in its unit."""
        return dict(zip(self.names, self.values.std(axis=0, ddof=1).tolist(), strict=True))

    def ci95(self) -> dict[str, tuple[float, float]]:
        """Return the percentile interval of each parameter, in its unit."""
        low, high = np.percentile(self.values, [2.5, 97.5], axis=0)
        return {n: (float(a), float(b)) for n, a, b in zip(self.names, low, high, strict=True)}


def bootstrap(
    problem: Problem, theta: Array, *, samples: int = 200, seed: int = 0, executor: Executor | None = None
) -> Bootstrap:
    """Return estimates from experiments drawn anew, with replacement, each sample fitted from near the optimum theta, (p,).

    Every experiment brings its own nuisances. The samples do not depend on the executor. Raises StudyError with fewer
    than three experiments, SimulationError where no sample can be fitted.
    """
    units = problem.fitted_experiments
    _require_several(len(units))
    random = np.random.default_rng(seed)
    drawn = [random.integers(len(units), size=len(units)) for _ in range(samples)]
    counts = np.array([np.bincount(d, minlength=len(units)) for d in drawn])
    theta = np.asarray(theta, dtype=float)
    refit = partial(_refit, problem, theta, problem.blocks(theta))
    rows = list(mapped(executor, refit, counts))
    fitted = [row for row in rows if row is not None]
    if not fitted:
        raise SimulationError("no sample of the bootstrap could be fitted", got=f"{len(rows)} failures")
    names = tuple(f.name for f in problem.free)
    return Bootstrap(names, np.array(fitted)[:, : len(names)], len(rows) - len(fitted), len(units))


def _refit(problem: Problem, theta: Array, blocks: Sequence[ResidualBlock], counts: NDArray[np.intp]) -> Array | None:
    """Return the estimates, (p,), with every experiment counted so many times; None where the fit fails."""
    units = problem.fitted_experiments
    times = {e.name: int(c) for e, c in zip(units, counts, strict=True) if c}
    drawn = replace(problem, experiments=tuple(e for e in units if e.name in times))
    places = [problem.names.index(n) for n in drawn.names]
    known = [b for b in blocks if b.experiment in times]
    # A Gauss-Newton step within the bounds, from the blocks at the optimum.
    r, jacobian = _counted(known, times, places)
    space = drawn.coordinates
    low, high = space.bounds
    x, scaled = space.scaled(theta[places]), jacobian * space.slope(theta[places])
    first = space.unscaled(x + bounded_step(scaled.T @ r, scaled.T @ scaled, low - x, high - x))

    def residual(at: Array) -> tuple[Array, Array]:
        return _counted(drawn.blocks(at), times, list(range(at.size)))

    objective = LeastSquares(drawn.unknowns, residual)
    for start in (first, theta[places]):  # a step that leads out of what can be simulated is not taken
        try:
            end = descend(objective, start, enough=1e-3)
        except SimulationError:
            continue
        estimates = theta.copy()
        estimates[places] = end.theta
        return estimates
    return None


def _counted(blocks: Sequence[ResidualBlock], times: Mapping[str, int], columns: Sequence[int]) -> tuple[Array, Array]:
    """Return the residual and jacobian in which every experiment counts so many times."""
    root = [np.sqrt(times[b.experiment]) for b in blocks]
    r = np.concatenate([b.residual * k for b, k in zip(blocks, root, strict=True)])
    return r, np.vstack([b.jacobian[:, columns] * k for b, k in zip(blocks, root, strict=True)])


def cluster_sandwich(blocks: Sequence[ResidualBlock]) -> tuple[Array, int]:
    """Return the covariance of the unknowns, (p, p), from the scatter of the experiments' scores, and its dof, n - 1.

    (J'J)^-1 (sum g_e g_e') (J'J)^-1 n/(n - 1), with g_e the gradient of experiment e alone at the common optimum
    (Liang and Zeger 1986); intervals use Student's t. Raises StudyError with fewer than three experiments.
    """
    names = list(dict.fromkeys(b.experiment for b in blocks))
    n, p = len(names), blocks[0].jacobian.shape[1]
    _require_several(n)
    scores, matrix = np.zeros((n, p)), np.zeros((p, p))
    for b in blocks:
        scores[names.index(b.experiment)] += b.jacobian.T @ b.residual
        matrix += b.jacobian.T @ b.jacobian
    scaled, d = normalised(matrix)
    inverse = np.linalg.pinv(scaled, hermitian=True) / np.outer(d, d)
    return inverse @ (scores.T @ scores) @ inverse * (n / (n - 1.0)), n - 1


def _require_several(count: int) -> None:
    if count < FEWEST:
        raise StudyError(
            "too few experiments to take their scatter as the uncertainty",
            expected=f"at least {FEWEST} experiments of role 'fit'",
            got=str(count),
            hint="the intervals of the profile instead",
        )
