"""Exact local sensitivities: of eigenvalues and the frequency response, and of all that a model gives together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, Experiment
from hvdc_ident.errors import LinearizationError, unknown_name
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model
from hvdc_ident.sensitivity.derivatives import (
    Ranges,
    Sensitivities,
    SteadySensitivities,
    factors,
    steady_sensitivities,
    table_text,
    trajectory_sensitivities,
)

if TYPE_CHECKING:
    import xarray

Complex = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class LinearSensitivities:
    """Derivatives of a linear model by k parameters, the shift of its operating point included.

    factors: what a derivative is multiplied by to be normalised, in the parameter's unit. eigenvalues: (m,) rad/s;
    eigenvalue_gradients: (m, k). omega: (n,) rad/s; response: (n, outputs, inputs); response_gradients:
    (n, outputs, inputs, k), all in units per parameter unit.
    """

    model: str
    parameters: tuple[str, ...]
    values: FrozenMap[float]
    factors: FrozenMap[float]
    eigenvalues: Complex
    eigenvalue_gradients: Complex
    omega: Array
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    response: Complex
    response_gradients: Complex

    @property
    def _scale(self) -> Array:
        return np.array([self.factors[p] for p in self.parameters])

    def eigenvalue_array(self, *, normalised: bool = False) -> xarray.DataArray:
        """d(lambda)/dp with labelled axes mode, parameter; modes in the order of `LinearModel.modes`."""
        import xarray

        found = self.eigenvalue_gradients * self._scale if normalised else self.eigenvalue_gradients
        axes: dict[str, Any] = {"mode": np.arange(self.eigenvalues.size), "parameter": list(self.parameters)}
        array = xarray.DataArray(found, coords=axes, dims=tuple(axes), name="eigenvalue sensitivity")
        return array.assign_coords(eigenvalue=("mode", self.eigenvalues))

    def response_array(self, *, normalised: bool = False) -> xarray.DataArray:
        """dG/dp with labelled axes omega, output, input, parameter."""
        import xarray

        found = self.response_gradients * self._scale if normalised else self.response_gradients
        axes = {
            "omega": self.omega,
            "output": list(self.outputs),
            "input": list(self.inputs),
            "parameter": list(self.parameters),
        }
        return xarray.DataArray(found, coords=axes, dims=tuple(axes), name="response sensitivity")

    def channel(self, input: str, output: str, parameter: str, *, normalised: bool = False) -> Complex:
        """Return the derivative of one channel's response by one parameter, (n,)."""
        for kind, name, known in (
            ("input", input, self.inputs),
            ("output", output, self.outputs),
            ("parameter", parameter, self.parameters),
        ):
            if name not in known:
                raise unknown_name(kind, name, known)
        places = self.outputs.index(output), self.inputs.index(input), self.parameters.index(parameter)
        found = self.response_gradients[(slice(None), *places)]
        return np.asarray(found * self.factors[parameter] if normalised else found)

    def to_dict(self) -> dict[str, Any]:
        """Eigenvalues with their derivatives, and of each channel the largest normalised derivative and where it is."""
        rows = zip(self.eigenvalues.tolist(), self.eigenvalue_gradients.tolist(), strict=True)
        return {
            "factors": dict(self.factors),
            "eigenvalues": [
                {
                    "eigenvalue": [value.real, value.imag],
                    "sensitivity": {p: [d.real, d.imag] for p, d in zip(self.parameters, line, strict=True)},
                }
                for value, line in rows
            ],
            "response": {
                o: {i: {p: self._peak(i, o, p) for p in self.parameters} for i in self.inputs} for o in self.outputs
            },
        }

    def _peak(self, input: str, output: str, parameter: str) -> dict[str, float]:
        size = np.abs(self.channel(input, output, parameter, normalised=True))
        largest = float(np.abs(self.response[:, self.outputs.index(output), self.inputs.index(input)]).max())
        at = int(np.argmax(size))
        peak = float(size[at])
        return {"peak": peak, "of_largest_gain": peak / largest if largest > 0 else 0.0, "omega": float(self.omega[at])}

    def plot(self, input: str | None = None, output: str | None = None, ax: Any = None) -> Any:
        """Axes with one channel's normalised derivatives over frequency (default: the first), a curve a parameter."""
        import matplotlib.pyplot as plt

        source, target = input or self.inputs[0], output or self.outputs[0]
        axes = ax if ax is not None else plt.subplots(layout="constrained")[1]
        for p in self.parameters:
            axes.loglog(self.omega / (2 * np.pi), np.abs(self.channel(source, target, p, normalised=True)), label=p)
        axes.set_xlabel("frequency, Hz")
        axes.set_ylabel(f"normalised derivative of {target}/{source}")
        axes.legend(fontsize=8)
        return axes

    def __str__(self) -> str:
        lines = [
            (f"{value:.5g}", p, f"{slope:.4g}")
            for value, row in zip(self.eigenvalues.tolist(), self.eigenvalue_gradients.tolist(), strict=True)
            for p, slope in zip(self.parameters, row, strict=True)
        ]
        return table_text(("eigenvalue, rad/s", "parameter", "derivative"), lines)

    def _repr_html_(self) -> str:
        return "<pre>" + escape(str(self)) + "</pre>"


def linear_sensitivities(
    model: Model,
    parameters: Sequence[str] | None = None,
    *,
    values: Mapping[str, float] | None = None,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    omega: Array | Sequence[float] | None = None,
    ranges: Ranges | None = None,
) -> LinearSensitivities:
    """Return the exact derivatives of the eigenvalues and of the frequency response at the steady state of given values.

    inputs, outputs: of the response; default, all. omega: rad/s; default, around the poles. ranges: as factors, as in
    `trajectory_sensitivities`. Raises SteadyStateError where there is no operating point, LinearizationError where the
    model has no linear one.
    """
    from hvdc_ident.linearize import find_operating_point, frequency, linearize

    names = tuple(model.parameters if parameters is None else parameters)
    at, scale = factors(model, names, values or {}, ranges or {})
    point = find_operating_point(model, values or {})
    linear = linearize(model, point, inputs=inputs, outputs=outputs, sensitivities=names)
    modes = linear.modes()
    response = linear.bode(None if omega is None else np.asarray(omega, dtype=float))
    slopes = frequency.sensitivity(linear, response.omega, names)
    shape = (*response.values.shape, len(names))
    return LinearSensitivities(
        model.name,
        names,
        at,
        scale,
        np.array([m.eigenvalue for m in modes], dtype=complex),
        np.array([[m.sensitivity[n] for n in names] for m in modes], dtype=complex).reshape(len(modes), len(names)),
        response.omega,
        tuple(linear.input_names),
        tuple(linear.output_names),
        np.asarray(response.values, dtype=complex),
        np.stack([slopes[n] for n in names], axis=-1) if names else np.zeros(shape, dtype=complex),
    )


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
    """Return the exact derivatives of all that a model gives by parameters (default: all of the model's) at `values`.

    outputs: names of outputs (default: those that experiments recorded, else all); inputs: of the frequency response at
    omega, rad/s (default: all, around the poles). ranges: (min, max) of a parameter as its factor, in its unit; else
    its value, or its range where that is 0. The global view is `morris` and `sobol`.
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
