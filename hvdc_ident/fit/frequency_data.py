"""Measured frequency responses beside recordings: experiments in the frequency domain, answered by the linear model.

The real and the imaginary part of each channel are outputs like any other; `WithResponses` is the simulator that gives them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hvdc_ident.data import Array, Experiment, Trajectory
from hvdc_ident.errors import LinearizationError, SimulationError, SteadyStateError, TimingError
from hvdc_ident.fit.simulator import SimulationRun, Simulator
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize import MeasuredResponse
from hvdc_ident.model import AnyModel, State
from hvdc_ident.parameters import Input, Parameter
from hvdc_ident.simulate import ModelSimulator


def frequency_experiment(response: MeasuredResponse) -> Experiment:
    """Return the experiment that a measured response is to a fit: its outputs are real and imaginary parts of each channel.

    Circular noise with standard deviation s of the error's modulus has s/sqrt(2) in each part. Where no standard deviation
    is known it is taken from the misfit, as one share of the modulus at all frequencies of a channel.
    """
    columns: dict[str, Array] = {}
    noise: dict[str, float] = {}
    profile: dict[str, Array] = {}
    for k, label in enumerate(response.labels):
        values = response.values[:, k]
        spread = np.abs(values) if response.std is None else response.std[:, k] / np.sqrt(2.0)
        # A frequency at which the response is 0 would outweigh all others: it counts like the smallest of them.
        spread = np.where(spread > 0, spread, spread[spread > 0].min(initial=np.inf))
        spread = np.where(np.isfinite(spread), spread, 1.0)
        size = float(np.sqrt(np.mean(spread**2)))
        for part, column in (("re", values.real), ("im", values.imag)):
            name = output_name(response, label, part)
            columns[name], profile[name] = column, spread / size
            if response.std is not None:
                noise[name] = size
    measured = Trajectory(
        response.omega / (2 * np.pi),
        np.column_stack([*columns.values()]),
        tuple(columns),
        (response.unit,) * len(columns),
    )
    dof = dict.fromkeys(noise, response.dof) if np.isfinite(response.dof) else {}
    return Experiment(
        measured.time, response.name, measured=measured, noise=FrozenMap(noise), noise_profile=FrozenMap(profile),
        noise_dof=FrozenMap(dof), role=response.role, domain="frequency",
    )  # fmt: skip


def output_name(response: MeasuredResponse, label: str, part: str) -> str:
    """Return the name of a channel's real ("re") or imaginary ("im") part among the outputs of a fit."""
    return f"{response.name}: {part} {label}"


def in_time(experiments: Iterable[Experiment]) -> tuple[Experiment, ...]:
    """Return the experiments that are recordings in time."""
    return tuple(e for e in experiments if e.domain == "time")


@dataclass(frozen=True, eq=False)
class LinearRun:
    """A response at an experiment's frequencies as a fit takes it, with its derivatives."""

    trajectory: Trajectory
    gradients: Array

    def gradient(self, output: str) -> Array:
        """Return the derivatives of one part of one channel, (frequencies, parameters)."""
        return np.asarray(self.gradients[:, self.trajectory.names.index(output)])


@dataclass(frozen=True, eq=False)
class WithResponses:
    """A model's simulator that answers experiments in the frequency domain too, by the linear model at rest.

    responses: by the experiment's name.
    """

    simulator: ModelSimulator
    responses: FrozenMap[MeasuredResponse]

    @property
    def model(self) -> AnyModel:
        """The model that is simulated and linearised."""
        return self.simulator.model

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        """The model's parameters by name."""
        return self.simulator.parameters

    @property
    def inputs(self) -> Mapping[str, Input]:
        """The model's inputs by name."""
        return self.simulator.inputs

    @property
    def states(self) -> Mapping[str, State]:
        """The model's states by name."""
        return self.simulator.states

    def simulate(
        self, experiment: Experiment, values: Mapping[str, float], sensitivities: Sequence[str] = ()
    ) -> SimulationRun:
        """Return a run, or the response at the experiment's frequencies. Raises SimulationError where there is none."""
        if experiment.domain == "time":
            return self.simulator.simulate(experiment, values, sensitivities)
        response = self.responses[experiment.name]
        try:
            answer, slopes = response.of_model(self.model, values, sensitivities)
        except (SteadyStateError, LinearizationError, TimingError) as e:
            where = f"response '{response.name}': {e.where}".removesuffix(": ")
            raise SimulationError(e.what, where=where, expected=e.expected, got=e.got, hint=e.hint) from None
        names = [output_name(response, label, part) for label in response.labels for part in ("re", "im")]
        columns = np.stack([answer.real, answer.imag], axis=2).reshape(len(answer), -1)
        gradients = np.stack([slopes.real, slopes.imag], axis=2).reshape(len(answer), columns.shape[1], -1)
        if not (np.isfinite(columns).all() and np.isfinite(gradients).all()):
            raise SimulationError("the response is not finite", where=f"response '{response.name}'")
        return LinearRun(Trajectory(experiment.time, columns, tuple(names)), gradients)


def with_responses(
    model: AnyModel, experiments: Iterable[Experiment], responses: Iterable[MeasuredResponse]
) -> tuple[Simulator, tuple[Experiment, ...]]:
    """Return the simulator and the experiments of a fit to recordings and measured responses together."""
    measured = tuple(responses)
    simulator = ModelSimulator(model)
    if not measured:
        return simulator, tuple(experiments)
    whole = WithResponses(simulator, FrozenMap({r.name: r for r in measured}))
    return whole, (*experiments, *(frequency_experiment(r) for r in measured))
