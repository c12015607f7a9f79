"""A study of a unit of a .dyr file and recordings at its terminals: the unit's card, played back, and the study beside it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from hvdc_ident.errors import InputError
from hvdc_ident.files import write_text
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import read_card
from hvdc_ident.next_step import NextStep
from hvdc_ident.parameters import Parameter
from hvdc_ident.plants import (
    LEVELS,
    MACHINE,
    STEP_UP,
    RecordedUnit,
    UnitPart,
    block_signals,
    idle_parts,
    machine_records,
    recorded_unit,
    shelf_model,
    unit_card,
)
from hvdc_ident.psse import read_dyr, read_raw
from hvdc_ident.shelf import asked_of, record_of
from hvdc_ident.study.new_study import DyrOfStudy, NewStudy, new_study
from hvdc_ident.study.nominal_frequency import recorded_frequencies
from hvdc_ident.study.recordings import level_before
from hvdc_ident.study.terminal_columns import Terminals
from hvdc_ident.study.unit_notes import InPowerFlow, unit_notes
from hvdc_ident.text import listed

FLAGS = FrozenMap({"Kvp": ("QFLAG",), "Kqp": ("QFLAG", "VFLAG")})
"""Flags of its part that must be 1 for a parameter to count."""
GAIN = re.compile(r"^share|\b(gain|droop|inertia|damping|feedback|loading|demagnetisation|lead-lag|constant of)\b")
"""Words in the description of a gain or of another factor in a loop; a time constant has the unit of time."""
LIMIT = re.compile(r"^(highest|lowest|time (below|above|after))\b")
"""Words in that of a limit, or of a setting of protection, which acts at an instant."""
COMMANDS = ("Pm", "Efd", "Ipcmd", "Iqcmd")
"""Inputs of a machine or converter that its controls give."""
SEEN = ("P", "Q")
"""Outputs that are recorded at the terminals."""
PLAYBACK = "playback"
"""Component whose inputs are recorded there."""
SYSTEM_BASE = 100.0
"""MVA, where no power flow states it: of the currents alone, which no recording has."""
SPAN = 4.0
"""Factor from the given value to either bound."""


@dataclass(frozen=True)
class UnitAsked:
    """A unit and its files. bus: its number; machine: its identifier, where the bus has several; raw: the power flow; base: MVA of the
    machine, and frequency in Hz, in place of what the power flow and the recordings say."""

    dyr: Path
    bus: int
    machine: str | None = None
    raw: Path | None = None
    base: float | None = None
    frequency: float | None = None


def new_unit_study(folder: str | Path, recordings: str | Path | Sequence[str | Path], asked: UnitAsked) -> NewStudy:
    """Write a unit's card, played back, and a study of recordings at its terminals into a folder.

    The machine's models that are not on the shelf are left out, and said, as is what the files state and the study does not use.
    Raises InputError where the base of the machine or the nominal frequency is not known, and as `new_study`, `read_dyr` and `read_raw`.
    """
    folder = Path(folder)
    file = read_dyr(asked.dyr)
    records = machine_records(file, asked.bus, asked.machine)
    grid = None if asked.raw is None else _in_power_flow(asked.raw, asked.bus, records[0].machine)
    base = _base(asked, grid)
    files = [Path(recordings)] if isinstance(recordings, str | Path) else [Path(r) for r in recordings]
    frequency, source = _frequency(asked, grid, files)
    generator, system = (None, SYSTEM_BASE) if grid is None else (grid.generator, grid.raw.sbase)
    unit = recorded_unit(file, records, base, generator, system)
    card = folder / "unit.toml"
    if card.exists():
        raise InputError("the folder already holds a unit", where=str(card), hint="a new folder")
    name = f"unit-{asked.bus}-{records[0].machine}"

    def write(levels: Mapping[str, float]) -> None:
        write_text(card, unit_card(unit.parts, name=name, network="playback", f0=frequency, levels=levels))

    # Levels are known once the columns are mapped, and those are mapped to the signals of the card.
    write({})
    candidates = asked_about(unit)
    about = DyrOfStudy(
        asked.dyr,
        asked.bus,
        records[0].machine,
        tuple(r.model for r in unit.unknown),
        candidates,
        offered={n: b for n, b in offered(unit).items() if n not in candidates},
        places=_places(unit, card),
        bus_kv=None if grid is None else grid.bus.base_kv or None,
        mva=base,
        frequency=frequency,
        notes=unit_notes(unit, records, grid, base, (frequency, source), list(candidates)),
    )
    try:
        study = new_study(folder, recordings, card, dyr=about, terminals=_terminals(grid, base, frequency))
    except InputError:
        card.unlink()  # the next try finds the folder as it was
        raise
    write(_levels(study))
    return study


def _in_power_flow(file: Path, bus: int, machine: str) -> InPowerFlow:
    raw = read_raw(file)
    return InPowerFlow(raw, raw.bus(bus), raw.generator(bus, machine))


def _base(asked: UnitAsked, grid: InPowerFlow | None) -> float:
    """Return the base of the machine in MVA: that asked for, else that of the power flow."""
    if asked.base is not None:
        return asked.base
    if grid is not None:
        return grid.generator.mbase
    raise InputError(
        "the base of the machine is not known",
        where=str(asked.dyr),
        expected="its MVA, which a .dyr file does not have",
        next=(
            NextStep("option", "raw = FILE", "reads it from the power flow (MBASE)"),
            NextStep("option", "base = MVA", "states it"),
        ),
    )


def _frequency(asked: UnitAsked, grid: InPowerFlow | None, recordings: Sequence[Path]) -> tuple[float, str]:
    """Return the nominal frequency in Hz, and in words where it is from and what else a recording shows.

    That asked for counts, else that of the power flow, else that of the recordings; no words where the first two say it and no
    recording contradicts.
    """
    shown = recorded_frequencies(recordings)
    stated = asked.frequency or (grid.raw.frequency if grid is not None else None)
    if stated is not None:
        others = [r.shown_by for r in shown if r.value != stated]
        return stated, f"but {listed(others)}" if others else "" if grid is not None else "as asked for"
    if len(shown) == 1:
        return shown[0].value, shown[0].shown_by
    raise InputError(
        "the nominal frequency is not known",
        where=str(asked.dyr),
        expected="50 or 60 Hz, which a .dyr file does not have and "
        + ("the recordings do not show" if not shown else "one of the recordings alone shows"),
        got="; ".join(r.shown_by for r in shown),
        next=(
            NextStep("option", "frequency = 60", "states it"),
            NextStep("option", "raw = FILE", "reads it from the power flow (BASFRQ)"),
        ),
    )


def _terminals(grid: InPowerFlow | None, base: float, frequency: float) -> Terminals:
    """Return what the files state of the unit's terminals."""
    if grid is None:
        return Terminals(frequency, base)
    bus, machine = grid.bus, grid.generator
    return Terminals(frequency, base, bus.base_kv or None, grid.raw.sbase, machine.pg, machine.qg, bus.name.strip())


