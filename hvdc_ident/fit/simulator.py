"""What a fit needs of a model: parameters with bounds, and runs with sensitivities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

from hvdc_ident.data import Array, Experiment, Trajectory
from hvdc_ident.parameters import Input, Parameter
from hvdc_ident.sensitivity import SENSITIVITY_ERROR


class SimulationRun(Protocol):
    """One run: the outputs and, where asked for, their derivatives by parameters."""

    @property
    def trajectory(self) -> Trajectory:
        """Every output of the model at the experiment's instants."""

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters whose derivatives were asked for, in that order."""

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
        """A run of the experiment; parameters not in `values` keep their own.

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
        """The relative error of a sensitivity column, by its own account: below it a rank cannot be told."""


def sensitivity_error(simulator: Simulator) -> float:
    """The relative error of the simulator's sensitivities; what the engine's own have where it does not say."""
    wrapped = (simulator, getattr(simulator, "model", None))  # a model that runs itself may say it for its simulator
    own = [float(s.sensitivity_error) for s in wrapped if isinstance(s, Approximate)]
    return max([*own, SENSITIVITY_ERROR])


def approximate(simulator: Simulator) -> bool:
    """Return whether the simulator says that its sensitivities are differences: runs of it may jump between values."""
    return any(isinstance(s, Approximate) for s in (simulator, getattr(simulator, "model", None)))


def inputs_of(simulator: Simulator, experiments: Sequence[Experiment]) -> dict[str, Input]:
    """The simulator's inputs; of one that does not name them, those of the experiments, as they began."""
    if isinstance(simulator, WithInputs):
        return dict(simulator.inputs)
    found: dict[str, Input] = {}
    for e in experiments:
        for name, signal in e.inputs.items():
            if name not in e.drive:
                found.setdefault(name, Input(float(signal.values[0])))
    return found
