"""Interface of every kind of model that has operating points and linear models: one with equations, and an FMU."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from hvdc_ident.linearize.derivatives import Side
from hvdc_ident.linearize.equilibrium import PointOptions
from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.point import Judge, OperatingPoint


@dataclass(frozen=True)
class LinearOptions:
    """Request for a linear model: the arguments of `linearize`."""

    inputs: Sequence[str] | None = None
    outputs: Sequence[str] | None = None
    pade_order: int | None = None
    sensitivities: Sequence[str] = ()
    side: Side = "refuse"
    descriptor: bool = False


class Kind(Judge, Protocol):
    """A model that has operating points, and a linear model at each."""

    def point(self, asked: PointOptions) -> OperatingPoint:
        """Return an operating point. Raises UnknownNameError, SteadyStateError where there is none."""
        ...

    def linear(self, point: OperatingPoint, asked: LinearOptions) -> LinearModel:
        """Return the linear model at a point. Raises UnknownNameError, LinearizationError for what it cannot answer."""
        ...

    def jacobian_error(self, point: OperatingPoint, outputs: Sequence[str] | None) -> float:
        """Return how far the Jacobian is off an independent one, of each row's largest entry."""
        ...
