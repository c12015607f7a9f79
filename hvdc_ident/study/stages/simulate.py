"""The stage `simulate`: the model at its given values, against every recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from hvdc_ident.study.stages import Stage, StageOptions, StageResult

if TYPE_CHECKING:
    from hvdc_ident.data import Experiment, Trajectory
    from hvdc_ident.study.study import Study
    from hvdc_ident.summary.gaps import SignalGap
    from hvdc_ident.summary.stage_results import ExperimentContext


def run(study: Study, options: StageOptions, earlier: Mapping[str, Any]) -> StageResult:
    """The RMSE of each output in each experiment, and a CSV of measured and simulated outputs for each experiment."""
    import numpy as np

    from hvdc_ident.errors import ComputationError
    from hvdc_ident.simulate import simulate
    from hvdc_ident.study import fitting
    from hvdc_ident.study.checks import at_given, need_experiments
    from hvdc_ident.study.study import candidate_lines
    from hvdc_ident.summary.gaps import worst_first

    need_experiments(study, "simulate")
    table: dict[str, dict[str, float | None]] = {}
    gaps: list[SignalGap] = []
    experiments: dict[str, ExperimentContext] = {}
    files: dict[str, str] = {}
    curves = {}
    for done, experiment in enumerate(study.experiments):
        options.progress(done, len(study.experiments), f"experiment '{experiment.name}'")
        try:
            with at_given(study):
                one = simulate(study.model, experiment, study.given, partial=True)
        except ComputationError as e:
            experiments[experiment.name] = fitting.context_of(experiment, "failed", str(e))
            for output in experiment.outputs:
                table.setdefault(output, {})[experiment.name] = None
            continue
        simulated, ended = one.trajectory, one.status == "ended"
        experiments[experiment.name] = fitting.context_of(experiment, one.status, one.notes.get("end", ""))
        if ended:
            experiment = _until(experiment, simulated.time.size)
        assert experiment.measured is not None  # a study's experiments have outputs
        for output in experiment.outputs:
            comparable = not ended or np.isfinite(experiment.measured[output][experiment.compared]).any()
            gap = _gap(study, experiment, simulated, output) if comparable else None
            table.setdefault(output, {})[experiment.name] = None if gap is None else gap.rmse
            gaps += [] if gap is None else [gap]
        if not ended:
            curves[experiment.name] = fitting.curves_of_run(experiment, simulated)
        files[f"simulation.{experiment.name}.csv"] = _comparison_csv(experiment, simulated)
    failed = {name: e.reason for name, e in experiments.items() if e.status != "converged"}
    data = {
        "values": {**study.model.values, **study.given},
        "rmse": table,
        "units": {o: study.model.outputs[o].unit for o in table},
        "gaps": worst_first(gaps),
        "candidates": candidate_lines(study),
        "experiments": experiments,
        "noise": study.noise,
        "judgement": fitting.judgement_of(study, {"given": curves}),
    }
    return StageResult(data, files, failed=_failures(failed))


def _failures(reasons: Mapping[str, str]) -> str:
    """Return why some experiments have no run, the first reasons in full; empty where all have one."""
    told = [r if n in r or len(reasons) == 1 else f"{n}: {r}" for n, r in reasons.items()]
    others = [*reasons][REASONS:]
    return "; ".join([*told[:REASONS], *([f"no run either of {', '.join(others)}"] if others else [])])


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


def _gap(study: Study, experiment: Experiment, simulated: Trajectory, output: str) -> SignalGap:
    """Return how far recorded and simulated output are apart. Raises StudyError where no row is compared."""
    import numpy as np

    from hvdc_ident.fit.residual import compared_rows
    from hvdc_ident.summary.gaps import SignalGap

    rows = compared_rows(experiment, output)
    assert experiment.measured is not None
    recorded = experiment.measured[output][rows]
    difference = recorded - simulated[output][rows]
    rmse, span = float(np.sqrt(np.mean(difference**2))), float(np.ptp(recorded))
    note = study.noise[experiment.name][output]
    noise = note.std if note.source in ("given", "estimated") and note.std > 0.0 else None
    k = int(np.argmax(np.abs(difference)))
    return SignalGap(
        output,
        experiment.name,
        study.model.outputs[output].unit,
        rmse,
        rmse / span if span > 0.0 else None,
        noise,
        None if noise is None else rmse / noise,
        float(difference[k]),
        float(experiment.time[rows][k]),
    )


def _comparison_csv(experiment: Experiment, simulated: Trajectory) -> str:
    """CSV text: time, then for each measured output the simulated column OUTPUT and the recorded OUTPUT.measured."""
    from hvdc_ident.files import csv_columns

    assert experiment.measured is not None
    columns = {"time": experiment.time}
    for output in experiment.outputs:
        columns |= {output: simulated[output], f"{output}.measured": experiment.measured[output]}
    return csv_columns(columns)


REASONS = 3
"""Failed experiments whose reason a message holds in full."""
ROWS = 12
"""Rows of the table on the screen; what follows is told by its largest."""


def lines_of(data: Mapping[str, Any]) -> Sequence[str]:
    """The question, a table of the errors from the worst signal on, the largest gap, and what to do next."""
    from hvdc_ident.display import Table, rounded
    from hvdc_ident.summary.stage_results import Context
    from hvdc_ident.text import listed, quantity

    about = Context.from_dict(data)
    gaps, roles = about.gaps, [e.role for e in about.experiments.values()]
    if not gaps:
        return []
    held = f", {roles.count('holdout')} of them held out" if "holdout" in roles else ""
    recordings = f"{len(roles)} recording{'s' if len(roles) > 1 else ''}{held}"
    lines = [f"{data['model']} at its given values against {recordings}:", ""]
    rows = []
    for g in gaps[:ROWS]:
        percent = None if g.nrmse is None else rounded(100.0 * g.nrmse, 3)
        name = (g.output, g.experiment, about.experiments[g.experiment].role)
        rows.append((*name, rounded(g.rmse), g.unit, percent, rounded(g.noise_units, 3)))
    header = ("output", "recording", "role", "RMSE", "unit", "NRMSE, %", "RMSE/noise")
    lines += str(Table(header, tuple(rows)).without_empty()).splitlines()
    lines += [f"and {len(gaps) - ROWS} more, with smaller errors"] if len(gaps) > ROWS else []
    g = gaps[0]
    by = f"{quantity(abs(g.largest), g.unit)} {'above' if g.largest > 0 else 'below'} the model"
    lines += ["", "NRMSE: RMSE over the recorded range of the output."]
    lines += [f"Worst signal: {g.text}.", f"Its largest gap: the recording is {by} at {g.at:.6g} s."]
    if about.candidates:
        names = listed(about.candidates)
        lines.append(f"Next: `hvdc-ident fit STUDY` estimates what the recordings determine of {names}.")
    else:
        lines.append(
            "Next: name what may be estimated in [parameters], NAME = {min = ..., max = ...}; then `hvdc-ident fit STUDY`."
        )
    return lines


def verdict(data: Mapping[str, Any]) -> str:
    """Return the worst signal; empty where nothing was compared."""
    from hvdc_ident.summary.stage_results import Context

    return next((f"worst is {g.text}" for g in Context.from_dict(data).gaps), "")


STAGE = Stage(
    name="simulate",
    file="simulation.json",
    summary="Compare the model at its given values with every recording.",
    run=run,
    wanted=lambda study: bool(study.experiments),
    order=10,
    tell=lines_of,
    told_in_part=True,
    verdict=verdict,
)
