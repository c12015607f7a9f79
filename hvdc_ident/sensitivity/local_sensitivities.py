"""Exact local sensitivities: of trajectories, steady states, eigenvalues and frequency responses.

All are derivatives in the units of output and parameter. Normalised they are multiplied by the parameter's factor: its value,
or its range where one is given or the value is 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.codec import Coded
from hvdc_ident.data import Array, Experiment
from hvdc_ident.display import Shown, Table, axes_of
from hvdc_ident.errors import LinearizationError, StudyError, require_known
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model
from hvdc_ident.simulate import Simulation, simulate
from hvdc_ident.text import with_unit

if TYPE_CHECKING:
    import xarray


Complex = NDArray[np.complex128]
Ranges = Mapping[str, tuple[float, float]]


def factors(
    model: Model, names: Sequence[str], values: Mapping[str, float], ranges: Ranges
) -> tuple[FrozenMap[float], FrozenMap[float]]:
    """Return the parameters' values and the factors that normalise derivatives by them, both in the parameters' units.

    A factor is the width of a given range, else the magnitude of the value; where the value is 0, the width of the
    model's own bounds or the parameter's size. Raises UnknownNameError, and StudyError for a range without a width.
    """
    at, scales = {}, {}
    require_known("parameter", names, model.parameters, f"model '{model.name}'")
    for name in names:
        parameter = model.parameters[name]
        at[name] = float(values.get(name, parameter.value))
        low, high = ranges.get(name, (parameter.min, parameter.max))
        width = high - low
        if name in ranges and not (math.isfinite(width) and width > 0):
            raise StudyError(
                f"the range of '{name}' is wrong", expected="finite min < max", got=f"min {low:g}, max {high:g}"
            )
        if name in ranges or (at[name] == 0 and math.isfinite(width) and width > 0):
            scales[name] = float(width)
        else:
            scales[name] = abs(at[name]) or parameter.size
    return FrozenMap(at), FrozenMap(scales)


def _labelled(values: Any, name: str, **axes: Any) -> xarray.DataArray:
    """Return values with labelled axes, in the order given."""
    import xarray

    return xarray.DataArray(values, coords=axes, dims=tuple(axes), name=name)


def bars(
    axes: Any, groups: Sequence[str], heights: Mapping[str, Array], errors: Mapping[str, Array] | None = None
) -> None:
    """Draw a bar of each series in every group. heights, errors: (groups,) by the series' label."""
    width = 0.8 / len(heights)
    for k, (label, values) in enumerate(heights.items()):
        places = np.arange(len(groups)) + (k + 0.5) * width - 0.4
        axes.bar(places, values, width, yerr=None if errors is None else errors[label], label=label)
    axes.set_xticks(range(len(groups)), groups)
    axes.legend(fontsize=8)


