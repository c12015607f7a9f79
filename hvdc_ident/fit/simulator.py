"""Simulators as a fit needs them: parameters with bounds, runs with sensitivities, and nuisances of single experiments.

A nuisance is unknown about one experiment alone and estimated with it (`unknowns`). It stands by name in
`Experiment.nuisance`: a clock offset, an offset of an input, a start of a state, a parameter with a value of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, Experiment, Trajectory
from hvdc_ident.errors import SimulationError, SteadyStartError, SteadyStateError, StudyError
from hvdc_ident.fit.fit_parameter import FitParameter
from hvdc_ident.parameters import Input, Parameter
from hvdc_ident.sensitivity import SENSITIVITY_ERROR

TIME_SHIFT = "time-shift"
REACH = 0.2
"""An offset may reach this share of its input's largest magnitude, or of 1 where that is 0."""


class SimulationRun(Protocol):
    """One run: the outputs and, where asked for, their derivatives by parameters."""

    @property
    def trajectory(self) -> Trajectory:
        """Every output of the model at the experiment's instants."""

    def gradient(self, output: str) -> Array:
        """(n_time, n_parameters): the output's derivatives, in the output's unit over the parameter's unit."""


class Simulator(Protocol):
    """Anything that can be run with other parameter values."""

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        """The parameters by name, with start values, units and physical bounds."""

    def simulate(
        self, experiment: Experiment, values: Mapping[str, float], sensitivities: Sequence[str] = ()
    ) -> SimulationRun:
        """Return a run of the experiment; parameters not in `values` keep their own.

        Raises SimulationError where it fails, SteadyStateError where it cannot begin.
        """


@runtime_checkable
class WithInputs(Protocol):
    """A simulator that says what its inputs are; one that does not is moved only where experiments moved it."""

    @property
    def inputs(self) -> Mapping[str, Input]:
        """The inputs by name, with start values and units."""


@runtime_checkable
class WithStates(Protocol):
    """A simulator whose states may begin at given values; one that does not say so begins where it begins."""

    @property
    def states(self) -> Mapping[str, Any]:
        """The states by name, with `guess` and `unit`."""


@runtime_checkable
class Approximate(Protocol):
    """A simulator whose sensitivities are differences; those of one that does not say so are taken as exact."""

    @property
    def sensitivity_error(self) -> float:
        """Relative error of a sensitivity column, by its own account: below it a rank cannot be determined."""


def sensitivity_error(simulator: Simulator) -> float:
    """Return the relative error of the simulator's sensitivities; that of the engine's own where it does not say."""
    wrapped = (simulator, getattr(simulator, "model", None))  # a model that runs itself may say it for its simulator
    return max([float(s.sensitivity_error) for s in wrapped if isinstance(s, Approximate)] + [SENSITIVITY_ERROR])


def approximate(simulator: Simulator) -> bool:
    """Return whether the simulator says that its sensitivities are differences: runs of it may jump between values."""
    return any(isinstance(s, Approximate) for s in (simulator, getattr(simulator, "model", None)))


def inputs_of(simulator: Simulator, experiments: Sequence[Experiment]) -> dict[str, Input]:
    """Return the simulator's inputs; of one that does not name them, those of the experiments, as they began."""
    if isinstance(simulator, WithInputs):
        return dict(simulator.inputs)
    inputs: dict[str, Input] = {}
    for e in experiments:
        for name, signal in e.inputs.items():
            if name not in e.drive:
                inputs.setdefault(name, Input(float(signal.values[0])))
    return inputs


@dataclass(frozen=True, eq=False)
class Observation:
    """Simulated outputs at an experiment's rows. values: (n,) by output; gradient: (n, unknowns) by output."""

    values: Mapping[str, Array]
    gradient: Mapping[str, Array]


def unknown_of(experiment: str, nuisance: str) -> str:
    """Return the name of an experiment's nuisance among the unknowns of a fit."""
    return f"{experiment}:{nuisance}"


