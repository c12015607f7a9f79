"""Columns a recording does not hold but its phases do."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hvdc_ident.errors import InputError, StudyError
from hvdc_ident.phases import PhaseFilter, quantities
from hvdc_ident.study import schema
from hvdc_ident.trajectory import Trajectory


def raw_columns(tables: Sequence[schema.Phases], columns: Sequence[str]) -> list[str]:
    """The columns to be read from the file where these are wanted, some of them made of phases."""
    made = {name for table in tables for name in table.gives}
    phases = [name for table in tables for name in (*table.voltage, *(table.current or ()))]
    return list(dict.fromkeys([*(c for c in columns if c not in made), *phases]))


def with_phases(tables: Sequence[schema.Phases], data: Trajectory, place: str) -> Trajectory:
    """The recording with the columns its phases give; the same object where none are asked for."""
    found = data
    for number, table in enumerate(tables, 1):
        where = f"{place}.phases, line {number}"
        taken = [name for name in table.gives if name in found]
        if taken:
            raise StudyError(f"a column '{taken[0]}' is already there", where=where, expected="a new name in gives")
        window = table.window if table.window is not None else 1.0 / table.frequency  # one cycle
        try:
            made = quantities(
                data,
                table.voltage,
                table.current,
                list(table.gives.values()),
                frequency=table.frequency,
                smoothing=PhaseFilter(table.filter, window),
            )
        except InputError as e:
            raise e.at(where) from None
        found = Trajectory(
            found.time,
            np.column_stack([found.values, made.values]),
            (*found.names, *table.gives),
            (*found.units, *made.units),
        )
    return found
