"""Angles and frequencies of one voltage: the turn that a frequency makes, and how far a recorded angle agrees with it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hvdc_ident.data.signals import distinct, row_noise
from hvdc_ident.data.three_phase import unwrapped
from hvdc_ident.data.units import Array

AGREES = 0.2
"""Share by which the turns of angle and frequency may differ: a concentrator's frequency lags its angle by some cycles, as a filter
of some 0.1 s makes of a swing of 1 to 2 Hz; a wrong unit, sign or base is a factor of 2 and more."""
MOVES = 10.0
"""Times its own scatter by which an angle has to leave a line before it tells a factor to a tenth."""


def turned(time: Array, frequency: Array, nominal: float) -> Array:
    """Return (n,) rad: the angle in a frame of the nominal frequency, of a voltage with this frequency, both in Hz; 0 in the first row."""
    rate = 2.0 * np.pi * (frequency - nominal)
    return np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(time))])


def scatter(time: Array, values: Array) -> float:
    """Return the standard deviation of a row's noise: from how far rows lie off the line between their neighbours, and not below what
    the file's digits leave."""
    t, v = distinct(time, values)
    steps = np.abs(np.diff(v))
    digit = float(steps[steps > 0.0].min()) if (steps > 0.0).any() else 0.0
    return max(row_noise(t, v), digit / math.sqrt(12.0))


def whole_turns(angle: Array) -> int:
    """Return between how many rows an angle in rad jumps by over half a turn."""
    known = angle[np.isfinite(angle)]
    return int(np.count_nonzero(np.abs(np.diff(known)) > np.pi))


def unwrapped_words(jumps: int) -> str:
    """Return in words that an angle with so many jumps by a whole turn was unwrapped."""
    return f"unwrapped: {jumps} {'jump' if jumps == 1 else 'jumps'} by a whole turn {'is' if jumps == 1 else 'are'} taken out"


@dataclass(frozen=True)
class Agreement:
    """A recorded angle against the turn of a recorded frequency, both less a line. factor: by which the angle turns more; None where not
    both turn enough to tell. rms: of what is left between them, rad; moves: rms of the turn, rad. unseen: rms, rad, of a turn that the
    noise of the two would hide."""

    factor: float | None
    rms: float
    moves: float
    unseen: float = math.inf

    @property
    def turns_alike(self) -> bool:
        """True where both turn, in one direction and as far."""
        return self.factor is not None and abs(self.factor - 1.0) <= AGREES

    @property
    def holds(self) -> bool:
        """True where nothing contradicts: both turn alike, or neither turns so that the other would have to show it."""
        if self.factor is None:
            return self.rms <= 2.0 * self.unseen
        return self.turns_alike and self.rms <= AGREES * self.moves


def agreement(time: Array, angle: Array, frequency: Array, nominal: float) -> Agreement:
    """Return how far a recorded angle in rad, unwrapped here, agrees with a recorded frequency in Hz, in a frame of the nominal one."""
    known = np.isfinite(angle) & np.isfinite(frequency)
    t, theta = time[known], unwrapped(angle[known])
    turn = turned(t, frequency[known], nominal)
    line = np.column_stack([np.ones(t.size), t - t[:1].sum()])

    def beyond_line(v: Array) -> Array:
        return np.asarray(v - line @ np.linalg.lstsq(line, v, rcond=None)[0])

    if t.size < 4:
        return Agreement(None, 0.0, 0.0)
    own, other = beyond_line(theta), beyond_line(turn)
    moves, rms = float(np.sqrt(np.mean(other**2))), float(np.sqrt(np.mean((own - other) ** 2)))
    wander, noise = MOVES * max(_wander(t, frequency[known]), 1e-12), MOVES * scatter(t, theta)
    if moves <= wander or float(np.sqrt(np.mean(own**2))) <= noise:
        still = np.ptp(frequency[known]) == 0.0  # a frequency that never changes has unknown digits
        return Agreement(None, rms, moves, math.inf if still else max(wander, noise))
    return Agreement(float(own @ other / (other @ other)), rms, moves, max(wander, noise))


def finer_is_angle(time: Array, angle: Array, frequency: Array) -> bool:
    """Return whether a recorded angle in rad tells the turn better than a recorded frequency in Hz, whose noise adds up over the record."""
    known = np.isfinite(angle) & np.isfinite(frequency)
    t = time[known]
    return scatter(t, unwrapped(angle[known])) <= _wander(t, frequency[known])


def _wander(time: Array, frequency: Array) -> float:
    """Return by how much, rad, the noise of a frequency in Hz makes its turn wander over the record."""
    return 2.0 * np.pi * scatter(time, frequency) * math.sqrt(float(np.median(np.diff(time))) * float(np.ptp(time)))