def unknowns(simulator: Simulator, experiment: Experiment) -> tuple[FitParameter, ...]:
    """Return the unknowns of the experiment alone, in the order it names them.

    - "time-shift": the recorder's clock is late by so many s. It starts at 0 and may reach 2 % of the record, or two rows.
    - an input (or a driven insertion point): a constant is added to it all along, the steady start included. It starts at 0.
    - a state: it begins at an unknown value and not at rest. It starts at the model's guess, without bounds.
    - a parameter: it has a value of its own in this experiment, with the start and the bounds of the experiment's `search`,
      else the simulator's.
    Raises StudyError for a nuisance that is not known here.
    """
    return tuple(_nuisance_parameter(simulator, experiment, name) for name in experiment.nuisance)


def unit_of(simulator: Simulator, nuisance: str) -> str:
    """Return the unit of a nuisance."""
    if nuisance == TIME_SHIFT:
        return "s"
    for names in (simulator.parameters, _inputs(simulator), states_of(simulator)):
        if nuisance in names:
            return str(names[nuisance].unit)
    return ""


def _inputs(simulator: Simulator) -> Mapping[str, Input]:
    """Return the inputs; none of a simulator that does not name them."""
    return simulator.inputs if isinstance(simulator, WithInputs) else {}


def states_of(simulator: Simulator) -> Mapping[str, Any]:
    """Return the states whose start may be given; none of a simulator that does not name them."""
    return simulator.states if isinstance(simulator, WithStates) else {}


def _nuisance_parameter(simulator: Simulator, experiment: Experiment, nuisance: str) -> FitParameter:
    name, where = unknown_of(experiment.name, nuisance), f"experiment '{experiment.name}'"
    inputs, states = _inputs(simulator), states_of(simulator)
    if nuisance in simulator.parameters and nuisance != TIME_SHIFT:
        search = dict(zip(("start", "min", "max"), experiment.search.get(nuisance, ()), strict=False))
        return FitParameter.of(name, simulator.parameters[nuisance], **search)
    if nuisance in states and nuisance != TIME_SHIFT:
        return FitParameter(name, states[nuisance].guess or 0.0, scale=1.0)
    if nuisance == TIME_SHIFT:
        steps = np.diff(np.unique(experiment.time))
        if not steps.size:
            raise StudyError("a time shift needs more than one instant", where=where, got="one row")
        reach = max(0.02 * float(np.ptp(experiment.time)), 2.0 * float(np.median(steps)))
    elif nuisance in inputs or (inputs and nuisance in experiment.drive):
        signal = experiment.inputs.get(nuisance)
        level = inputs[nuisance].value if nuisance in inputs else 0.0
        size = np.abs(signal.values).max() if signal is not None else abs(experiment.values.get(nuisance, level))
        reach = REACH * (float(size) or 1.0)
    else:
        names = ", ".join(map(repr, [TIME_SHIFT, *inputs, *(experiment.drive if inputs else ()), *states]))
        raise StudyError(
            f"nuisance '{nuisance}' cannot be estimated",
            where=where,
            expected=f"{names} or a parameter",
            hint="hold the input's offset with `values`, or leave the nuisance out",
        )
    return FitParameter(name, 0.0, -reach, reach, scale=reach)


