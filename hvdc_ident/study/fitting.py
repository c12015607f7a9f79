"""A study's fit: its problem, the fits it asks for, and what is written about them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np
import sympy as sp

from hvdc_ident.budget import BudgetSpent
from hvdc_ident.errors import ComputationError, SteadyStateError
from hvdc_ident.files import csv_columns
from hvdc_ident.fit import FitResult, Group, Problem, StartOutcome, fit, fit_each, fit_individually
from hvdc_ident.fit.judgement import Judgement, Judgements, judge
from hvdc_ident.fit.likelihood import loss
from hvdc_ident.fit.partial_fits import part_of
from hvdc_ident.fit.residual import Curve, compared_rows
from hvdc_ident.fit.result import EachSoFar, FitSoFar
from hvdc_ident.fit.search import outcome_lines
from hvdc_ident.fit.tolerance_profile import tolerance
from hvdc_ident.identifiability import gated_fit
from hvdc_ident.model import Model, is_white_box
from hvdc_ident.simulate import simulate
from hvdc_ident.study.checks import need_candidates, need_experiments, need_start
from hvdc_ident.study.recorded_inputs import fitted_records
from hvdc_ident.study.schema import FitTable
from hvdc_ident.study.study import priors
from hvdc_ident.summary.stage_results import Derived, ExperimentContext
from hvdc_ident.text import listed

if TYPE_CHECKING:
    from hvdc_ident.data import Experiment, Trajectory
    from hvdc_ident.executor import Executor, Progress
    from hvdc_ident.fit.adequacy import ResidualSize
    from hvdc_ident.fit.tolerance_profile import ToleranceProfile
    from hvdc_ident.identifiability import IdentifiabilityReport
    from hvdc_ident.study.study import Study


@lru_cache(maxsize=1)
def problem_of(study: Study) -> Problem:
    """Return the fit of all candidates to the study's recordings and measured frequency responses.

    Of one study it is made once, for the model runs each record whose input is a recorded one.
    """
    simulator, experiments = fitted_records(study)
    return Problem(simulator, experiments, tuple(study.candidates.values()))


def asked_of(study: Study) -> FitTable:
    """The study's [fit], or its defaults."""
    return study.settings.fit or FitTable()


def with_settings(study: Study, problem: Problem) -> Problem:
    """The problem with the loss, the guard, the band and the priors of the study."""
    asked = asked_of(study)
    band = None
    if asked.residual == "frequency":
        band = (asked.band[0], asked.band[1]) if asked.band else (0.0, np.inf)
    known = {n: p for n, p in priors(study.settings, study.experiments).items() if n in problem.names}
    return replace(problem, loss=loss(asked.loss), guard=asked.guard, band=band, priors=problem.priors | known)


def as_reported(study: Study) -> bool:
    """Return whether the fit is of the same data in the same way as the report's, so that its profiles are the fit's."""
    asked = asked_of(study)
    plain = asked.loss == "linear" and asked.whiten == "no" and asked.residual == "time" and not asked.guard
    return plain and not priors(study.settings, study.experiments)


def groups_of(study: Study, names: Collection[str]) -> list[Group]:
    """Return the groups of the individual mode with those of their parameters that are named; those with none are left out."""
    groups = [
        Group(tuple(n for n in g.parameters if n in names), tuple(g.outputs or ()), tuple(g.experiments or ()))
        for g in asked_of(study).groups
    ]
    return [g for g in groups if g.parameters]


def need(study: Study, stage: str) -> None:
    """Raise StudyError where the study has no data to fit or no candidate, SteadyStateError where it has no start."""
    need_experiments(study, stage, role="fit", responses=True)
    need_candidates(study, stage)
    need_start(study)


