"""The stage `fit`: estimates from the recordings, of what the stage `identify` found identifiable."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hvdc_ident.study.stages import Stage, StageOptions, StageResult

if TYPE_CHECKING:
    from hvdc_ident.budget import Known
    from hvdc_ident.fit import FitResult, Problem
    from hvdc_ident.study.study import Study
    from hvdc_ident.summary.stage_results import Context


def run(study: Study, options: StageOptions, earlier: Mapping[str, Any]) -> StageResult:
    """Return the estimates with their intervals, RMSE before and after, and the values in the forms other tools read."""
    from hvdc_ident.budget import BudgetSpent
    from hvdc_ident.fit.result import FitSoFar
    from hvdc_ident.fit.search import outcome_lines
    from hvdc_ident.identifiability import IdentifiabilityReport
    from hvdc_ident.next_step import next_phrases
    from hvdc_ident.study import fitting
    from hvdc_ident.study.measured_responses import compared
    from hvdc_ident.study.pipeline import executor_of

    fitting.need(study, "fit")
    if "parameters" not in earlier["identify"] or "not_tried" in earlier["identify"]:
        why = f"nothing can be fitted before the stage identify has run: {earlier['identify'].get('message', 'it failed')}"
        return StageResult({"status": "failed", "message": why}, failed=why)
    report = IdentifiabilityReport.from_dict(earlier["identify"])
    with executor_of(study, options, "fit") as executor:
        result = fitting.estimated(
            study, report, force=options.force, seed=options.seed, executor=executor, progress=options.progress
        )
    problem = fitting.problem_of(study)
    forced = [n for n in options.force if n in result.fitted and n not in report.identifiable]
    data = {**result.to_dict(), **_context(study, problem, forced)}
    if result.status == "failed":
        tried = f". Try: {next_phrases(result.next)}" if result.next else ""
        return StageResult(data, failed=f"{result.message}{tried}")
    try:
        options.progress(0, 1, "comparison of the fitted model with the recordings")
        sets = {"given": fitting.curves_at_given(study), "fitted": result.curves}
        data["judgement"] = fitting.judgement_of(study, sets, result)
        data["derived"] = fitting.derived(study, result)
        if study.responses:
            data["responses"] = compared(study, {"given": study.given, "fitted": result.values})
    except BudgetSpent as end:
        end.known[:] = [FitSoFar(outcome_lines(result.starts), result=result, forced=tuple(forced))]
        raise
    files = _files(study, result, data["derived"])
    return StageResult(data, files, failed=result.message if result.status == "not-converged" else "")


def so_far(study: Study, known: Sequence[Known], options: StageOptions) -> Mapping[str, Any]:
    """Return the estimates, where the budget ended after they were found."""
    from hvdc_ident.fit.result import FitSoFar
    from hvdc_ident.study import fitting

    fit = next((k for k in known if isinstance(k, FitSoFar) and k.result is not None), None)
    if fit is None or fit.result is None:
        return {}
    return {**fit.result.to_dict(), **_context(study, fitting.problem_of(study), fit.forced)}


def _context(study: Study, problem: Problem, forced: Sequence[str]) -> dict[str, Any]:
    """Return what a reader of the JSON needs beside the result: candidates, units, experiments, noise."""
    from hvdc_ident.study import fitting
    from hvdc_ident.study.study import candidate_lines

    return {
        "forced": list(forced),
        "candidates": candidate_lines(study),
        "units": {o: e.measured.unit(o) for e in problem.experiments if e.measured is not None for o in e.outputs},
        "experiments": {e.name: fitting.context_of(e) for e in problem.experiments},
        "noise": study.noise,
        "ties": {n: line.tie for n, line in study.settings.parameters.items() if line.tie is not None},
    }


def _files(study: Study, result: FitResult, derived: Mapping[str, Any]) -> dict[str, str]:
    """The values to paste, and the waveforms at the estimates; of an experiment that fails there is none."""
    from hvdc_ident.study.fitting import curves_csv
    from hvdc_ident.study.value_files import value_files

    curves = result.curves
    waveforms = {f"fit.{e.name}.csv": curves_csv(e, curves[e.name]) for e in study.experiments if e.name in curves}
    return {**value_files(study, result, derived), **waveforms}


def follow(study: Study, folder: Path, data: Mapping[str, Any]) -> dict[str, str]:
    """Return the files of fitted values with the effect, where a diagnosis that stands named one."""
    from hvdc_ident.study.value_files import after_fit

    return after_fit(study, folder, data)


def lines_of(data: Mapping[str, Any]) -> list[str]:
    """The status and the verdict on the residuals, the values, what is to be said of each, and what to do next."""
    from hvdc_ident.summary import summarise
    from hvdc_ident.summary.compared_responses import response_lines
    from hvdc_ident.summary.phrases import remarks
    from hvdc_ident.summary.screen import lines_of as screen
    from hvdc_ident.summary.stage_results import Context, fit_of
    from hvdc_ident.text import capital

    fit, about = fit_of(data), Context.from_dict(data)
    if fit is None or fit.status == "unfinished":
        return []
    more = [f"{capital(fit.adequacy.text)}."] if fit.adequacy is not None and fit.adequacy.text else []
    more += [f"{fit.roughness['text']}."] if fit.roughness else []
    more += [f"{n}: {remark}." for n, remark in remarks(fit, about.candidates).items()] + _conditions(fit, about)
    more += [*response_lines(about.responses, "fitted"), *_searched(fit, about)]
    return [f"{fit.status}: {fit.message}", "", *screen(summarise({"fit": data}), more=more)]


def _conditions(fit: FitResult, about: Context) -> list[str]:
    """The held parameters on whose values the estimates rest: those that these records do not tell, yet answer to."""
    given = {n for e in fit.estimates.values() for n in e.conditional_on}
    # A profile says on which held values its interval rests; of other intervals any of these may be one.
    unknown = any(e.method == "covariance" for e in fit.estimates.values())
    asked = ("practically-unidentifiable", "not-judged") if unknown else ("not-judged",)
    given |= {n for n, why in fit.held.items() if why.startswith(asked)}
    names = ", ".join(n for n in about.candidates if n in given and n in fit.held)
    if not names or not fit.fitted:
        return []
    return [
        f"The estimates and their intervals hold for {names} as held: another value there may move them beyond these."
    ]


def _searched(fit: FitResult, about: Context) -> list[str]:
    """The range of each fitted parameter that has a bound missing: the results speak of what lies in it."""
    open_ended = {n: c.searched for n, c in about.candidates.items() if n in fit.fitted and None in (c.min, c.max)}
    ranges = [f"{n} {s[0]:.4g} to {s[1]:.4g}" for n, s in open_ended.items() if s is not None]
    return [f"Without bounds of their own, starts were drawn from: {', '.join(ranges)}."] if ranges else []


def verdict(data: Mapping[str, Any]) -> str:
    """Return any doubt about the search, the fit's status, and that a noise is not known."""
    from hvdc_ident.summary.stage_results import fit_of

    fit = fit_of(data)
    return (
        ""
        if fit is None
        else "; ".join(part for part in (fit.search_doubt, fit.status, fit.noise_note.rstrip(".")) if part)
    )


STAGE = Stage(
    name="fit",
    file="fit.json",
    summary="Estimate the identifiable candidates, with their intervals.",
    run=run,
    wanted=lambda study: study.settings.fit is not None,
    order=40,
    after=("identify",),
    takes=("force",),
    tell=lines_of,
    verdict=verdict,
    searches=True,
    so_far=so_far,
    parts={
        "search for the optimum": "the search for the optimum",
        "'": "the fits to single experiments",
        "comparison": "the comparison of the fitted model with the recordings",
    },
    counted="'",
    follow=follow,
)