def observe(
    simulator: Simulator,
    experiment: Experiment,
    values: Mapping[str, float],
    sensitivities: Sequence[str] = (),
    nuisance: Mapping[str, float] | None = None,
    *,
    derivatives: bool = True,
) -> Observation:
    """Return the measured outputs as the model gives them, with derivatives by `sensitivities` and then by each nuisance.

    nuisance: value of each nuisance by its name in the experiment; "time-shift" tau in s: the recorder's clock is late
    by tau, so a row at t shows y(t - tau); before the first row the outputs stand still. derivatives: whether they are
    wanted; without them the gradient has no column.
    Raises SimulationError where the run fails, has no steady start (SteadyStartError) or returns a value that is not finite.
    """
    nuisance = dict(nuisance or {})
    simulated, own, rows = _with_nuisances(simulator, experiment, nuisance) if nuisance else (experiment, {}, None)
    wanted = (*sensitivities, *(n for n in nuisance if n != TIME_SHIFT)) if derivatives else ()
    try:
        run = simulator.simulate(simulated, {**values, **own}, wanted)
    except SteadyStateError as error:
        raise SteadyStartError(f"no steady start: {error}") from error
    outputs = {o: np.asarray(run.trajectory[o], dtype=float) for o in experiment.outputs}
    none = np.empty((simulated.time.size, 0))
    gradients = {o: np.asarray(run.gradient(o), dtype=float) if wanted else none for o in experiment.outputs}
    if rows is not None:
        gradients = {o: g[rows] for o, g in gradients.items()}
        if derivatives:
            column = len(sensitivities) + list(nuisance).index(TIME_SHIFT)
            before = experiment.time - nuisance[TIME_SHIFT] < experiment.time[0]
            slopes = {
                o: np.where(before, 0.0, -_slope(simulated.time, y, experiment)[rows]) for o, y in outputs.items()
            }
            gradients = {o: np.insert(g, column, slopes[o], axis=1) for o, g in gradients.items()}
        outputs = {o: y[rows] for o, y in outputs.items()}
    for output, y in outputs.items():
        if not (np.isfinite(y).all() and (not derivatives or np.isfinite(gradients[output]).all())):
            raise SimulationError(
                f"output '{output}' or its sensitivity is not finite",
                where=f"experiment '{experiment.name}'",
                hint="a root, power or logarithm whose argument reaches 0 has an infinite slope there: keep it off 0, as "
                "sqrt(max(x, 1e-6)); or narrower bounds",
            )
    return Observation(outputs, gradients)


def _with_nuisances(
    simulator: Simulator, experiment: Experiment, nuisance: Mapping[str, float]
) -> tuple[Experiment, dict[str, float], NDArray[np.intp] | None]:
    """Return the experiment to simulate, the parameters it has of its own, and with a late clock each row's instant.

    The instants begin where the record begins. The outputs keep their names, for they decide what is computed.
    """
    own = {n: v for n, v in nuisance.items() if n in simulator.parameters}
    starts = {n: v for n, v in nuisance.items() if n in states_of(simulator) and n not in own}
    offsets = {n: v for n, v in nuisance.items() if n != TIME_SHIFT and n not in own and n not in starts}
    simulated, time, rows = experiment, experiment.time, None
    if TIME_SHIFT in nuisance:
        rows = np.arange(time.size)
        if nuisance[TIME_SHIFT] != 0.0:
            moved = time - nuisance[TIME_SHIFT]
            later = moved > time[0]
            rows = np.where(later, np.cumsum(later), 0)
            grid, names = np.concatenate([time[:1], moved[later]]), experiment.outputs
            blank = Trajectory(grid, np.zeros((grid.size, len(names))), names) if names else None
            simulated = experiment.with_(time=grid, measured=blank)
    if starts:
        simulated = simulated.with_(starts=simulated.starts | starts)
    if offsets:
        total = {n: simulated.offsets.get(n, 0.0) + v for n, v in offsets.items()}
        simulated = simulated.with_(offsets=simulated.offsets | total)
    return simulated, own, rows


def _slope(time: Array, y: Array, experiment: Experiment) -> Array:
    """Return dy/dt at every instant from its neighbours, never across a jump or a corner of an input."""
    breaks = np.concatenate([np.empty(0), *(signal.breaks for signal in experiment.inputs.values())])
    piece = np.searchsorted(np.unique(breaks), time, side="right")
    cut = (np.diff(piece) != 0) | (np.diff(time) == 0)
    slope = np.zeros_like(y)
    for part in np.split(np.arange(time.size), np.flatnonzero(cut) + 1):
        if part.size > 1:
            slope[part] = np.gradient(y[part], time[part], edge_order=2 if part.size > 2 else 1)
    return slope
