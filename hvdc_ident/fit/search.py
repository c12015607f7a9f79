"""The search for the optimum: a multistart, made once for a problem, whatever optimiser runs from each start.

The ends of all runs are refined by least squares, told apart, and found again in the weights and the noise model that the
misfit gives.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from hvdc_ident.budget import BudgetSpent, Known
from hvdc_ident.data import MAD_TO_STD, Array
from hvdc_ident.errors import SimulationError, require_known
from hvdc_ident.executor import Executor, Progress, mapped
from hvdc_ident.fit.adequacy import adequacy
from hvdc_ident.fit.fit_parameter import starting_points
from hvdc_ident.fit.jump_instants import within_own_stretches
from hvdc_ident.fit.noise import MISFIT, floor_of, models_before_event, source_text
from hvdc_ident.fit.nonsmooth import LUCK, roughness
from hvdc_ident.fit.optimiser import LocalMinimum, Optimiser, OptimiserResult
from hvdc_ident.fit.optimisers import optimiser as named
from hvdc_ident.fit.optimisers.trust_region import TrustRegion
from hvdc_ident.fit.problem import Problem
from hvdc_ident.fit.result import StartOutcome
from hvdc_ident.fit.simulator import approximate
from hvdc_ident.fit.uncertainty import TWO_SIDED, samples_by_output
from hvdc_ident.fit.whitening import autoregression
from hvdc_ident.immutable import FrozenMap

WHITEN = ("no", "pre-event", "residual")

STARTS = 8
"""Runs of a multistart, where nothing else is said."""
MOST_STARTS = 64
"""Runs of a multistart whose lowest cost is reached once: an optimum that one start in twenty reaches is found by 96 of 100."""
UNVISITED = 0.02
"""Expected share of the starts that would lead to an optimum not seen yet, below which a search for a lower cost ends. Of sines whose
frequency one start in fifteen finds it lets 1 in 50 go unfound (0.05: 1 in 8; 0.01: none of 100, for twice as many starts)."""
SIMULATIONS = 10_000
"""Simulations of all experiments, those for differences counted too, after which no further starts are begun."""
SAME = 0.1
"""A run whose cost is higher by less has reached the optimum: no estimate is off by half its standard deviation."""
LONGER = 1000
"""Evaluations more that the lowest run may take where it used up its own."""
DISTINCT = TWO_SIDED
"""Costs that differ by less are as good: half the 95 % quantile of chi-square with one degree of freedom."""
TIE = 1e-6
"""Costs that differ by this share differ by what no number of rows makes a likelihood notice (half of it a row)."""


@dataclass(frozen=True)
class Refined:
    """A method, then a trust region from where it ended.

    Covariances, bounds and profiles need the optimum itself; methods without derivatives stop some way off. The message
    says what each of the two did.
    """

    method: Optimiser

    def run(self, problem: Problem, start: Array) -> OptimiserResult:
        """Return the result of both together; the first method's failure stands where it found no admissible point."""
        first = self.method.run(problem, start)
        if first.cost is None:
            return first
        end = TrustRegion().run(problem, np.asarray(first.theta))
        used = first.evaluations + end.evaluations
        if end.cost is None:
            return OptimiserResult(first.theta, first.cost, "failed", f"{first.message}; {end.message}", used)
        fall = max(first.cost - end.cost, 0.0)
        message = f"{first.message}; then least squares lowered the cost by {fall:.3g}: {end.message}"
        return OptimiserResult(end.theta, end.cost, end.status, message, used)


@dataclass(frozen=True, eq=False)
class Search:
    """A multistart: the starting points, (p,) each, and the run from each, in the order of the starts."""

    points: tuple[Array, ...]
    runs: tuple[OptimiserResult, ...]

    @property
    def ends(self) -> list[LocalMinimum]:
        """Ends of the runs that could be simulated, the lowest first."""
        reached = [LocalMinimum(r.theta, r.cost) for r in self.runs if r.cost is not None]
        return sorted(reached, key=lambda end: end.cost)


