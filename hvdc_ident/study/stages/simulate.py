"""The stage `simulate`: the model at its given values, against every recording."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from hvdc_ident.study.stage import Options, Outcome, Stage

if TYPE_CHECKING:
    from hvdc_ident.study.study import Study


def run(study: Study, options: Options, earlier: Mapping[str, Any]) -> Outcome:
    """The RMSE of each output in each experiment, and a CSV of measured and simulated outputs for each experiment."""
    from hvdc_ident.errors import ComputationError
    from hvdc_ident.simulate import simulate
    from hvdc_ident.study.needs import at_given, need_experiments
    from hvdc_ident.study.tables import comparison_csv, rmse

    need_experiments(study, "simulate")
    table: dict[str, dict[str, float | None]] = {}
    status: dict[str, dict[str, str]] = {}
    files: dict[str, str] = {}
    for done, experiment in enumerate(study.experiments):
        options.progress(done, len(study.experiments), f"experiment '{experiment.name}'")
        try:
            with at_given(study):
                simulated = simulate(study.model, experiment, study.given).trajectory
        except ComputationError as e:
            status[experiment.name] = {"status": "failed", "reason": str(e)}
            for output in experiment.outputs:
                table.setdefault(output, {})[experiment.name] = None
            continue
        status[experiment.name] = {"status": "converged", "reason": ""}
        for output in experiment.outputs:
            table.setdefault(output, {})[experiment.name] = rmse(experiment, simulated, output)
        files[f"simulation.{experiment.name}.csv"] = comparison_csv(experiment, simulated)
    failed = [name for name, s in status.items() if s["status"] == "failed"]
    data = {
        "values": {**study.model.values, **study.given},
        "rmse": table,
        "units": {o: study.model.outputs[o].unit for o in table},
        "experiments": {
            e.name: {"role": e.role, "event": e.event, "window": e.window, "recording": e.recording, **status[e.name]}
            for e in study.experiments
        },
    }
    return Outcome(data, files, failed=status[failed[0]]["reason"] if failed else "")


STAGE = Stage(
    name="simulate",
    file="simulation.json",
    summary="The model at its given values, against every recording.",
    run=run,
    wanted=lambda study: bool(study.experiments),
    order=10,
)
