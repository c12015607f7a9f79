"""Fits of a problem's parts: one group of parameters after the other, or each experiment alone.

Groups are fitted each on its own outputs and experiments, the other free parameters held. The fits of single experiments
show by their spread how well one set of values serves all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.linalg import block_diag
from scipy.special import stdtrit

from hvdc_ident.budget import BudgetSpent, Known
from hvdc_ident.data import Array
from hvdc_ident.errors import SimulationError, StudyError, require_known
from hvdc_ident.executor import Executor, Progress, mapped
from hvdc_ident.fit.assessment import assessed, in_final_weights
from hvdc_ident.fit.estimate import failed, fit, result_at
from hvdc_ident.fit.fit_parameter import FitParameter
from hvdc_ident.fit.optimiser import LocalMinimum, OptimiserResult
from hvdc_ident.fit.problem import Problem
from hvdc_ident.fit.result import Covariance, EachSoFar, FitResult, StartOutcome, Status
from hvdc_ident.fit.search import outcome_lines
from hvdc_ident.fit.simulator import unknown_of
from hvdc_ident.fit.uncertainty import NO_INTERVAL, samples_by_output
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.text import listed

_WORST: tuple[Status, ...] = ("failed", "not-converged", "two-optima", "at-bound", "converged")


@dataclass(frozen=True)
class Group:
    """Parameters fitted together, on some outputs of some experiments; none named means all."""

    parameters: tuple[str, ...]
    outputs: tuple[str, ...] = ()
    experiments: tuple[str, ...] = ()


def fit_individually(
    problem: Problem,
    groups: Sequence[Group],
    *,
    begun: Callable[[Sequence[str]], Sequence[StartOutcome]] = lambda names: (),
    **options: Any,
) -> FitResult:
    """Return the fits of the groups, one after the other, as one result.

    While one group is fitted the other free parameters are held: at their estimate if their turn has been, else at
    their given value. Every estimate is conditional on those. The status is the worst of the groups'; cost, RMSE and tests
    are those of the whole problem with all estimates put in. A group that fails leaves its parameters at those values.
    begun: from the names of a group's parameters the search that its fit takes up. options: as in `fit`.
    Raises StudyError or UnknownNameError for groups that do not fit the problem.
    """
    check_groups(problem, groups)
    whole, at = problem, {f.name: f.given for f in problem.free}
    parts: list[FitResult] = []
    for number, group in enumerate(groups, start=1):
        try:
            result = fit(part_of(problem, group, at), assess=False, begun=begun(group.parameters), **options)
        except BudgetSpent as end:
            rest = listed([n for g in groups[number:] for n in g.parameters])
            before = tuple(line for r in parts for line in outcome_lines(r.starts))
            end.known.insert(0, Known(before, later=(f"all of {rest}",) if rest else ()))
            raise
        at |= {n: e.value for n, e in result.estimates.items()}
        whole = in_final_weights(whole, result)
        parts.append(result)
    result = _together(whole, at, parts)
    return result if result.status == "failed" else assessed(whole, result)


def check_groups(problem: Problem, groups: Sequence[Group]) -> None:
    """Raise StudyError or UnknownNameError for groups that do not fit the problem."""
    free, where = [f.name for f in problem.free], "fit groups"
    grouped = [n for g in groups for n in g.parameters]
    require_known("free parameter", grouped, free, where)
    if sorted(grouped) != sorted(free):
        raise StudyError(
            "groups must hold every free parameter once", where=where, expected=", ".join(free), got=", ".join(grouped)
        )
    experiments = [e.name for e in problem.fitted_experiments]
    for group in groups:
        require_known("fitted experiment", group.experiments, experiments, where)
        require_known("measured output", group.outputs, problem.outputs, where)


def part_of(problem: Problem, group: Group, current: dict[str, float]) -> Problem:
    """Return the problem of one group alone: its parameters, and its outputs in its experiments.

    current: values of the free parameters; those of other groups are held there.
    """
    mine = tuple(f for f in problem.free if f.name in group.parameters)
    others = {n: v for n, v in current.items() if n not in group.parameters}
    experiments = []
    for e in problem.fitted_experiments:
        outputs = [o for o in e.outputs if not group.outputs or o in group.outputs]
        if outputs and e.measured is not None and (not group.experiments or e.name in group.experiments):
            experiments.append(e.with_(measured=e.measured.select(outputs)))
    return replace(
        problem,
        experiments=tuple(experiments),
        free=mine,
        held=problem.held | others,
        why=problem.why | dict.fromkeys(others, "fitted in a group of its own"),
        conditional_on=FrozenMap({f.name: (*problem.conditional_on.get(f.name, ()), *others) for f in mine}),
        rho=FrozenMap({o: m for o, m in problem.rho.items() if not group.outputs or o in group.outputs}),
    )


def _together(whole: Problem, at: Mapping[str, float], parts: Sequence[FitResult]) -> FitResult:
    """Return the result of the problem, which is in final weights, with the estimates of its parts, (`at` by parameter).

    Parts fitted one after the other are taken as independent. Of a nuisance that several estimated the last estimate stands.
    """
    numbered = [(f"group {i}", r) for i, r in enumerate(parts, start=1)]
    nuisance = {e: own for r in parts for e, own in r.nuisance.items()}
    values = {**at, **{unknown_of(e, n): v.value for e, own in nuisance.items() for n, v in own.items()}}
    theta = np.array([values.get(u.name, u.start) for u in whole.unknowns])
    status: Status = min((r.status for r in parts), key=_WORST.index)
    message = "; ".join(f"{group}: {r.status}, {r.message}" for group, r in numbered)
    try:
        blocks = whole.blocks(theta, derivatives=False)
        result = result_at(
            whole, LocalMinimum(theta, whole.cost(theta)), blocks, *samples_by_output(blocks, theta.size)
        )
    except SimulationError as error:
        point = OptimiserResult(theta, None, "failed", str(error), 1)
        return failed(whole, [theta], [point], f"{message}; all estimates together: {error}")
    estimates = {n: e for r in parts for n, e in r.estimates.items()}
    if result.adequacy is not None and result.adequacy.systematic:  # together, though each may fit its own records
        stated = {n: e for n, e in estimates.items() if e.method != "none"}
        estimates |= {n: e.without_interval(NO_INTERVAL) for n, e in stated.items()}
    known = [r.covariance for r in parts if r.covariance is not None]
    names = tuple(n for c in known for n in c.names)
    joint = Covariance(names, block_diag(*(c.matrix for c in known)), min((c.dof for c in known), default=np.inf))
    return replace(
        result,
        status=status,
        message=message,
        estimates=FrozenMap({f.name: estimates[f.name] for f in whole.free if f.name in estimates}),
        nuisance=FrozenMap(nuisance),
        correlation={n: line for r in parts for n, line in r.correlation.items()},
        starts=tuple(replace(s, group=i) for i, r in enumerate(parts) for s in r.starts),
        search_doubt="; ".join(f"{group}: {r.search_doubt}" for group, r in numbered if r.search_doubt),
        dof=min((r.dof for r in parts if r.dof is not None), default=None),
        covariance=joint if len(set(names)) == len(names) else None,
    )


def fit_each(
    problem: Problem,
    *,
    runs: Mapping[str, Sequence[str]] | None = None,
    whiten: str = "no",
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Return by parameter the estimates of each experiment alone, and their spread, as the JSON's `per_experiment`.

    runs: by name, the experiments of each fit, where one fit is to hold several; left out: each alone.
    executor: the fits are shared out over it.
    Each: experiments {name: {value, std, status}}, on_bound, and what `spread` gives, all in the parameter's unit.
    Fits that failed or did not converge are listed and left out of the spread; so are estimates on a bound, whose
    number is `on_bound`. Raises UnknownNameError for a run's experiment that is not fitted, StudyError for an empty run.
    """
    parts = _parts(problem, runs)
    outcomes: Iterator[FitResult] = mapped(executor, partial(_alone, whiten=whiten), list(parts.values()))
    results: dict[str, FitResult] = {}
    try:
        for name, result in zip(parts, outcomes, strict=True):
            results[name] = result
            if progress:
                progress(len(results), len(parts), f"'{name}' alone: {result.status}")
    except BudgetSpent as end:
        done = tuple(f"'{name}' alone: {r.status}" for name, r in results.items())
        rest = listed([f"'{n}'" for n in parts if n not in results])
        table = {f.name: _row(f, results) for f in problem.free} if results else {}
        end.known.append(EachSoFar(done, (f"the fits to {rest} alone",) if rest else (), table=table))
        raise
    return {f.name: _row(f, results) for f in problem.free}


