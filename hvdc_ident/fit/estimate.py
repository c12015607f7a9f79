"""The verb `fit`: a multistart of least squares, and what the optimum says about the parameters."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.errors import SimulationError
from hvdc_ident.executor import Executor, Progress, mapped
from hvdc_ident.fit.adequacy import adequacy, residual_tests
from hvdc_ident.fit.assessment import assessed
from hvdc_ident.fit.multistart import (
    DISTINCT,
    LocalMinimum,
    Refined,
    best_first,
    cost_of,
    distinct,
    has_clocks,
    latin_hypercube,
    prepared,
    searched,
    weighted,
    whitened_by_residuals,
)
from hvdc_ident.fit.noise_model import floor_of, source_of, source_text
from hvdc_ident.fit.nonsmooth import LUCK, Trend, residual_at, threshold_of, trend_of
from hvdc_ident.fit.objective import promised
from hvdc_ident.fit.optimiser import Optimiser, OptimiserResult
from hvdc_ident.fit.optimisers import catalogue
from hvdc_ident.fit.optimisers import optimiser as named
from hvdc_ident.fit.optimisers.trust_region import TrustRegion
from hvdc_ident.fit.problem import Problem
from hvdc_ident.fit.residual import ResidualBlock
from hvdc_ident.fit.result import NOT_ASKED, Covariance, Estimate, FitResult, StartOutcome, Status
from hvdc_ident.fit.simulator import unknown_of
from hvdc_ident.fit.uncertainty import Uncertainty, estimates_of, uncertainty
from hvdc_ident.immutable import FrozenMap

STARTS = 8
"""Runs of a multistart, where nothing else is said."""
LONGER = 1000
"""Evaluations more that the lowest run may take which used up its own."""
SAME = 0.1
"""A run whose cost is higher by less has reached the optimum: no estimate is off by half its standard deviation."""
SETTLED = 1e-3
"""A Gauss-Newton step that lowers the cost by less moves no estimate by a twentieth of its standard deviation."""


def fit(
    problem: Problem,
    *,
    starts: int | None = None,
    seed: int = 0,
    optimiser: Optimiser | str | None = None,
    whiten: str = "no",
    executor: Executor | None = None,
    progress: Progress | None = None,
    assess: bool = True,
) -> FitResult:
    """The best optimum of a multistart with its covariance, tests of its residuals and the outcome of every start.

    starts: runs in all (default 8; 1 for an optimiser that searches the whole range by itself); the first from the
    given start, the others from a seeded Latin hypercube over the bounds, nuisances from their own start.
    optimiser: one of the catalogue, by name or with options; the ends of all but the default are refined by least squares.
    whiten: "no", "pre-event" (AR model of the noise before the event) or "residual" (of the first fit's residuals).
    assess: whether goodness and validation are wanted too.
    Standard deviations of outputs without noise, or with deterministic data, come from the misfit (`noise_source`).
    Status: converged; at-bound (an estimate lies on a bound); two-optima (another optimum within 1.92 of the best);
    not-converged; failed (no start could be simulated to an end). A run that fails raises nothing: it is in `starts`.
    """
    method, count = _method(optimiser, starts, seed)
    first = prepared(problem, whiten)
    begins = [first.start, *latin_hypercube(first.free, first.unknowns[len(first.free) :], count - 1, seed)]
    runs = _run_all(first, begins, method, executor, progress)
    if all(r.status == "failed" or r.cost is None for r in runs):
        return _failed(first, begins, runs, f"no start reached an end: {runs[0].message}")
    runs = _continued(first, runs, method)
    try:
        problem, result = _result(first, begins, runs, whiten)
    except SimulationError as e:
        return _failed(first, begins, runs, f"the optimum cannot be simulated again: {e}")
    return assessed(problem, result) if assess else result


def _result(
    first: Problem, begins: Sequence[Array], runs: Sequence[OptimiserResult], whiten: str
) -> tuple[Problem, FitResult]:
    """The problem in its final weights, and what its optima say.

    Raises SimulationError where a simulator fails at values at which it did not before.
    """
    local = TrustRegion()
    usable = _ends(runs)
    problem, best, rivals = weighted(first, usable, local)
    if has_clocks(problem):
        best = searched(problem, best, local)
        rivals = [r for r in rivals if r.cost >= best.cost]
    if whiten == "residual":
        problem, best, rivals = whitened_by_residuals(problem, best, rivals, local)
    again = problem is not first or best not in usable
    best, trend = on_trend(problem, best)
    if trend is not None:  # what ended on another tooth of this optimum is no other optimum
        rivals = [
            r for r in rivals if not trend.holds(r.theta, threshold_of(problem, residual_at(problem, best.theta)))
        ]
    blocks = problem.blocks(best.theta)
    source = {o: source_of(problem.fitted_experiments, o) for o in problem.outputs}
    inner, all_unknowns = (
        u.on_trend(trend, problem.names) for u in _uncertainties(problem, best.theta, blocks, source)
    )
    samples = sum(b.residual.size for b in blocks)
    worth = min(1.0, sum(inner.effective.values()) / samples)
    optima = [best] if inner.singular else distinct(problem, [best, *rivals], worth)
    if trend is not None:
        optima = [best, *(o for o in optima if o is not best)]
    outcomes = _outcomes(problem, begins, runs, weigh=problem is not first)
    status, message = _status(problem, best, optima, outcomes, worth, trend, again=again)
    noise = {o: _noise_text(problem, o) for o in problem.outputs}
    judged = adequacy(problem, blocks, noise, inner.effective, inner.rho)
    inner, all_unknowns = inner.widened(judged.widening), all_unknowns.widened(judged.widening)
    found = estimates_of(problem, best.theta, blocks, inner, all_unknowns)
    found = _beside_the_other_optimum(
        problem, found, [o for o in optima[1:] if (o.cost - best.cost) * worth < DISTINCT]
    )
    squares = sum(float(b.residual @ b.residual) for b in blocks)
    return problem, FitResult(
        status=status,
        message=message,
        fitted=tuple(f.name for f in problem.free),
        held=_held(problem),
        values=FrozenMap(problem.values(best.theta)),
        estimates=FrozenMap({f.name: found[f.name] for f in problem.free}),
        nuisance=_nuisance(problem, found),
        cost=best.cost,
        chi2_per_dof=squares / (samples - best.theta.size) if samples > best.theta.size else None,
        rmse=problem.rmse(best.theta),
        rmse_start=problem.rmse_start,
        rmse_given=problem.rmse_given,
        adequacy=judged,
        roughness={} if trend is None else {"delta_chi2": 2.0 * trend.roughness, "text": trend.text},
        noise_source=FrozenMap(noise),
        sigma=problem.sigma,
        rho=inner.rho,
        effective_samples=inner.effective,
        correlation=inner.correlation(),
        residual_tests=residual_tests(_in_time(problem, best.theta, blocks), problem.fitted_experiments),
        starts=outcomes,
        loss=problem.loss.name,
        whitening={o: m for o, m in problem.treatment.whitening.items() if any(m)},
        dof=float(inner.dof) if np.isfinite(inner.dof) else None,
        covariance=Covariance(inner.names, inner.corrected, inner.dof),
    )


def on_trend(problem: Problem, best: LocalMinimum) -> tuple[LocalMinimum, Trend | None]:
    """The optimum, that of the trend where the cost is rough, and that trend. Raises SimulationError."""
    trend = trend_of(problem, best.theta)
    if trend is None:
        return best, None
    r, _ = problem.residual(trend.theta)
    return LocalMinimum(trend.theta, 0.5 * float(r @ r)), trend


def _method(optimiser: Optimiser | str | None, starts: int | None, seed: int) -> tuple[Optimiser, int]:
    """The optimiser as it is run, and how many starts it gets."""
    chosen = named(optimiser, seed) if isinstance(optimiser, str) else optimiser or TrustRegion()
    whole = any(isinstance(chosen, m.OPTIMISER) and getattr(m, "GLOBAL", False) for m in catalogue().values())
    count = starts if starts is not None else (1 if whole else STARTS)
    return chosen if isinstance(chosen, TrustRegion) else Refined(chosen), count


def _run_all(
    problem: Problem, begins: Sequence[Array], method: Optimiser, executor: Executor | None, progress: Progress | None
) -> list[OptimiserResult]:
    """The optimiser's outcome from each start, in the starts' order, whatever runs them."""
    jobs: Iterator[OptimiserResult] = mapped(executor, partial(method.run, problem), begins)
    runs: list[OptimiserResult] = []
    if progress:
        progress(0, len(begins), f"search for the optimum, start 1 of {len(begins)}")
    for run in jobs:
        runs.append(run)
        if progress:
            cost = "no cost" if run.cost is None else f"cost {run.cost:.6g}"
            told = f"start {len(runs)} {run.status} after {run.evaluations} evaluations, {cost}"
            progress(len(runs), len(begins), f"search for the optimum, {told}")
    return runs


def _continued(problem: Problem, runs: Sequence[OptimiserResult], method: Optimiser) -> list[OptimiserResult]:
    """The runs, with the lowest of those that used up their evaluations gone on: along a narrow valley it takes more.

    An optimiser with options of its own keeps the evaluations it was given.
    """
    runs = list(runs)
    spent = [i for i, r in enumerate(runs) if r.status == "max-evaluations" and r.cost is not None]
    if not spent or method != TrustRegion():
        return runs
    i = min(spent, key=lambda k: runs[k].cost or 0.0)
    end = TrustRegion(max_evaluations=LONGER).run(problem, runs[i].theta)
    if end.cost is not None:
        runs[i] = replace(end, evaluations=runs[i].evaluations + end.evaluations)
    return runs


def _ends(runs: Sequence[OptimiserResult]) -> list[LocalMinimum]:
    """Where the runs ended, the lowest cost first whatever stopped it; of the others those that may be optima."""
    reached = [(r.status, LocalMinimum(r.theta, r.cost)) for r in runs if r.cost is not None]
    first, *rest = best_first([o for _, o in reached])
    optima = [o for status, o in reached if status in ("converged", "stalled")]
    return [first, *(o for o in rest if o in optima)]


def _in_time(problem: Problem, theta: Array, blocks: Sequence[ResidualBlock]) -> Sequence[ResidualBlock]:
    """The blocks as samples in time, which tests of residuals need."""
    return blocks if problem.band is None else problem.blocks(theta, derivatives=False, in_time=True)


def _uncertainties(
    problem: Problem, theta: Array, blocks: Sequence[ResidualBlock], source: dict[str, str]
) -> tuple[Uncertainty, Uncertainty]:
    """What the curvature says about the unknowns inside their bounds, and about all of them."""
    names = problem.names
    spans = np.array([u.span for u in problem.unknowns])
    inside = [i for i, (u, v) in enumerate(zip(problem.unknowns, theta, strict=True)) if u.min < v < u.max]
    blocks = _informative(problem, blocks)
    _, prior = problem.prior(theta)
    everything = uncertainty(blocks, names, spans, source, prior, problem.noise_dof)
    if len(inside) == len(names):
        return everything, everything
    fewer = [replace(b, jacobian=b.jacobian[:, inside]) for b in blocks]
    inner = uncertainty(fewer, [names[i] for i in inside], spans[inside], source, prior[:, inside], problem.noise_dof)
    return inner, everything


def _informative(problem: Problem, blocks: Sequence[ResidualBlock]) -> list[ResidualBlock]:
    """The blocks with the information their samples have under a robust loss."""
    if problem.loss.linear:
        return list(blocks)
    share = {
        o: problem.loss.efficiency(np.concatenate([b.residual for b in blocks if b.output == o]))
        for o in problem.outputs
    }
    return [
        replace(b, residual=problem.loss.psi(b.residual), jacobian=b.jacobian * np.sqrt(share[b.output]))
        for b in blocks
    ]


def _outcomes(
    problem: Problem, begins: Sequence[Array], runs: Sequence[OptimiserResult], *, weigh: bool = True
) -> tuple[StartOutcome, ...]:
    """The table of starts, with costs in the problem's weights."""
    rows = []
    for begin, run in zip(begins, runs, strict=True):
        cost = run.cost
        if weigh and cost is not None:
            cost = cost_of(problem, run.theta)
        names = problem.names
        at = FrozenMap(dict(zip(names, map(float, begin), strict=True)))
        end = FrozenMap(dict(zip(names, map(float, run.theta), strict=True)))
        rows.append(StartOutcome(at, end, cost, run.status, run.message, run.evaluations))
    return tuple(rows)


def _status(
    problem: Problem,
    best: LocalMinimum,
    optima: Sequence[LocalMinimum],
    outcomes: Sequence[StartOutcome],
    worth: float,
    trend: Trend | None,
    *,
    again: bool,
) -> tuple[Status, str]:
    """The status of the whole fit and why, worst first.

    again: whether the optimum was found once more in other weights than the runs had. trend: where the cost is rough.
    """
    jump = 0.0 if trend is None else LUCK * trend.roughness
    lower = [o for o in outcomes if o.cost is not None and (best.cost - jump - o.cost) * worth > DISTINCT]
    if trend is not None:
        lower = [o for o in lower if not trend.holds(_end(problem, o), DISTINCT / worth)]
    if lower:
        return "not-converged", f"a run had reached a lower cost: {lower[0].message}"
    if trend is not None and not trend.settled:
        return "not-converged", f"the trend of the cost has no optimum near the best run's end: {trend.text}"
    there = _arrived(problem, best, outcomes, worth, jump)
    if not again and trend is None and all(o.status == "flat" for o in there):
        return "not-converged", f"the start with the lowest cost did not move: {there[0].message}"
    if again and trend is None and promised(problem, best.theta) > SETTLED:
        return "not-converged", (
            "the cost still falls where the best run used up its evaluations: bounds, a nearer start or more of [fit] starts help"
        )
    if not again and trend is None and not _stands(problem, best, there):
        return "not-converged", f"the best run did not reach an optimum: {there[0].message}"
    near = [o for o in optima[1:] if (o.cost - best.cost) * worth < DISTINCT]
    if near:
        theta = ", ".join(f"{n} = {v:.6g}" for n, v in zip(problem.names, near[0].theta, strict=True))
        return "two-optima", f"another optimum is as good (cost higher by {near[0].cost - best.cost:.3g}): {theta}"
    at_bound = [f.name for f, v in zip(problem.unknowns, best.theta, strict=True) if not f.min < v < f.max]
    if at_bound:
        return "at-bound", f"on a bound: {', '.join(at_bound)}"
    if again:
        count = sum(o.status == "converged" for o in outcomes)
        return "converged", f"{count} of {len(outcomes)} runs converged, and the best again in the final weights"
    flat = sum(o.status == "flat" for o in outcomes)
    unmoved = f"; {flat} could not move, for no compared output answers where they start" if flat else ""
    return "converged", f"{len(there)} of {len(outcomes)} runs reached this optimum{unmoved}"


def _beside_the_other_optimum(
    problem: Problem, found: dict[str, Estimate], rivals: Sequence[LocalMinimum]
) -> dict[str, Estimate]:
    """The estimates, each with the value it has at another optimum as good where that lies outside its interval."""
    told = dict(found)
    for name, e in found.items():
        values = [float(o.theta[problem.names.index(name)]) for o in rivals]
        low, high = e.ci95 or (None, None)
        outside = [v for v in values if low is not None and high is not None and not low <= v <= high]
        if outside:
            words = f"another optimum, as good, has {outside[0]:.6g}: the interval is that of this one alone"
            told[name] = replace(e, reason=f"{e.reason}; {words}" if e.reason else words)
    return told


def _arrived(
    problem: Problem, best: LocalMinimum, outcomes: Sequence[StartOutcome], worth: float, jump: float
) -> list[StartOutcome]:
    """The runs that reached the optimum, the best first: its cost, to within what moves no estimate by half its spread, or
    its place, to a thousandth of the ranges, for a cost may scatter by the simulation's own error. jump: what it does so by,
    where that is known."""
    slack = max(1e-6 * best.cost, SAME / worth) + jump
    reached = [
        (o.cost, o)
        for o in outcomes
        if o.cost is not None and (o.cost <= best.cost + slack or (o.status != "failed" and _there(problem, best, o)))
    ]
    return [o for _, o in sorted(reached, key=lambda pair: pair[0])]


def _end(problem: Problem, outcome: StartOutcome) -> Array:
    """(p,) where a run ended."""
    return np.array([outcome.end[n] for n in problem.names])


def _there(problem: Problem, best: LocalMinimum, outcome: StartOutcome) -> bool:
    """Return whether a run ended where the best one did."""
    space = problem.coordinates
    end = space.scaled(_end(problem, outcome))
    return bool((np.abs(end - space.scaled(best.theta)) <= 1e-3 * space.ranges).all())


def _stands(problem: Problem, best: LocalMinimum, there: Sequence[StartOutcome]) -> bool:
    """Return whether the best point is an optimum: a run says so that arrived, or nothing is left to gain, or two runs agree.

    Runs that ended at one point from different starts have found what there is to be found, whatever stopped them.
    """
    if any(o.status == "converged" for o in there) or promised(problem, best.theta) <= SETTLED:
        return True
    return sum(o.status == "stalled" and _there(problem, best, o) for o in there) > 1


def _held(problem: Problem) -> FrozenMap[str]:
    """The reason for each parameter that is not fitted."""
    free = {f.name for f in problem.free}
    rest = [n for n in problem.simulator.parameters if n not in free]
    default = {n: "held at a given value" if n in problem.held else NOT_ASKED for n in rest}
    return FrozenMap({n: problem.why.get(n, default[n]) for n in rest})


def _nuisance(problem: Problem, found: dict[str, Estimate]) -> FrozenMap[FrozenMap[Estimate]]:
    """The estimates of the nuisances by experiment."""
    return FrozenMap(
        {
            e.name: FrozenMap({n: found[unknown_of(e.name, n)] for n in e.nuisance})
            for e in problem.fitted_experiments
            if e.nuisance
        }
    )


def _noise_text(problem: Problem, output: str) -> str:
    """Where an output's standard deviation comes from, in words."""
    weight = problem.weights.get(output)
    floor = weight is not None and weight <= floor_of(problem.fitted_experiments, output)
    return source_text(problem.fitted_experiments, output, floor)


def _failed(problem: Problem, begins: Sequence[Array], runs: Sequence[OptimiserResult], message: str) -> FitResult:
    """The result where no run reached an admissible end, or none can be repeated."""
    return FitResult(
        status="failed",
        message=message,
        fitted=tuple(f.name for f in problem.free),
        held=_held(problem),
        values=FrozenMap(problem.held),
        rmse_start=problem.rmse_start,
        rmse_given=problem.rmse_given,
        starts=_outcomes(problem, begins, runs, weigh=False),
    )
