"""The nominal frequency of a network, as recordings of it show."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from hvdc_ident.data import Trajectory
from hvdc_ident.data.quantities import read_columns
from hvdc_ident.data.units import conversion
from hvdc_ident.formats import read_waveforms
from hvdc_ident.study.phase_columns import proposed_phases

NOMINAL: Final = (50.0, 60.0)
"""Hz, of public networks."""
OFF_NOMINAL: Final = 3.0
"""Hz: networks run within 47 to 52 or 57 to 62 Hz, beyond which plants are allowed to trip; the two ranges lie 5 Hz apart."""


class RecordedFrequency(NamedTuple):
    """A nominal frequency, Hz, and in words what shows it."""

    value: float
    shown_by: str


def recorded_frequencies(files: Sequence[Path]) -> tuple[RecordedFrequency, ...]:
    """Return the nominal frequencies that recordings show, each once: of columns of a frequency, and of waveforms of three phases.

    A frequency deviation, one in pu and an angle in the frame of a network show none. Raises InputError for a file that cannot be read.
    """
    frequencies: dict[float, RecordedFrequency] = {}
    for file in files:
        for level, what in _levels(read_waveforms(file)):
            nominal = min(NOMINAL, key=lambda n: abs(level - n))
            if abs(level - nominal) <= OFF_NOMINAL:
                frequencies.setdefault(
                    nominal, RecordedFrequency(nominal, f"{what} of {file.name} reads {level:.4g} Hz")
                )
    return tuple(frequencies.values())


def _levels(record: Trajectory) -> Iterator[tuple[float, str]]:
    """Yield the frequencies of a recording in Hz, with the words for what has them."""
    for name, stated, reading in zip(record.names, record.units, read_columns(record.names, record.units), strict=True):
        unit = stated or reading.unit
        scale = conversion(unit, "Hz") if unit else (1.0, 0.0)
        values = record[name][np.isfinite(record[name])]
        if reading.measured == "frequency" and scale is not None and values.size:
            yield float(np.median(values)) * scale[0] + scale[1], f"column {name}"
    for line in proposed_phases(record):
        yield line.frequency, f"the three phases {', '.join(line.voltage)}"
