"""Power, magnitudes, dq components and frequency from recorded phases or phasors.

Space vector, amplitude invariant: x = 2/3 (xa + a xb + a^2 xc), a = exp(j 2 pi/3), so |x| is a phase's peak value.
p = 3/2 Re(v conj(i)), q = 3/2 Im(v conj(i)): q is positive where the current lags the voltage. dq: the vector divided by
the direction of the positive-sequence voltage, so that vq is 0 in the steady state and id carries the active power.
Source: Akagi, Watanabe, Aredes, "Instantaneous Power Theory", chapter 3.

Angles of phasors are those against a cosine of the nominal frequency (IEEE C37.118), wrapped anywhere; they are
unwrapped here. Three phasors of one quantity give its positive sequence, X = (Xa + a Xb + a^2 Xc)/3.
Powers of phasors: p + j q = k v conj(i), with k by how the magnitudes are counted (`COUNTED`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data.trajectory import Array, Trajectory
from hvdc_ident.data.units import conversion
from hvdc_ident.errors import WaveformError, unknown_name

PHASE_QUANTITIES = {
    "p": "active power",
    "q": "reactive power, positive where the current lags",
    "v": "magnitude of the positive-sequence voltage, phase to ground, peak",
    "v-rms": "magnitude of the positive-sequence voltage, line to line, rms",
    "i": "magnitude of the positive-sequence current, peak",
    "i-rms": "magnitude of the positive-sequence current, rms",
    "vd": "voltage along the positive-sequence voltage, peak",
    "vq": "voltage across it",
    "id": "current along the positive-sequence voltage, peak",
    "iq": "current across it, negative where the current lags",
    "f": "frequency of the positive-sequence voltage in Hz",
    "v2": "magnitude of the negative-sequence voltage, peak",
    "i2": "magnitude of the negative-sequence current, peak",
}
"""Quantities that phases give, by name."""

PHASOR_QUANTITIES = {
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
"""Quantities that phasors give, by name."""

COUNTED = {"phase-rms": 3.0, "line-rms": 3.0**0.5, "phase-peak": 1.5, "pu": 1.0}
"""p/(v i cos) by how magnitudes are counted: rms from phase to ground, rms from line to line (of the current always that
of the line), peak from phase to ground, per unit."""

_TURN = np.exp(2j * np.pi / 3)

Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class PhaseFilter:
    """The smoothing of quantities made of phases: it is part of what was measured, so it is always named.

    kind: "mean", a trailing mean as an instrument's window mean is, which a fit can put on the model too; "lowpass", of
    first order; "none". window: s, the mean's length or the low pass's time constant.
    """

    kind: Literal["mean", "lowpass", "none"]
    window: float

    def __call__(self, time: Array, values: Complex) -> Complex:
        """Return the (n,) values smoothed, causally; a mean is that of the first whole window until this has passed."""
        if self.kind == "none" or self.window == 0:
            return values
        return _mean(time, values, self.window) if self.kind == "mean" else _lowpass(time, values, self.window)


def phase_quantities(
    record: Trajectory,
    voltage: Sequence[str],
    current: Sequence[str] | None,
    wanted: Sequence[str],
    *,
    frequency: float,
    smoothing: PhaseFilter,
) -> Trajectory:
    """Return the wanted quantities of three phases over the record's time, in the order given.

    voltage, current: names of the three phases, phase to ground, in the order of rotation. frequency: nominal, Hz.
    smoothing: applied to p and q as products, and to the vectors seen from a frame turning at the nominal frequency.
    Units follow from the record's: kV and kA give MW. Raises UnknownNameError for another quantity, WaveformError where
    the record is too coarse, has gaps or lacks the currents.
    """
    for name in wanted:
        if name not in PHASE_QUANTITIES:
            raise unknown_name("quantity of three phases", name, PHASE_QUANTITIES)
        if current is None and needs_current(name):
            raise WaveformError(
                f"'{name}' needs the currents", expected='current = ["IA", "IB", "IC"] beside the voltages'
            )
    for name in (*voltage, *(current or ())):
        if gaps := record.gaps(name):
            raise WaveformError(
                f"phase '{name}' is not recorded in {gaps} of {len(record)} rows",
                expected="a number in every row, for the filter runs over all of them",
                hint="cut the record at the gap",
            )
    time = record.time
    step = float(np.median(np.diff(time)))
    if step * frequency > 0.1:
        raise WaveformError(
            "the record is too coarse for phases",
            expected=f"at least 10 samples a cycle of {frequency:g} Hz",
            got=f"{1 / (step * frequency):.3g}",
            hint="use the recorder's own P, Q and magnitudes",
        )
    turn = np.exp(-2j * np.pi * frequency * time)
    v = space_vector(record, voltage)
    i = space_vector(record, current) if current else v
    positive = smoothing(time, v * turn)
    if not np.abs(positive).all():
        raise WaveformError("the positive-sequence voltage is zero somewhere", got="no direction for d and q")

    def quantity(name: str) -> Array:
        if name == "f":
            strict = time + 1e-9 * step * np.arange(time.size)  # increasing, over a record with jumps too
            return np.asarray(frequency + np.gradient(np.unwrap(np.angle(positive)), strict) / (2 * np.pi))
        if name in ("p", "q"):
            power = smoothing(time, 1.5 * v * np.conj(i))
            return np.asarray(power.real if name == "p" else power.imag)
        vector = i if name.startswith("i") else v
        if name.endswith("2"):
            return np.abs(smoothing(time, np.conj(vector) * turn))
        turned = smoothing(time, i * turn) if name.startswith("i") else positive
        if name.endswith(("d", "q")):
            seen = turned * np.conj(positive) / np.abs(positive)
            return np.asarray(seen.real if name.endswith("d") else seen.imag)
        rms = {"v-rms": np.sqrt(1.5), "i-rms": np.sqrt(0.5)}.get(name, 1.0)
        return np.asarray(np.abs(turned) * rms)

    units = _units(wanted, record, voltage[0], current[0] if current else None)
    return Trajectory(time, np.column_stack([quantity(name) for name in wanted]), tuple(wanted), units)


def space_vector(record: Trajectory, phases: Sequence[str]) -> Complex:
    """Return the (n,) space vector of three phases, amplitude invariant."""
    a, b, c = (record[n] for n in phases)
    return np.asarray((a + _TURN * b + _TURN**2 * c) * (2.0 / 3.0))


def _mean(time: Array, values: Complex, window: float) -> Complex:
    """Return the (n,) mean over the last `window` seconds of the polygon through the values; before the first whole window its mean."""
    length = min(window, float(time[-1] - time[0]))
    area = np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(time))])

    def until(instants: Array) -> Complex:
        k = np.clip(np.searchsorted(time, instants, side="right") - 1, 0, time.size - 2)
        width = time[k + 1] - time[k]
        share = np.where(width > 0, (instants - time[k]) / np.where(width > 0, width, 1.0), 0.0)
        at = values[k] + share * (values[k + 1] - values[k])
        return np.asarray(area[k] + 0.5 * (values[k] + at) * (instants - time[k]))

    end = np.maximum(time, time[0] + length)
    return np.asarray((until(end) - until(end - length)) / length)


def _lowpass(time: Array, values: Complex, constant: float) -> Complex:
    """Return the (n,) response of a first-order lag, exact for the polygon through the values, settled at the start."""
    response = np.empty_like(values)
    response[0] = values[0]
    for n, h in enumerate(np.diff(time)):
        if h == 0:
            response[n + 1] = response[n]
            continue
        slope = (values[n + 1] - values[n]) / h
        end = values[n + 1] - slope * constant
        response[n + 1] = end + (response[n] - (values[n] - slope * constant)) * np.exp(-h / constant)
    return response


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
    """Settings of `phasor_quantities`.

    frequency: nominal, Hz, needed for f. window: s, of f. counted: a key of COUNTED, needed for p and q.
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
    settings: PhasorSettings,
) -> Trajectory:
    """Return the wanted quantities of phasors over the record's time, NaN where a column they need is not recorded.

    Raises UnknownNameError for another quantity, WaveformError where what it needs is not given.
    """
    for name in wanted:
        if name not in PHASOR_QUANTITIES:
            raise unknown_name("quantity of phasors", name, PHASOR_QUANTITIES)
        if current is None and needs_current(name):
            raise WaveformError(f"'{name}' needs the current", expected="current = {magnitude = ..., angle = ...}")
        if name == "f" and settings.frequency is None:
            raise WaveformError("'f' needs the nominal frequency", expected="frequency = 50 or 60")
        if name in ("p", "q") and not settings.counted:
            raise WaveformError(
                f"'{name}' needs to know how magnitudes are counted",
                expected=f"magnitudes = one of {', '.join(COUNTED)}",
            )
    v = _phasor(record, voltage)
    i = _phasor(record, current) if current is not None else v
    if settings.reference == "start":
        recorded = np.angle(v)[np.isfinite(v)]
        zero = recorded[0] if recorded.size else 0.0
    else:
        zero = _radians(record, settings.reference, voltage.unit) if settings.reference else 0.0
    v, i = v * np.exp(-1j * zero), i * np.exp(-1j * zero)

    def quantity(name: str) -> Array:
        if name == "f":
            assert settings.frequency is not None
            return sliding_frequency(record.time, unwrapped(np.angle(v)), settings.frequency, settings.window)
        if name in ("p", "q"):
            power = COUNTED[settings.counted] * v * np.conj(i)
            return np.asarray(power.real if name == "p" else power.imag)
        if name in ("id", "iq"):
            with np.errstate(invalid="ignore", divide="ignore"):
                seen = i * np.conj(v) / np.abs(v)  # NaN where there is no voltage to see it from
            return np.asarray(seen.real if name == "id" else seen.imag)
        x = i if name == "i" or name.startswith("i-") else v
        part = name.removeprefix("i-")
        if part == "angle":
            return unwrapped(np.angle(x))
        return np.asarray(x.real if part == "real" else x.imag if part == "imag" else np.abs(x))

    units = _units(wanted, record, voltage.magnitude[0], current.magnitude[0] if current is not None else None)
    return Trajectory(
        record.time, np.column_stack([quantity(name) for name in wanted]), tuple(wanted), units, record.origin
    )


