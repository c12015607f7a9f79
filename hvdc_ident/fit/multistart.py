"""The search for the optimum from several starting points, whatever optimiser runs from each.

The ends of all runs are refined by least squares, told apart, moved over the clock offsets that a descent cannot reach, and
found again in the weights and the noise model that the misfit gives.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from hvdc_ident.data import MAD_TO_STD, Array, Experiment
from hvdc_ident.errors import SimulationError, require_known
from hvdc_ident.executor import Executor, Progress, mapped
from hvdc_ident.fit.fit_parameter import FitParameter
from hvdc_ident.fit.noise import MISFIT, floor_of, models_before_event
from hvdc_ident.fit.optimiser import Optimiser, OptimiserResult
from hvdc_ident.fit.optimisers import is_global
from hvdc_ident.fit.optimisers import optimiser as named
from hvdc_ident.fit.optimisers.trust_region import TrustRegion
from hvdc_ident.fit.problem import Problem
from hvdc_ident.fit.simulator import TIME_SHIFT, unknown_of
from hvdc_ident.fit.uncertainty import TWO_SIDED
from hvdc_ident.fit.whitening import autoregression
from hvdc_ident.immutable import FrozenMap

WHITEN = ("no", "pre-event", "residual")

STARTS = 8
"""Runs of a multistart, where nothing else is said."""
LONGER = 1000
"""Evaluations more that the lowest run may take which used up its own."""
DISTINCT = TWO_SIDED
"""Costs that differ by less are as good: half the 95 % quantile of chi-square with one degree of freedom."""
TIE = 1e-6
"""Costs that differ by this share differ by what no number of rows makes a likelihood notice (half of it a row)."""
MOST_OFFSETS = 80
"""Stretches of clock offsets that are tried in an experiment; of more, every so many."""
ROUNDS = 6
"""Rounds of finding the other unknowns again between two searches over the clock offsets."""


@dataclass(frozen=True, eq=False)
class LocalMinimum:
    """A local minimum of the cost: (p,) theta and its cost."""

    theta: Array
    cost: float


@dataclass(frozen=True)
class Refined:
    """A method, then a trust region from where it ended.

    Covariances, bounds and profiles need the optimum itself; methods without derivatives stop some way off. The message
    says what each of the two did.
    """

    method: Optimiser
    polish: TrustRegion = field(default_factory=TrustRegion)

    def run(self, problem: Problem, start: Array) -> OptimiserResult:
        """Return the result of both together; the first method's failure stands where it found no admissible point."""
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


def multistart(
    problem: Problem,
    optimiser: Optimiser | str | None,
    starts: int | None,
    seed: int,
    executor: Executor | None,
    progress: Progress | None,
) -> tuple[list[Array], list[OptimiserResult]]:
    """Return the starting points, (p,) each, and the run from each, in their order whatever runs them.

    The lowest of the runs that used up their evaluations is continued: along a narrow valley it takes more. An optimiser with
    options of its own keeps the evaluations it was given.
    """
    method = named(optimiser, seed) if isinstance(optimiser, str) else optimiser or TrustRegion()
    if starts is None:
        starts = 1 if is_global(method) else STARTS
    if not isinstance(method, TrustRegion):
        method = Refined(method)
    nuisances = problem.unknowns[len(problem.free) :]
    points = [problem.start, *starting_points(problem.free, nuisances, starts - 1, seed)]
    if progress:
        progress(0, len(points), f"search for the optimum, start 1 of {len(points)}")
    runs: list[OptimiserResult] = []
    for run in mapped(executor, partial(method.run, problem), points):
        runs.append(run)
        if progress:
            cost = "no cost" if run.cost is None else f"cost {run.cost:.6g}"
            text = f"start {len(runs)} {run.status} after {run.evaluations} evaluations, {cost}"
            progress(len(runs), len(points), f"search for the optimum, {text}")
    spent = [i for i, r in enumerate(runs) if r.status == "max-evaluations" and r.cost is not None]
    if spent and method == TrustRegion():
        i = min(spent, key=lambda k: runs[k].cost or 0.0)
        end = TrustRegion(max_evaluations=LONGER).run(problem, runs[i].theta)
        if end.cost is not None:
            runs[i] = replace(end, evaluations=runs[i].evaluations + end.evaluations)
    return points, runs


