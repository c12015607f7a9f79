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
    def time_constant(self) -> float:
        """1/|Re lambda| in s, infinite on the imaginary axis."""
        return 1.0 / abs(self.eigenvalue.real) if self.eigenvalue.real else float("inf")

    @property
    def dominant(self) -> str:
        """The state that takes part most."""
        return max(self.participation, key=lambda n: self.participation[n])


def kind_of_mode(eigenvalue: complex, zero: float, driven: bool, seen: bool) -> str:
    """Return the kind of a mode. zero: size below which it is at 0. driven, seen: whether inputs reach and outputs see it."""
    if abs(eigenvalue) > zero:
        if eigenvalue.imag:
            return "oscillation" if eigenvalue.real <= 0 else "growing oscillation"
        return "decay" if eigenvalue.real < 0 else "growth"
    if driven:
        return "free integrator" if seen else "angle reference or unobserved integrator"
    return "undriven integrator" if seen else "hidden integrator"
