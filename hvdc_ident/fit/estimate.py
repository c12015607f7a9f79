"""The verb `fit`: a multistart of least squares, and the result at its best optimum.

The search itself is in `search`. Here its optima become a status, estimates with intervals, tests of the residuals and
the table of starts.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from hvdc_ident.budget import BudgetSpent
from hvdc_ident.data import Array
from hvdc_ident.errors import SimulationError
from hvdc_ident.executor import Executor, Progress
from hvdc_ident.fit.adequacy import adequacy, residual_tests
from hvdc_ident.fit.assessment import assessed
from hvdc_ident.fit.descent import predicted_reduction
from hvdc_ident.fit.jump_instants import (
    PlacedInstant,
    placed_instants,
    search_instants,
    within_own_stretches,
    within_stretches,
)
from hvdc_ident.fit.noise import source_text
from hvdc_ident.fit.nonsmooth import LUCK, Trend, residual_at, threshold_of, trend_of
from hvdc_ident.fit.optimiser import LocalMinimum, Optimiser, OptimiserResult
from hvdc_ident.fit.optimisers.trust_region import TrustRegion
from hvdc_ident.fit.problem import Problem
from hvdc_ident.fit.residual import ResidualBlock
from hvdc_ident.fit.result import NOT_ASKED, Covariance, Estimate, FitResult, StartOutcome, Status
from hvdc_ident.fit.search import (
    DISTINCT,
    SAME,
    StartsSoFar,
    cost_at,
    distinct,
    higher_ends,
    local_minima,
    prewhitened,
    reweighted,
    same_place,
    search,
    slack_of,
    whitened_by_residuals,
)
from hvdc_ident.fit.simulator import unknown_of
from hvdc_ident.fit.uncertainty import Uncertainty, estimates_of, uncertainty
from hvdc_ident.immutable import FrozenMap

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
    begun: Sequence[StartOutcome] = (),
    misfit_expected: bool = False,
) -> FitResult:
    """Return the best optimum of a multistart with its covariance, tests of its residuals and the outcome of every start.

    starts: runs in all (left out: 8, and more where they leave a doubt, see `search`); the first from the given start, the
    others from a seeded Latin hypercube over the bounds, nuisances from their own start. begun: a search that is taken up
    from where its runs ended, in place of new starts. misfit_expected: whether the model is known to lack something, so that a misfit
    calls for no further starts.
    optimiser: one of the catalogue, by name or with options; the ends of all but the default are refined by least squares.
    whiten: "no", "pre-event" (AR model of the noise before the event) or "residual" (of the first fit's residuals).
    assess: whether goodness and validation are wanted too.
    Standard deviations of outputs without noise, or with deterministic data, come from the misfit (`noise_source`).
    Status: converged; at-bound (an estimate lies on a bound); two-optima (another optimum within 1.92 of the best);
    not-converged; failed (no start could be simulated to an end). A run that fails raises nothing: it is in `starts`.
    """
    first = prewhitened(problem, whiten)
    multistart = search(first, optimiser, starts, seed, executor, progress, begun, misfit_expected=misfit_expected)
    points, runs = multistart.points, multistart.runs
    if all(r.status == "failed" or r.cost is None for r in runs):
        return failed(first, points, runs, f"no start reached an end: {runs[0].message}")
    try:
        problem, result = _result(first, points, runs, whiten)
        return assessed(problem, result) if assess else result
    except SimulationError as e:
        return failed(first, points, runs, f"the optimum cannot be simulated again: {e}")
    except BudgetSpent as end:
        so_far = StartsSoFar.of(first, runs, len(runs))
        end.known.append(replace(so_far, not_tried=("the estimates and their intervals at the lowest of the starts",)))
        raise


def _result(
    first: Problem, points: Sequence[Array], runs: Sequence[OptimiserResult], whiten: str
) -> tuple[Problem, FitResult]:
    """Return the problem in its final weights, and the result at its best optimum.

    Raises SimulationError where a simulator fails at values at which it did not before.
    """
    usable = local_minima(runs)
    problem, best, rivals = _in_final_weights(first, usable, whiten)
    refitted = problem is not first or best not in usable
    trend = trend_of(problem, best.theta)
    if trend is not None:
        r, _ = problem.residual(trend.theta)
        best = LocalMinimum(trend.theta, 0.5 * float(r @ r))
        # An end in another local minimum of this trend is no other optimum.
        if rivals:
            threshold = threshold_of(problem, residual_at(problem, best.theta))
            rivals = [end for end in rivals if not trend.holds(end.theta, threshold)]
    blocks = problem.blocks(best.theta)
    rise = threshold_of(problem, np.concatenate([b.residual for b in blocks]))
    placed = placed_instants(problem, best.theta, rise) if trend is None else {}
    inner, everything = (u.on_trend(trend, problem.names) for u in _uncertainties(problem, best.theta, blocks, placed))
    samples = sum(b.residual.size for b in blocks)
    effective_share = min(1.0, sum(inner.effective.values()) / samples)
    optima = [best] if inner.singular else distinct(problem, [best, *rivals], effective_share)
    if trend is not None:
        optima = [best, *(o for o in optima if o is not best)]
    outcomes = _outcomes(problem, points, runs, weigh=problem is not first)
    near = [o for o in optima[1:] if (o.cost - best.cost) * effective_share < DISTINCT]
    status, message = _status(problem, best, near, outcomes, effective_share, trend, refitted=refitted)
    result = result_at(problem, best, blocks, inner.rho, inner.effective)
    judged = result.adequacy
    assert judged is not None
    jump = 0.0 if trend is None else LUCK * trend.roughness
    doubt = _doubt(problem, best, outcomes, samples, effective_share, jump)
    message = f"{doubt}; {message}" if doubt else message
    inner, everything = inner.widened(judged.widening), everything.widened(judged.widening)
    estimates = estimates_of(problem, best.theta, blocks, inner, everything, systematic=judged.systematic)
    estimates = _with_placed(problem, best.theta, estimates, placed)
    estimates = _with_rivals(problem, estimates, near)
    nuisance = {
        e.name: FrozenMap({n: estimates[unknown_of(e.name, n)] for n in e.nuisance})
        for e in problem.fitted_experiments
        if e.nuisance
    }
    return problem, replace(
        result,
        status=status,
        message=message,
        estimates=FrozenMap({f.name: estimates[f.name] for f in problem.free}),
        nuisance=FrozenMap(nuisance),
        roughness={} if trend is None else {"delta_chi2": 2.0 * trend.roughness, "text": trend.text},
        correlation=inner.correlation(),
        starts=outcomes,
        search_doubt=doubt,
        dof=float(inner.dof) if np.isfinite(inner.dof) else None,
        covariance=Covariance(inner.names, inner.corrected, inner.dof),
        instants=placed,
    )


def result_at(
    problem: Problem,
    at: LocalMinimum,
    blocks: Sequence[ResidualBlock],
    rho: Mapping[str, float],
    effective: Mapping[str, float],
) -> FitResult:
    """Return the part of a result that the values alone decide: of a problem in its final weights, without estimates.

    blocks: the residuals there. rho, effective: AR(1) coefficient of the residuals and independent samples, by output.
    Raises SimulationError.
    """
    samples, unknowns = sum(b.residual.size for b in blocks), at.theta.size
    squares = sum(float(b.residual @ b.residual) for b in blocks)
    in_time = blocks if problem.band is None else problem.blocks(at.theta, derivatives=False, in_time=True)
    noise = {o: source_text(problem.fitted_experiments, o, problem.weights.get(o)) for o in problem.outputs}
    return FitResult(
        status="converged",
        message="",
        fitted=tuple(f.name for f in problem.free),
        held=_held(problem),
        values=FrozenMap(problem.values(at.theta)),
        cost=at.cost,
        chi2_per_dof=squares / (samples - unknowns) if samples > unknowns else None,
        rmse=problem.rmse(at.theta),
        rmse_start=problem.rmse_start,
        rmse_given=problem.rmse_given,
        adequacy=adequacy(problem, blocks, noise, effective, rho),
        noise_source=FrozenMap(noise),
        sigma=problem.sigma,
        rho=FrozenMap(rho),
        effective_samples=FrozenMap(effective),
        residual_tests=residual_tests(in_time, problem.fitted_experiments),
        loss=problem.loss.name,
        whitening={o: m for o, m in problem.treatment.whitening.items() if any(m)},
    )


def _in_final_weights(
    problem: Problem, ends: Sequence[LocalMinimum], whiten: str
) -> tuple[Problem, LocalMinimum, list[LocalMinimum]]:
    """Return the problem in its final weights and noise model, its best optimum and the other candidates."""
    local = TrustRegion()
    problem, best, rivals = reweighted(problem, ends, local)
    better = search_instants(problem, best, local)
    if better is not best:
        problem, best, rivals = reweighted(problem, [better, *rivals], local)
        rivals = [r for r in rivals if r.cost >= best.cost]
    if whiten == "residual":
        problem, best, rivals = whitened_by_residuals(problem, best, rivals, local)
    return problem, best, rivals


def _uncertainties(
    problem: Problem, theta: Array, blocks: Sequence[ResidualBlock], placed: Collection[str]
) -> tuple[Uncertainty, Uncertainty]:
    """Return the uncertainty of the unknowns inside their bounds, the others held there, and that of all.

    placed: unknowns that are held as well, for no curvature tells their interval.
    """
    if not problem.loss.linear:  # samples have less information under a robust loss
        share = {
            o: problem.loss.efficiency(np.concatenate([b.residual for b in blocks if b.output == o]))
            for o in problem.outputs
        }
        blocks = [
            replace(b, residual=problem.loss.psi(b.residual), jacobian=b.jacobian * np.sqrt(share[b.output]))
            for b in blocks
        ]
    names = problem.names
    spans = np.array([u.span for u in problem.unknowns])
    inside = [
        i
        for i, (u, v) in enumerate(zip(problem.unknowns, theta, strict=True))
        if not u.on_bound(v) and u.name not in placed
    ]
    _, prior = problem.prior(theta)
    everything = uncertainty(blocks, names, spans, problem.noise_source, prior, problem.noise_dof)
    if len(inside) == len(names):
        return everything, everything
    fewer = [replace(b, jacobian=b.jacobian[:, inside]) for b in blocks]
    inner = uncertainty(
        fewer, [names[i] for i in inside], spans[inside], problem.noise_source, prior[:, inside], problem.noise_dof
    )
    return inner, everything


def _outcomes(
    problem: Problem, points: Sequence[Array], runs: Sequence[OptimiserResult], *, weigh: bool = True
) -> tuple[StartOutcome, ...]:
    """Return the table of starts, with costs in the problem's weights."""
    rows = []
    for point, run in zip(points, runs, strict=True):
        cost = cost_at(problem, run.theta) if weigh and run.cost is not None else run.cost
        start, end = (FrozenMap(dict(zip(problem.names, map(float, t), strict=True))) for t in (point, run.theta))
        rows.append(StartOutcome(start, end, cost, run.status, run.message, run.evaluations))
    return tuple(rows)


def _status(
    problem: Problem,
    best: LocalMinimum,
    near: Sequence[LocalMinimum],
    outcomes: Sequence[StartOutcome],
    effective_share: float,
    trend: Trend | None,
    *,
    refitted: bool,
) -> tuple[Status, str]:
    """Return the status of the whole fit and its reason, worst first.

    near: other optima that are as good. refitted: whether the optimum was found once more in other weights than the runs
    had. trend: where the cost is nonsmooth.
    """
    jump = 0.0 if trend is None else LUCK * trend.roughness
    lower = [o for o in outcomes if o.cost is not None and (best.cost - jump - o.cost) * effective_share > DISTINCT]
    if trend is not None:
        lower = [o for o in lower if not trend.holds(_end(problem, o), DISTINCT / effective_share)]
    if lower:
        return "not-converged", f"a run had reached a lower cost: {lower[0].message}"
    if trend is not None and not trend.settled:
        return "not-converged", f"the trend of the cost has no optimum near the best run's end: {trend.text}"
    arrived = _arrived(problem, best, outcomes, effective_share, jump)
    if not refitted and trend is None and all(o.status == "flat" for o in arrived):
        return "not-converged", f"the start with the lowest cost did not move: {arrived[0].message}"
    smooth = within_stretches(problem, best.theta)
    if refitted and trend is None and predicted_reduction(smooth, best.theta) > SETTLED:
        return "not-converged", (
            "the cost still falls where the best run used up its evaluations: bounds, a nearer start or more of [fit] starts help"
        )
    if not refitted and trend is None and not _is_optimum(problem, best, arrived):
        return "not-converged", f"the best run did not reach an optimum: {arrived[0].message}"
    if near:
        theta = ", ".join(f"{n} = {v:.6g}" for n, v in zip(problem.names, near[0].theta, strict=True))
        return "two-optima", f"another optimum is as good (cost higher by {near[0].cost - best.cost:.3g}): {theta}"
    at_bound = [f.name for f, v in zip(problem.unknowns, best.theta, strict=True) if f.on_bound(v)]
    if at_bound:
        return "at-bound", f"on a bound: {', '.join(at_bound)}"
    if refitted:
        count = sum(o.status == "converged" for o in outcomes)
        return "converged", f"{count} of {len(outcomes)} runs converged, and the best again in the final weights"
    flat = sum(o.status == "flat" for o in outcomes)
    unmoved = f"; {flat} could not move, for no compared output answers where they start" if flat else ""
    return "converged", f"{len(arrived)} of {len(outcomes)} runs reached this optimum{unmoved}"


def _arrived(
    problem: Problem, best: LocalMinimum, outcomes: Sequence[StartOutcome], effective_share: float, jump: float
) -> list[StartOutcome]:
    """Return the runs that reached the optimum, the best first.

    They reached its cost, to within what moves no estimate by half its spread, or its place, to a thousandth of the ranges,
    for a cost may scatter by the simulation's own error. jump: that scatter, where it is known.
    """
    slack = slack_of(best.cost, effective_share=effective_share) + jump
    reached = [
        (o.cost, o)
        for o in outcomes
        if o.cost is not None
        and (
            o.cost <= best.cost + slack or (o.status != "failed" and same_place(problem, best.theta, _end(problem, o)))
        )
    ]
    return [o for _, o in sorted(reached, key=lambda pair: pair[0])]


def _doubt(
    problem: Problem,
    optimum: LocalMinimum,
    outcomes: Sequence[StartOutcome],
    samples: int,
    effective_share: float,
    jump: float,
) -> str:
    """Return in words that one start alone reached the lowest cost of several; "" where another did, or none disagrees.

    Nor is there doubt of the starts where the optimum was found beyond where all of them ended, by a search over instants, or where
    none but one began between the same rows.

    Then the starts say nothing of how likely a still lower cost is. The size of the residual is the unit of cost, whether or not the
    noise is known: costs that differ by less lead to the same estimates. samples: number of residuals.
    """
    reached = [LocalMinimum(_end(problem, o), o.cost) for o in outcomes if o.cost is not None]
    ends = within_own_stretches(problem, sorted(reached, key=lambda end: end.cost))
    failed = len(outcomes) - len(reached)
    if not ends or len(ends) + failed < 2:
        return ""
    lowest = ends[0].cost
    unit = max(1.0, 2.0 * lowest / max(samples - len(problem.unknowns), 1))
    slack = slack_of(lowest, unit, effective_share) + jump
    if optimum.cost < lowest - slack:
        return ""
    others = [end.cost for end in higher_ends(problem, ends, slack)]
    if len(others) < len(ends) - 1:
        return ""
    levels = [c for k, c in enumerate(others) if k == 0 or c > others[k - 1] + slack]
    parts = []
    if levels:
        costs = f"{len(levels)} higher costs" if len(levels) > 1 else "a higher cost"
        between = f" from {levels[0]:.4g} to {levels[-1]:.4g}" if len(levels) > 1 else f" of {levels[0]:.4g}"
        parts.append(f"{len(others)} ended at {costs}{between}")
    if failed:
        parts.append(f"{failed} failed")
    return (
        f"one start of {len(outcomes)} alone reached the lowest cost, {lowest:.4g} ({', '.join(parts)}): a lower one may exist, "
        "and [fit] starts = ... searches from more"
    )


def _end(problem: Problem, outcome: StartOutcome) -> Array:
    """Return where a run ended, (p,)."""
    return np.array([outcome.end[n] for n in problem.names])


def _is_optimum(problem: Problem, best: LocalMinimum, arrived: Sequence[StartOutcome]) -> bool:
    """Return whether a run that arrived says the best point is an optimum, no more can be gained, or two runs agree.

    Runs that ended at one point from different starts have found what there is to be found, whatever stopped them.
    """
    if any(o.status == "converged" for o in arrived) or predicted_reduction(problem, best.theta) <= SETTLED:
        return True
    return sum(o.status == "stalled" and same_place(problem, best.theta, _end(problem, o)) for o in arrived) > 1


def _with_placed(
    problem: Problem, theta: Array, estimates: Mapping[str, Estimate], placed: Mapping[str, PlacedInstant]
) -> dict[str, Estimate]:
    """Return the estimates with the intervals of instants between rows, and those of the others over all of these.

    An interval of another parameter reaches from its lowest end to its highest where the instant moves over its own.
    """
    widened = dict(estimates)
    for name, instant in placed.items():
        for other, e in estimates.items():
            if other == name or other in placed or e.ci95 is None or None in e.ci95:
                continue
            k = problem.names.index(other)
            moved = [float(x[k] - theta[k]) for v, _, x in instant.points if instant.low <= v <= instant.high]
            low, high = widened[other].ci95 or e.ci95
            assert low is not None and high is not None
            reason = f"it moves with {name}, which the rows leave open between {instant.low:.6g} and {instant.high:.6g}"
            wider = max(moved) - min(moved) > SAME * (high - low)
            widened[other] = replace(
                widened[other],
                ci95=(low + min(moved), high + max(moved)),
                reason="; ".join(filter(None, [widened[other].reason, reason if wider else ""])),
            )
        widened[name] = replace(
            widened[name],
            std=None,
            ci95=(instant.low, instant.high),
            method="between-rows",
            reason=f"{instant.text[0].lower()}{instant.text[1:]}",
        )
    return widened


def _with_rivals(
    problem: Problem, estimates: Mapping[str, Estimate], rivals: Sequence[LocalMinimum]
) -> dict[str, Estimate]:
    """Return the estimates, each with the value it has at another optimum as good where that is outside its interval."""
    remarked = dict(estimates)
    for name, e in estimates.items():
        values = [float(o.theta[problem.names.index(name)]) for o in rivals]
        low, high = e.ci95 or (None, None)
        outside = [v for v in values if low is not None and high is not None and not low <= v <= high]
        if outside:
            remark = f"another optimum, as good, has {outside[0]:.6g}: the interval is that of this one alone"
            remarked[name] = replace(e, reason=f"{e.reason}; {remark}" if e.reason else remark)
    return remarked


def _held(problem: Problem) -> FrozenMap[str]:
    """Return the reason for each parameter that is not fitted."""
    free = {f.name for f in problem.free}
    others = [n for n in problem.simulator.parameters if n not in free]
    default = {n: "held at a given value" if n in problem.held else NOT_ASKED for n in others}
    return FrozenMap({n: problem.why.get(n, default[n]) for n in others})


def failed(problem: Problem, points: Sequence[Array], runs: Sequence[OptimiserResult], message: str) -> FitResult:
    """Return the result where no run reached an admissible end, or none can be repeated."""
    return FitResult(
        status="failed",
        message=message,
        fitted=tuple(f.name for f in problem.free),
        held=_held(problem),
        values=FrozenMap(problem.held),
        rmse_start=problem.rmse_start,
        rmse_given=problem.rmse_given,
        starts=_outcomes(problem, points, runs, weigh=False),
    )
