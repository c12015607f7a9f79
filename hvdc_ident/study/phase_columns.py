"""Phases in a recording as a new study writes them: lines of `phases` in its experiment."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from difflib import SequenceMatcher

from hvdc_ident.data import Trajectory
from hvdc_ident.data.phase_sets import PhaseSet, phase_sets
from hvdc_ident.data.three_phase import PHASE_QUANTITIES, needs_current
from hvdc_ident.model.card import toml_key, toml_string
from hvdc_ident.study import schema


def proposed_phases(record: Trajectory) -> tuple[schema.PhasesTable, ...]:
    """Return what can be made of the phases in a recording.

    A line for each current, with the voltage of the likest name, and for each voltage that is then left.
    """
    sets = phase_sets(record)
    voltages = [s for s in sets if s.quantity == "voltage"]
    pairs: list[tuple[PhaseSet, PhaseSet | None]] = []
    if voltages:
        pairs += [(max(voltages, key=lambda v: _likeness(v, s)), s) for s in sets if s.quantity == "current"]
    pairs += [(v, None) for v in voltages if v not in [voltage for voltage, _ in pairs]]
    lines: list[schema.PhasesTable] = []
    taken = set(record.names)
    for voltage, current in pairs:
        known = [q for q in PHASE_QUANTITIES if current is not None or not needs_current(q)]
        gives = {q if q not in taken else f"{q} of {(current or voltage).names[0]}": q for q in known}
        taken |= set(gives)
        currents = list(current.names) if current is not None else None
        lines.append(
            schema.PhasesTable(voltage=list(voltage.names), current=currents, frequency=voltage.frequency, gives=gives)
        )
    return tuple(lines)


def without_phases(record: Trajectory, lines: Sequence[schema.PhasesTable]) -> Trajectory:
    """Return the columns that are no phase: no signal of a model is one."""
    waves = {name for line in lines for name in (*line.voltage, *(line.current or ()))}
    return record.select(name for name in record.names if name not in waves)


def ways_to_count(lines: Sequence[schema.PhasesTable]) -> dict[str, str]:
    """Return by column that is a voltage or a current which of the ways to count it is meant, in words."""
    once = ("p", "q", "f")
    return {n: PHASE_QUANTITIES[q] for line in lines for n, q in line.gives.items() if q not in once}


def of_use(lines: Sequence[schema.PhasesTable], names: Collection[str]) -> tuple[schema.PhasesTable, ...]:
    """Return the lines with those of their columns that have one of the names, as far as there are any."""
    used = [(line, {n: q for n, q in line.gives.items() if n in names}) for line in lines]
    return tuple(line.model_copy(update={"gives": gives}) for line, gives in used if gives)


def phases_text(line: schema.PhasesTable) -> str:
    """Return a line of `phases` as TOML."""
    columns = {"voltage": line.voltage, **({"current": line.current} if line.current else {})}
    named = [f"{kind} = [{', '.join(map(toml_string, names))}]" for kind, names in columns.items()]
    gives = ", ".join(f"{toml_key(name)} = {toml_string(quantity)}" for name, quantity in line.gives.items())
    return f"{{{', '.join(named)}, frequency = {line.frequency:g}, gives = {{{gives}}}}}"


def _likeness(voltage: PhaseSet, current: PhaseSet) -> float:
    """Return how much two names have in common, beside the letter of the quantity."""
    return SequenceMatcher(None, voltage.names[0].lower(), current.names[0].lower()).ratio()
