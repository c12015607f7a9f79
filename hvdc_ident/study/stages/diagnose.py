"""The stage `diagnose`: what the model lacks, if the recordings tell, and the model with it."""

from __future__ import annotations

import fnmatch
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hvdc_ident.budget import TO_TELL, Budget
from hvdc_ident.errors import ComputationError, unknown_name
from hvdc_ident.next_step import NextStep
from hvdc_ident.study.stages import UNFINISHED, Stage, StageOptions, StageResult

if TYPE_CHECKING:
    from hvdc_ident.discrepancy import Diagnosis
    from hvdc_ident.executor import Executor, Progress
    from hvdc_ident.identifiability import IdentifiabilityReport
    from hvdc_ident.model import AnyModel
    from hvdc_ident.study.study import Study


class NothingIdentified(ComputationError):
    """The data identify none of the parameters."""


def run(study: Study, options: StageOptions, earlier: Mapping[str, Any]) -> StageResult:
    """Return the verdict with its evidence, the gap before and after, and the augmented model as a card."""
    from hvdc_ident.identifiability import IdentifiabilityReport
    from hvdc_ident.model import is_white_box
    from hvdc_ident.study.augmented import compared
    from hvdc_ident.study.pipeline import executor_of
    from hvdc_ident.study.size_curves import size_curves

    _need(study)
    if "parameters" not in earlier["identify"] or "not_tried" in earlier["identify"]:
        why = f"nothing can be diagnosed before the stage identify has run: {earlier['identify'].get('message', 'it failed')}"
        return StageResult({"status": "failed", "message": why}, failed=why)
    report = IdentifiabilityReport.from_dict(earlier["identify"])
    with executor_of(study, options, "diagnose") as executor:
        try:
            found = diagnosed(
                study,
                report,
                seed=options.seed,
                budget=_of(options.budget),
                executor=executor,
                progress=options.progress,
            )
        except NothingIdentified as e:
            return StageResult({"status": "failed", "message": str(e)}, failed=str(e))
    sizes = size_curves(study.model, study.experiments, found) if is_white_box(study.model) else None
    beside, curves = compared(study, found)
    asked = {"budget": None if options.budget is None else options.budget.seconds}
    data = {**found.to_dict(), "sizes": sizes, "options": asked, **beside}
    if found.verdict == "unfinished":
        return StageResult(
            {"status": UNFINISHED, **data}, {**found.files, **curves}, failed=found.text, unfinished=True
        )
    return StageResult(data, {**found.files, **curves})


def _of(budget: Budget | None) -> Budget | None:
    """Return the part of a run's budget after which a diagnosis looks for nothing further."""
    return None if budget is None else Budget(budget.to_search / (1.0 - TO_TELL), budget.clock(), budget.clock)


def _need(study: Study) -> None:
    from hvdc_ident.study.checks import need_candidates, need_experiments, need_start

    need_experiments(study, "diagnose", role="fit")
    need_candidates(study, "diagnose")
    need_start(study)


def diagnosed(
    study: Study,
    report: IdentifiabilityReport,
    *,
    seed: int = 0,
    budget: Budget | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Return the diagnosis of the study's model. report: on its candidates. budget: beside that of the study.

    Raises StudyError where it lacks data or candidates, NothingIdentified where the report leaves no parameter to be fitted.
    """
    from hvdc_ident.discrepancy import DiagnosisOptions, diagnose
    from hvdc_ident.identifiability import gate
    from hvdc_ident.study.augmented import with_estimates
    from hvdc_ident.study.schema import DiagnoseTable

    _need(study)
    asked = study.settings.diagnose or DiagnoseTable()
    known: IdentifiabilityReport | None = report
    fitted = gate(report, diagnosis=True).fitted
    moving = ("at-bound", "practically-unidentifiable")
    if not fitted and any(v.verdict in moving for v in report.parameters.values()):
        known = None  # a search of its own, over what the records tell apart: why nothing is to be estimated is what is asked
    elif not fitted:
        raise NothingIdentified(
            "nothing can be diagnosed: these recordings identify none of the parameters, so no gap is the model's own",
            next=(NextStep("identify"),),
        )
    found = diagnose(
        study.model,
        study.experiments,
        tuple(study.candidates.values()),
        effects="all" if asked.effects == "all" else list(asked.effects),
        places=None if asked.places is None else places_of(study.model, asked.places),
        tolerance=asked.tolerances,
        report=known,
        options=DiagnosisOptions(most=asked.most, thorough=asked.thorough, budget=shorter(budget, asked.budget)),
        seed=seed,
        executor=executor,
        progress=progress,
    )
    found = with_estimates(study, found, fitted)
    if not study.responses:
        return found
    names = ", ".join(r.name for r in study.responses)
    note = f"The measured frequency responses ({names}) are not used here: an effect is looked for in recordings alone."
    return replace(found, notes=(*found.notes, note))


def shorter(budget: Budget | None, seconds: float | None) -> Budget | float | None:
    """Return the one that ends first of a budget and of seconds from now."""
    return budget if seconds is None or (budget is not None and budget.left < seconds) else seconds


def places_of(model: AnyModel, patterns: Sequence[str]) -> list[str]:
    """Return the insertion points that one of the patterns matches. Raises UnknownNameError for a pattern without one."""
    found: dict[str, None] = {}
    for pattern in patterns:
        matched = fnmatch.filter(model.insertion_points, pattern)
        if not matched:
            raise unknown_name("insertion point", pattern, model.insertion_points, where="diagnose.places")
        found |= dict.fromkeys(matched)
    return list(found)


def follow(study: Study, folder: Path, data: Mapping[str, Any]) -> dict[str, str]:
    """Return the files of fitted values: with the effect if the diagnosis named one, else those of the fit."""
    from hvdc_ident.study.value_files import after_diagnosis

    return after_diagnosis(study, folder, data)


def lines_of(data: Mapping[str, Any]) -> Sequence[str]:
    """The verdict, what is missing, what it changes, and what to measure to be sure."""
    from hvdc_ident.summary import summarise
    from hvdc_ident.summary.screen import lines_of as screen
    from hvdc_ident.summary.stage_results import diagnosis_of

    found = diagnosis_of(data)
    if found is None:
        return [str(data.get("message", ""))]
    summary = replace(summarise({"discrepancy": data}), noise_from_misfit=())  # the text says it
    return [f"{found.verdict}: {found.text}", "", *screen(summary, more=found.notes)]


def verdict(data: Mapping[str, Any]) -> str:
    """Return the verdict with its text."""
    from hvdc_ident.summary.stage_results import diagnosis_of

    found = diagnosis_of(data)
    return str(data.get("message", "")) if found is None else f"{found.verdict}: {found.text}"


STAGE = Stage(
    name="diagnose",
    file="discrepancy.json",
    summary="Find what the model lacks, if the recordings tell.",
    run=run,
    wanted=lambda study: study.settings.diagnose is not None,
    order=50,
    after=("identify", "fit"),
    despite=("fit",),
    tell=lines_of,
    verdict=verdict,
    searches=True,
    follow=follow,
    told_in_part=True,
    counted=None,
    parts={
        "the nominal model": "the fit of the model as it is",
        "round": "rounds of candidates",
        "before and after": "before and after",
    },
)
