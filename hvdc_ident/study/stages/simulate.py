"""The stage `simulate`: the model at its given values, against every recording."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from hvdc_ident.study.stages import Stage, StageOptions, StageResult

if TYPE_CHECKING:
    from hvdc_ident.data import Experiment, Trajectory
    from hvdc_ident.study.study import Study


def run(study: Study, options: StageOptions, earlier: Mapping[str, Any]) -> StageResult:
    """The RMSE of each output in each experiment, and a CSV of measured and simulated outputs for each experiment."""
    import numpy as np

    from hvdc_ident.errors import ComputationError
    from hvdc_ident.simulate import simulate
    from hvdc_ident.study.checks import at_given, need_experiments

    need_experiments(study, "simulate")
    table: dict[str, dict[str, float | None]] = {}
    status: dict[str, dict[str, str]] = {}
    files: dict[str, str] = {}
    for done, experiment in enumerate(study.experiments):
        options.progress(done, len(study.experiments), f"experiment '{experiment.name}'")
        try:
            with at_given(study):
                one = simulate(study.model, experiment, study.given, partial=True)
        except ComputationError as e:
            status[experiment.name] = {"status": "failed", "reason": str(e)}
            for output in experiment.outputs:
                table.setdefault(output, {})[experiment.name] = None
            continue
        simulated, ended = one.trajectory, one.status == "ended"
        status[experiment.name] = {"status": one.status, "reason": one.notes.get("end", "")}
        if ended:
            experiment = _until(experiment, simulated.time.size)
        assert experiment.measured is not None  # a study's experiments have outputs
        for output in experiment.outputs:
            comparable = not ended or np.isfinite(experiment.measured[output][experiment.compared]).any()
            table.setdefault(output, {})[experiment.name] = _rmse(experiment, simulated, output) if comparable else None
        files[f"simulation.{experiment.name}.csv"] = _comparison_csv(experiment, simulated)
    failed = [name for name, s in status.items() if s["status"] != "converged"]
    data = {
        "values": {**study.model.values, **study.given},
        "rmse": table,
        "units": {o: study.model.outputs[o].unit for o in table},
        "experiments": {
            e.name: {"role": e.role, "event": e.event, "window": e.window, "recording": e.recording, **status[e.name]}
            for e in study.experiments
        },
    }
    return StageResult(data, files, failed=status[failed[0]]["reason"] if failed else "")


def _until(experiment: Experiment, rows: int) -> Experiment:
    """Return the experiment's first rows, which a run that an FMU ended came to."""
    from hvdc_ident.data import Trajectory
    from hvdc_ident.immutable import FrozenMap

    m = experiment.measured
    assert m is not None  # a study's experiments have outputs
    return experiment.with_(
        time=m.time[:rows],
        measured=Trajectory(m.time[:rows], m.values[:rows], m.names, m.units, m.origin),
        noise_profile=FrozenMap({o: p[:rows] for o, p in experiment.noise_profile.items()}),
    )


def _rmse(experiment: Experiment, simulated: Trajectory, output: str) -> float:
    """The root mean square of measured - simulated over the rows that are compared, in the output's unit.

    Raises StudyError where there is none.
    """
    import numpy as np

    from hvdc_ident.fit.residual import compared_rows

    rows = compared_rows(experiment, output)
    assert experiment.measured is not None
    difference = experiment.measured[output][rows] - simulated[output][rows]
    return float(np.sqrt(np.mean(difference**2)))


def _comparison_csv(experiment: Experiment, simulated: Trajectory) -> str:
    """CSV text: time, then for each measured output the simulated column OUTPUT and the recorded OUTPUT.measured."""
    from hvdc_ident.files import csv_columns

    assert experiment.measured is not None
    columns = {"time": experiment.time}
    for output in experiment.outputs:
        columns |= {output: simulated[output], f"{output}.measured": experiment.measured[output]}
    return csv_columns(columns)


STAGE = Stage(
    name="simulate",
    file="simulation.json",
    summary="Compare the model at its given values with every recording.",
    run=run,
    wanted=lambda study: bool(study.experiments),
    order=10,
)
