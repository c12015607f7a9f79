"""The stage `sweep`: the model at many points of some parameters, against every recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

from hvdc_ident.study.stages import Stage, StageOptions, StageResult

if TYPE_CHECKING:
    from hvdc_ident.sensitivity import Quantities, Samples
    from hvdc_ident.sensitivity.sweep_points import Want
    from hvdc_ident.study import schema
    from hvdc_ident.study.study import Study


def run(study: Study, options: StageOptions, earlier: Mapping[str, Any]) -> StageResult:
    """A row for each point, as JSON and as CSV; finished points are kept in the folder and not run again."""
    from hvdc_ident.codec import Rows
    from hvdc_ident.errors import StudyError
    from hvdc_ident.sensitivity import sweep
    from hvdc_ident.study.checks import need_experiments
    from hvdc_ident.study.pipeline import workers_of
    from hvdc_ident.study.store import CachingExecutor, Store

    tables = study.settings.sweep
    if not tables:
        hint = '[[sweep]] with parameter = "NAME", min, max and points'
        raise StudyError("sweep needs a parameter and the study names none", where=study.path.name, hint=hint)
    want = swept_names(tables)
    if "rmse" in want:
        need_experiments(study, "sweep")
    with (
        Store(options.folder) if options.folder is not None else nullcontext() as store,
        workers_of(study, options) as pool,
    ):
        result = sweep(
            study.model,
            study.experiments,
            sweep_axes(tables, options.seed),
            against=study.against or ("base" if sweep_reference(tables) == "base" else "data"),
            values=study.given,
            want=sweep_quantities(study, want),
            executor=pool if store is None else CachingExecutor(store.job("sweep"), pool, by_item=True),
            progress=options.progress,
        )
    data = {**result.heading, "points": Rows(result.rows, len(result))}
    reason = f"every point failed; the first: {result.failed[0]}" if len(result.failed) == len(result) else ""
    return StageResult(data, {"sweep.csv": result.to_csv()}, failed=reason)


def sweep_axes(tables: Sequence[schema.SweepTable], seed: int, where: str = "sweep") -> tuple[Samples, ...]:
    """One axis for each table; those sampled by a Latin hypercube together are one. Their product is the sweep."""
    from hvdc_ident.sensitivity import Points, grid, listed, log_grid

    axes: list[Samples] = []
    cube = [t for t in tables if t.sampling == "latin-hypercube"]
    for table in tables:
        if table in cube:
            if table is cube[0]:
                axes.append(_cube(cube, seed, where))
        elif table.values is not None:
            axes.append(listed(table.parameter, table.values))
        else:
            assert table.min is not None and table.max is not None and table.points is not None
            make = log_grid if table.scale == "log" else grid
            axes.append(make(table.parameter, table.min, table.max, table.points))
    Points(tuple(axes))  # refuses a parameter that stands twice, and too many points
    return tuple(axes)


def _cube(tables: Sequence[schema.SweepTable], seed: int, where: str) -> Samples:
    from hvdc_ident.errors import StudyError
    from hvdc_ident.sensitivity import latin_hypercube

    points = {t.points for t in tables}
    if len(points) != 1 or None in points:
        raise StudyError(
            "the axes of a Latin hypercube have different numbers of points",
            where=where,
            expected="one number of points for all tables of sampling 'latin-hypercube'",
            got=", ".join(f"{t.parameter} {t.points}" for t in tables),
        )
    bounds = {t.parameter: (float(t.min or 0.0), float(t.max or 0.0)) for t in tables}
    logs = [t.parameter for t in tables if t.scale == "log"]
    return latin_hypercube(bounds, int(tables[0].points or 0), seed=seed, log=logs)


def sweep_reference(tables: Sequence[schema.SweepTable], where: str = "sweep") -> str:
    """Reference of the sweep, "data", "base" or a model's name, in the same words in every table."""
    from hvdc_ident.errors import StudyError

    said = {t.against for t in tables if t.against is not None}
    if len(said) > 1:
        raise StudyError("the sweep tables do not agree on `against`", where=where, got=" and ".join(sorted(said)))
    return said.pop() if said else "data"


def sweep_quantities(study: Study, names: Sequence[Want]) -> Quantities:
    """Return the quantities of those names, linear ones between the inputs and outputs of [linearize]."""
    from hvdc_ident.sensitivity import Quantities

    table = study.settings.linearize
    if table is None:
        return Quantities(names)
    return Quantities(names, table.inputs or list(study.model.inputs), table.outputs or list(study.model.outputs))


def swept_names(tables: Sequence[schema.SweepTable]) -> tuple[Want, ...]:
    """Return the names of the quantities that any of the tables wants at each point, in a fixed order."""
    asked = {w for t in tables for w in t.want}
    kinds: tuple[Want, ...] = ("rmse", "poles", "bode")
    return tuple(k for k in kinds if k in asked)


def lines_of(data: Mapping[str, Any]) -> Sequence[str]:
    """Return the number of points, the reason of the first that failed, and where the error of each series is smallest."""
    from hvdc_ident.sensitivity import SweepSummary

    summary = SweepSummary.from_dict(data)
    first = f"; the first: {summary.failure}" if summary.failure else ""
    return [f"{summary.text}, {summary.failed} failed{first}", *(series.text for series in summary.best)]


def verdict(data: Mapping[str, Any]) -> str:
    """Return the number of points and of those that failed."""
    from hvdc_ident.sensitivity import SweepSummary

    summary = SweepSummary.from_dict(data)
    return f"{summary.text}, {summary.failed or 'none'} failed"


STAGE = Stage(
    name="sweep",
    file="sweep.json",
    summary="Compute the errors over a range of parameters.",
    run=run,
    wanted=lambda study: bool(study.settings.sweep),
    order=25,
    tell=lines_of,
    verdict=verdict,
)
