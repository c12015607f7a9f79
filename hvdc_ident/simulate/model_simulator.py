"""A model as the thing a fit can run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from hvdc_ident.data import Experiment
from hvdc_ident.errors import SimulationError, SteadyStateError
from hvdc_ident.model import AnyModel, Model, State
from hvdc_ident.parameters import Input, Parameter
from hvdc_ident.simulate.engine import Tolerance, simulate
from hvdc_ident.simulate.result import Simulation


@dataclass(frozen=True, eq=False)
class ModelSimulator:
    """The model with its engine: parameters, and runs with sensitivities. It travels to other processes.

    tolerance: of every run (default: the engine's own).
    """

    model: AnyModel
    tolerance: Tolerance | None = None

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        """The model's parameters by name."""
        return self.model.parameters

    @property
    def inputs(self) -> Mapping[str, Input]:
        """The model's inputs by name; each may stand among the sensitivities, for a constant added to it."""
        return self.model.inputs

    @property
    def states(self) -> Mapping[str, State]:
        """The states by name; each may stand among the sensitivities, for its start. An FMU shows none."""
        return self.model.states if isinstance(self.model, Model) else {}

    def simulate(
        self, experiment: Experiment, values: Mapping[str, float], sensitivities: Sequence[str] = ()
    ) -> Simulation:
        """A run of the experiment. Raises SimulationError; values without a steady state are a run that failed."""
        try:
            return simulate(
                self.model, experiment, values, sensitivities,
                outputs=experiment.outputs or None, tolerance=self.tolerance,
            )  # fmt: skip
        except SteadyStateError as e:
            raise SimulationError(e.what, where=e.where, expected=e.expected, got=e.got, hint=e.hint) from None