def _levels(study: NewStudy) -> dict[str, float]:
    """Return the levels before the event of the first recording that has outputs, by input of the unit."""
    experiment = next((r.experiment for r in study.recordings if r.experiment is not None), None)
    if experiment is None or experiment.measured is None:
        return {}
    own = {n: level_before(experiment.time, s(experiment.time), experiment.event) for n, s in experiment.inputs.items()}
    recorded = {n: experiment.measured[o] for n, o in LEVELS.items() if o in experiment.outputs}
    return own | {n: level_before(experiment.time, v, experiment.event) for n, v in recorded.items()}


def _places(unit: RecordedUnit, card: Path) -> tuple[str, ...]:
    """Return the signals of the controls, what they act on and the outputs: what lacks in a machine's own equations is no effect."""
    controls = [n for n in unit.parts if n not in (MACHINE, STEP_UP)]
    if not controls:
        return ()
    commands = [n for n in COMMANDS if n in shelf_model(unit.parts[MACHINE].source).inputs]
    patterns = (*(f"{n}.*" for n in controls), *(f"{MACHINE}.{n}" for n in commands), *SEEN)
    return block_signals(read_card(card), patterns, shelf_model(PLAYBACK).inputs, SEEN)


def asked_about(unit: RecordedUnit) -> dict[str, tuple[float, float]]:
    """Return of each part that acts the first parameter that its card asks about, is not 0 and counts at its flags, with its bounds."""
    candidates = {}
    idle = idle_parts(unit.parts)
    for name, part in ((n, p) for n, p in unit.parts.items() if n not in idle):
        off = {n for n, flags in FLAGS.items() if any(part.values.get(f) == 0.0 for f in flags)}
        usual = next((n for n in asked_of(part.source) if n not in off and part.values.get(n)), None)
        if usual is not None:
            candidates[f"{name}.{usual}"] = _bounds(part, usual)
    return candidates


def offered(unit: RecordedUnit) -> dict[str, tuple[float, float]]:
    """Return the gains and time constants of the records, with bounds; those that are 0 take their block out and have none."""
    return {
        f"{name}.{n}": _bounds(part, n)
        for name, part in unit.parts.items()
        for n in record_of(part.source)
        if part.values.get(n) and is_gain_or_time(shelf_model(part.source).parameters[n])
    }


def is_gain_or_time(parameter: Parameter) -> bool:
    """Return True for a gain, a droop, an inertia, a damping or a time constant: what a study of a unit may ask about."""
    about = parameter.description
    named = parameter.unit == "s" or GAIN.search(about.split(";")[0]) is not None
    return named and not LIMIT.search(about)


def _bounds(part: UnitPart, name: str) -> tuple[float, float]:
    """Return the given value by and times `SPAN`, within what the physics allows."""
    value, limits = part.values[name], shelf_model(part.source).parameters[name]
    low, high = sorted((value / SPAN, value * SPAN))
    return max(low, limits.min), min(high, limits.max)