@dataclass(frozen=True)
class StartsSoFar(Known):
    """The starts of a search that its budget has ended. best: by unknown, where the lowest of them ended; empty where none has."""

    best: FrozenMap[float] = field(default_factory=FrozenMap)

    @classmethod
    def of(cls, problem: Problem, runs: Sequence[OptimiserResult], count: int) -> StartsSoFar:
        """Return those of a search for a problem's unknowns that was to make so many runs."""
        reached = [r for r in runs if r.cost is not None]
        best = min(reached, key=lambda r: r.cost or 0.0).theta if reached else ()
        first = f"start {len(runs) + 1}" if len(runs) + 1 == count else f"starts {len(runs) + 1} to {count}"
        return cls(
            outcome_lines(runs),
            (f"{first} of the search for the optimum",) if len(runs) < count else (),
            best=FrozenMap(dict(zip(problem.names, map(float, best), strict=bool(reached)))),
        )


def outcome_lines(runs: Sequence[OptimiserResult | StartOutcome]) -> tuple[str, ...]:
    """Return how each start of a search ended, in lines."""
    return tuple(_outcome_line(k, run) for k, run in enumerate(runs, start=1))


def _outcome_line(number: int, run: OptimiserResult | StartOutcome) -> str:
    cost = "no cost" if run.cost is None else f"cost {run.cost:.6g}"
    return f"search for the optimum, start {number} {run.status} after {run.evaluations} evaluations, {cost}"


def search(
    problem: Problem,
    optimiser: Optimiser | str | None,
    starts: int | None,
    seed: int,
    executor: Executor | None,
    progress: Progress | None,
    begun: Sequence[StartOutcome] = (),
    *,
    misfit_expected: bool = False,
) -> Search:
    """Return the runs from the given start and from others that are spread over the bounds.

    starts: how many; None: 8, and as many again as long as they leave a doubt (`_worth_more`) and all together have taken fewer
    simulations than `SIMULATIONS`. begun: the outcomes of a search for these unknowns, or more of them, that is to be taken up:
    each of its ends is gone on from, in place of new starts. misfit_expected: whether the model is known to lack something: its
    misfit is no doubt then. The lowest run is continued where it used up its evaluations: along a narrow valley it takes more. An
    optimiser with options of its own keeps the evaluations it was given.
    """
    method = named(optimiser) if isinstance(optimiser, str) else optimiser or TrustRegion()
    if not isinstance(method, TrustRegion):
        method = Refined(method)
    if begun:
        so_far = _taken_up(problem, method, begun, executor, progress)
    else:
        so_far = Search((), ())
        count, number = starts or STARTS, 0
        while True:
            points = _round(problem, count - len(so_far.points), seed, number)
            runs = _runs(problem, method, points, count, so_far.runs, executor, progress)
            so_far = Search((*so_far.points, *points), (*so_far.runs, *runs))
            count, number = 2 * count, number + 1
            if starts or not _worth_more(problem, so_far, misfit_expected=misfit_expected):
                break
    return _continued(problem, method, so_far)


def _round(problem: Problem, count: int, seed: int, number: int) -> list[Array]:
    """Return the starting points of one round of a search; the first round begins at the given start."""
    nuisances = problem.unknowns[len(problem.free) :]
    if number == 0:
        return [problem.start, *starting_points(problem.free, nuisances, count - 1, seed)]
    return starting_points(problem.free, nuisances, count, (seed, number))


def _runs(
    problem: Problem,
    method: Optimiser,
    points: Sequence[Array],
    count: int,
    before: Sequence[OptimiserResult],
    executor: Executor | None,
    progress: Progress | None,
) -> list[OptimiserResult]:
    """Return the run from each point. count: of all starts so far planned; before: the runs that were made before.

    Where the budget ends, `StartsSoFar` is what is known.
    """
    runs = list(before)
    try:
        if progress:
            why = " (they disagree)" if runs else ""
            progress(len(runs), count, f"search for the optimum, start {len(runs) + 1} of {count}{why}")
        for run in mapped(executor, partial(method.run, problem), points):
            runs.append(run)
            if progress:
                progress(len(runs), count, _outcome_line(len(runs), run))
    except BudgetSpent as end:
        end.known.append(StartsSoFar.of(problem, runs, count))
        raise
    return runs[len(before) :]


