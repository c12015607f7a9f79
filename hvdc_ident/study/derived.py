"""Columns a recording does not hold but its phases or phasors do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from hvdc_ident.data import Trajectory
from hvdc_ident.data.three_phase import (
    PhaseFilter,
    PhasorColumns,
    PhasorSettings,
    frequency_noise,
    phase_quantities,
    phasor_quantities,
)
from hvdc_ident.errors import InputError, StudyError
from hvdc_ident.study import schema


def raw_columns(table: schema.ExperimentTable, columns: Sequence[str]) -> list[str]:
    """The columns to be read from the file where these are wanted, some of them made of phases or phasors."""
    made = {*(n for line in table.phases for n in line.gives), *(n for line in table.phasors for n in line.gives)}
    phases = [name for line in table.phases for name in (*line.voltage, *(line.current or ()))]
    phasors = [n for line in table.phasors for p in (line.voltage, line.current) if p for n in (*p.magnitude, *p.angle)]
    references = [line.reference for line in table.phasors if line.reference not in (None, "start")]
    return list(dict.fromkeys([*(c for c in columns if c not in made), *phases, *phasors, *map(str, references)]))


def with_derived(table: schema.ExperimentTable, data: Trajectory, place: str) -> Trajectory:
    """The recording with the columns its phases and phasors give; the same object where none are asked for."""
    found = data
    for number, line in enumerate(table.phases, 1):
        found = _added(found, line.gives, _of_phases(line, data, f"{place}.phases, line {number}"))
    for number, phasors in enumerate(table.phasors, 1):
        made = _of_phasors(phasors, data, f"{place}.phasors, line {number}")
        found = _added(found, phasors.gives, made)
    return found


def _of_phases(line: schema.PhasesTable, data: Trajectory, where: str) -> Trajectory:
    _check_new(line.gives, data, where)
    window = line.window if line.window is not None else 1.0 / line.frequency  # one cycle
    try:
        return phase_quantities(
            data,
            line.voltage,
            line.current,
            list(line.gives.values()),
            frequency=line.frequency,
            smoothing=PhaseFilter(line.filter, window),
        )
    except InputError as e:
        raise e.at(where) from None


def _of_phasors(line: schema.PhasorsTable, data: Trajectory, where: str) -> Trajectory:
    _check_new(line.gives, data, where)
    how = PhasorSettings(line.frequency, line.window, line.magnitudes or "", line.reference or "")
    current = _columns(line.current) if line.current is not None else None
    try:
        made = phasor_quantities(data, _columns(line.voltage), current, list(line.gives.values()), how)
    except InputError as e:
        raise e.at(where) from None
    told = tuple(
        f"{name}: mean frequency over the last {line.window:g} s, from the angle; noise of 1 deg in it is "
        f"{frequency_noise(np.pi / 180.0, line.window):.3g} Hz here"
        for name, quantity in line.gives.items()
        if quantity == "f"
    )
    return replace(made, origin=replace(made.origin, converted=told))


def _columns(phasor: schema.PhasorTable) -> PhasorColumns:
    return PhasorColumns(tuple(phasor.magnitude), tuple(phasor.angle), phasor.unit or "")


def _check_new(gives: Mapping[str, str], data: Trajectory, where: str) -> None:
    taken = [name for name in gives if name in data]
    if taken:
        raise StudyError(f"a column '{taken[0]}' is already there", where=where, expected="a new name in gives")


def _added(found: Trajectory, gives: Mapping[str, str], made: Trajectory) -> Trajectory:
    return Trajectory(
        found.time,
        np.column_stack([found.values, made.values]),
        (*found.names, *gives),
        (*found.units, *made.units),
        replace(found.origin, converted=(*found.origin.converted, *made.origin.converted)),
    )
