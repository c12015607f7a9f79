"""The stage `fit`: estimates from the recordings, of what the stage `identify` found identifiable."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hvdc_ident.study.stages import Stage, StageOptions, StageResult, two_by_group
from hvdc_ident.text import figures_of, interval_text, interval_words

if TYPE_CHECKING:
    from hvdc_ident.fit import FitResult, Problem
    from hvdc_ident.fit.residual import Curve
    from hvdc_ident.study.study import Study


def run(study: Study, options: StageOptions, earlier: Mapping[str, Any]) -> StageResult:
    """Return the estimates with their intervals, RMSE before and after, and the values in the forms other tools read."""
    from hvdc_ident.study import fitting
    from hvdc_ident.study.measured_responses import compared
    from hvdc_ident.study.pipeline import executor_of

    fitting.need(study, "fit")
    report = earlier["identify"]
    if "parameters" not in report:
        why = f"nothing can be fitted before the stage identify has run: {report.get('message', 'it failed')}"
        return StageResult({"status": "failed", "message": why}, failed=why)
    with executor_of(study, options, "fit") as executor:
        result = fitting.estimated(
            study, report, force=options.force, seed=options.seed, executor=executor, progress=options.progress
        )
    problem = fitting.problem_of(study)
    data = {**result.to_dict(), **_context(study, problem, options, report, result)}
    if result.status == "failed":
        return StageResult(data, failed=result.message)
    sets = {"given": fitting.curves_at_given(study), "fitted": result.curves}
    data["judgement"] = fitting.judgement_of(study, sets, result)
    data["derived"] = fitting.derived(study, result)
    if study.responses:
        data["responses"] = compared(study, {"given": study.given, "fitted": result.values})
    files = _files(study, data, result.curves)
    return StageResult(data, files, failed=result.message if result.status == "not-converged" else "")


def _context(
    study: Study, problem: Problem, options: StageOptions, report: Mapping[str, Any], result: FitResult
) -> dict[str, Any]:
    """Return what a reader of the JSON needs beside the result: candidates, units, experiments, noise."""
    from hvdc_ident.study.study import candidate_lines

    return {
        "forced": [n for n in options.force if n in result.fitted and n not in report["identifiable"]],
        "candidates": candidate_lines(study),
        "units": {o: e.measured.unit(o) for e in problem.experiments if e.measured is not None for o in e.outputs},
        "experiments": {
            e.name: {"role": e.role, "event": e.event, "window": e.window, "recording": e.recording}
            for e in problem.experiments
        },
        "noise": {e: {o: asdict(n) for o, n in notes.items()} for e, notes in study.noise.items()},
        "ties": {n: line.tie for n, line in study.settings.parameters.items() if line.tie is not None},
    }


def _files(study: Study, data: Mapping[str, Any], curves: Mapping[str, Mapping[str, Curve]]) -> dict[str, str]:
    """The values to paste, and the waveforms at the estimates; of an experiment that fails there is none."""
    from hvdc_ident.study.fitting import curves_csv
    from hvdc_ident.study.value_files import value_files

    waveforms = {f"fit.{e.name}.csv": curves_csv(e, curves[e.name]) for e in study.experiments if e.name in curves}
    return {**value_files(study, data), **waveforms}


def follow(study: Study, folder: Path, data: Mapping[str, Any]) -> dict[str, str]:
    """Return the files of fitted values with the effect, where a diagnosis that stands named one."""
    from hvdc_ident.study.value_files import after_fit

    return after_fit(study, folder, data)


def lines_of(data: Mapping[str, Any]) -> list[str]:
    """The status and the verdict on the residuals, then every estimate beside its given value, then what is held."""
    from hvdc_ident.fit.result import FIT_WORDS
    from hvdc_ident.study.measured_responses import response_lines

    lines = [f"{data['status']}: {data['message']}"]
    judged = data.get("adequacy") or {}
    lines += [f"{FIT_WORDS[judged['verdict']]}: {judged['text']}."] if judged.get("text") else []
    lines += [f"Next: {judged['next']}"] if judged.get("next") else []
    lines += [f"{data['roughness']['text']}."] if data.get("roughness") else []
    chi2 = judged.get("chi2_per_dof")
    # How large the residual is against the noise that every interval rests on.
    beside = f"chi2/dof {chi2:.3g}" if chi2 is not None else "noise from the residual"
    words = "95 %" if judged.get("verdict") != "does-not-fit" else interval_words(beyond_noise=True)
    for name, e in data["estimates"].items():
        unit = f" {e['unit']}" if e["unit"] else ""
        given = f" (given {data['candidates'][name]['given']:.6g})"
        value = f"{e['value']:.{figures_of(e['ci95'])}g}"
        lines.append(f"{name} = {value}{unit}{given}{_interval(e['ci95'], words, beside)}" + _note(e))
    held = [n for n in data["candidates"] if n not in data["estimates"]]
    lines += [f"{n}: held, {data['held'][n]}" for n in held if n in data["held"]]
    lines += _conditions(data)
    lines += response_lines(data.get("responses", ()), "fitted")
    lines += _searched(data)
    if data["estimates"] and not judged.get("next"):
        lines.append("Next: `hvdc-ident export STUDY --to FILE` writes the model with these values (.fmu, .mo, .toml).")
    return lines


def _interval(ci95: Sequence[float | None] | None, words: str, beside: str) -> str:
    ends = interval_text(ci95)
    return f", {words}: {ends} ({beside})" if ends else ""


def _conditions(data: Mapping[str, Any]) -> list[str]:
    """The held parameters on whose values the estimates rest: those that these records do not tell, yet answer to."""
    given = {n for e in data["estimates"].values() for n in e["conditional_on"]}
    given |= {n for n, why in data["held"].items() if why.startswith(("practically-unidentifiable", "not-judged"))}
    names = ", ".join(n for n in data["candidates"] if n in given and n in data["held"])
    if not names or not data["fitted"]:
        return []
    return [
        f"The estimates and their intervals hold for {names} as held: another value there may move them beyond these."
    ]


def _note(estimate: Mapping[str, Any]) -> str:
    """The reason that goes with an estimate, and the interval of independent residuals where it is a far smaller one."""
    from hvdc_ident.fit.uncertainty import WIDER

    plain, ci95 = estimate.get("ci95_independent"), estimate["ci95"]
    text = estimate["reason"]
    if plain and ci95 and None not in ci95 and ci95[1] - ci95[0] > WIDER * (plain[1] - plain[0]):
        why = "" if "residuals are correlated" in text else "the residuals are correlated; "
        text = f"{text.rstrip('.')}; {why}" if text else why
        text += f"as if they were independent: {plain[0]:.6g} to {plain[1]:.6g}"
    return f" ({text})" if text else ""


def _searched(data: Mapping[str, Any]) -> list[str]:
    """The range of each fitted parameter that has a bound missing: the results speak of what lies in it."""
    rows = {n: c for n, c in data["candidates"].items() if n in data["fitted"] and None in (c["min"], c["max"])}
    ranges = [f"{n} {c['searched'][0]:.4g} to {c['searched'][1]:.4g}" for n, c in rows.items() if c.get("searched")]
    return [f"Without bounds of their own, starts were drawn from: {', '.join(ranges)}."] if ranges else []


def verdict(data: Mapping[str, Any]) -> str:
    """Return any doubt about the search, the fit's status, and the verdict on its residuals."""
    from hvdc_ident.fit.result import FIT_WORDS

    judged = (data.get("adequacy") or {}).get("verdict")
    words = FIT_WORDS[judged] if judged else ""
    parts = (data.get("search_doubt"), data["status"], f"{words[:1].lower()}{words[1:]}")
    return "; ".join(str(part) for part in parts if part)


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
    phases=two_by_group,
    follow=follow,
)
