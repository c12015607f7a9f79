"""A mode of a linear model: eigenvalue, damping, participation, shape, and its derivatives by parameters."""

from __future__ import annotations

from dataclasses import dataclass

from hvdc_ident.codec import Coded
from hvdc_ident.immutable import FrozenMap


@dataclass(frozen=True, eq=False)
class Mode(Coded):
    """One eigenvalue in rad/s, with damping, participation, shape and kind.

    frequency_hz: of the oscillation, 0 for a real one. damping: -Re/|lambda|, 0 for a zero eigenvalue.
    participation: share of each state, they sum to 1. shape: the right eigenvector, its largest entry 1.
    sensitivity: d(lambda)/dp by parameter. kind: "oscillation", "decay", "growth", "growing oscillation",
    or what a zero eigenvalue is: "free integrator", "hidden integrator" (nothing reaches it), "saturated state", "angle
    reference or unobserved integrator", "undriven integrator", "sliding mean (cancelled by its delay)".
    """

    eigenvalue: complex
    frequency_hz: float
    damping: float
    participation: FrozenMap[float]
    shape: FrozenMap[complex]
    sensitivity: FrozenMap[complex]
    kind: str

    @property
    def dominant(self) -> str:
        """The state that takes part most."""
        return max(self.participation, key=lambda n: self.participation[n])


def damping_of(eigenvalue: complex) -> float:
    """Return -Re/|lambda|, 0 for a zero eigenvalue."""
    return float(-eigenvalue.real / abs(eigenvalue)) if eigenvalue else 0.0


def kind_of_mode(eigenvalue: complex, driven: bool, seen: bool) -> str:
    """Return the kind of a mode. driven, seen: whether inputs reach and outputs see it."""
    if eigenvalue:
        if eigenvalue.imag:
            return "oscillation" if eigenvalue.real <= 0 else "growing oscillation"
        return "decay" if eigenvalue.real < 0 else "growth"
    if driven:
        return "free integrator" if seen else "angle reference or unobserved integrator"
    return "undriven integrator" if seen else "hidden integrator"