def _worth_more(problem: Problem, so_far: Search, *, misfit_expected: bool) -> bool:
    """Return whether further starts are called for, and the simulations allow them.

    None where all ended at the lowest cost. Where that leaves more than noise a lower one is missing, or the model lacks something:
    starts go on until hardly one would lead to an optimum not seen yet (`unvisited`), or most lead to one of their own, so that more
    would not find them again. Else up to `MOST_STARTS` where the lowest cost was reached once.
    """
    ends = within_own_stretches(problem, so_far.ends)
    differences = len(problem.unknowns) if approximate(problem.simulator) else 0
    if sum(r.evaluations for r in so_far.runs) * (1 + differences) >= SIMULATIONS or not ends:
        return False
    try:
        slack = _slack_at(problem, ends[0], differences > 0)
        higher = higher_ends(problem, ends, slack)
        if not higher:
            return False
        if len(higher) == len(ends) - 1 and len(so_far.points) < MOST_STARTS:
            return True
        levels = 1 + sum(e.cost > before.cost + slack for before, e in zip([ends[0], *higher], higher, strict=False))
        most_alone = len(so_far.points) >= MOST_STARTS and 2 * levels > len(ends)
        known_well = misfit_expected or most_alone or unvisited(levels, len(ends)) <= UNVISITED
        return not known_well and leaves_more_than_noise(problem, ends[0].theta)
    except SimulationError:
        # What could be simulated cannot be again: the fit's result says so, and no start would do better.
        return False


def _slack_at(problem: Problem, best: LocalMinimum, approximate_derivatives: bool) -> float:
    """Return by how much a cost may be above the lowest and be as low. Raises SimulationError."""
    unit = 2.0 * best.cost / max(problem.rows - len(problem.unknowns), 1)
    known = MISFIT not in problem.noise_source.values()
    slack = slack_of(best.cost, max(1.0, unit) if known else unit)
    return slack + (LUCK * roughness(problem, best.theta) if approximate_derivatives else 0.0)


def unvisited(optima: int, searches: int) -> float:
    """Return the expected share of starts that lead to an optimum not seen yet, after so many searches that ended at so many optima.

    The posterior mean where every number of optima, and every size of their basins, was as likely before (Boender and Rinnooy Kan
    1987, doi 10.1007/BF02591684).
    """
    return optima * (optima + 1.0) / (searches * (searches - 1.0)) if searches > optima else 1.0


def leaves_more_than_noise(problem: Problem, theta: Array) -> bool:
    """Return whether the residuals at theta, (p,), are more than the noise stated or, where it is not, than the rows' scatter.

    Raises SimulationError.
    """
    unknown = [o for o, source in problem.noise_source.items() if source == MISFIT]
    if unknown:
        problem = problem.with_(weights={**problem.weights, **misfit_weights(problem, theta, unknown)})
    blocks = problem.blocks(theta, derivatives=False)
    rho, effective = samples_by_output(blocks, theta.size)
    sources = {o: source_text(problem.fitted_experiments, o, problem.weights.get(o)) for o in problem.outputs}
    return bool(adequacy(problem, blocks, sources, effective, rho).structure)


def slack_of(cost: float, unit: float = 1.0, effective_share: float = 1.0) -> float:
    """Return by how much a run's cost may be above another and be as low: it moves no estimate by half its spread.

    unit: mean squared residual that noise alone leaves, half of it the unit of cost. effective_share: independent samples per sample.
    """
    return max(TIE * cost, unit * SAME / effective_share)