def unwrapped(angle: Array) -> Array:
    """Return the (n,) rad without jumps of a whole turn between recorded rows; NaN stays NaN."""
    result, recorded = np.array(angle, dtype=float), np.isfinite(angle)
    result[recorded] = np.unwrap(result[recorded])
    return result


def sliding_frequency(time: Array, angle: Array, nominal: float, window: float) -> Array:
    """Return (n,) Hz: nominal, and the mean slope of the unwrapped angle, (n,) rad, over the last `window` s.

    nominal + (angle(t) - angle(t - window))/(2 pi window), the angle joined by lines between rows: a model's frequency
    behind an instrument's window mean of that length. Rows before the first whole window take its value.
    Raises WaveformError where the window is shorter than two steps or longer than the record.
    """
    recorded = np.isfinite(angle)
    t, a = time[recorded], angle[recorded]
    step = float(np.median(np.diff(t))) if t.size > 1 else np.inf
    if not 2.0 * step * (1.0 - 1e-9) <= window <= float(np.ptp(t)):
        raise WaveformError(
            "no window to take the frequency from the angle over",
            expected=f"at least two steps of {step:g} s, and no longer than the record",
            got=f"{window:g} s",
            hint=f"window = {max(0.1, 4.0 * step):.2g}; a longer one lets less noise through and is slower",
        )
    end = np.maximum(t, t[0] + window)
    result = np.full(time.size, np.nan)
    result[recorded] = nominal + (np.interp(end, t, a) - np.interp(end - window, t, a)) / (2.0 * np.pi * window)
    return result


