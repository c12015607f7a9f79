"""The axes that a study's [[sweep]] tables ask for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from hvdc_ident.errors import StudyError
from hvdc_ident.sensitivity import Points, Samples, grid, latin_hypercube, listed, log_grid
from hvdc_ident.study import schema


def axes_of(tables: Sequence[schema.SweepTable], seed: int, where: str = "sweep") -> tuple[Samples, ...]:
    """One axis for each table; those sampled by a Latin hypercube together are one. Their product is the sweep."""
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


def against_of(tables: Sequence[schema.SweepTable], where: str = "sweep") -> str:
    """What the sweep is compared with, "data", "base" or a model's name: every table that says so says the same."""
    said = {t.against for t in tables if t.against is not None}
    if len(said) > 1:
        raise StudyError("the sweep tables do not agree on `against`", where=where, got=" and ".join(sorted(said)))
    return said.pop() if said else "data"


def wanted(tables: Sequence[schema.SweepTable]) -> tuple[Literal["rmse", "poles", "bode"], ...]:
    """What any of the tables wants at each point, in a fixed order."""
    asked = {w for t in tables for w in t.want}
    kinds: tuple[Literal["rmse", "poles", "bode"], ...] = ("rmse", "poles", "bode")
    return tuple(k for k in kinds if k in asked)


def _cube(tables: Sequence[schema.SweepTable], seed: int, where: str) -> Samples:
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
