"""The verb `identifiability`: structure, pilot fit, information and profiles, put together into a report.

Each stage takes parameters out of the fit and gives its verdict on them (`practical`); what is left is fitted. By groups
the stages run once a group, the other groups held, and the reports are joined.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from hvdc_ident.budget import BudgetSpent
from hvdc_ident.data import Experiment
from hvdc_ident.errors import SimulationError, StudyError
from hvdc_ident.executor import Executor, Progress
from hvdc_ident.fit import FitParameter, FitResult, Problem, Simulator
from hvdc_ident.fit.adequacy import structure_text
from hvdc_ident.fit.frequency_data import WithResponses, in_time
from hvdc_ident.fit.jump_instants import moving_parameters
from hvdc_ident.fit.noise import unknown_noise
from hvdc_ident.fit.partial_fits import Group, check_groups, part_of
from hvdc_ident.fit.profile_path import ProfileOptions
from hvdc_ident.fit.simulator import inputs_of
from hvdc_ident.identifiability.experiment_design import Recommendation, recommend
from hvdc_ident.identifiability.likelihood_intervals import pair_of, thresholds
from hvdc_ident.identifiability.misspecification import (
    Misspecification,
    heterogeneity,
    misspecification,
    noise_half_widths,
)
from hvdc_ident.identifiability.pilot_fit import LocalAnalysis, at_given_values, pilot_fit
from hvdc_ident.identifiability.practical import (
    Assessment,
    hold_structural,
    profile_remaining,
    with_placed_instants,
    without_insensitive,
    without_null_directions,
)
from hvdc_ident.identifiability.report import CONDITIONS, Contribution, Held, IdentifiabilityReport, Pilot
from hvdc_ident.identifiability.structural import StructuralAnalysis, structural_analysis
from hvdc_ident.identifiability.unfinished import joined_so_far, report_so_far
from hvdc_ident.identifiability.verdicts import HIDDEN_BY_MISFIT, WIDE, scale_of, unjudged_verdict, with_misfit_remark
from hvdc_ident.immutable import FrozenMap, joined
from hvdc_ident.model import Model, is_white_box
from hvdc_ident.sensitivity import collinear_subsets
from hvdc_ident.simulate import ModelSimulator


def identifiability(
    subject: Model | Simulator,
    experiments: Iterable[Experiment],
    candidates: Iterable[FitParameter],
    *,
    starts: int | None = None,
    seed: int = 0,
    held: Mapping[str, float] | None = None,
    pair: tuple[str, str] | None = None,
    profile_options: ProfileOptions | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> IdentifiabilityReport:
    """Return a verdict on each candidate from what the experiments tell, the set to fit, and what to measure next.

    subject: a model, or anything that can be simulated (then the structure is judged by numbers, at random points).
    candidates: the parameters to judge, with start, bounds and the given values, at which those are held that these data
    do not tell. held: values of other parameters.
    pair: two candidates whose common profile is wanted too, over twice their intervals, where both are fitted.
    Raises StudyError where there is nothing to judge, SimulationError where an experiment cannot be simulated. Where a budget ends it,
    `ReportSoFar` is what is known.
    """
    simulator: Simulator = ModelSimulator(subject) if is_white_box(subject) else subject
    problem = Problem(simulator, tuple(experiments), tuple(candidates), held=FrozenMap(held or {}))
    assessment = Assessment(problem, seed, profile_options or ProfileOptions(), progress)
    _check(assessment)
    model = subject.model if isinstance(subject, WithResponses) else subject
    try:
        return _assessed(assessment, model if is_white_box(model) else None, starts, pair, executor)
    except BudgetSpent as end:
        end.known[:] = [report_so_far(assessment, end.known)]
        raise


def _assessed(
    assessment: Assessment,
    model: Model | None,
    starts: int | None,
    pair: tuple[str, str] | None,
    executor: Executor | None,
) -> IdentifiabilityReport:
    """Return the report, stage by stage. model: None of what is no model, whose structure is judged by numbers."""
    problem, seed = assessment.problem, assessment.seed
    assessment.report_stage("structure")
    structure = _structure(model, problem, seed)
    assessment.structure = structure
    hold_structural(assessment, structure)
    free = tuple(f for f in problem.free if f.name not in assessment.held)
    if free:
        given = {n: assessment.free[n].given for n in assessment.held}
        admissible = replace(problem, free=free, held=problem.held | given)
        first, result = pilot_fit(admissible, starts=starts, seed=seed, executor=executor, progress=assessment.progress)
        assessment.pilot = result
    else:
        first, result = at_given_values(problem)
    _data_notes(assessment, first, result)
    assessment.ends = tuple((o.end, o.cost) for o in result.starts if o.cost is not None)
    assessment.placed = result.instants
    assessment.thresholds = thresholds(first)
    last = without_insensitive(assessment, with_placed_instants(assessment, first)) if free else None
    last = without_null_directions(assessment, last) if last else None
    last = profile_remaining(assessment, last, executor) if last else None
    report = _assembled(assessment, structure, first, last, result)
    if pair and last is not None and set(pair) <= set(report.identifiable):
        return replace(report, pair=pair_of(last, report.parameters, pair))
    note = f"No common profile of {' and '.join(pair)}: not both are fitted." if pair else ""
    return replace(report, notes=(*report.notes, note)) if note else report


def _structure(model: Model | None, problem: Problem, seed: int) -> StructuralAnalysis:
    """Return the structure of the parameters beside those that move the instant of a jump.

    Of the instant itself the jump tells, which no derivative between jumps sees; what the records tell of it, their rows say.
    """
    instants = moving_parameters(problem)
    others = tuple(f for f in problem.free if f.name not in instants)
    if not instants:
        return structural_analysis(model, problem, seed)
    if not others:
        return StructuralAnalysis("decided", "instants of jumps", instants)
    given = {f.name: f.given for f in problem.free if f.name in instants}
    analysis = structural_analysis(model, replace(problem, free=others, held=problem.held | given), seed)
    return replace(
        analysis, admissible=tuple(f.name for f in problem.free if f.name in {*instants, *analysis.admissible})
    )


def _check(assessment: Assessment) -> None:
    """Note that no input moves, where none does. Raises StudyError where nothing was measured."""
    experiments = assessment.problem.fitted_experiments
    for e in experiments:
        assert e.measured is not None
        if not any(np.isfinite(e.measured[o][e.compared]).any() for o in e.outputs):
            raise StudyError(
                "nothing was measured", where=f"experiment '{e.name}'", expected="finite values in its window"
            )
    recordings = in_time(experiments)
    assessment.quiet = len(recordings) == len(experiments) and all(
        s.is_constant for e in recordings for s in e.inputs.values()
    )
    if assessment.quiet and any(e.inputs for e in experiments):
        assessment.notes.append("No input moves in any of the experiments: they show a steady state and nothing else.")


def _data_notes(assessment: Assessment, optimum: LocalAnalysis, result: FitResult) -> None:
    """Note what the number of rows, the noise and the pilot fit say about the data."""
    rows, unknowns = sum(b.residual.size for b in optimum.blocks), len(assessment.problem.unknowns)
    if rows < unknowns:
        assessment.notes.append(f"{rows} measured values cannot determine {unknowns} unknowns.")
    elif rows == unknowns:
        assessment.notes.append(f"{rows} measured values for as many unknowns leave nothing to tell a wrong model by.")
    if optimum.deterministic:
        reasons = unknown_noise(assessment.problem.fitted_experiments, result.noise_source)
        assessment.notes += [f"{o}: {why}; its standard deviation is that of the misfit." for o, why in reasons.items()]
        assessment.remark = f"The noise is that of the misfit ({'; '.join(dict.fromkeys(reasons.values()))})."
    if result.search_doubt or result.status in ("two-optima", "not-converged"):
        assessment.notes.append(f"Pilot fit: {result.status}, {result.message}.")


def _assembled(
    assessment: Assessment,
    structure: StructuralAnalysis,
    first: LocalAnalysis,
    last: LocalAnalysis | None,
    result: FitResult,
) -> IdentifiabilityReport:
    """Return the report. first: the optimum of the pilot fit; last: that of the set that is fitted."""
    bound = {n for n, v in assessment.verdicts.items() if v.verdict == "at-bound"}
    fitted = tuple(n for n in assessment.free if last is not None and n in last.names and n not in bound)
    held = {
        n: (assessment.verdicts[n].value, assessment.verdicts[n].reason)
        if n in bound
        else (assessment.held_at.get(n, assessment.free[n].given), assessment.held[n])
        for n in assessment.free
        if n not in fitted
    }
    whole = _whole(assessment, last or first)
    unjudged = _unjudged(assessment, whole, fitted, first)
    held = {n: (v, assessment.verdicts[n].reason if n in unjudged else why) for n, (v, why) in held.items()}
    for n, verdict in assessment.verdicts.items():
        value = held[n][0] if n in held else verdict.value
        if last is not None and not np.isfinite(value):
            value = last.value(n)
        scale = scale_of(assessment.free[n], value)[0]
        norm = whole.information.norms[n]
        verdict = replace(verdict.noted(assessment.remark), value=value, scale=scale, sensitivity_norm=norm)
        assessment.verdicts[n] = verdict.under_misfit() if first.adequacy.systematic else verdict
    several = last is not None and len(last.problem.fitted_experiments) > 1
    tests = heterogeneity(last) if last is not None and several else FrozenMap()
    matrix = first.information.matrix
    advice = _recommended(assessment, whole, misfit=first.adequacy.systematic)
    return IdentifiabilityReport(
        parameters=FrozenMap({n: assessment.verdicts[n] for n in assessment.free}),
        identifiable=fitted,
        held=FrozenMap({n: Held(v, why) for n, (v, why) in held.items()}),
        structure=structure,
        combinations=tuple(assessment.combinations),
        collinear=collinear_subsets(matrix, first.names)[:200],
        correlation=last.uncertainty.correlation() if last is not None else {},
        experiments=FrozenMap({e: Contribution(share) for e, share in whole.information.shares().items()}),
        misspecification=misspecification(last, tests, assessment.units) if last else Misspecification(),
        recommended=advice if isinstance(advice, Recommendation) else None,
        not_recommended=advice if isinstance(advice, str) else "",
        thresholds=FrozenMap(assessment.thresholds),
        profiles=FrozenMap({n: v.profile for n, v in assessment.verdicts.items() if v.profile is not None}),
        pilot=Pilot(
            result.status,
            result.message,
            result.search_doubt,
            len(result.starts),
            result.starts,
            first.cost,
            first.misfit,
            dict(first.uncertainty.effective),
            dict(result.noise_source),
            structure_left=structure_text(first.adequacy.foretold),
        ),
        notes=(*assessment.notes, CONDITIONS),
        not_judged=unjudged,
        optima=assessment.optima,
    )


def _unjudged(
    assessment: Assessment, whole: LocalAnalysis, fitted: Sequence[str], at: LocalAnalysis
) -> tuple[str, ...]:
    """Return the held parameters that noise alone would tell, where the misfit is more than noise; their verdicts are taken back.

    The weak ones that noise alone would let be known within `WIDE` get a remark. at: the optimum of the pilot fit; a misfit
    that comes only with holding one at its start value is not the model's.
    """
    if at.excess == 1.0:
        return ()
    verdicts, ratio = assessment.verdicts, float(np.sqrt(at.excess))
    others = [n for n in assessment.free if n not in fitted and verdicts[n].verdict in HIDDEN_BY_MISFIT]
    unjudged = noise_half_widths(whole, fitted, others) if others else {}
    for n, half in unjudged.items():
        verdicts[n] = unjudged_verdict(verdicts[n], ratio, half)
    weak = [n for n in fitted if verdicts[n].verdict == "weak"]
    halves = noise_half_widths(whole, [n for n in fitted if n not in weak], weak) if weak else {}
    for n, half in halves.items():
        scale = scale_of(assessment.free[n], verdicts[n].value)[0]
        if half <= WIDE * scale:
            verdicts[n] = with_misfit_remark(verdicts[n], ratio, half)
    return tuple(n for n in assessment.free if n in unjudged)


def _whole(assessment: Assessment, at: LocalAnalysis) -> LocalAnalysis:
    """Return the analysis with all candidates free, at the values found or held."""
    values = {**{n: f.given for n, f in assessment.free.items()}, **at.problem.values(at.theta)}
    theta = [values[n] for n in assessment.free]
    theta += [v for u, v in zip(at.problem.names, at.theta, strict=True) if u not in assessment.free]
    return LocalAnalysis(replace(assessment.problem, weights=at.problem.weights), np.array(theta, dtype=float))


def _recommended(assessment: Assessment, whole: LocalAnalysis, *, misfit: bool) -> Recommendation | str:
    """Return what to measure next, or why nothing is advised. misfit: whether more than a known noise is left."""
    assessment.report_stage("what to measure next")
    inputs = inputs_of(assessment.problem.simulator, assessment.problem.fitted_experiments)
    ends = {n: v.profile.ci95 for n, v in assessment.verdicts.items() if v.profile is not None}
    told = {n: 0.5 * (high - low) for n, (low, high) in ends.items() if low is not None and high is not None}
    try:
        return recommend(whole, inputs, assessment.units, thresholds=assessment.thresholds, told=told, misfit=misfit)
    except SimulationError as error:
        return f"What to measure next cannot be told: {error.what}."


def identifiability_by_group(
    subject: Model | Simulator,
    experiments: Iterable[Experiment],
    candidates: Iterable[FitParameter],
    groups: Sequence[Group],
    *,
    pair: tuple[str, str] | None = None,
    **options: Any,
) -> IdentifiabilityReport:
    """Return one report of what each group's outputs and experiments tell about its parameters while the others are held.

    The groups follow each other as in the fit: a later one holds what the earlier ones found, and those to come at their
    given value. Every verdict is its group's; the others' values are taken as known in it, and a note says so. Other arguments
    as in `identifiability`. Raises StudyError where a candidate stands in no group, or in two.
    """
    simulator: Simulator = ModelSimulator(subject) if is_white_box(subject) else subject
    problem = Problem(simulator, tuple(experiments), tuple(candidates))
    check_groups(problem, groups)
    at = {f.name: f.given for f in problem.free}
    reports: list[IdentifiabilityReport] = []
    for number, group in enumerate(groups, start=1):
        part = part_of(problem, group, at)
        both = pair if pair and set(pair) <= set(group.parameters) else None
        try:
            report = identifiability(subject, part.experiments, part.free, held=part.held, pair=both, **options)
        except BudgetSpent as end:
            joined_so_far(reports, end, [g.parameters for g in groups[number:]])
            raise
        at |= {n: v.value for n, v in report.parameters.items()}
        reports.append(_noted(report, part))
    # What to measure next is that of the first group that needs it; the notes say what the others would.
    settled = ("identifiable", "at-bound")
    advised = next((r for r in reports if any(v.verdict not in settled for v in r.parameters.values())), reports[0])
    others = [(r, r.recommended.text) for r in reports if r is not advised and r.recommended is not None]
    notes = [f"To measure next for {', '.join(r.parameters)}: {text}" for r, text in others]
    if pair and not any(set(pair) <= set(g.parameters) for g in groups):
        notes.append(f"No common profile of {' and '.join(pair)}: they stand in two groups.")
    whole = joined([replace(r, recommended=None, not_recommended="") for r in reports])
    decided = all(r.structure.status == "decided" for r in reports)
    return replace(
        whole,
        parameters=FrozenMap({n: whole.parameters[n] for n in at}),
        identifiable=tuple(n for n in at if n in whole.identifiable),
        structure=replace(whole.structure, status="decided" if decided else "not decided"),
        recommended=advised.recommended,
        not_recommended=advised.not_recommended,
        notes=(*whole.notes, *notes, CONDITIONS),
    )


def _noted(report: IdentifiabilityReport, part: Problem) -> IdentifiabilityReport:
    """Return what a group's report brings to that of all, each note begun with the group's parameters."""
    mine = ", ".join(report.parameters)
    data = f"{', '.join(part.outputs)} in {', '.join(e.name for e in part.fitted_experiments)}"
    first = f"{mine}: judged alone, on {data}, the other candidates held."
    signs = tuple(f"{mine}: {s}" for s in report.misspecification.signs)
    return replace(
        report,
        notes=(first, *(f"{mine}: {n}" for n in report.notes if n != CONDITIONS)),
        misspecification=replace(report.misspecification, signs=signs),
        pilot=Pilot(groups=(replace(report.pilot, parameters=tuple(report.parameters)),)),
    )
