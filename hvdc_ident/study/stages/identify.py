"""The stage `identify`: what the recordings tell about the candidates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from hvdc_ident.study.stages import Stage, StageOptions, StageResult
from hvdc_ident.text import listed

if TYPE_CHECKING:
    from hvdc_ident.budget import Known
    from hvdc_ident.executor import Executor, Progress
    from hvdc_ident.identifiability import IdentifiabilityReport
    from hvdc_ident.study.study import Study

FEWEST_STARTS = 4
"""The pilot fit is a multistart of its own, however few starts the fit has."""
A_START = 20
"""Evaluations with derivatives that a start takes: 18.5 on average for five parameters of a cooling loop of 57 states."""
SOON = 60.0
"""Seconds of a search from which on a first answer is given before it."""


def run(study: Study, options: StageOptions, earlier: Mapping[str, Any]) -> StageResult:
    """Return a verdict on each candidate with its evidence, the set a fit may use, and what to measure next."""
    from hvdc_ident.fit.search import STARTS
    from hvdc_ident.study.fitting import need
    from hvdc_ident.study.pipeline import executor_of
    from hvdc_ident.study.study import candidate_lines

    need(study, "identify")
    _first_answer(study, options, _starts(study) or STARTS)
    with executor_of(study, options, "identify") as executor:
        report = judged(study, seed=options.seed, executor=executor, progress=options.progress)
    return StageResult({**report.to_dict(), "candidates": candidate_lines(study)})


def so_far(study: Study, known: Sequence[Known], options: StageOptions) -> Mapping[str, Any]:
    """Return the verdicts that stood when the budget ended, and what was known of the other candidates."""
    from hvdc_ident.identifiability.unfinished import ReportSoFar
    from hvdc_ident.study.study import candidate_lines

    report = next((k.report for k in known if isinstance(k, ReportSoFar)), None)
    return {} if report is None else {**report.to_dict(), "candidates": candidate_lines(study)}


def judged(
    study: Study, *, seed: int = 0, executor: Executor | None = None, progress: Progress | None = None
) -> IdentifiabilityReport:
    """Return the report on the study's candidates. The study has data and candidates (`fitting.need`)."""
    from hvdc_ident.identifiability import identifiability, identifiability_by_group
    from hvdc_ident.study.fitting import groups_of, problem_of

    pair = study.settings.identifiability.pair if study.settings.identifiability else None
    common: dict[str, Any] = {
        "starts": _starts(study),
        "seed": seed,
        "executor": executor,
        "progress": progress,
        "pair": (pair[0], pair[1]) if pair else None,
    }
    problem = problem_of(study)
    subject = problem.simulator if study.responses else study.model
    asked = (subject, problem.experiments, problem.free)
    groups = groups_of(study, study.candidates)
    return identifiability_by_group(*asked, groups, **common) if groups else identifiability(*asked, **common)


def _starts(study: Study) -> int | None:
    """Return the number of starts of the search; None: as many as it takes."""
    asked = study.settings.fit.starts if study.settings.fit else None
    return None if asked is None else max(asked, FEWEST_STARTS)


def _first_answer(study: Study, options: StageOptions, starts: int) -> None:
    """Tell and keep the local analysis at the given values, where the search will take longer than `SOON`."""
    from hvdc_ident.errors import SimulationError
    from hvdc_ident.identifiability.pilot_fit import cramer_rao_bounds
    from hvdc_ident.parallel import available_cores
    from hvdc_ident.study.fitting import problem_of
    from hvdc_ident.study.study import candidate_lines
    from hvdc_ident.text import duration

    options.progress(0, 1, "first answer: the model and its derivatives at the given values")
    try:
        first = cramer_rao_bounds(problem_of(study))
    except SimulationError as error:
        options.announce([f"There is no first answer at the given values: {error}"])
        return
    rest = starts * A_START * first.seconds / (options.workers or available_cores())
    message = "this is the first answer, from the curvature at the given values: the stage has not come to its end"
    options.keep({"message": message, "first": first.to_dict(), "candidates": candidate_lines(study)})
    if rest < SOON:
        return
    about = (
        f"One evaluation of the model with its derivatives took {duration(first.seconds)}. The search takes {starts} starts of some ten "
        "to a hundred each, then profiles. An interrupt keeps this answer and what is finished."
    )
    options.announce([*first.lines, about])


def lines_of(data: Mapping[str, Any]) -> Sequence[str]:
    """Return whether the model explains the data, every verdict in a line, the remarks, and what to measure next.

    A misfit comes first and its size stands beside every interval: what is read alone is to be believed alone.
    """
    from hvdc_ident.next_step import NextStep, next_sentence
    from hvdc_ident.summary import summarise
    from hvdc_ident.summary.stage_results import identified_of

    report = identified_of(data)
    width = max(map(len, (*report.parameters, *report.unsettled)), default=0)
    if not report.parameters and not report.unsettled:
        return []
    lines = [*report.pilot.doubts]
    beside = ""
    if report.misspecified:
        signs = "; ".join(report.misspecification.signs)
        lines.append(f"The model does not explain these data: {signs}. {next_sentence(NextStep('diagnose'))}")
        ratio = report.pilot.chi2_per_dof
        beside = "" if ratio is None else f" (chi2/dof {ratio:.3g})"
    lines += [f"{n:{width}}  {v.verdict}: {v.reason}{beside if v.ci95 else ''}" for n, v in report.parameters.items()]
    lines += [f"{n:{width}}  no verdict: {u.text}" for n, u in report.unsettled.items()]
    lines += [*report.notes, *([report.not_recommended] if report.not_recommended else [])]
    lines += map(next_sentence, summarise({"identifiability": data}).next)
    names = listed(report.identifiable)
    return [*lines, f"Next: `hvdc-ident fit STUDY` estimates {names}."] if names else lines


def verdict(data: Mapping[str, Any]) -> str:
    """Return any doubt about the search or the model, the candidates by their verdicts, and that a noise is not known."""
    from hvdc_ident.fit.noise import misfit_sentence
    from hvdc_ident.summary.stage_results import identified_of

    report = identified_of(data)
    groups: dict[str, list[str]] = {}
    for name, v in report.parameters.items():
        groups.setdefault(v.verdict, []).append(name)
    groups |= {"no verdict": [*report.unsettled]} if report.unsettled else {}
    verdicts = "; ".join(f"{kind}: {', '.join(names)}" for kind, names in groups.items())
    unknown = misfit_sentence(report.pilot.outputs_of_misfit).rstrip(".")
    if report.misspecified:
        verdicts = f"the model does not explain these data; if nothing else is missing, {verdicts}"
    return "; ".join(part for part in (report.pilot.search_doubt, verdicts, unknown) if part)


STAGE = Stage(
    name="identify",
    file="identifiability.json",
    summary="Judge which candidates the recordings determine.",
    run=run,
    wanted=lambda study: study.settings.identifiability is not None or study.settings.fit is not None,
    order=30,
    tell=lines_of,
    verdict=verdict,
    searches=True,
    so_far=so_far,
    counted=None,
    parts={
        "first answer": "the answer at the given values",
        "structure": "the structure of the model",
        "search for the optimum": "the search for the optimum",
        "profile": "the profiles, on which the verdicts rest",
        "other optima": "other optima",
        "what to measure next": "what to measure next",
    },
)