def estimated(
    study: Study,
    report: IdentifiabilityReport,
    *,
    force: Sequence[str] = (),
    seed: int = 0,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> FitResult:
    """Return the fit of the candidates that a report calls identifiable, and of those that are forced."""

    def fit_of(open_set: Problem) -> FitResult:
        settled = with_settings(study, open_set)
        return fitted(study, settled, report.pilot.ends_over, seed=seed, executor=executor, progress=progress)

    return gated_fit(
        problem_of(study), report, fit_of, force=force, whole=as_reported(study), executor=executor, progress=progress
    )


def fitted(
    study: Study,
    problem: Problem,
    begun: Callable[[Sequence[str]], Sequence[StartOutcome]],
    *,
    seed: int,
    executor: Executor | None,
    progress: Progress | None,
) -> FitResult:
    """The fit the study asks for, with the statistics over its experiments one by one.

    begun: from names of parameters the search over them that is taken up.
    """
    asked = asked_of(study)
    common: dict[str, Any] = {
        "starts": asked.starts,
        "seed": seed,
        "optimiser": asked.optimiser,
        "whiten": asked.whiten,
        "executor": executor,
        "progress": progress,
    }
    names = [f.name for f in problem.free]
    groups = groups_of(study, names)
    if groups:
        result = fit_individually(problem, groups, **common, begun=begun)
    else:
        result = fit(problem, **common, begun=begun(names))
    if result.status == "failed" or len(problem.fitted_experiments) < 2:
        return result
    try:
        return replace(result, per_experiment=_one_by_one(problem, groups, result, asked.whiten, executor, progress))
    except BudgetSpent as end:
        own = next((k for k in end.known if isinstance(k, EachSoFar)), EachSoFar())
        done = (*outcome_lines(result.starts), *own.done)
        whole = replace(result, per_experiment=dict(own.table))
        end.known[:] = [FitSoFar(done, own.not_tried, own.later, result=whole)]
        raise


def _one_by_one(
    problem: Problem,
    groups: list[Group],
    result: FitResult,
    whiten: str,
    executor: Executor | None,
    progress: Progress | None,
) -> dict[str, Any]:
    """The statistics over fits to single experiments, each begun at the estimates, group by group."""
    at = {f.name: result.values[f.name] for f in problem.free}
    parts = [part_of(problem, g, at) for g in groups] or [problem]
    parts = [p for p in parts if len(p.fitted_experiments) > 1]
    table: dict[str, Any] = {}
    done, count = 0, sum(len(p.fitted_experiments) for p in parts)
    for part in parts:
        begun = replace(part, free=tuple(replace(f, start=min(max(at[f.name], f.min), f.max)) for f in part.free))
        told = None if progress is None else partial(_beside_others, progress, done, count)
        try:
            table |= fit_each(begun, whiten=whiten, executor=executor, progress=told)
        except BudgetSpent as end:
            own = next((k for k in end.known if isinstance(k, EachSoFar)), EachSoFar())
            rest = [f"the fits of {listed(p.names)} to single experiments" for p in parts[parts.index(part) + 1 :]]
            end.known[:] = [replace(own, later=tuple(rest), table={**table, **own.table})]
            raise
        done += len(part.fitted_experiments)
    return table


def _beside_others(progress: Progress, before: int, count: int, done: int, _: int, text: str) -> None:
    """Tell the progress of one part of so many pieces of work. before: those of the parts before it."""
    progress(before + done, count, text)


def curves_of_run(experiment: Experiment, run: Trajectory) -> dict[str, Curve]:
    """Return the recorded outputs of an experiment beside those of a run at its times; those without a compared row are left out."""
    measured = experiment.measured
    assert measured is not None
    return {
        o: Curve(
            run[o], measured[o], compared_rows(experiment, o), float(experiment.noise.get(o) or np.nan), None, None
        )
        for o in experiment.outputs
        if np.isfinite(measured[o][experiment.compared]).any()
    }


def judgement_of(
    study: Study, sets: Mapping[str, Mapping[str, Mapping[str, Curve]]], result: FitResult | None = None
) -> Judgements:
    """Return whether the model follows the recordings, by set of values.

    sets: by name, the curves of every output by experiment and output. result: the fit that gave the curves named "fitted", whose own
    judgement of the residuals then holds.
    """
    by = Yardsticks.of(study)
    sizes = result.adequacy.signals if result is not None and result.adequacy is not None else {}
    judged = {name: by.judge(runs, sizes if name == "fitted" else None) for name, runs in sets.items()}
    head = {k: getattr(by.profile, k) for k in ("name", "version", "title", "source", "notes", "unit")}
    return Judgements(by.tolerances, {**head, "named": by.named}, judged)


@dataclass(frozen=True)
class Yardsticks:
    """What runs of a study's model are judged by, as the study states it.

    profile: of the windows; named: whether the study names it. tolerances: of the RMSE by output, in its unit. units: of the outputs.
    """

    experiments: tuple[Experiment, ...]
    units: Mapping[str, str]
    profile: ToleranceProfile
    tolerances: Mapping[str, float]
    named: bool

    @classmethod
    def of(cls, study: Study) -> Yardsticks:
        """Return those of a study. Raises InputError where its file of the profile cannot be read."""
        asked, stated = asked_of(study), study.settings.diagnose
        return cls(
            study.experiments,
            {n: o.unit for n, o in study.model.outputs.items()},
            tolerance(asked.tolerance, study.path.parent),
            {} if stated is None else stated.tolerances,
            "tolerance" in asked.model_fields_set,
        )

    def judge(
        self,
        runs: Mapping[str, Mapping[str, Curve]],
        sizes: Mapping[str, Mapping[str, ResidualSize]] | None = None,
    ) -> Judgement:
        """Return the judgement of runs, by experiment and output. sizes: of the residuals, where a fit has told them."""
        recorded = {e.name: runs[e.name] for e in self.experiments if e.name in runs}
        return judge(
            recorded, self.experiments, self.units, self.profile,
            tolerance=self.tolerances, named=self.named, sizes=sizes,
        )  # fmt: skip


def curves_at_given(study: Study) -> dict[str, dict[str, Curve]]:
    """Return every recorded output beside a run at the given values, by experiment and output; experiments without a run are left out."""
    curves = {}
    for e in study.experiments:
        try:
            curves[e.name] = curves_of_run(e, simulate(study.model, e, study.given).trajectory)
        except (ComputationError, SteadyStateError):  # the stage `simulate` says why
            continue
    return curves


def curves_csv(experiment: Experiment, curves: Mapping[str, Curve]) -> str:
    """CSV text: time, then for each measured output OUTPUT, OUTPUT.measured and the ends of the 95 % band of a sample.

    The columns OUTPUT.low and OUTPUT.high are left out where no estimate has a standard deviation.
    """
    columns = {"time": experiment.time}
    for output, c in curves.items():
        columns |= {output: c.model, f"{output}.measured": c.measured}
        if c.band is not None:
            columns |= {f"{output}.low": c.model - c.band, f"{output}.high": c.model + c.band}
    return csv_columns(columns)


def context_of(e: Experiment, status: str = "", reason: str = "") -> ExperimentContext:
    """Return an experiment as the results hold it. status, reason: of a run at the given values."""
    return ExperimentContext(e.role, e.event, e.window, e.recording, status, reason)


def derived(study: Study, result: FitResult) -> dict[str, Derived]:
    """Return the parameters that follow from the fitted ones, by a tie or a parameterisation.

    std by the derivative of the expression and the covariance of the estimates; None where one of them has none.
    """
    model = study.model
    if not is_white_box(model):
        return {}
    names = [n for n, line in study.settings.parameters.items() if line.tie is not None]
    if study.settings.model.parameterisation is not None:
        from hvdc_ident.models import load_model

        source = study.settings.model.source
        plain = load_model(source) if "/" not in source and not source.endswith((".toml", ".py")) else None
        if is_white_box(plain):
            names += [n for n in plain.parameters if n in model.signals and n not in names]
    table = {}
    for name in names:
        expression = model.signals[name].value
        value, std = _value(expression, model, result)
        table[name] = Derived(value, std, model.signals[name].unit, str(expression))
    return table


def _value(expression: sp.Expr, model: Model, result: FitResult) -> tuple[float, float | None]:
    values = {**model.values, **result.values}
    at = {s: values[s.name] for s in expression.free_symbols}
    value = float(expression.subs(at))
    moved = [s for s in expression.free_symbols if s.name in result.estimates]
    known = result.covariance
    if (
        not moved
        or known is None
        or any(result.estimates[s.name].std is None or s.name not in known.names for s in moved)
    ):
        return value, None
    slope = np.array([float(sp.diff(expression, s).subs(at)) for s in moved])
    place = [known.names.index(s.name) for s in moved]
    return value, float(np.sqrt(slope @ known.matrix[np.ix_(place, place)] @ slope))