def _parts(problem: Problem, runs: Mapping[str, Sequence[str]] | None) -> dict[str, Problem]:
    """Return the problem of each run."""
    known = {e.name: e for e in problem.fitted_experiments}
    parts = {}
    for run, names in ({n: (n,) for n in known} if runs is None else runs).items():
        require_known("fitted experiment", names, known, f"run '{run}'")
        if not names:
            raise StudyError("a run without experiments", where=f"run '{run}'", expected="at least one experiment")
        parts[run] = problem.with_(experiments=[known[n] for n in names])
    return parts


def _alone(problem: Problem, *, whiten: str) -> FitResult:
    """Return the fit that begins at the start alone."""
    return fit(problem, starts=1, whiten=whiten, assess=False)


def _row(free: FitParameter, results: Mapping[str, FitResult]) -> dict[str, Any]:
    """Return one parameter's estimates by run, and their spread."""
    rows: dict[str, dict[str, Any]] = {}
    for run, result in results.items():
        e = result.estimates.get(free.name)
        rows[run] = {"value": None if e is None else e.value, "std": None if e is None else e.std}
        rows[run]["status"] = result.status
    ended = [r for r in rows.values() if r["status"] in ("converged", "at-bound")]
    inside = np.array([r["value"] for r in ended if r["std"] is not None], dtype=float)
    on_bound = sum(r["value"] is not None and free.on_bound(r["value"]) for r in ended)
    return {"experiments": rows, "on_bound": on_bound, **spread(inside)}


def spread(values: Array) -> dict[str, Any]:
    """Return n, mean, std (n - 1), variance, cv (std over |mean|), and two 95 % intervals; None where n is too small.

    `ci95` = mean -+ t std sqrt(1 + 1/n) is where one more value falls; `ci95_of_mean` = mean -+ t std/sqrt(n) is an
    interval of the mean over runs, which shrinks with their number: neither is an interval of the parameter.
    """
    n = values.size
    names = ("mean", "std", "variance", "cv", "ci95", "ci95_of_mean")
    table: dict[str, Any] = {"n": n, **dict.fromkeys(names)}
    if n:
        table["mean"] = float(values.mean())
    if n < 2:
        return table
    mean, std = table["mean"], float(values.std(ddof=1))
    half = half_width(std, n)
    one = half * math.sqrt(n + 1.0)
    return table | {
        "std": std,
        "variance": std**2,
        "cv": std / abs(mean) if mean else None,
        "ci95": [mean - one, mean + one],
        "ci95_of_mean": [mean - half, mean + half],
    }


def half_width(std: float, n: int) -> float:
    """Return t std/sqrt(n), half the 95 % interval of the mean of n values with that standard deviation, in its unit."""
    return float(stdtrit(n - 1, 0.975)) * std / math.sqrt(n)