def starting_points(
    spread: Sequence[FitParameter], others: Sequence[FitParameter], count: int, seed: int
) -> list[Array]:
    """Return `count` points, (p,) each, of a seeded Latin hypercube.

    spread: unknowns spread over their bounds (even in the logarithm where scaled so). others: unknowns that keep their own
    start, as nuisances do: they are small by nature, and far off they only lead a run astray.
    """
    if count < 1:
        return []
    from scipy.stats import qmc

    kept = [u.start for u in others]
    shares = qmc.LatinHypercube(d=len(spread), seed=np.random.default_rng(seed)).random(count)
    return [np.array([*(u.draw(float(s)) for u, s in zip(spread, row, strict=True)), *kept]) for row in shares]


def local_minima(runs: Sequence[OptimiserResult]) -> list[LocalMinimum]:
    """Return where the runs ended: the lowest cost first whatever stopped it; of the others those that may be optima."""
    reached = [(r.status, LocalMinimum(r.theta, r.cost)) for r in runs if r.cost is not None]
    first, *others = best_first([o for _, o in reached])
    optima = [o for status, o in reached if status in ("converged", "stalled")]
    return [first, *(o for o in others if o in optima)]


def best_first(ends: Sequence[LocalMinimum]) -> list[LocalMinimum]:
    """Return the ends by their cost; the first one stays first where no other is lower by more than rounding.

    So of optima that are one but for the names of their unknowns, as two time constants that may change places, the one
    next to the given start is reported.
    """
    ordered = sorted(ends, key=lambda o: o.cost)
    if ends and ends[0].cost <= (1.0 + TIE) * ordered[0].cost:
        return [ends[0], *(o for o in ordered if o is not ends[0])]
    return ordered


def distinct(problem: Problem, ends: Sequence[LocalMinimum], effective_share: float = 1.0) -> list[LocalMinimum]:
    """Return the best end of each basin, best first.

    Two ends are one optimum where no coordinate differs by a thousandth of its range, or where the cost between them on the
    straight line (in scaled coordinates) never rises by DISTINCT above the worse one. effective_share: independent samples per sample.
    """
    kept: list[LocalMinimum] = []
    for end in sorted(ends, key=lambda o: o.cost):
        if not any(_one_basin(problem, end, other, effective_share) for other in kept):
            kept.append(end)
    return kept


def _one_basin(problem: Problem, a: LocalMinimum, b: LocalMinimum, effective_share: float) -> bool:
    space = problem.coordinates
    x, y = space.scaled(a.theta), space.scaled(b.theta)
    if (np.abs(x - y) <= 1e-3 * space.ranges).all():
        return True
    if (max(a.cost, b.cost) - min(a.cost, b.cost)) * effective_share >= DISTINCT:
        return False
    barrier = max(a.cost, b.cost) + DISTINCT / effective_share
    try:
        return all(problem.cost(space.unscaled(x + s * (y - x))) < barrier for s in np.linspace(0.0, 1.0, 9)[1:-1])
    except SimulationError:
        return False


# --- clock offsets ---
# An output that jumps with an input makes the cost jump in the offset of the clock, each time a row passes the jump:
# between two rows the cost is smooth, and a descent never leaves the stretch it begins in. So the stretches are tried.


def has_clocks(problem: Problem) -> bool:
    """Return whether any experiment has a clock of unknown offset."""
    return any(TIME_SHIFT in e.nuisance for e in problem.fitted_experiments)


