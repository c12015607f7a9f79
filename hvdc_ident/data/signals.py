"""Input signals: piecewise linear with jumps, and the ones that tests are made of."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from hvdc_ident.data.trajectory import Array
from hvdc_ident.errors import WaveformError


@dataclass(frozen=True, eq=False)
class InputSignal:
    """A piecewise linear signal with jumps.

    times: (n,) in s, non-decreasing; a time that stands twice is a jump. values: (n,).
    Before the first and after the last point the signal is constant.
    breaks: instants at which an integrator has to stop: jumps and the corners that matter.
    """

    times: Array
    values: Array
    breaks: Array

    def __post_init__(self) -> None:
        for name in ("times", "values", "breaks"):
            array = np.ascontiguousarray(getattr(self, name), dtype=float)
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        t = self.times
        if t.ndim != 1 or t.size == 0 or t.shape != self.values.shape:
            raise WaveformError(
                "an input signal's times and values do not fit",
                expected="two vectors of one length, at least 1",
                got=f"shapes {t.shape} and {self.values.shape}",
            )
        if not (np.isfinite(t).all() and np.isfinite(self.values).all()):
            raise WaveformError("an input signal has a time or value that is not finite")
        if (np.diff(t) < 0).any():
            raise WaveformError("an input signal's times go back", expected="non-decreasing times")
        if t.size > 2 and (t[2:] == t[:-2]).any():
            raise WaveformError(
                "an input signal has one time more than twice",
                expected="at most two values at one instant: before and after a jump",
            )

    @classmethod
    def constant(cls, value: float) -> InputSignal:
        """A signal that never changes."""
        return cls(np.zeros(1), np.array([float(value)]), np.empty(0))

    @classmethod
    def corners(cls, points: Iterable[tuple[float, float]]) -> InputSignal:
        """The signal through (time, value) points joined by lines; two points at one time are a jump. Every point is a break."""
        t, v = np.array(list(points), dtype=float).T
        return cls(t, v, np.unique(t))

    @classmethod
    def step(cls, time: float, before: float, after: float) -> InputSignal:
        """A jump from one value to another."""
        return cls.corners([(time, before), (time, after)])

    @classmethod
    def ramp(cls, start: float, before: float, end: float, after: float) -> InputSignal:
        """A ramp between two constant values."""
        return cls.corners([(start, before), (end, after)])

    def __call__(self, t: float | Array) -> Array:
        """The value at t, after the jump where there is one."""
        t = np.asarray(t, dtype=float)
        right = np.searchsorted(self.times, t, side="right")
        i, j = np.clip(right - 1, 0, None), np.clip(right, None, self.times.size - 1)
        t0, t1 = self.times[i], self.times[j]
        share = np.where(t1 > t0, np.clip((t - t0) / np.where(t1 > t0, t1 - t0, 1.0), 0.0, 1.0), 0.0)
        return np.where(right == 0, self.values[0], self.values[i] + share * (self.values[j] - self.values[i]))

    @property
    def jumps(self) -> Array:
        """(k,) instants at which the value changes at once, s."""
        return np.asarray(self.times[1:][(np.diff(self.times) == 0) & (np.diff(self.values) != 0)])

    @property
    def is_constant(self) -> bool:
        """True where the signal never changes."""
        return bool((self.values == self.values[0]).all())


def step(before: float, after: float, *, at: float) -> InputSignal:
    """Return the signal that jumps from one value to another at an instant, s.

    >>> import hvdc_ident as hi
    >>> hi.step(1.0, 1.019, at=0.1)([0.0, 0.1, 0.2]).tolist()
    [1.0, 1.019, 1.019]
    """
    return InputSignal.step(float(at), float(before), float(after))


def ramp(before: float, after: float, *, start: float, end: float) -> InputSignal:
    """Return the signal that moves along a line from one value to another between two instants, s.

    >>> import hvdc_ident as hi
    >>> hi.ramp(0.0, 1.0, start=1.0, end=3.0)([0.0, 2.0, 4.0]).tolist()
    [0.0, 0.5, 1.0]
    """
    if not end > start:
        raise WaveformError(
            "a ramp ends before it starts", expected="start < end, in s", got=f"start {start:g}, end {end:g}"
        )
    return InputSignal.ramp(float(start), float(before), float(end), float(after))


def multisine(
    level: float,
    amplitude: float,
    frequencies: Sequence[float] | float,
    *,
    start: float,
    end: float,
    samples: int = 40,
) -> InputSignal:
    """Return sines of one amplitude around a level, from `start` to `end` in s; the level before and after.

    frequencies: in Hz. Phases are Schroeder's, -pi k (k - 1) / n, which keep the peak of n sines low (Schroeder 1970);
    the sum is shifted to begin at the level. samples: points joined by lines in a period of the fastest sine; 40 follow it
    to 0.3 % of its amplitude.

    >>> import hvdc_ident as hi
    >>> u = hi.multisine(1.0, 0.01, [2.0, 5.0], start=0.5, end=1.5)
    >>> float(u(0.4)), bool(abs(u(1.0) - 1.0) < 0.04)
    (1.0, True)
    """
    f = np.atleast_1d(np.asarray(frequencies, dtype=float))
    if f.ndim != 1 or not f.size or not (np.isfinite(f) & (f > 0)).all():
        raise WaveformError(
            "a multisine needs frequencies", expected="one or more numbers above 0, in Hz", got=f"{frequencies!r}"
        )
    if not end > start:
        raise WaveformError(
            "a multisine ends before it starts", expected="start < end, in s", got=f"start {start:g}, end {end:g}"
        )
    k = np.arange(1, f.size + 1)
    phase = -np.pi * k * (k - 1) / f.size
    t = np.linspace(start, end, int(np.ceil((end - start) * f.max() * samples)) + 2)
    wave = np.sin(2 * np.pi * f[:, None] * (t - start) + phase[:, None]).sum(axis=0)
    v = level + amplitude * (wave - wave[0])
    points = [(start, level), *zip(t.tolist(), v.tolist(), strict=True), (end, level)]
    # Only where it begins and ends does the signal have a corner that an integrator must not step over.
    times, values = np.array(points).T
    keep = np.concatenate([[True], (np.diff(times) > 0) | (np.diff(values) != 0)])
    return InputSignal(times[keep], values[keep], np.array([start, end], dtype=float))
