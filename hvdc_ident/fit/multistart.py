"""The search for the optimum from several starts, whatever optimiser runs from each.

The ends of all runs are refined by least squares, told apart, moved over the clock offsets that a descent cannot reach, and
found again in the weights and the noise model that the misfit gives.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from hvdc_ident.data import Array, Experiment
from hvdc_ident.errors import SimulationError, unknown_name
from hvdc_ident.fit.fit_parameter import FitParameter
from hvdc_ident.fit.noise_model import MISFIT, autoregression, before_event, floor_of, source_of
from hvdc_ident.fit.optimiser import Optimiser, OptimiserResult
from hvdc_ident.fit.optimisers.trust_region import TrustRegion
from hvdc_ident.fit.problem import Problem
from hvdc_ident.fit.simulator import TIME_SHIFT, unknown_of
from hvdc_ident.immutable import FrozenMap

DISTINCT = 1.92
"""Half the 95 % quantile of chi-square with one degree of freedom: costs that differ by less are as good."""


@dataclass(frozen=True, eq=False)
class LocalMinimum:
    """An optimum: (p,) theta and its cost."""

    theta: Array
    cost: float


TIE = 1e-6
"""Costs that differ by this share differ by what no number of rows makes a likelihood notice (half of it a row)."""


def best_first(ends: Sequence[LocalMinimum]) -> list[LocalMinimum]:
    """The ends by their cost; the first one stays first where no other is lower by more than rounding.

    So of optima that are one but for the names of their unknowns, as two time constants that may change places, the one
    next to the given start is told.
    """
    ordered = sorted(ends, key=lambda o: o.cost)
    if ends and ends[0].cost <= (1.0 + TIE) * ordered[0].cost:
        return [ends[0], *(o for o in ordered if o is not ends[0])]
    return ordered


def latin_hypercube(spread: Sequence[FitParameter], rest: Sequence[FitParameter], count: int, seed: int) -> list[Array]:
    """`count` starts, (p,) each: `spread` over the bounds (even in the logarithm where scaled so), `rest` at their own.

    Nuisances are the rest: they are small by nature, and far off they only lead a run astray.
    """
    if count < 1:
        return []
    from scipy.stats import qmc

    own = [u.start for u in rest]
    shares = qmc.LatinHypercube(d=len(spread), seed=np.random.default_rng(seed)).random(count)
    return [np.array([*(u.draw(float(s)) for u, s in zip(spread, row, strict=True)), *own]) for row in shares]


def distinct(problem: Problem, ends: Sequence[LocalMinimum], worth: float = 1.0) -> list[LocalMinimum]:
    """The ends that are optima of their own, best first; of the others the best of each basin.

    Two are one where no coordinate differs by a thousandth of its range, or where the cost between them on the straight
    line (in scaled coordinates) never rises by DISTINCT above the worse one. worth: independent samples per sample.
    """
    kept: list[LocalMinimum] = []
    for end in sorted(ends, key=lambda o: o.cost):
        if not any(_same(problem, end, other, worth) for other in kept):
            kept.append(end)
    return kept


def _same(problem: Problem, a: LocalMinimum, b: LocalMinimum, worth: float) -> bool:
    space = problem.coordinates
    x, y = space.scaled(a.theta), space.scaled(b.theta)
    if (np.abs(x - y) <= 1e-3 * space.ranges).all():
        return True
    if (max(a.cost, b.cost) - min(a.cost, b.cost)) * worth >= DISTINCT:
        return False
    barrier = max(a.cost, b.cost) + DISTINCT / worth
    try:
        return all(problem.cost(space.unscaled(x + s * (y - x))) < barrier for s in np.linspace(0.0, 1.0, 9)[1:-1])
    except SimulationError:
        return False


@dataclass(frozen=True)
class Refined:
    """A method, then a trust region from where it ended.

    Covariances, bounds and profiles need the optimum itself; methods without derivatives stop some way off. The message
    says what each of the two did.
    """

    method: Optimiser
    polish: TrustRegion = field(default_factory=TrustRegion)

    def run(self, problem: Problem, start: Array) -> OptimiserResult:
        """Where both together ended; the first method's failure stands where it found no admissible point."""
        first = self.method.run(problem, start)
        if first.cost is None:
            return first
        end = self.polish.run(problem, np.asarray(first.theta))
        used = first.evaluations + end.evaluations
        if end.cost is None:
            return OptimiserResult(first.theta, first.cost, "failed", f"{first.message}; {end.message}", used)
        fall = max(first.cost - end.cost, 0.0)
        message = f"{first.message}; then least squares lowered the cost by {fall:.3g}: {end.message}"
        return OptimiserResult(end.theta, end.cost, end.status, message, used)


MOST = 80
"""Stretches that are tried in an experiment; of more, every so many."""
ROUNDS = 6
"""How often the other unknowns are found again between two searches."""


def has_clocks(problem: Problem) -> bool:
    """Whether any experiment has a clock of unknown offset."""
    return any(TIME_SHIFT in e.nuisance for e in problem.fitted_experiments)


def searched(problem: Problem, best: LocalMinimum, method: Optimiser) -> LocalMinimum:
    """The best optimum over the stretches of all clocks: search, fit again, until no other stretch is better."""
    for _ in range(ROUNDS):
        theta = best.theta.copy()
        for e in problem.fitted_experiments:
            if TIME_SHIFT in e.nuisance:
                theta[problem.names.index(unknown_of(e.name, TIME_SHIFT))] = _best_offset(problem, e, theta)
        if np.array_equal(theta, best.theta):
            return best
        run = method.run(problem, theta)
        if run.status == "failed" or run.cost is None or not run.cost < best.cost:
            return best
        best = LocalMinimum(run.theta, run.cost)
    return best


def _best_offset(problem: Problem, e: Experiment, theta: Array) -> float:
    """The offset of one clock at which its experiment's cost is least, the other unknowns as they are; s."""
    alone = replace(problem, experiments=(e,), priors=problem.priors.without(*problem.priors))
    at = np.array([theta[problem.names.index(n)] for n in alone.names])
    place = alone.names.index(unknown_of(e.name, TIME_SHIFT))
    own, unknown = float(at[place]), alone.unknowns[place]
    offsets = _stretches(e, unknown.min, unknown.max)
    costs = []
    for tau in (own, *offsets):
        at[place] = tau
        try:
            costs.append(alone.cost(at))
        except SimulationError:
            costs.append(np.inf)  # only compared: an offset that cannot be simulated is not chosen
    return float((own, *offsets)[int(np.argmin(costs))])


def _stretches(e: Experiment, low: float, high: float) -> list[float]:
    """The middles of the stretches of offsets within which no row passes a break of an input, s."""
    breaks = np.unique([b for signal in e.inputs.values() for b in signal.breaks.tolist()])
    passing = np.unique(np.subtract.outer(e.time, breaks))
    inner = passing[(passing > low) & (passing < high)]
    ends = np.concatenate([[low], inner, [high]])
    middles = 0.5 * (ends[1:] + ends[:-1])
    return [float(m) for m in middles[:: max(1, -(-middles.size // MOST))]]


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
