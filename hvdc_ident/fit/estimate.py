"""The verb `fit`: a multistart of least squares, and what the optimum says about the parameters."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Protocol

import numpy as np

from hvdc_ident.errors import SimulationError
from hvdc_ident.fit.intervals import estimates_of
from hvdc_ident.fit.noise import GIVEN, MISFIT, floor_of, source_of
from hvdc_ident.fit.nuisance import unknown_of
from hvdc_ident.fit.optimiser import Optimiser, OptimiserResult
from hvdc_ident.fit.optimisers.trust_region import TrustRegion
from hvdc_ident.fit.problem import Problem
from hvdc_ident.fit.residual import Block
from hvdc_ident.fit.residual_tests import residual_tests
from hvdc_ident.fit.result import Estimate, FitResult, StartOutcome, Status
from hvdc_ident.fit.starts import DISTINCT, Optimum, distinct, latin_hypercube
from hvdc_ident.fit.uncertainty import Uncertainty, uncertainty
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.trajectory import Array

Progress = Callable[[int, int, str], None]
"""Called with runs done, runs in all, and a line of text."""


class Executor(Protocol):
    """Anything with the `map` of concurrent.futures."""

    def map(self, function: Callable[[Any], Any], items: Iterable[Any], /) -> Iterator[Any]:
        """The function's results in the items' order."""


def fit(
    problem: Problem,
    *,
    starts: int = 8,
    seed: int = 0,
    optimiser: Optimiser | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> FitResult:
    """The best optimum of a multistart with its covariance, tests of its residuals and the outcome of every start.

    starts: runs in all; the first from the given start, the others from a seeded Latin hypercube over the bounds.
    Standard deviations of outputs without noise, or with deterministic data, come from the misfit (`noise_source`).
    Status: converged; at-bound (an estimate lies on a bound); two-optima (another optimum within 1.92 of the best);
    not-converged; failed (no start could be simulated to an end). A run that fails raises nothing: it is in `starts`.
    """
    method = optimiser if optimiser is not None else TrustRegion()
    begins = [problem.start, *latin_hypercube(problem.unknowns, starts - 1, seed)]
    runs = _run_all(problem, begins, method, executor, progress)
    usable = [_optimum(r) for r in runs if r.status != "failed" and r.cost is not None]
    if not usable:
        return _failed(problem, begins, runs)
    problem, best, rivals = _weighted(problem, usable, method)
    blocks = problem.blocks(best.theta)
    source = {o: source_of(problem.fitted_experiments, o) for o in problem.outputs}
    inner, all_unknowns = _uncertainties(problem, best.theta, blocks, source)
    samples = sum(b.residual.size for b in blocks)
    worth = min(1.0, sum(inner.effective.values()) / samples)
    optima = [best] if inner.singular else distinct(problem, [best, *rivals], worth)
    outcomes = _outcomes(problem, begins, runs)
    status, message = _status(problem, best, optima, runs, outcomes, worth)
    found = estimates_of(problem, best.theta, blocks, inner, all_unknowns)
    return FitResult(
        status=status,
        message=message,
        fitted=tuple(f.name for f in problem.free),
        held=_held(problem),
        values=FrozenMap(problem.values(best.theta)),
        estimates=FrozenMap({f.name: found[f.name] for f in problem.free}),
        nuisance=_nuisance(problem, found),
        cost=best.cost,
        chi2_per_dof=2.0 * best.cost / (samples - best.theta.size) if samples > best.theta.size else None,
        rmse=problem.rmse(best.theta),
        rmse_start=problem.rmse(problem.start),
        noise_source=FrozenMap({o: _noise_text(problem, o, source[o]) for o in problem.outputs}),
        sigma=problem.sigma,
        rho=inner.rho,
        effective_samples=inner.effective,
        correlation=inner.correlation(),
        residual_tests=residual_tests(blocks, problem.fitted_experiments),
        starts=outcomes,
    )


def _run_all(
    problem: Problem, begins: Sequence[Array], method: Optimiser, executor: Executor | None, progress: Progress | None
) -> list[OptimiserResult]:
    """The optimiser's outcome from each start, in the starts' order, whatever runs them."""
    jobs: Iterator[OptimiserResult] = (executor.map if executor else map)(partial(method.run, problem), begins)
    runs = []
    for run in jobs:
        runs.append(run)
        if progress:
            cost = "-" if run.cost is None else f"{run.cost:.6g}"
            progress(len(runs), len(begins), f"start {len(runs)}: {run.status}, cost {cost}")
    return runs


def _optimum(run: OptimiserResult) -> Optimum:
    assert run.cost is not None
    return Optimum(run.theta, run.cost)


def _weighted(problem: Problem, ends: Sequence[Optimum], method: Optimiser) -> tuple[Problem, Optimum, list[Optimum]]:
    """The problem with the misfit's weights where noise is not given, its best optimum and the other candidates.

    One output: the optimum does not depend on its weight. Several: fitted again until the weights stand (1 %).
    """
    ends = sorted(ends, key=lambda o: o.cost)
    open_outputs = [o for o in problem.outputs if source_of(problem.fitted_experiments, o) == MISFIT]
    if not open_outputs:
        return problem, ends[0], list(ends[1:])
    best = ends[0]
    rivals = distinct(problem, ends)[1:4]
    for _ in range(20):
        weights = _misfit_weights(problem, best.theta, open_outputs)
        settled = all(abs(weights[o] / problem.weights.get(o, np.inf) - 1.0) < 0.01 for o in open_outputs)
        problem = problem.with_(weights={**problem.weights, **weights})
        if len(problem.outputs) == 1 or settled:
            break
        again = method.run(problem, best.theta)
        if again.status == "failed":
            break
        best = _optimum(again)
    candidates = [best.theta, *(r.theta for r in rivals)]
    if len(problem.outputs) > 1:
        moved = [method.run(problem, r.theta) for r in rivals]
        candidates = [best.theta, *(m.theta for m in moved if m.status != "failed")]
    again_at = [Optimum(t, c) for t in candidates if (c := _cost(problem, t)) is not None]
    best, *rivals = sorted(again_at, key=lambda o: o.cost)
    return problem, best, rivals


def _cost(problem: Problem, theta: Array) -> float | None:
    """The cost as the optimiser saw it, from runs with sensitivities; None where a run fails."""
    try:
        r, _ = problem.residual(theta)
    except SimulationError:
        return None
    return 0.5 * float(r @ r)


def _misfit_weights(problem: Problem, theta: Array, outputs: Sequence[str]) -> dict[str, float]:
    """The RMSE of each output over all its records, freed of the fitted unknowns' share, in its unit.

    For a whitened problem it is the standard deviation of the whitened residual that becomes 1.
    """
    blocks = problem.blocks(theta)
    total = sum(b.residual.size for b in blocks)
    share = total / max(total - theta.size, 1)
    weights = {}
    for output in outputs:
        squares = np.concatenate([(b.residual * b.sigma) ** 2 for b in blocks if b.output == output])
        floor = floor_of(problem.fitted_experiments, output)
        weights[output] = max(float(np.sqrt(squares.mean() * share)), floor)
    return weights


def _uncertainties(
    problem: Problem, theta: Array, blocks: Sequence[Block], source: dict[str, str]
) -> tuple[Uncertainty, Uncertainty]:
    """What the curvature says about the unknowns inside their bounds, and about all of them."""
    names = problem.names
    spans = np.array([u.span for u in problem.unknowns])
    inside = [i for i, (u, v) in enumerate(zip(problem.unknowns, theta, strict=True)) if u.min < v < u.max]
    everything = uncertainty(blocks, names, spans, source)
    if len(inside) == len(names):
        return everything, everything
    fewer = [replace(b, jacobian=b.jacobian[:, inside]) for b in blocks]
    return uncertainty(fewer, [names[i] for i in inside], spans[inside], source), everything


def _outcomes(
    problem: Problem, begins: Sequence[Array], runs: Sequence[OptimiserResult], *, weigh: bool = True
) -> tuple[StartOutcome, ...]:
    """The table of starts, with costs in the problem's weights."""
    rows = []
    for begin, run in zip(begins, runs, strict=True):
        cost = run.cost
        if weigh and problem.weights and cost is not None:
            cost = _cost(problem, run.theta)
        names = problem.names
        at = FrozenMap(dict(zip(names, map(float, begin), strict=True)))
        end = FrozenMap(dict(zip(names, map(float, run.theta), strict=True)))
        rows.append(StartOutcome(at, end, cost, run.status, run.message, run.evaluations))
    return tuple(rows)