@dataclass(frozen=True, eq=False, repr=False)
class Sensitivities(Coded, Shown):
    """Derivatives of the outputs of some experiments by parameters.

    values: of the parameters. factors: what a derivative is multiplied by to be normalised, in the parameter's unit:
    its value, or its range where one is given or the value is 0. By experiment: runs, with the derivatives; compared: (n,) the
    rows inside the window; notes: a reason why its sensitivities say little.
    """

    model: str
    parameters: tuple[str, ...]
    parameter_units: tuple[str, ...]
    values: FrozenMap[float]
    factors: FrozenMap[float]
    runs: FrozenMap[Simulation]
    compared: FrozenMap[NDArray[np.bool_]]
    notes: FrozenMap[str]

    def _run(self, experiment: str) -> Simulation:
        require_known("experiment", [experiment], self.runs, "")
        return self.runs[experiment]

    def of(self, experiment: str, output: str, parameter: str, *, normalised: bool = False) -> Array:
        """Return one derivative over time, (n,), in units or times the parameter's factor."""
        gradient = self._run(experiment).gradient(output)
        require_known("parameter", [parameter], self.parameters, "")
        derivative = gradient[:, self.parameters.index(parameter)]
        return derivative * self.factors[parameter] if normalised else derivative

    @property
    def _scale(self) -> Array:
        return np.array([self.factors[p] for p in self.parameters])

    def array(self, experiment: str, *, normalised: bool = False) -> xarray.DataArray:
        """One experiment's derivatives with labelled axes time, output, parameter."""
        derivatives = self._run(experiment).sensitivities
        return (derivatives * self._scale).rename("normalised sensitivity") if normalised else derivatives

    @cached_property
    def table(self) -> FrozenMap[FrozenMap[FrozenMap[tuple[float, float]]]]:
        """(rms, peak) of the normalised sensitivity over the compared rows, by experiment, output and parameter."""
        by_experiment = {}
        for e, run in self.runs.items():
            scaled = run.gradients[self.compared[e]] * self._scale
            rms, peak = np.sqrt((scaled**2).mean(axis=0)), np.abs(scaled).max(axis=0)
            by_experiment[e] = FrozenMap(
                {
                    o: FrozenMap({p: (float(rms[i, k]), float(peak[i, k])) for k, p in enumerate(self.parameters)})
                    for i, o in enumerate(run.trajectory.names)
                }
            )
        return FrozenMap(by_experiment)

    @property
    def norms(self) -> xarray.Dataset:
        """The RMS and the peak of the normalised sensitivities, over experiment, output and parameter; nan: no output."""
        import xarray

        outputs = list(dict.fromkeys(o for lines in self.table.values() for o in lines))
        axes = {"experiment": list(self.runs), "output": outputs, "parameter": list(self.parameters)}
        values = np.full((2, *(len(a) for a in axes.values())), np.nan)
        for i, e in enumerate(self.table):
            for o, line in self.table[e].items():
                for k, pair in enumerate(line.values()):
                    values[:, i, outputs.index(o), k] = pair
        dims = tuple(axes)
        return xarray.Dataset({"rms": (dims, values[0]), "peak": (dims, values[1])}, coords=axes)

    def plot(self, experiment: str | None = None, output: str | None = None, ax: Any = None) -> Any:
        """Axes with one output's normalised derivatives in one experiment (default: the first), a curve a parameter."""
        name = next(iter(self.runs)) if experiment is None else experiment
        table = self._run(name).trajectory
        shown = table.names[0] if output is None else output
        axes = axes_of(ax)
        for p in self.parameters:
            axes.plot(table.time, self.of(name, shown, p, normalised=True), label=p)
        axes.set_ylabel(with_unit(f"normalised derivative of {shown}", table.unit(shown)))
        axes.set_xlabel("time, s")
        axes.set_title(name)
        axes.legend(fontsize=8)
        return axes

    def _screen(self) -> Iterator[str | Table]:
        count = len(self.runs)
        yield f"Trajectories of {self.model}: normalised sensitivities in {count} experiment{'s' if count > 1 else ''}"
        lines = (
            (e, o, p, f"{rms:.4g}", f"{peak:.4g}")
            for e, outputs in self.table.items()
            for o, line in outputs.items()
            for p, (rms, peak) in line.items()
        )
        yield Table(("experiment", "output", "parameter", "rms", "peak"), tuple(lines))


def trajectory_sensitivities(
    model: Model,
    experiments: Sequence[Experiment],
    parameters: Sequence[str] | None = None,
    *,
    values: Mapping[str, float] | None = None,
    outputs: Sequence[str] | None = None,
    ranges: Ranges | None = None,
) -> Sensitivities:
    """Return the exact derivatives of each experiment's outputs over time, the start's dependence on the parameters included.

    parameters: default, all of the model. values: parameters that differ from the model's. outputs: names of outputs or
    signals (default: the recorded ones, else all outputs). ranges: (min, max) of a parameter, in its unit, as its factor.

    Raises StudyError without an experiment, UnknownNameError, SteadyStateError or SimulationError.
    """
    if not experiments:
        raise StudyError("sensitivities need an experiment and there is none", expected="at least one experiment")
    names = tuple(model.parameters if parameters is None else parameters)
    at, scale = factors(model, names, values or {}, ranges or {})
    runs: dict[str, Simulation] = {}
    for e in experiments:
        if e.name in runs:
            raise StudyError("two experiments of one name", got=e.name, expected="distinct names")
        runs[e.name] = simulate(model, e, values, names, outputs=tuple(outputs or e.outputs or model.outputs))
    still = [e.name for e in experiments if all(u.is_constant for u in e.inputs.values())]
    notes = dict.fromkeys(still, "no input moves: only the steady state is seen")
    compared = FrozenMap({e.name: e.compared for e in experiments})
    units = tuple(model.parameters[p].unit for p in names)
    return Sensitivities(model.name, names, units, at, scale, FrozenMap(runs), compared, FrozenMap(notes))


