"""The individual mode: one group of parameters after the other, each on its own outputs and experiments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hvdc_ident.data import Experiment
from hvdc_ident.errors import SimulationError, StudyError, unknown_name
from hvdc_ident.executor import Executor, Progress
from hvdc_ident.fit.adequacy import adequacy
from hvdc_ident.fit.assessment import assessed
from hvdc_ident.fit.estimate import fit
from hvdc_ident.fit.noise import from_misfit
from hvdc_ident.fit.optimiser import Optimiser
from hvdc_ident.fit.problem import Problem
from hvdc_ident.fit.residual_tests import residual_tests
from hvdc_ident.fit.result import Covariance, FitResult, Status
from hvdc_ident.immutable import FrozenMap

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
    starts: int | None = None,
    seed: int = 0,
    optimiser: Optimiser | str | None = None,
    whiten: str = "no",
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> FitResult:
    """The fits of the groups, one after the other, as one result.

    While one group is fitted the other free parameters are held: at their estimate if their turn has been, else at
    their given value. Every estimate is conditional on those. The status is the worst of the groups'; cost, RMSE and tests
    are those of the whole problem with all estimates put in. A group that fails leaves its parameters there.
    Raises StudyError or UnknownNameError for groups that do not fit the problem.
    """
    _check(problem, groups)
    current = {f.name: f.given for f in problem.free}
    results = []
    for group in groups:
        result = fit(
            part_of(problem, group, current),
            starts=starts,
            seed=seed,
            optimiser=optimiser,
            whiten=whiten,
            executor=executor,
            progress=progress,
            assess=False,
        )
        current |= {n: result.values[n] for n in group.parameters if n in result.values and n in result.estimates}
        results.append(result)
    return _merged(problem, results, current)


def _check(problem: Problem, groups: Sequence[Group]) -> None:
    free = [f.name for f in problem.free]
    named = [n for g in groups for n in g.parameters]
    for name in named:
        if name not in free:
            raise unknown_name("free parameter", name, free, where="fit groups")
    if sorted(named) != sorted(free):
        raise StudyError(
            "groups must hold every free parameter once",
            where="fit groups",
            expected=", ".join(free),
            got=", ".join(named),
        )
    names = [e.name for e in problem.fitted_experiments]
    for group in groups:
        for name in group.experiments:
            if name not in names:
                raise unknown_name("fitted experiment", name, names, where="fit groups")
        for name in group.outputs:
            if name not in problem.outputs:
                raise unknown_name("measured output", name, problem.outputs, where="fit groups")


def part_of(problem: Problem, group: Group, current: dict[str, float]) -> Problem:
    """The problem of one group alone."""
    mine = tuple(f for f in problem.free if f.name in group.parameters)
    others = {n: v for n, v in current.items() if n not in group.parameters}
    why = dict.fromkeys(others, "fitted in a group of its own")
    return replace(
        problem,
        experiments=tuple(e for e in (_seen(e, group) for e in problem.fitted_experiments) if e is not None),
        free=mine,
        held=problem.held | others,
        why=problem.why | why,
        conditional_on=FrozenMap({f.name: (*problem.conditional_on.get(f.name, ()), *others) for f in mine}),
        rho=FrozenMap({o: m for o, m in problem.rho.items() if not group.outputs or o in group.outputs}),
    )


def _seen(experiment: Experiment, group: Group) -> Experiment | None:
    """The experiment with the group's outputs alone; None where it has none or is not the group's."""
    if experiment.measured is None or (group.experiments and experiment.name not in group.experiments):
        return None
    outputs = [o for o in experiment.outputs if not group.outputs or o in group.outputs]
    return experiment.with_(measured=experiment.measured.select(outputs)) if outputs else None


def _merged(problem: Problem, results: Sequence[FitResult], current: dict[str, float]) -> FitResult:
    """The groups' results as one, judged on the whole problem."""
    status: Status = min((r.status for r in results), key=_WORST.index)
    message = "; ".join(f"group {i + 1}: {r.status}, {r.message}" for i, r in enumerate(results))
    weights: dict[str, float] = {}
    nuisance: FrozenMap = FrozenMap()
    for r in results:
        nuisance = nuisance | r.nuisance
        for output, source in r.noise_source.items():
            if from_misfit(source):
                weights[output] = next(s[output] for s in r.sigma.values() if output in s)
    models = {o: m for r in results for o, m in r.whitening.items()}
    whole = replace(
        problem,
        weights=problem.weights | weights,
        rho=problem.rho | models,
        experiments=tuple(_with_known(e, nuisance) for e in problem.experiments),
    )
    shift = {f"{e}:{n}": v.value for e, group in nuisance.items() for n, v in group.items()}
    theta = np.array([current.get(u.name, shift.get(u.name, u.start)) for u in whole.unknowns])
    result = FitResult(
        status=status,
        message=message,
        fitted=tuple(f.name for f in problem.free),
        held=FrozenMap({n: w for n, w in results[0].held.items() if n not in current}),
        values=FrozenMap(whole.values(theta)),
        estimates=FrozenMap(
            {f.name: r.estimates[f.name] for f in problem.free for r in results if f.name in r.estimates}
        ),
        nuisance=nuisance,
        rmse=whole.rmse(theta),
        rmse_start=problem.rmse_start,
        rmse_given=problem.rmse_given,
        noise_source=FrozenMap({k: v for r in results for k, v in r.noise_source.items()}),
        sigma=whole.sigma,
        rho=FrozenMap({k: v for r in results for k, v in r.rho.items()}),
        effective_samples=FrozenMap({k: v for r in results for k, v in r.effective_samples.items()}),
        correlation={k: v for r in results for k, v in r.correlation.items()},
        starts=tuple(replace(s, group=i) for i, r in enumerate(results) for s in r.starts),
        loss=problem.loss.name,
        whitening=models,
        dof=min((r.dof for r in results if r.dof is not None), default=None),
        covariance=_together(results),
    )
    try:
        cost = whole.cost(theta)
        blocks = whole.blocks(theta, derivatives=False, in_time=True)
    except SimulationError as error:
        return replace(result, status="failed", message=f"{message}; all estimates together: {error}")
    squares = sum(float(b.residual @ b.residual) for b in blocks)
    spare = sum(b.residual.size for b in blocks) - theta.size
    tests = residual_tests(blocks, whole.fitted_experiments)
    judged = adequacy(whole, blocks, result.noise_source, result.effective_samples, result.rho)
    chi2 = squares / spare if spare > 0 else None
    result = replace(result, cost=cost, chi2_per_dof=chi2, adequacy=judged, residual_tests=tests)
    return assessed(whole, result)


def _with_known(experiment: Experiment, nuisance: Mapping[str, Mapping[str, object]]) -> Experiment:
    """The experiment without nuisances that no group's fit has estimated."""
    known = nuisance.get(experiment.name, {})
    if experiment.role != "fit":
        return experiment
    return experiment.with_(nuisance=tuple(n for n in experiment.nuisance if n in known))


def _together(results: Sequence[FitResult]) -> Covariance | None:
    """The covariances side by side: groups fitted one after the other are taken as independent."""
    parts = [r.covariance for r in results if r.covariance is not None]
    names = tuple(n for c in parts for n in c.names)
    if not parts or len(set(names)) < len(names):
        return None  # a nuisance that two groups estimated
    matrix = np.zeros((len(names), len(names)))
    place = 0
    for c in parts:
        matrix[place : place + len(c.names), place : place + len(c.names)] = c.matrix
        place += len(c.names)
    return Covariance(names, matrix, min(c.dof for c in parts))