def frequency_noise(angle: float, window: float) -> float:
    """Return the standard deviation in Hz that an angle's noise of so many rad makes in a frequency over a window in s.

    sqrt(2) angle/(2 pi window), whatever the sampling.
    """
    return float(np.sqrt(2.0) * angle / (2.0 * np.pi * window))


def _phasor(record: Trajectory, columns: PhasorColumns) -> Complex:
    """Return the (n,) complex phasor, or the positive sequence of three."""
    parts = [
        record[m] * np.exp(1j * _radians(record, a, columns.unit))
        for m, a in zip(columns.magnitude, columns.angle, strict=True)
    ]
    if len(parts) == 1:
        return np.asarray(parts[0])
    return np.asarray((parts[0] + _TURN * parts[1] + _TURN**2 * parts[2]) / 3.0)


def _radians(record: Trajectory, column: str, stated: str) -> Array:
    unit = stated or record.unit(column)
    factor = conversion(unit, "rad") if unit else None
    if factor is None:
        raise WaveformError(
            f"the unit of the angles in column '{column}' is not known",
            expected='unit = "deg" or "rad" beside magnitude and angle',
            got=f"'{unit}'" if unit else "none, in the file or the study",
        )
    return record[column] * factor[0]


def needs_current(name: str) -> bool:
    """Return whether a quantity of phases or phasors is made of currents too."""
    return name in ("p", "q") or (name.startswith("i") and name != "imag")


def _units(wanted: Sequence[str], record: Trajectory, voltage: str, current: str | None) -> tuple[str, ...]:
    """Return the units of quantities made of a voltage and a current; "" where they do not tell."""
    volts, amperes = record.unit(voltage), record.unit(current) if current else ""
    prefixes = {"": 0, "k": 3, "M": 6, "m": -3}
    exponent = 99
    if volts.endswith("V") and amperes.endswith("A"):
        exponent = prefixes.get(volts[:-1], 99) + prefixes.get(amperes[:-1], 99)
    power = {e: p for p, e in prefixes.items()}.get(exponent)

    def unit(name: str) -> str:
        if name in ("angle", "i-angle"):
            return "rad"
        if name == "f":
            return "Hz"
        if name in ("p", "q"):
            return "" if power is None else f"{power}{'W' if name == 'p' else 'var'}"
        return amperes if needs_current(name) else volts

    return tuple(unit(name) for name in wanted)
