"""Three columns of a record that are the phases of one voltage or current: by their names, and by the waveforms."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hvdc_ident.data.three_phase import space_vector
from hvdc_ident.data.trajectory import Trajectory
from hvdc_ident.data.units import conversion

LETTERS = ("abc", "123", "rst", "uvw", "ryb")
"""Letters by which the names of three phases differ."""
NOMINAL = (50.0, 60.0)
"""Hz."""
_OFF = 0.1  # share by which the frequency may differ from the nominal one
_BALANCED = 0.5  # least square of the space vector over the sum of the phases' mean squares; 2/3 for a balanced set
_FEWEST = 10  # samples of a cycle


@dataclass(frozen=True)
class PhaseSet:
    """Three phases in the order of rotation. frequency: nominal, Hz."""

    names: tuple[str, str, str]
    quantity: Literal["voltage", "current"]
    frequency: float


def phase_sets(record: Trajectory) -> tuple[PhaseSet, ...]:
    """Return the sets of three columns whose names differ in the letter of a phase and which rotate at 50 or 60 Hz, each column once.

    What they are is told by their unit, else by the first letter of the name: i is a current, u, v and e are voltages.
    """
    sets: list[PhaseSet] = []
    for names in _alike(record.names):
        taken = {name for known in sets for name in known.names}
        quantity = _quantity(record, names)
        if quantity is None or taken.intersection(names):
            continue
        turns = _frequency(record, names)
        nominal = min(NOMINAL, key=lambda f: abs(abs(turns) - f))
        if abs(abs(turns) - nominal) <= _OFF * nominal:
            a, b, c = names
            sets.append(PhaseSet((a, b, c) if turns > 0 else (a, c, b), quantity, nominal))
    return tuple(sets)


def _alike(names: tuple[str, ...]) -> Iterator[tuple[str, str, str]]:
    """Yield three names that differ in one letter of a phase, in the order of these letters."""
    groups: dict[tuple[str, str, str], dict[str, str]] = {}
    for name in names:
        for place, letter in enumerate(name.lower()):
            for letters in LETTERS:
                if letter in letters:
                    groups.setdefault((name[:place], letters, name[place + 1 :]), {}).setdefault(letter, name)
    for (_, letters, _), group in groups.items():
        if len(group) == 3:
            a, b, c = (group[letter] for letter in letters)
            yield a, b, c


def _quantity(record: Trajectory, names: tuple[str, str, str]) -> Literal["voltage", "current"] | None:
    units = {record.unit(name) for name in names}
    if len(units) > 1:
        return None
    (unit,) = units
    for kind, letters in (("V", "uve"), ("A", "i")):
        if (unit and conversion(unit, kind) is not None) or (
            conversion(unit, "pu") is not None and names[0][0].lower() in letters
        ):
            return "voltage" if kind == "V" else "current"
    return None


def _frequency(record: Trajectory, names: tuple[str, str, str]) -> float:
    """The mean frequency in Hz at which the phases turn, each instant by its power; 0 where they are no three phases."""
    later = np.diff(record.time) > 0
    step = float(np.median(np.diff(record.time)[later])) if later.any() else 0.0
    values = record.select(names).values
    vector = space_vector(record, names)
    power, whole = float(np.mean(np.abs(vector) ** 2)), float(np.sum(np.mean(values**2, axis=0)))
    if not step or not power > _BALANCED * whole:  # of a record with gaps neither is a number
        return 0.0
    turn = np.angle(np.sum((vector[1:] * np.conj(vector[:-1]))[later]))
    return float(turn / (2.0 * np.pi * step)) if abs(turn) * _FEWEST <= 2.0 * np.pi else 0.0
