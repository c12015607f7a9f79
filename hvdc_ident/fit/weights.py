"""What a fit learns about the noise on its way: weights from the misfit, a noise model from the residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.errors import SimulationError, unknown_name
from hvdc_ident.fit.noise import MISFIT, floor_of, source_of
from hvdc_ident.fit.optimiser import Optimiser
from hvdc_ident.fit.problem import Problem
from hvdc_ident.fit.starts import LocalMinimum, best_first, distinct
from hvdc_ident.fit.whitening import autoregression, before_event
from hvdc_ident.immutable import FrozenMap

Whiten = Literal["no", "pre-event", "residual"]
WHITEN = ("no", "pre-event", "residual")
MAD = 1.482602218505602
"""Standard deviation over median absolute deviation, of a normal distribution."""


def prepared(problem: Problem, whiten: str) -> Problem:
    """The problem with the noise model from before the event, where that is asked for.

    Raises UnknownNameError for another word, StudyError where nothing before the event tells the noise.
    """
    if whiten not in WHITEN:
        raise unknown_name("way of whitening", whiten, WHITEN)
    if whiten != "pre-event":
        return problem
    return replace(problem, rho=FrozenMap(before_event(problem.fitted_experiments, problem.outputs_in_time)))


def weighted(
    problem: Problem, ends: Sequence[LocalMinimum], method: Optimiser
) -> tuple[Problem, LocalMinimum, list[LocalMinimum]]:
    """The problem with the misfit's weights where noise is not given, its best optimum and the other candidates.

    ends: the best first. One output: the optimum does not depend on its weight. Several: fitted again until the weights
    stand (1 %).
    """
    open_outputs = [o for o in problem.outputs if source_of(problem.fitted_experiments, o) == MISFIT]
    if not open_outputs:
        return problem, ends[0], list(ends[1:])
    best = ends[0]
    once = len(problem.outputs) == 1 and problem.loss.linear and not problem.priors
    rivals: list[LocalMinimum] | None = None
    for _ in range(20):
        weights = misfit_weights(problem, best.theta, open_outputs)
        settled = all(abs(weights[o] / problem.weights.get(o, np.inf) - 1.0) < 0.01 for o in open_outputs)
        problem = problem.with_(weights={**problem.weights, **weights})
        if rivals is None:  # in the first weights, which are far too large, every end is as good as any other
            at = [LocalMinimum(e.theta, c) for e in ends if (c := cost_of(problem, e.theta)) is not None]
            rivals = [r for r in distinct(problem, at) if not np.array_equal(r.theta, best.theta)][:3]
        if once or settled:
            break
        again = method.run(problem, best.theta)
        if again.status == "failed" or again.cost is None:
            break
        best = LocalMinimum(again.theta, again.cost)
    return _again(problem, best, rivals or [], method)


def whitened_by_residuals(
    problem: Problem, best: LocalMinimum, rivals: Sequence[LocalMinimum], method: Optimiser
) -> tuple[Problem, LocalMinimum, list[LocalMinimum]]:
    """The problem whitened by the model of its own residuals, fitted again until that model stands (twice at most)."""
    for _ in range(2):
        blocks = replace(problem, rho=FrozenMap()).blocks(best.theta, derivatives=False, in_time=True)
        models = {}
        for output in problem.outputs_in_time:
            own = [(b, b.scaled(b.misfit)) for b in blocks if b.output == output]
            records = [(r - r.mean())[part] for b, r in own for part in b.stretches]
            models[output] = autoregression(records)
        problem, best, rivals = _again(replace(problem, rho=FrozenMap(models)), best, rivals, method)
        problem, best, rivals = weighted(problem, [best, *rivals], method)
    return problem, best, list(rivals)


def _again(
    problem: Problem, best: LocalMinimum, rivals: Sequence[LocalMinimum], method: Optimiser
) -> tuple[Problem, LocalMinimum, list[LocalMinimum]]:
    """The optima found again in the problem's weights, best first; of the rivals those that are optima there.

    Raises SimulationError where no simulation succeeds at any of them, though those that led there did.
    """
    runs = [method.run(problem, r.theta) for r in (best, *rivals)]
    candidates = [
        runs[0].theta if runs[0].cost is not None else best.theta,
        *(m.theta for m in runs[1:] if m.status in ("converged", "stalled")),
    ]
    at = [LocalMinimum(t, c) for t in candidates if (c := cost_of(problem, t)) is not None]
    if not at:
        problem.residual(candidates[0])  # raises what the simulation fails with
        raise SimulationError("a simulation at the optimum failed, and another of the same values did not")
    first, *rest = best_first(at)
    return problem, first, rest


def cost_of(problem: Problem, theta: Array) -> float | None:
    """The cost as the optimiser saw it, from runs with sensitivities; None where a run fails."""
    try:
        r, _ = problem.residual(theta)
    except SimulationError:
        return None
    return 0.5 * float(r @ r)


def misfit_weights(problem: Problem, theta: Array, outputs: Sequence[str]) -> dict[str, float]:
    """The RMSE of each output over all its records, freed of the fitted unknowns' share, in its unit.

    For a whitened problem it is the standard deviation of the whitened residual that becomes 1. With a robust loss the
    median absolute residual stands for it, for outliers are not noise.
    """
    blocks = problem.blocks(theta)
    total = sum(b.residual.size for b in blocks)
    share = total / max(total - theta.size, 1)
    weights = {}
    for output in outputs:
        misfit = np.concatenate([b.residual * b.sigma for b in blocks if b.output == output])
        floor = floor_of(problem.fitted_experiments, output)
        size = np.sqrt(np.mean(misfit**2)) if problem.loss.linear else MAD * np.median(np.abs(misfit))
        weights[output] = max(float(size * np.sqrt(share)), floor)
    return weights