@dataclass(frozen=True, eq=False, repr=False)
class SteadySensitivities(Coded, Shown):
    """Derivatives of a steady state by parameters: state_values by name; gradients (outputs, parameters) in units."""

    model: str
    outputs: tuple[str, ...]
    parameters: tuple[str, ...]
    steady: FrozenMap[float]
    factors: FrozenMap[float]
    gradients: Array

    def array(self, *, normalised: bool = False) -> xarray.DataArray:
        """The derivatives with labelled axes output, parameter; in units, or times the parameters' factors."""
        values = self.gradients * np.array([self.factors[p] for p in self.parameters]) if normalised else self.gradients
        return _labelled(values, "steady sensitivity", output=list(self.outputs), parameter=list(self.parameters))

    def plot(self, ax: Any = None) -> Any:
        """Axes with a bar for every output and parameter: the derivative times the parameter's factor."""
        axes = axes_of(ax)
        bars(axes, self.outputs, {p: self.gradients[:, k] * self.factors[p] for k, p in enumerate(self.parameters)})
        axes.set_ylabel("normalised derivative of the steady value")
        return axes

    def _screen(self) -> Iterator[str | Table]:
        yield f"Steady state of {self.model}: sensitivities in the units of output and parameter"
        lines = (
            (o, f"{self.steady[o]:.6g}", p, f"{slope:.4g}")
            for o, row in zip(self.outputs, self.gradients.tolist(), strict=True)
            for p, slope in zip(self.parameters, row, strict=True)
        )
        yield Table(("output", "steady value", "parameter", "derivative"), tuple(lines))


def steady_sensitivities(
    model: Model,
    parameters: Sequence[str] | None = None,
    *,
    values: Mapping[str, float] | None = None,
    outputs: Sequence[str] | None = None,
    ranges: Ranges | None = None,
) -> SteadySensitivities:
    """Return the exact derivatives of the steady state at given values of parameters and inputs.

    outputs: names of outputs or signals; default, all outputs. Raises SteadyStateError where there is none.
    """
    names = tuple(model.parameters if parameters is None else parameters)
    _, scale = factors(model, names, values or {}, ranges or {})
    shown = tuple(outputs or model.outputs)
    at_rest = Experiment(np.zeros(1), "rest")
    run = simulate(model, at_rest, values, names, outputs=shown)
    steady = dict(zip(shown, run.trajectory.values[0].tolist(), strict=True))
    return SteadySensitivities(model.name, shown, names, FrozenMap(steady), scale, run.gradients[0])