def higher_ends(problem: Problem, ends: Sequence[LocalMinimum], slack: float) -> list[LocalMinimum]:
    """Return those of several ends, the lowest first, that reached neither the lowest one's cost, to within a slack, nor its place."""
    best = ends[0]
    return [e for e in ends[1:] if e.cost > best.cost + slack and not same_place(problem, best.theta, e.theta)]


def _taken_up(
    problem: Problem,
    method: Optimiser,
    begun: Sequence[StartOutcome],
    executor: Executor | None,
    progress: Progress | None,
) -> Search:
    """Return the search that goes on from where each run of another ended; ends at one place are gone on from once."""

    def placed(values: Mapping[str, float]) -> Array:
        theta = (min(max(values.get(u.name, u.start), u.min), u.max) for u in problem.unknowns)
        return np.array([*theta], dtype=float)

    lowest = min((o.cost for o in begun if o.cost is not None), default=np.inf)
    places: list[Array] = []
    which: list[int | None] = []
    stay: dict[
        int, str
    ] = {}  # those that used up their evaluations, but for the lowest: nothing more is expected of them
    for o in begun:
        end = placed(o.end)
        alike = next((k for k, known in enumerate(places) if same_place(problem, known, end)), len(places))
        if o.cost is not None and alike == len(places):
            places.append(end)
            if o.status == "max-evaluations" and o.cost > lowest:
                stay[alike] = o.message
        which.append(None if o.cost is None else alike)
    going = [k for k in range(len(places)) if k not in stay]
    gone = _runs(problem, method, [places[k] for k in going], len(going), (), executor, progress)
    runs = dict(zip(going, gone, strict=True)) | {k: _stayed(problem, places[k], why) for k, why in stay.items()}
    points, results = [], []
    for number, (o, k) in enumerate(zip(begun, which, strict=True)):
        points.append(placed(o.start))
        if k is None:
            results.append(OptimiserResult(points[-1], None, "failed", o.message, o.evaluations))
        else:
            added = runs[k].evaluations if which.index(k) == number else 0
            results.append(replace(runs[k], evaluations=o.evaluations + added))
    return Search(tuple(points), tuple(results))


def _stayed(problem: Problem, theta: Array, why: str) -> OptimiserResult:
    """Return the end of a run that used up its evaluations elsewhere, with its cost here. why: its message."""
    cost = cost_at(problem, theta)
    return OptimiserResult(theta, cost, "failed" if cost is None else "max-evaluations", why, 1)


def _continued(problem: Problem, method: Optimiser, so_far: Search) -> Search:
    """Return the search with the lowest run continued where it used up its evaluations."""
    costs = [np.inf if r.cost is None else r.cost for r in so_far.runs]
    lowest = int(np.argmin(costs))
    run = so_far.runs[lowest]
    if run.status != "max-evaluations" or run.cost is None or method != TrustRegion():
        return so_far
    end = TrustRegion(max_evaluations=LONGER).run(problem, run.theta)
    if end.cost is None:
        return so_far
    longer = replace(end, evaluations=run.evaluations + end.evaluations)
    return Search(so_far.points, (*so_far.runs[:lowest], longer, *so_far.runs[lowest + 1 :]))


def same_place(problem: Problem, theta: Array, other: Array) -> bool:
    """Return whether two points, (p,) each, differ by no more than a thousandth of each scaled coordinate's range."""
    space = problem.coordinates
    return bool((np.abs(space.scaled(theta) - space.scaled(other)) <= 1e-3 * space.ranges).all())


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
    if same_place(problem, a.theta, b.theta):
        return True
    space = problem.coordinates
    x, y = space.scaled(a.theta), space.scaled(b.theta)
    if (max(a.cost, b.cost) - min(a.cost, b.cost)) * effective_share >= DISTINCT:
        return False
    barrier = max(a.cost, b.cost) + DISTINCT / effective_share
    try:
        return all(problem.cost(space.unscaled(x + s * (y - x))) < barrier for s in np.linspace(0.0, 1.0, 9)[1:-1])
    except SimulationError:
        return False


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
