"""What a fit needs of a model: parameters with bounds, and runs with sensitivities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from hvdc_ident.experiment import Experiment
from hvdc_ident.parameters import Parameter
from hvdc_ident.trajectory import Array, Trajectory


class Simulation(Protocol):
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
    ) -> Simulation:
        """A run of the experiment; parameters not in `values` keep their own.

        Raises SimulationError where it fails, SteadyStateError where it cannot begin.
        """