@dataclass(frozen=True, eq=False, repr=False)
class LinearSensitivities(Coded, Shown):
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
        gradients = self.eigenvalue_gradients * self._scale if normalised else self.eigenvalue_gradients
        modes = np.arange(self.eigenvalues.size)
        array = _labelled(gradients, "eigenvalue sensitivity", mode=modes, parameter=list(self.parameters))
        return array.assign_coords(eigenvalue=("mode", self.eigenvalues))

    def response_array(self, *, normalised: bool = False) -> xarray.DataArray:
        """dG/dp with labelled axes omega, output, input, parameter."""
        return _labelled(
            self.response_gradients * self._scale if normalised else self.response_gradients,
            "response sensitivity",
            omega=self.omega,
            output=list(self.outputs),
            input=list(self.inputs),
            parameter=list(self.parameters),
        )

    def channel(self, input: str, output: str, parameter: str, *, normalised: bool = False) -> Complex:
        """Return the derivative of one channel's response by one parameter, (n,)."""
        require_known("input", [input], self.inputs, "")
        require_known("output", [output], self.outputs, "")
        require_known("parameter", [parameter], self.parameters, "")
        places = self.outputs.index(output), self.inputs.index(input), self.parameters.index(parameter)
        derivative = self.response_gradients[(slice(None), *places)]
        return np.asarray(derivative * self.factors[parameter] if normalised else derivative)

    def plot(self, input: str | None = None, output: str | None = None, ax: Any = None) -> Any:
        """Axes with one channel's normalised derivatives over frequency (default: the first), a curve a parameter."""
        source, target = input or self.inputs[0], output or self.outputs[0]
        axes = axes_of(ax)
        for p in self.parameters:
            axes.loglog(self.omega / (2 * np.pi), np.abs(self.channel(source, target, p, normalised=True)), label=p)
        axes.set_xlabel("frequency, Hz")
        axes.set_ylabel(f"normalised derivative of {target}/{source}")
        axes.legend(fontsize=8)
        return axes

    def _screen(self) -> Iterator[str | Table]:
        yield f"Eigenvalues of {self.model}: sensitivities in rad/s per unit of the parameter"
        lines = (
            (f"{value:.5g}", p, f"{slope:.4g}")
            for value, row in zip(self.eigenvalues.tolist(), self.eigenvalue_gradients.tolist(), strict=True)
            for p, slope in zip(self.parameters, row, strict=True)
        )
        yield Table(("eigenvalue, rad/s", "parameter", "derivative"), tuple(lines))


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

    The shift of the operating point is included.

    Parameters
    ----------
    model : Model
        A model with equations.
    parameters : list of str, default None
        Names of parameters. None: all.
    values : dict of float, default None
        Values of parameters and inputs by name, in the model's units, where they differ from the model's.
    inputs : list of str, default None
        Names of inputs of the response. None: all.
    outputs : list of str, default None
        Names of outputs or signals of the response. None: all outputs.
    omega : array of float (n,), default None
        Frequencies in rad/s. None: around the poles.
    ranges : dict of (float, float), default None
        (min, max) by parameter, in its unit: their distance is the factor that normalises. None: the size of its value, or its range where
        that is 0.

    Returns
    -------
    LinearSensitivities
        eigenvalues (m,) in rad/s with eigenvalue_gradients (m, k), and response (n, outputs, inputs) with response_gradients
        (n, outputs, inputs, k), in units per unit of each of the k parameters.

    Raises
    ------
    UnknownNameError
        A name that the model lacks.
    StudyError
        A range without a width.
    SteadyStateError
        There is no operating point.
    LinearizationError
        The model has no linear one.

    Examples
    --------
    >>> import hvdc_ident as hi
    >>> lag = hi.Model("lag", parameters={"T": 0.5, "k": 2.0}, inputs={"u": 0.0}, states={"x": "(k*u - x)/T"}, outputs={"y": "x"})
    >>> derivatives = hi.linear.linear_sensitivities(lag, ["T"])
    >>> derivatives.eigenvalues.real.round(9).tolist(), derivatives.eigenvalue_gradients.real.round(9).tolist()  # -1/T and 1/T^2
    ([-2.0], [[4.0]])
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


@dataclass(frozen=True, eq=False, repr=False)
class LocalSensitivities(Coded, Shown):
    """Derivatives by the same parameters, in units and normalised by the same factors.

    trajectories: by experiment and output over time; None without an experiment. steady: of the steady state of the
    values. linear: of eigenvalues and frequency response there; None where there is no linear model, and `why` says it.
    """

    trajectories: Sensitivities | None
    steady: SteadySensitivities
    linear: LinearSensitivities | None
    why: str = ""

    def plot(self, ax: Any = None) -> Any:
        """Axes with the first output's derivatives over time; of the steady state where there is no experiment."""
        return self.trajectories.plot(ax=ax) if self.trajectories is not None else self.steady.plot(ax)

    def _screen(self) -> Iterator[str | Table]:
        for part in (self.trajectories, self.steady, self.linear):
            if part is not None:
                yield from part._screen()
        yield self.why


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