def _status(
    problem: Problem,
    best: Optimum,
    optima: Sequence[Optimum],
    runs: Sequence[OptimiserResult],
    outcomes: Sequence[StartOutcome],
    worth: float,
) -> tuple[Status, str]:
    """The status of the whole fit and why, worst first."""
    slack = 1e-6 * best.cost + 1e-9
    arrived = [o for o in outcomes if o.status == "converged" and o.cost is not None and o.cost <= best.cost + slack]
    lower = [o for o in outcomes if o.cost is not None and (best.cost - o.cost) * worth > DISTINCT]
    if lower and lower[0].status == "failed":
        return "not-converged", f"a run that failed had reached a lower cost: {lower[0].message}"
    if not arrived and not any(r.status == "converged" for r in runs):
        return "not-converged", "no run reached an optimum; the best was stopped by its evaluations"
    if not arrived and len(problem.outputs) == 1:
        return "not-converged", "the best run was stopped by its evaluations"
    near = [o for o in optima[1:] if (o.cost - best.cost) * worth < DISTINCT]
    if near:
        theta = ", ".join(f"{n} = {v:.6g}" for n, v in zip(problem.names, near[0].theta, strict=True))
        return "two-optima", f"another optimum is as good (cost higher by {near[0].cost - best.cost:.3g}): {theta}"
    at_bound = [f.name for f, v in zip(problem.unknowns, best.theta, strict=True) if not f.min < v < f.max]
    if at_bound:
        return "at-bound", f"on a bound: {', '.join(at_bound)}"
    count = sum(o.status == "converged" for o in outcomes)
    return "converged", f"{count} of {len(outcomes)} runs converged, {len(arrived)} to this optimum"


def _held(problem: Problem) -> FrozenMap[str]:
    """The reason for each parameter that is not fitted."""
    free = {f.name for f in problem.free}
    rest = [n for n in problem.simulator.parameters if n not in free]
    default = {n: "held at a given value" if n in problem.held else "not a candidate" for n in rest}
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


def _noise_text(problem: Problem, output: str, source: str) -> str:
    """Where an output's standard deviation comes from, in words."""
    if source == GIVEN:
        return "given"
    if problem.weights[output] <= floor_of(problem.fitted_experiments, output):
        return "misfit, at the floor of 1e-6 of the range"
    return "misfit"


def _failed(problem: Problem, begins: Sequence[Array], runs: Sequence[OptimiserResult]) -> FitResult:
    """The result where no run reached an admissible end."""
    return FitResult(
        status="failed",
        message=f"no start reached an end: {runs[0].message}",
        fitted=tuple(f.name for f in problem.free),
        held=_held(problem),
        values=FrozenMap(problem.held),
        rmse_start=problem.rmse(problem.start),
        starts=_outcomes(problem, begins, runs, weigh=False),
    )
