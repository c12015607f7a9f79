"""Components, powers and frequency from recorded phasors, as phasor measurement units give them: magnitude and angle.

Angles are those against a cosine of the nominal frequency (IEEE C37.118), wrapped anywhere; they are unwrapped here.
Three phasors of one quantity give its positive sequence, X = (Xa + a Xb + a^2 Xc)/3 with a = exp(j 2 pi/3).

The frequency is the mean over the last `window` seconds: nominal + (angle(t) - angle(t - window))/(2 pi window), the
angle joined by lines between rows. So it is what a model's frequency gives behind an instrument's window mean of that
length, and noise of the angle of standard deviation s rad is one of sqrt(2) s/(2 pi window) Hz in it, whatever the
sampling. Rows before the first whole window take its value.
Powers: p + j q = k v conj(i), with k by how the magnitudes are counted (`COUNTED`); q is positive where the current lags.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data.phases import product_unit
from hvdc_ident.data.trajectory import Array, Trajectory
from hvdc_ident.data.units import conversion
from hvdc_ident.errors import WaveformError, unknown_name

QUANTITIES = {
    "v": "magnitude of the voltage",
    "angle": "its angle in rad, unwrapped",
    "real": "its real part",
    "imag": "its imaginary part",
    "f": "frequency in Hz, the mean over the last `window` s of the angle's slope",
    "i": "magnitude of the current",
    "i-angle": "its angle in rad, unwrapped",
    "i-real": "its real part",
    "i-imag": "its imaginary part",
    "id": "current along the voltage",
    "iq": "current across it, negative where the current lags",
    "p": "active power",
    "q": "reactive power, positive where the current lags",
}
"""What can be had from phasors, by name."""

COUNTED = {"phase-rms": 3.0, "line-rms": 3.0**0.5, "phase-peak": 1.5, "pu": 1.0}
"""p/(v i cos) by how magnitudes are counted: rms from phase to ground, rms from line to line (of the current always that
of the line), peak from phase to ground, per unit."""

_TURN = np.exp(2j * np.pi / 3)
_NEEDS_CURRENT = {"i", "i-angle", "i-real", "i-imag", "id", "iq", "p", "q"}

Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class PhasorColumns:
    """The columns of one quantity's phasor, or of its three phases in the order of rotation.

    unit: of the angles, deg or rad; "" where the file says it.
    """

    magnitude: tuple[str, ...]
    angle: tuple[str, ...]
    unit: str = ""


@dataclass(frozen=True)
class PhasorSettings:
    """frequency: nominal, Hz, needed for f. window: s, of f. counted: a key of COUNTED, needed for p and q.

    reference: what angles are counted from: "" as recorded, "start" the voltage's first, else another column of angles.
    """

    frequency: float | None = None
    window: float = 0.1
    counted: str = ""
    reference: str = ""


def phasor_quantities(
    record: Trajectory,
    voltage: PhasorColumns,
    current: PhasorColumns | None,
    wanted: Sequence[str],
    how: PhasorSettings,
) -> Trajectory:
    """The wanted quantities over the record's time, in the order given, NaN where a column they need is not recorded.

    Raises UnknownNameError for another quantity, WaveformError where what it needs is not given.
    """
    for name in wanted:
        if name not in QUANTITIES:
            raise unknown_name("quantity of phasors", name, QUANTITIES)
        if name in _NEEDS_CURRENT and current is None:
            raise WaveformError(f"'{name}' needs the current", expected="current = {magnitude = ..., angle = ...}")
        if name == "f" and how.frequency is None:
            raise WaveformError("'f' needs the nominal frequency", expected="frequency = 50 or 60")
        if name in ("p", "q") and not how.counted:
            raise WaveformError(
                f"'{name}' needs to know how magnitudes are counted",
                expected=f"magnitudes = one of {', '.join(COUNTED)}",
            )
    zero = _zero(record, voltage, how.reference)
    v = _phasor(record, voltage) * np.exp(-1j * zero)
    i = _phasor(record, current) * np.exp(-1j * zero) if current is not None else None
    columns = [_quantity(name, record.time, v, i, how) for name in wanted]
    volts = record.unit(voltage.magnitude[0])
    amperes = record.unit(current.magnitude[0]) if current is not None else ""
    units = tuple(_unit(name, volts, amperes) for name in wanted)
    return Trajectory(record.time, np.column_stack(columns), tuple(wanted), units, record.origin)


def unwrapped(angle: Array) -> Array:
    """(n,) rad without jumps of a whole turn between recorded rows; NaN stays NaN."""
    found, there = np.array(angle, dtype=float), np.isfinite(angle)
    found[there] = np.unwrap(found[there])
    return found


def sliding_frequency(time: Array, angle: Array, nominal: float, window: float) -> Array:
    """(n,) Hz: nominal, and the mean slope of the unwrapped angle, (n,) rad, over the last `window` s.

    Raises WaveformError where the window is shorter than two steps or longer than the record.
    """
    there = np.isfinite(angle)
    t, a = time[there], angle[there]
    step = float(np.median(np.diff(t))) if t.size > 1 else np.inf
    if not 2.0 * step * (1.0 - 1e-9) <= window <= float(np.ptp(t)):
        raise WaveformError(
            "no window to take the frequency from the angle over",
            expected=f"at least two steps of {step:g} s, and no longer than the record",
            got=f"{window:g} s",
            hint=f"window = {max(0.1, 4.0 * step):.2g}; a longer one lets less noise through and is slower",
        )
    end = np.maximum(t, t[0] + window)
    slope = (np.interp(end, t, a) - np.interp(end - window, t, a)) / window
    found = np.full(time.size, np.nan)
    found[there] = nominal + slope / (2.0 * np.pi)
    return found


def frequency_noise(angle: float, window: float) -> float:
    """The standard deviation in Hz that one of the angle's samples, in rad, makes in a frequency over a window in s."""
    return float(np.sqrt(2.0) * angle / (2.0 * np.pi * window))


