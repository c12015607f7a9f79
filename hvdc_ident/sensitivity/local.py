"""The verb `sensitivities`: exact derivatives of trajectories, of the steady state, of eigenvalues and of responses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from hvdc_ident.errors import LinearizationError
from hvdc_ident.experiment import Experiment
from hvdc_ident.model.definition import Model
from hvdc_ident.sensitivity.factors import Ranges
from hvdc_ident.sensitivity.forward import (
    Sensitivities,
    SteadySensitivities,
    steady_sensitivities,
    trajectory_sensitivities,
)
from hvdc_ident.sensitivity.linear import LinearSensitivities, linear_sensitivities
from hvdc_ident.trajectory import Array


@dataclass(frozen=True, eq=False)
class LocalSensitivities:
    """Derivatives by the same parameters, in units and normalised by the same factors.

    trajectories: by experiment and output over time; None without an experiment. steady: of the steady state of the
    values. linear: of eigenvalues and frequency response there; None where there is no linear model, and `why` says it.
    """

    trajectories: Sensitivities | None
    steady: SteadySensitivities
    linear: LinearSensitivities | None
    why: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Norms of the trajectories' derivatives, the steady ones, those of the eigenvalues, peaks of the responses'."""
        return {
            "trajectories": self.trajectories.to_dict() if self.trajectories else None,
            "steady": self.steady.to_dict(),
            "linear": self.linear.to_dict() if self.linear else None,
            "why": self.why,
        }

    def plot(self, ax: Any = None) -> Any:
        """Axes with the first output's derivatives over time; of the steady state where there is no experiment."""
        return self.trajectories.plot(ax=ax) if self.trajectories is not None else self.steady.plot(ax)

    def __str__(self) -> str:
        parts = [p for p in (self.trajectories, self.steady, self.linear) if p is not None]
        return "\n\n".join([*map(str, parts), *([self.why] if self.why else [])])

    def _repr_html_(self) -> str:
        return "<pre>" + escape(str(self)) + "</pre>"


def sensitivities(
    model: Model,
    experiments: Sequence[Experiment] = (),
    parameters: Sequence[str] | None = None,
    *,
    values: Mapping[str, float] | None = None,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    omega: Array | Sequence[float] | None = None,
    ranges: Ranges | None = None,
) -> LocalSensitivities:
    """The exact derivatives of all that a model gives, by parameters (default: all of the model's), local to `values`.

    outputs: names of outputs (default: those that experiments recorded, else all); inputs: of the frequency response at
    omega, rad/s (default: all, around the poles). ranges: (min, max) of a parameter as its factor, in its unit; else
    its value, or its range where that is 0. The global view is `morris` and `sobol` in `sensitivity.global_screening`.
    Raises UnknownNameError, SteadyStateError or SimulationError.
    """
    common: dict[str, Any] = {"values": values, "outputs": outputs, "ranges": ranges}
    along = trajectory_sensitivities(model, experiments, parameters, **common) if experiments else None
    steady = steady_sensitivities(model, parameters, **common)
    recorded = dict.fromkeys(o for e in experiments for o in e.outputs)
    seen = outputs or list(recorded) or None
    try:
        linear = linear_sensitivities(model, parameters, inputs=inputs, omega=omega, **{**common, "outputs": seen})
    except LinearizationError as error:
        return LocalSensitivities(along, steady, None, f"no linear model: {error}")
    return LocalSensitivities(along, steady, linear)
