"""The stage `fit`: estimates from the recordings, of what the stage `identify` found identifiable."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from hvdc_ident.study.stage import Options, Outcome, Stage

if TYPE_CHECKING:
    from hvdc_ident.fit import FitResult, Problem
    from hvdc_ident.fit.assessment import Curve
    from hvdc_ident.study.study import Study


def run(study: Study, options: Options, earlier: Mapping[str, Any]) -> Outcome:
    """The estimates with their intervals, RMSE before and after, and the values in the forms other tools read."""
    from hvdc_ident.fit import Problem
    from hvdc_ident.identifiability import gated_fit
    from hvdc_ident.identifiability.gate import gate, gated
    from hvdc_ident.study import fitting
    from hvdc_ident.study.at_work import executor_of
    from hvdc_ident.study.needs import need_candidates, need_experiments, need_start
    from hvdc_ident.study.simulator import ModelSimulator

    need_experiments(study, "fit", role="fit")
    need_candidates(study, "fit")
    problem = Problem(ModelSimulator(study.model), study.experiments, tuple(study.candidates.values()))
    need_start(study)
    report = earlier["identify"]
    if "parameters" not in report:
        why = f"nothing can be fitted before the stage identify has run: {report.get('message', 'it failed')}"
        return Outcome({"status": "failed", "message": why}, failed=why)

    with executor_of(study, options, "fit") as executor:

        def fit(open_set: Problem) -> FitResult:
            asked = fitting.with_settings(study, open_set)
            return fitting.fitted(study, asked, seed=options.seed, executor=executor, progress=options.progress)

        result = gated_fit(problem, report, fit, force=options.force, whole=fitting.as_reported(study))
    data = {**result.to_dict(), **_context(study, options, report, result)}
    if result.status == "failed":
        return Outcome(data, failed=result.message)
    through = fitting.with_settings(study, gated(problem, gate(report, options.force)))
    curves = fitting.curves_of(through, result)
    data["windowed_errors"] = fitting.errors_in_windows(study, curves)
    data["derived"] = fitting.derived(study, result)
    files = _files(study, result, data, curves)
    return Outcome(data, files, failed=result.message if result.status == "not-converged" else "")


def _context(study: Study, options: Options, report: Mapping[str, Any], result: FitResult) -> dict[str, Any]:
    """What a reader of the JSON needs beside the result: candidates, units, experiments, noise."""
    return {
        "forced": [n for n in options.force if n in result.fitted and n not in report["identifiable"]],
        "candidates": {
            n: {"start": f.start, "min": f.min, "max": f.max, "unit": study.model.parameters[n].unit}
            for n, f in study.candidates.items()
        },
        "units": {o: study.model.outputs[o].unit for o in result.rmse},
        "experiments": {
            e.name: {"role": e.role, "event": e.event, "window": e.window, "recording": e.recording}
            for e in study.experiments
        },
        "noise": {
            e: {o: {"std": n.std, "source": n.source} for o, n in notes.items()} for e, notes in study.noise.items()
        },
        "ties": {n: line.tie for n, line in study.settings.parameters.items() if line.tie is not None},
    }


def _files(
    study: Study, result: FitResult, data: Mapping[str, Any], curves: Mapping[str, Mapping[str, Curve]]
) -> dict[str, str]:
    """The values to paste, and the waveforms at the estimates; of an experiment that fails there is none."""
    from hvdc_ident.study.tables import curves_csv, ssv, values_csv

    values = {n: float(result.values[n]) for n in study.candidates if n in result.values}
    units = {n: study.model.parameters[n].unit for n in values}
    follow = [f"# {n} = {d['expression']} = {d['value']!r}" for n, d in data["derived"].items()]
    files = {
        "fitted-values.toml": result.to_toml_values() + "".join(f"{line}\n" for line in follow),
        "fitted-values.csv": values_csv(values, units, data["estimates"], result.held),
        "fitted-values.ssv": ssv(values, study.name),
    }
    return files | {f"fit.{e.name}.csv": curves_csv(e, curves[e.name]) for e in study.experiments if e.name in curves}


def told(data: Mapping[str, Any]) -> list[str]:
    """The status, then every estimate in the form it may be stated in, then what is held."""
    lines = [f"{data['status']}: {data['message']}"]
    for name, e in data["estimates"].items():
        unit = f" {e['unit']}" if e["unit"] else ""
        low, high = e["ci95"] or (None, None)
        interval = "" if low is None or high is None else f", 95 %: {low:.6g} to {high:.6g}"
        lines.append(f"{name} = {e['value']:.6g}{unit}{interval}" + (f" ({e['reason']})" if e["reason"] else ""))
    held = [n for n in data["candidates"] if n not in data["estimates"]]
    return lines + [f"{n}: held, {data['held'][n]}" for n in held if n in data["held"]]


STAGE = Stage(
    name="fit",
    file="fit.json",
    summary="Estimates of the identifiable candidates, with their intervals.",
    run=run,
    wanted=lambda study: study.settings.fit is not None,
    order=40,
    after=("identify",),
    takes=("force",),
    tell=told,
)
