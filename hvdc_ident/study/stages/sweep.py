"""The stage `sweep`: the model at many points of some parameters, against every recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

from hvdc_ident.study.stage import Options, Outcome, Stage

if TYPE_CHECKING:
    from hvdc_ident.study.study import Study


def run(study: Study, options: Options, earlier: Mapping[str, Any]) -> Outcome:
    """A row for each point, as JSON and as CSV; finished points are kept in the folder and not run again."""
    from hvdc_ident.errors import StudyError
    from hvdc_ident.files import Rows
    from hvdc_ident.sensitivity import sweep
    from hvdc_ident.study.at_work import workers_of
    from hvdc_ident.study.needs import need_experiments
    from hvdc_ident.study.store import Store
    from hvdc_ident.study.sweeps import against_of, axes_of, wanted

    tables = study.settings.sweep
    if not tables:
        hint = '[[sweep]] with parameter = "NAME", min, max and points'
        raise StudyError("sweep needs a parameter and the study names none", where=study.path.name, hint=hint)
    want = wanted(tables)
    if "rmse" in want:
        need_experiments(study, "sweep")
    linear = study.settings.linearize
    with (
        Store(options.folder) if options.folder is not None else nullcontext() as store,
        workers_of(options) as pool,
    ):
        result = sweep(
            study.model,
            study.experiments,
            axes_of(tables, options.seed),
            against=study.against or ("base" if against_of(tables) == "base" else "data"),
            values=study.given,
            want=want,
            linear=(linear.inputs or list(study.model.inputs), linear.outputs or list(study.model.outputs))
            if linear
            else None,
            executor=pool,
            kept=(lambda fingerprint: store.job("sweep", fingerprint)) if store is not None else None,
            progress=options.progress,
        )
    data = {**result.summary(), "points": Rows(result.rows, len(result))}
    reason = f"every point failed; the first: {result.failed[0]}" if len(result.failed) == len(result) else ""
    return Outcome(data, {"sweep.csv": result.to_csv()}, failed=reason)


def told(data: Mapping[str, Any]) -> Sequence[str]:
    """How many points, the reason of the first that failed, and where the error of each series is smallest."""
    best: dict[tuple[str, str], tuple[float, Mapping[str, float]]] = {}
    reason = ""
    for point in data["points"]:
        if point["status"] != "done":
            reason = reason or f"; the first: {point['reason']}"
            continue
        for output, line in point["rmse"].items():
            for experiment, error in line.items():
                if (output, experiment) not in best or error < best[output, experiment][0]:
                    best[output, experiment] = error, point["values"]
    lines = [f"{data['count']} points of {', '.join(data['parameters'])}, {data['failed']} failed{reason}"]
    for (output, experiment), (error, values) in best.items():
        at = ", ".join(f"{n} = {v:.6g}" for n, v in values.items())
        size = f"{error:.4g} {data['units'].get(output, '')}".rstrip()
        lines.append(f"{output} in {experiment}: smallest RMSE {size}, at {at}")
    return lines


STAGE = Stage(
    name="sweep",
    file="sweep.json",
    summary="The errors over a range of parameters.",
    run=run,
    wanted=lambda study: bool(study.settings.sweep),
    order=25,
    tell=told,
)
