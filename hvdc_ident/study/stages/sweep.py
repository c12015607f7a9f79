"""The stage `sweep`: the model at many points of some parameters, against every recording."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

from hvdc_ident.study.stage import Options, Outcome, Stage

if TYPE_CHECKING:
    from hvdc_ident.study.study import Study


def run(study: Study, options: Options, earlier: Mapping[str, Any]) -> Outcome:
    """A row for each point, as JSON and as CSV; finished points are kept in the folder and not run again."""
    from hvdc_ident.errors import StudyError
    from hvdc_ident.files import Rows
    from hvdc_ident.sensitivity.sweep import sweep
    from hvdc_ident.study.executors import LocalPool
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
    with Store(options.folder) if options.folder is not None else nullcontext() as store:
        result = sweep(
            study.model,
            study.experiments,
            axes_of(tables, options.seed),
            against=against_of(tables),
            values=study.values,
            want=want,
            linear=(linear.inputs or list(study.model.inputs), linear.outputs or list(study.model.outputs))
            if linear
            else None,
            executor=LocalPool(options.workers) if options.workers > 1 else None,
            kept=(lambda fingerprint: store.job("sweep", fingerprint)) if store is not None else None,
            progress=options.progress,
        )
    data = {**result.summary(), "points": Rows(result.rows, len(result))}
    reason = f"every point failed; the first: {result.failed[0]}" if len(result.failed) == len(result) else ""
    return Outcome(data, {"sweep.csv": result.to_csv()}, failed=reason)


STAGE = Stage(
    name="sweep",
    file="sweep.json",
    summary="The errors over a range of parameters.",
    run=run,
    wanted=lambda study: bool(study.settings.sweep),
    order=25,
)