def search_clock_offsets(problem: Problem, best: LocalMinimum, method: Optimiser) -> LocalMinimum:
    """Return the best optimum over the stretches of all clocks: search, fit again, until no other stretch is better."""
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
    """Return the offset of one clock, s, at which its experiment's cost is least, the other unknowns as they are.

    Tried are the present offset and the middle of each stretch of offsets within which no row passes a break of an input.
    """
    alone = replace(problem, experiments=(e,), priors=problem.priors.without(*problem.priors))
    trial = np.array([theta[problem.names.index(n)] for n in alone.names])
    place = alone.names.index(unknown_of(e.name, TIME_SHIFT))
    present, low, high = float(trial[place]), alone.unknowns[place].min, alone.unknowns[place].max
    breaks = np.unique([b for signal in e.inputs.values() for b in signal.breaks.tolist()])
    passing = np.unique(np.subtract.outer(e.time, breaks))
    ends = np.concatenate([[low], passing[(passing > low) & (passing < high)], [high]])
    middles = 0.5 * (ends[1:] + ends[:-1])
    offsets = [present, *map(float, middles[:: max(1, -(-middles.size // MOST_OFFSETS))])]
    costs = []
    for offset in offsets:
        trial[place] = offset
        try:
            costs.append(alone.cost(trial))
        except SimulationError:
            costs.append(np.inf)  # only compared: an offset that cannot be simulated is not chosen
    return offsets[int(np.argmin(costs))]


# --- weights and noise models from the misfit ---


def prewhitened(problem: Problem, whiten: str) -> Problem:
    """Return the problem with the noise model from before the event, where that is asked for.

    Raises UnknownNameError for another word, StudyError where no rows before the event show the noise.
    """
    require_known("way of whitening", [whiten], WHITEN, "")
    if whiten != "pre-event":
        return problem
    return replace(problem, rho=FrozenMap(models_before_event(problem.fitted_experiments, problem.outputs_in_time)))


def reweighted(
    problem: Problem, ends: Sequence[LocalMinimum], method: Optimiser
) -> tuple[Problem, LocalMinimum, list[LocalMinimum]]:
    """Return the problem weighted by the misfit where noise is not given, its best optimum and the other candidates.

    ends: the best first. One output: the optimum does not depend on its weight. Several: fitted again until the weights
    stand (1 %).
    """
    unknown = [o for o, source in problem.noise_source.items() if source == MISFIT]
    if not unknown:
        return problem, ends[0], list(ends[1:])
    best = ends[0]
    once = len(problem.outputs) == 1 and problem.loss.linear and not problem.priors
    rivals: list[LocalMinimum] | None = None
    for _ in range(20):
        weights = misfit_weights(problem, best.theta, unknown)
        steady = all(abs(weights[o] / problem.weights.get(o, np.inf) - 1.0) < 0.01 for o in unknown)
        problem = problem.with_(weights={**problem.weights, **weights})
        if rivals is None:  # in the first weights, which are far too large, every end is as good as any other
            minima = _minima_at(problem, [e.theta for e in ends])
            rivals = [r for r in distinct(problem, minima) if not np.array_equal(r.theta, best.theta)][:3]
        if once or steady:
            break
        run = method.run(problem, best.theta)
        if run.status == "failed" or run.cost is None:
            break
        best = LocalMinimum(run.theta, run.cost)
    return _found_again(problem, best, rivals or [], method)


def whitened_by_residuals(
    problem: Problem, best: LocalMinimum, rivals: Sequence[LocalMinimum], method: Optimiser
) -> tuple[Problem, LocalMinimum, list[LocalMinimum]]:
    """Return the problem whitened by the model of its own residuals, fitted again until that model stands (at most twice)."""
    for _ in range(2):
        blocks = replace(problem, rho=FrozenMap()).blocks(best.theta, derivatives=False, in_time=True)
        models = {}
        for output in problem.outputs_in_time:
            scaled = [(b, b.scaled(b.misfit)) for b in blocks if b.output == output]
            models[output] = autoregression([(r - r.mean())[part] for b, r in scaled for part in b.stretches])
        problem, best, rivals = _found_again(replace(problem, rho=FrozenMap(models)), best, rivals, method)
        problem, best, rivals = reweighted(problem, [best, *rivals], method)
    return problem, best, list(rivals)


def _found_again(
    problem: Problem, best: LocalMinimum, rivals: Sequence[LocalMinimum], method: Optimiser
) -> tuple[Problem, LocalMinimum, list[LocalMinimum]]:
    """Return the optima found again in the problem's weights, best first; of the rivals those that are optima there.

    Raises SimulationError where no simulation succeeds at any of them, though those that led there did.
    """
    runs = [method.run(problem, r.theta) for r in (best, *rivals)]
    candidates = [
        runs[0].theta if runs[0].cost is not None else best.theta,
        *(m.theta for m in runs[1:] if m.status in ("converged", "stalled")),
    ]
    minima = _minima_at(problem, candidates)
    if not minima:
        problem.residual(candidates[0])  # raises what the simulation fails with
        raise SimulationError("a simulation at the optimum failed, and another of the same values did not")
    first, *others = best_first(minima)
    return problem, first, others


def _minima_at(problem: Problem, thetas: Sequence[Array]) -> list[LocalMinimum]:
    return [LocalMinimum(t, c) for t in thetas if (c := cost_at(problem, t)) is not None]


def cost_at(problem: Problem, theta: Array) -> float | None:
    """Return the cost as the optimiser saw it, from runs with sensitivities; None where a run fails."""
    try:
        r, _ = problem.residual(theta)
    except SimulationError:
        return None
    return 0.5 * float(r @ r)


def misfit_weights(problem: Problem, theta: Array, outputs: Sequence[str]) -> dict[str, float]:
    """Return the RMSE of each output over all its records, freed of the fitted unknowns' share, in its unit.

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
        size = np.sqrt(np.mean(misfit**2)) if problem.loss.linear else MAD_TO_STD * np.median(np.abs(misfit))
        weights[output] = max(float(size * np.sqrt(share)), floor)
    return weights
