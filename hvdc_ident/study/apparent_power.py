"""Recorded power beside that which the recorded voltage and current make: in size before the event, and in how it moves after it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from hvdc_ident.data import Array, before_event
from hvdc_ident.data.turning import scatter
from hvdc_ident.text import quantity

FACTORS = (math.sqrt(3.0), 3.0)
"""Apparent power over voltage times current: of a voltage from line to line, and of one from phase to ground."""
NEAR = math.sqrt(math.sqrt(1.5))
"""Factor within which the powers are alike: transformers for measurement are off by some percent; the mistake that comes nearest, a peak
value for an rms one beside another way to count the voltage, is off by the square of this."""
MOVES = 10.0
"""Times its scatter by which a power has to move before that tells anything."""
APART = math.radians(5.0)
"""Error of an angle between voltage and current: transformers of class 6P and 5P are off by 240 and 60 minutes (IEC 61869-3 and -2)."""
LEFT = 0.5
"""Share of the square of a movement that windows and filters of different lengths leave at most; two plants have nothing in common."""


@dataclass(frozen=True)
class ApparentPower:
    """The recorded power beside that of voltage and current, all of them before the event. power: MVA; product: kV kA; left: share of the
    square of the movement that the product leaves of the power's, 0 where neither moves. named: the columns of voltage and current."""

    power: float
    product: float
    left: float
    named: str

    @classmethod
    def of(cls, time: Array, power: Array, product: Array, event: float | None, named: str) -> ApparentPower | None:
        """Return the comparison of (n,) MVA with (n,) kV kA; None where no row stands before an event, or nothing flows there."""
        known = np.isfinite(power) & np.isfinite(product)
        t, own, other = time[known], power[known], product[known]
        before = before_event(t, own, event)
        if event is None or not before.any():
            return None
        levels = float(own[before].mean()), float(other[before].mean())
        if min(levels) <= 0.0:
            return None
        return cls(*levels, _left(t, own - levels[0], (other - levels[1]) * levels[0] / levels[1]), named)

    @property
    def ratio(self) -> float:
        """The recorded power over that of voltage and current, counted as it comes nearest."""
        return min((self.power / (k * self.product) for k in FACTORS), key=lambda r: abs(math.log(r)))

    @property
    def level_holds(self) -> bool:
        """True where both have one size."""
        return abs(math.log(self.ratio)) <= math.log(NEAR)

    @property
    def holds(self) -> bool:
        """True where nothing contradicts."""
        return self.level_holds and self.left <= LEFT

    def times(self, factor: float) -> ApparentPower:
        """Return the same with a factor in the recorded power."""
        return replace(self, power=factor * self.power)

    @property
    def words(self) -> str:
        """Both sizes."""
        return f"{quantity(self.power, 'MVA')}, {self.ratio:.3g} times what {self.named} make, {quantity(self.power / self.ratio, 'MVA')},"


def _left(time: Array, own: Array, other: Array) -> float:
    """Return the share of the square of a movement that another one leaves, 0 where it is no more than its scatter."""
    moved, seen = float(np.mean(own**2)), MOVES * scatter(time, own)
    return float(np.mean((own - other) ** 2)) / moved if moved > seen**2 else 0.0


def exchanged(power: Array, lead: Array) -> bool:
    """Return whether the angle of a power is that of its conjugate: voltage and current are exchanged, or Q has the other sign.

    power: (n,) P + jQ of rows at rest. lead: (n,) rad, by which the voltage's recorded angle is ahead of the current's. False too where
    the power has no angle to tell it by.
    """
    known = np.isfinite(power) & np.isfinite(lead) & (power != 0.0)
    if not known.any():
        return False
    turn = np.exp(1j * lead[known]) * np.abs(power[known])
    right, wrong = (abs(float(np.angle(np.mean(turn * p)))) for p in (power[known].conj(), power[known]))
    return wrong <= APART < right
