"""The stage `fit`: estimates from the recordings, of what the stage `identify` found identifiable."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from hvdc_ident.study.stage import Options, Outcome, Stage

if TYPE_CHECKING:
    from hvdc_ident.fit import FitResult, Problem
    from hvdc_ident.study.study import Study


def run(study: Study, options: Options, earlier: Mapping[str, Any]) -> Outcome:
    """The estimates with their intervals, RMSE before and after, and the values in the forms other tools read."""
    from hvdc_ident.errors import SimulationError
    from hvdc_ident.fit import Problem
    from hvdc_ident.frozen import FrozenMap
    from hvdc_ident.identifiability import gated_fit
    from hvdc_ident.simulate import simulate
    from hvdc_ident.study.needs import need_candidates, need_experiments, need_start
    from hvdc_ident.study.simulator import ModelSimulator
    from hvdc_ident.study.tables import comparison_csv, ssv, values_csv

    need_experiments(study, "fit", role="fit")
    need_candidates(study, "fit")
    problem = Problem(ModelSimulator(study.model), study.experiments, tuple(study.candidates.values()))
    need_start(study)
    report = earlier["identify"]
    if "parameters" not in report:
        why = f"nothing can be fitted before the stage identify has run: {report.get('message', 'it failed')}"
        return Outcome({"status": "failed", "message": why}, failed=why)
    whole = study.settings.fit is None or study.settings.fit.mode == "simultaneous"
    result = gated_fit(problem, report, lambda p: _fitted(study, options, p), force=options.force, whole=whole)
    found = result.to_dict()
    data = {
        **found,
        "forced": [n for n in options.force if n in result.fitted and n not in report["identifiable"]],
        "candidates": {
            n: {"start": f.start, "min": f.min, "max": f.max, "unit": study.model.parameters[n].unit}
            for n, f in study.candidates.items()
        },
        "units": {o: study.model.outputs[o].unit for o in found["rmse"]},
        "experiments": {e.name: {"role": e.role, "event": e.event, "window": e.window} for e in study.experiments},
        "noise": {
            e: {o: {"std": n.std, "source": n.source} for o, n in notes.items()} for e, notes in study.noise.items()
        },
    }
    if result.status == "failed":
        return Outcome(data, failed=result.message)
    values = {n: float(result.values[n]) for n in study.candidates if n in result.values}
    units = {n: study.model.parameters[n].unit for n in values}
    files = {
        "fitted-values.toml": result.to_toml_values(),
        "fitted-values.csv": values_csv(values, units, found["estimates"], result.held),
        "fitted-values.ssv": ssv(values, study.name),
    }
    for experiment in study.experiments:
        try:
            simulated = simulate(study.model, experiment, FrozenMap(values)).trajectory
        except SimulationError:
            continue  # its RMSE is null in the JSON
        files[f"fit.{experiment.name}.csv"] = comparison_csv(experiment, simulated)
    return Outcome(data, files, failed=result.message if result.status == "not-converged" else "")


def _fitted(study: Study, options: Options, problem: Problem) -> FitResult:
    from hvdc_ident.fit import Group, fit, fit_individually
    from hvdc_ident.fit.optimisers import optimiser
    from hvdc_ident.study.schema import Fit

    asked = study.settings.fit or Fit()
    from hvdc_ident.study.at_work import executor_of

    with executor_of(study, options, "fit") as executor:
        common: dict[str, Any] = {
            "starts": asked.starts,
            "seed": options.seed,
            "optimiser": optimiser(asked.optimiser),
            "executor": executor,
            "progress": options.progress,
        }
        if asked.mode == "individual":
            groups = [
                Group(tuple(g.parameters), tuple(g.outputs or ()), tuple(g.experiments or ())) for g in asked.groups
            ]
            free = [f.name for f in problem.free]
            groups = [replace(g, parameters=tuple(n for n in g.parameters if n in free)) for g in groups]
            return fit_individually(problem, [g for g in groups if g.parameters], **common)
        return fit(problem, **common)


STAGE = Stage(
    name="fit",
    file="fit.json",
    summary="Estimates of the identifiable candidates, with their intervals.",
    run=run,
    wanted=lambda study: study.settings.fit is not None,
    order=40,
    after=("identify",),
    takes=("force",),
)
