"""Power, magnitudes and dq quantities from recorded phases.

Field records come as three phases; models speak of P, Q, a voltage's magnitude and currents in a rotating frame.
The filter between is part of what was measured, so it is always named and never hidden: a trailing mean over the last
`window` seconds (the same form as an instrument's window mean, so that a fit can put it on the model too), a
first-order low pass of that time constant, or none.

Conventions. Space vector, amplitude invariant: x = 2/3 (xa + a xb + a^2 xc), a = exp(j 2 pi/3), so |x| is a phase's peak
value. p = 3/2 Re(v conj(i)), q = 3/2 Im(v conj(i)): q is positive where the current lags the voltage. dq: the vector
divided by the direction of the positive-sequence voltage, so that vq is 0 in the steady state and id carries the active
power. Source: Akagi, Watanabe, Aredes, "Instantaneous Power Theory", chapter 3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data.trajectory import Array, Trajectory
from hvdc_ident.errors import WaveformError, unknown_name

__all__ = ["QUANTITIES", "PhaseFilter", "quantities", "space_vector"]

QUANTITIES = {
    "p": "active power",
    "q": "reactive power, positive where the current lags",
    "v": "magnitude of the positive-sequence voltage, phase to ground, peak",
    "v-rms": "the same as line-to-line rms",
    "i": "magnitude of the positive-sequence current, peak",
    "i-rms": "the same as rms",
    "vd": "voltage along the positive-sequence voltage, peak",
    "vq": "voltage across it",
    "id": "current along the positive-sequence voltage, peak",
    "iq": "current across it, negative where the current lags",
    "f": "frequency of the positive-sequence voltage in Hz",
    "v2": "magnitude of the negative-sequence voltage, peak",
    "i2": "magnitude of the negative-sequence current, peak",
}
"""What can be had from phases, by name."""

_NEEDS_CURRENT = {"p", "q", "i", "i-rms", "id", "iq", "i2"}
_ROTATE = np.exp(2j * np.pi / 3)

Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class PhaseFilter:
    """How quantities are smoothed. window: s, the mean's length or the low pass's time constant."""

    kind: Literal["mean", "lowpass", "none"]
    window: float

    def __call__(self, time: Array, values: Complex) -> Complex:
        """(n,) the values smoothed, causally; before the record its first value is taken to hold."""
        if self.kind == "none" or self.window == 0:
            return values
        return _mean(time, values, self.window) if self.kind == "mean" else _lowpass(time, values, self.window)


def space_vector(phases: Array) -> Complex:
    """(n,) the space vector of three phases, amplitude invariant. phases: (n, 3)."""
    return np.asarray((phases @ np.array([1.0, _ROTATE, _ROTATE**2])) * (2.0 / 3.0))


def quantities(
    record: Trajectory,
    voltage: Sequence[str],
    current: Sequence[str] | None,
    wanted: Sequence[str],
    *,
    frequency: float,
    smoothing: PhaseFilter,
) -> Trajectory:
    """The wanted quantities over the record's time, in the order given.

    voltage, current: names of the three phases, phase to ground, in the order of rotation. frequency: nominal, Hz.
    smoothing: applied to p and q as products, and to the vectors seen from a frame turning at the nominal frequency.
    Units follow from the record's: kV and kA give MW. Raises WaveformError where the record is too coarse.
    """
    for name in wanted:
        if name not in QUANTITIES:
            raise unknown_name("quantity of three phases", name, QUANTITIES)
        if current is None and name in _NEEDS_CURRENT:
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
    step = float(np.median(np.diff(record.time)))
    if step * frequency > 0.1:
        raise WaveformError(
            "the record is too coarse for phases",
            expected=f"at least 10 samples a cycle of {frequency:g} Hz",
            got=f"{1 / (step * frequency):.3g}",
            hint="use the recorder's own P, Q and magnitudes",
        )
    found = _Quantities(record, voltage, current, frequency, smoothing)
    columns = [found.get(name) for name in wanted]
    units = tuple(found.unit(n) for n in wanted)
    return Trajectory(record.time, np.column_stack(columns), tuple(wanted), units)


class _Quantities:
    """The vectors of one record, each made once."""

    def __init__(
        self,
        record: Trajectory,
        voltage: Sequence[str],
        current: Sequence[str] | None,
        frequency: float,
        smoothing: PhaseFilter,
    ) -> None:
        self.time = record.time
        self.smooth = smoothing
        self.turn = np.exp(-2j * np.pi * frequency * record.time)
        self.frequency = frequency
        self.v = space_vector(np.column_stack([record[n] for n in voltage]))
        self.i = space_vector(np.column_stack([record[n] for n in current])) if current else None
        self.units = (record.unit(voltage[0]), record.unit(current[0]) if current else "")
        self.positive = smoothing(self.time, self.v * self.turn)
        if not np.abs(self.positive).all():
            raise WaveformError("the positive-sequence voltage is zero somewhere", got="no direction for d and q")

    def unit(self, name: str) -> str:
        volts, amperes = self.units
        if name == "f":
            return "Hz"
        if name in ("p", "q"):
            return product_unit(volts, amperes, "W" if name == "p" else "var")
        return amperes if name.startswith("i") else volts

    def get(self, name: str) -> Array:
        """(n,) one quantity."""
        if name == "f":
            angle = np.unwrap(np.angle(self.positive))
            return np.asarray(self.frequency + np.gradient(angle, _strict(self.time)) / (2 * np.pi))
        if name in ("p", "q"):
            power = self.smooth(self.time, 1.5 * self.v * np.conj(self._current()))
            return np.asarray(power.real if name == "p" else power.imag)
        vector = self._current() if name.startswith("i") else self.v
        if name.endswith("2"):
            return np.abs(self.smooth(self.time, np.conj(vector) * self.turn))
        turned = self.positive if not name.startswith("i") else self.smooth(self.time, vector * self.turn)
        if name.endswith(("d", "q")):
            seen = turned * np.conj(self.positive) / np.abs(self.positive)
            return np.asarray(seen.real if name.endswith("d") else seen.imag)
        rms = {"v-rms": np.sqrt(1.5), "i-rms": np.sqrt(0.5)}.get(name, 1.0)
        return np.asarray(np.abs(turned) * rms)

    def _current(self) -> Complex:
        assert self.i is not None  # checked by name before
        return self.i


def _mean(time: Array, values: Complex, window: float) -> Complex:
    """(n,) the mean over the last `window` seconds of the polygon through the values."""
    area = np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(time))])
    start = time - window
    before = np.minimum(start - time[0], 0.0)  # the first value holds before the record
    inside = np.maximum(start, time[0])
    k = np.clip(np.searchsorted(time, inside, side="right") - 1, 0, time.size - 2)
    width = time[k + 1] - time[k]
    share = np.where(width > 0, (inside - time[k]) / np.where(width > 0, width, 1.0), 0.0)
    at = values[k] + share * (values[k + 1] - values[k])
    area_start = area[k] + 0.5 * (values[k] + at) * (inside - time[k])
    return np.asarray((area - area_start - before * values[0]) / window)


def _lowpass(time: Array, values: Complex, constant: float) -> Complex:
    """(n,) the response of a first-order lag, exact for the polygon through the values, settled at the start."""
    found = np.empty_like(values)
    found[0] = values[0]
    steps = np.diff(time)
    for n, h in enumerate(steps):
        if h == 0:
            found[n + 1] = found[n]
            continue
        decay = np.exp(-h / constant)
        slope = (values[n + 1] - values[n]) / h
        end = values[n + 1] - slope * constant
        found[n + 1] = end + (found[n] - (values[n] - slope * constant)) * decay
    return found


def _strict(time: Array) -> Array:
    """Times that increase, for a derivative over a record with jumps."""
    step = float(np.median(np.diff(time)))
    return time + 1e-9 * step * np.arange(time.size)


def product_unit(volts: str, amperes: str, unit: str) -> str:
    prefixes = {"": 0, "k": 3, "M": 6, "m": -3}
    power = {v: k for k, v in prefixes.items()}
    if not (volts.endswith("V") and amperes.endswith("A")):
        return ""
    exponent = prefixes.get(volts[:-1], 99) + prefixes.get(amperes[:-1], 99)
    return f"{power[exponent]}{unit}" if exponent in power else ""
