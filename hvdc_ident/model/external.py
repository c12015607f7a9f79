"""A model whose equations are elsewhere: it runs itself, and the verbs ask it instead of compiling it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Protocol, TypeAlias

from hvdc_ident.experiment import Experiment
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.model.definition import Model, Output
from hvdc_ident.parameters import Input, Parameter


class External(Protocol):
    """An FMU, or anything else with a model's names that can be run. Slots are its inputs and outputs."""

    @property
    def name(self) -> str:
        """Name of the model."""

    @property
    def parameters(self) -> FrozenMap[Parameter]:
        """The parameters by name, with start values, units and bounds."""

    @property
    def inputs(self) -> FrozenMap[Input]:
        """The inputs by name."""

    @property
    def outputs(self) -> FrozenMap[Output]:
        """Outputs by name, with units; their expressions have no meaning."""

    @property
    def states(self) -> FrozenMap[Any]:
        """The states by name, with units; none where it does not show them."""

    @property
    def signals(self) -> FrozenMap[Any]:
        """None: it is closed."""

    @property
    def algebraic(self) -> FrozenMap[Any]:
        """None: it is closed."""

    @property
    def slots(self) -> tuple[str, ...]:
        """Names at which an effect may sit."""

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters, inputs and states."""

    @property
    def values(self) -> dict[str, float]:
        """The parameters' values by name."""

    @property
    def text(self) -> str:
        """Text that differs where the model or a value does."""

    def with_values(self, values: Mapping[str, float]) -> External:
        """The model with other parameter or input values."""

    def recording(self, names: Iterable[str]) -> External:
        """Return the model with these variables among its outputs. Raises InputError for what it cannot record."""

    def records(self, name: str) -> bool:
        """Return whether `recording` takes the name."""

    def with_effects(self, effects: Iterable[Any]) -> External:
        """The model with effects at its slots."""

    def driven(self, slots: Iterable[str]) -> External:
        """The model in which the slots follow a recorded column."""

    def parameterised(self, name: str) -> External:
        """The model in another parameterisation."""

    def simulate(
        self,
        experiment: Experiment,
        values: Mapping[str, float] | None = None,
        sensitivities: Sequence[str] = (),
        *,
        outputs: Sequence[str] | None = None,
        tolerance: Any = None,
        partial: bool = False,
    ) -> Any:
        """A run: a `hvdc_ident.simulate.Simulation`."""


AnyModel: TypeAlias = Model | External


def recording(model: AnyModel, names: Iterable[str]) -> AnyModel:
    """Return the model with the names among its outputs; equations have what they declare, and stay as they are."""
    return model if isinstance(model, Model) else model.recording(names)
