"""A study of a unit of a .dyr file and recordings at its terminals: the unit's card, played back, and the study beside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from hvdc_ident.errors import InputError
from hvdc_ident.files import write_text
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import read_card
from hvdc_ident.next_step import NextStep
from hvdc_ident.plants import (
    LEVELS,
    MACHINE,
    RecordedUnit,
    block_signals,
    machine_records,
    recorded_unit,
    shelf_model,
    unit_card,
)
from hvdc_ident.psse import read_dyr, read_raw
from hvdc_ident.study.new_study import DyrOfStudy, NewStudy, new_study
from hvdc_ident.study.recordings import level_before

USUAL = ("H", "KA", "K", "KS1", "KS", "R", "r", "Rperm", "Kvp", "Kqp", "Kqv", "Kp")
"""Parameters that are asked about first, of each part the first that it has: inertia, gains of voltage control and stabiliser, droop."""
FLAGS = FrozenMap({"Kvp": ("QFLAG",), "Kqp": ("QFLAG", "VFLAG")})
"""Flags of its part that must be 1 for a parameter to count."""
COMMANDS = ("Pm", "Efd", "Ipcmd", "Iqcmd")
"""Inputs of a machine or converter that its controls give."""
SEEN = ("P", "Q")
"""Outputs that are recorded at the terminals."""
PLAYBACK = "playback"
"""Component whose inputs are recorded there."""
SPAN = 4.0
"""Factor from the given value to either bound."""


@dataclass(frozen=True)
class UnitAsked:
    """A unit and its files. bus: its number; machine: its identifier, where the bus has several; raw: the power flow; base: MVA of the
    machine, and frequency in Hz, where no power flow says them."""

    dyr: Path
    bus: int
    machine: str | None = None
    raw: Path | None = None
    base: float | None = None
    frequency: float | None = None


def new_unit_study(folder: str | Path, recordings: str | Path | Sequence[str | Path], asked: UnitAsked) -> NewStudy:
    """Write a unit's card, played back, and a study of recordings at its terminals into a folder.

    The machine's models that are not on the shelf are left out, and said. Raises InputError where the base of the machine is not known,
    and as `new_study`, `read_dyr` and `read_raw`.
    """
    folder = Path(folder)
    file = read_dyr(asked.dyr)
    records = machine_records(file, asked.bus, asked.machine)
    raw = None if asked.raw is None else read_raw(asked.raw)
    base = asked.base
    if base is None and raw is not None:
        base = raw.generator(asked.bus, records[0].machine).mbase
    if base is None:
        raise InputError(
            "the base of the machine is not known",
            where=str(asked.dyr),
            expected="its MVA, which a .dyr file does not have",
            next=(
                NextStep("option", "raw = FILE", "reads it from the power flow (MBASE)"),
                NextStep("option", "base = MVA", "states it"),
            ),
        )
    frequency = asked.frequency or (raw and raw.frequency) or 50.0
    unit = recorded_unit(records, base)
    card = folder / "unit.toml"
    if card.exists():
        raise InputError("the folder already holds a unit", where=str(card), hint="a new folder")
    name = f"unit-{asked.bus}-{records[0].machine}"

    def write(levels: Mapping[str, float]) -> None:
        write_text(card, unit_card(unit.parts, name=name, network="playback", f0=frequency, levels=levels))

    # Levels are known once the columns are mapped, and those are mapped to the signals of the card.
    write({})
    about = DyrOfStudy(asked.dyr, asked.bus, records[0].machine, unit.unknown, _candidates(unit), _places(unit, card))
    try:
        found = new_study(folder, recordings, card, dyr=about)
    except InputError:
        card.unlink()  # the next try finds the folder as it was
        raise
    write(_levels(found))
    return found


def _levels(found: NewStudy) -> dict[str, float]:
    """Return the levels before the event of the first recording that has outputs, by input of the unit."""
    experiment = next((r.experiment for r in found.recordings if r.experiment is not None), None)
    if experiment is None or experiment.measured is None:
        return {}
    own = {n: level_before(experiment.time, s(experiment.time), experiment.event) for n, s in experiment.inputs.items()}
    recorded = {n: experiment.measured[o] for n, o in LEVELS.items() if o in experiment.outputs}
    return own | {n: level_before(experiment.time, v, experiment.event) for n, v in recorded.items()}


def _places(unit: RecordedUnit, card: Path) -> tuple[str, ...]:
    """Return the signals of the controls, what they act on and the outputs: what lacks in a machine's own equations is no effect."""
    controls = [n for n in unit.parts if n != MACHINE]
    if not controls:
        return ()
    commands = [n for n in COMMANDS if n in shelf_model(unit.parts[MACHINE].source).inputs]
    patterns = (*(f"{n}.*" for n in controls), *(f"{MACHINE}.{n}" for n in commands), *SEEN)
    return block_signals(read_card(card), patterns, shelf_model(PLAYBACK).inputs, SEEN)


def _candidates(unit: RecordedUnit) -> dict[str, tuple[float, float]]:
    found = {}
    for name, part in unit.parts.items():
        off = {n for n, flags in FLAGS.items() if any(part.values.get(f) == 0.0 for f in flags)}
        usual = next((n for n in USUAL if n not in off and part.values.get(n, 0.0) > 0.0), None)
        if usual is not None:
            found[f"{name}.{usual}"] = (part.values[usual] / SPAN, part.values[usual] * SPAN)
    return found