def _phasor(record: Trajectory, columns: PhasorColumns) -> Complex:
    """(n,) complex: the phasor, or the positive sequence of three."""
    parts = [
        record[m] * np.exp(1j * _radians(record, a, columns.unit))
        for m, a in zip(columns.magnitude, columns.angle, strict=True)
    ]
    if len(parts) == 1:
        return np.asarray(parts[0])
    return np.asarray((parts[0] + _TURN * parts[1] + _TURN**2 * parts[2]) / 3.0)


def _radians(record: Trajectory, column: str, stated: str) -> Array:
    unit = stated or record.unit(column)
    by = conversion(unit, "rad") if unit else None
    if by is None:
        raise WaveformError(
            f"the unit of the angles in column '{column}' is not known",
            expected='unit = "deg" or "rad" beside magnitude and angle',
            got=f"'{unit}'" if unit else "none, in the file or the study",
        )
    return record[column] * by[0]


def _zero(record: Trajectory, voltage: PhasorColumns, reference: str) -> Array | float:
    if not reference:
        return 0.0
    if reference != "start":
        return _radians(record, reference, voltage.unit)
    angle = np.angle(_phasor(record, voltage))
    there = np.isfinite(angle)
    return float(angle[there][0]) if there.any() else 0.0


def _quantity(name: str, time: Array, v: Complex, i: Complex | None, how: PhasorSettings) -> Array:
    if name == "f":
        assert how.frequency is not None
        return sliding_frequency(time, unwrapped(np.angle(v)), how.frequency, how.window)
    if name in ("p", "q"):
        assert i is not None
        power = COUNTED[how.counted] * v * np.conj(i)
        return np.asarray(power.real if name == "p" else power.imag)
    if name in ("id", "iq"):
        assert i is not None
        with np.errstate(invalid="ignore", divide="ignore"):
            seen = i * np.conj(v) / np.abs(v)  # NaN where there is no voltage to see it from
        return np.asarray(seen.real if name == "id" else seen.imag)
    x = i if name.startswith("i-") or name == "i" else v
    assert x is not None
    part = name.removeprefix("i-")
    if part in ("v", "i"):
        return np.abs(x)
    if part == "angle":
        return unwrapped(np.angle(x))
    return np.asarray(x.real if part == "real" else x.imag)


def _unit(name: str, volts: str, amperes: str) -> str:
    if name in ("angle", "i-angle"):
        return "rad"
    if name == "f":
        return "Hz"
    if name in ("p", "q"):
        return product_unit(volts, amperes, "W" if name == "p" else "var")
    return amperes if name.startswith("i") and name != "imag" else volts
