"""Runs of experiments on a model, with what an experiment changes of it.

An experiment may drive insertion points by recorded columns, see outputs through instruments, add an unknown constant to
an input, and begin a state away from the steady state.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np

from hvdc_ident.data import Array, Experiment, InputSignal, Trajectory
from hvdc_ident.errors import (
    ModelError,
    SimulationError,
    SteadyStartError,
    SteadyStateError,
    TimingError,
    require_known,
)
from hvdc_ident.expression import symbol
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel, Model, ModelOrigin, State, fresh, is_white_box, rewritten
from hvdc_ident.parameters import Input, Parameter
from hvdc_ident.simulate.engine import Method, Tolerance
from hvdc_ident.simulate.short_delays import DelayedRuns
from hvdc_ident.simulate.simulation import Simulation

if TYPE_CHECKING:
    from hvdc_ident.effects import EffectUse


def with_recording(model: Model, experiment: Experiment) -> Model:
    """Return the model with the experiment's driven insertion points as inputs and its recording chains on the outputs."""
    if not experiment.drive and not experiment.instrument:
        return model
    return _with_recording(model, experiment.drive, experiment.instrument)


@lru_cache(maxsize=32)
def _with_recording(model: Model, drive: tuple[str, ...], instrument: FrozenMap[FrozenMap[float]]) -> Model:
    driven = model.driven(drive)
    if not instrument:
        return driven
    from hvdc_ident.effects import apply_effects  # only runs that see instruments load the effects

    return apply_effects(driven, chains_of(instrument))


def chains_of(instrument: FrozenMap[FrozenMap[float]]) -> list[EffectUse]:
    """Return the recording chains as effects at the outputs, in the order in which an instrument acts on the signal."""
    from hvdc_ident.effects import EffectUse

    chains = []
    for output, chain in instrument.items():
        for name in ("window-mean", "delay"):
            if chain.get(name):
                chains.append(EffectUse(name, (f"outputs.{output}",), FrozenMap({"T": chain[name]})))
    return chains


@lru_cache(maxsize=32)
def _with_offsets_and_starts(model: Model, names: tuple[str, ...]) -> tuple[Model, FrozenMap[str]]:
    """Return the model with an experiment's offsets and starts as parameters, and the parameter of each name.

    names: inputs, to which a constant is added all along, the steady start included (0 unless given); states, which
    begin at a value instead of at rest. A state that the model calls free has its parameter already.
    """
    by_name = {n: f"{n}_start" for n in names if n in model.states}
    begun = {n: model.states[n] for n in by_name if model.states[n].start != "free"}
    if begun:
        starts = {
            by_name[n]: Parameter(x.guess or 0.0, x.unit, description=f"{n} at the start") for n, x in begun.items()
        }
        free = {n: replace(x, start="free") for n, x in begun.items()}
        model = replace(model, states=model.states | free, parameters=model.parameters | starts)
    for name in names:
        if name in by_name:
            continue
        by_name[name] = offset = fresh(model, f"{name}_offset")
        constant = Parameter(0.0, model.inputs[name].unit, description=f"constant added to {name}")
        model = replace(model, parameters=model.parameters | {offset: constant})
        model = rewritten(model, name, "offset", lambda m, u, offset=offset: (m, u + symbol(offset)))  # type: ignore[misc]
    return model, FrozenMap(by_name)


@dataclass(frozen=True, eq=False)
class ModelSimulator:
    """Model as a simulator: parameters, and runs with exact sensitivities. It can be sent to other processes.

    tolerance: of every run (default: the engine's own). method: of every run; where the engine chooses it, by the first run of a
    structure in a process, the last digits of a result depend on what was run before.
    """

    model: AnyModel
    tolerance: Tolerance | None = None
    method: Method = "auto"

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
        return self.model.states if is_white_box(self.model) else {}

    def simulate(
        self, experiment: Experiment, values: Mapping[str, float], sensitivities: Sequence[str] = ()
    ) -> Simulation:
        """Return a run of the experiment.

        Raises SimulationError; values without a steady state (SteadyStartError), or with a negative delay, are a run that failed.
        """
        try:
            return simulate(
                self.model, experiment, values, sensitivities,
                outputs=experiment.outputs or None, tolerance=self.tolerance, method=self.method,
            )  # fmt: skip
        except (SteadyStateError, TimingError) as e:
            kind = SteadyStartError if isinstance(e, SteadyStateError) else SimulationError
            raise kind(e.what, where=e.where, expected=e.expected, got=e.got, hint=e.hint) from None


@lru_cache(maxsize=256)
def _constant(value: float) -> InputSignal:
    return InputSignal.constant(value)


def simulate(
    model: AnyModel,
    experiment: Experiment,
    values: Mapping[str, float] | None = None,
    sensitivities: Sequence[str] = (),
    *,
    outputs: Sequence[str] | None = None,
    tolerance: Tolerance | None = None,
    rtol: float | None = None,
    method: Method = "auto",
    partial: bool = False,
) -> Simulation:
    """Return the model's outputs at the experiment's times and, exactly, their derivatives by the named parameters.

    values: parameters (and constant inputs) that differ from the model's. outputs: names of outputs or signals (default:
    all outputs). The start is the steady state of the inputs' first values unless a state says otherwise; it depends on
    the parameters, and so do the sensitivities at the start. rtol: shorthand for a Tolerance with atol = rtol / 100.
    The name of an input among the sensitivities asks for the derivative by a constant added to that input all along,
    that of a state for the derivative by its start, which is then no longer the steady one.
    A model that is external (an FMU) runs itself, from its own start; `method` is then its own. It may ask for the end
    of its run: partial gives the rows up to there, with status "ended" and the instant in the notes; else that has failed.

    Raises SteadyStateError where there is no steady start, SimulationError where the run does not reach its end.
    """
    tol = tolerance or (Tolerance() if rtol is None else Tolerance(rtol, rtol / 100))
    if not is_white_box(model):
        chosen = tuple(model.outputs) if outputs is None else outputs
        ending = {"partial": True} if partial else {}
        own: Simulation = model.simulate(experiment, values, sensitivities, outputs=chosen, tolerance=tol, **ending)
        return own
    seen = None if outputs is None else tuple(outputs)
    return _prepared(model, model.origin, experiment, tuple(sensitivities), seen, tol, method).run(values or {})


@dataclass(frozen=True, eq=False)
class _Prepared:
    """Runs of an experiment on a model that differ by values alone: what does not hang on these is worked out once.

    plant: the model with what the experiment changes of it. known: names that values may have. p: the parameters' values but for those
    of a run, which stand at `places`. levels: values of the inputs that no signal drives. parameters: those of the sensitivities.
    """

    model: Model
    experiment: Experiment
    plant: Model
    known: tuple[str, ...]
    places: Mapping[str, int]
    p: Array
    levels: Mapping[str, float]
    sensitivities: tuple[str, ...]
    parameters: tuple[str, ...]
    outputs: tuple[str, ...]
    tolerance: Tolerance
    method: Method

    def run(self, values: Mapping[str, float]) -> Simulation:
        """Return the run with these values of parameters and constant inputs."""
        places, p, where = self.places, self.p.copy(), f"experiment '{self.experiment.name}'"
        beside = False
        for name, value in values.items():
            place = places.get(name)
            if place is not None:
                p[place] = value
            else:
                beside = True
        runs = self._runs(values) if beside else self._own
        if not np.isfinite(p).all():
            bad = next(n for n, v in zip(self.plant.parameters, p, strict=True) if not math.isfinite(v))
            raise ModelError(
                f"the value of parameter '{bad}' is not finite",
                where=f"model '{self.model.name}'",
                hint="an effect at an infinite neutral value is left out: do not set it",
            )
        try:
            answer = runs.run(p)
        except (SimulationError, SteadyStateError) as e:
            raise e.at(where) from None
        trajectory = Trajectory(self.experiment.time, answer.values, self.outputs, self._units)
        return Simulation(trajectory, self.sensitivities, answer.slopes, answer.statistics)

    @cached_property
    def _own(self) -> DelayedRuns:
        """The runs with inputs as the experiment has them."""
        return self._runs({})

    def _runs(self, values: Mapping[str, float]) -> DelayedRuns:
        """Return the runs with constant inputs at these values."""
        require_known("parameter or input", values, self.known, f"experiment '{self.experiment.name}'")
        levels = {n: float(values.get(n, v)) for n, v in self.levels.items()}
        signals = tuple(self.experiment.inputs.get(n) or _constant(levels[n]) for n in self.plant.inputs)
        return DelayedRuns(
            self.plant, self.parameters, self.outputs, signals, self.experiment.time, self.tolerance, self.method
        )

    @cached_property
    def _units(self) -> tuple[str, ...]:
        known = self.plant.outputs
        return tuple(known[n].unit if n in known else "" for n in self.outputs)


# A screen goes back and forth between the experiments of a study; a model's origin, which tells its steady state, is no part of its
# equality.
@lru_cache(maxsize=32)
def _prepared(
    model: Model,
    origin: ModelOrigin | None,
    experiment: Experiment,
    sensitivities: tuple[str, ...],
    outputs: tuple[str, ...] | None,
    tolerance: Tolerance,
    method: Method,
) -> _Prepared:
    plant, where = with_recording(model, experiment), f"experiment '{experiment.name}'"
    known = (*plant.parameters, *plant.inputs)
    require_known("parameter or input", (*experiment.values, *experiment.inputs), known, where)
    require_known("input", experiment.offsets, plant.inputs, where)
    require_known("state", experiment.starts, plant.states, where)
    shifts = {**experiment.offsets, **experiment.starts}
    names = tuple(n for n in (*plant.inputs, *plant.states) if n in shifts or n in sensitivities)
    plant, parameter = _with_offsets_and_starts(plant, names) if names else (plant, FrozenMap())
    stated = {parameter[n]: v for n, v in shifts.items()}
    given = {**experiment.values, **stated}
    p = np.array([float(given.get(n, q.value)) for n, q in plant.parameters.items()])
    return _Prepared(
        model, experiment, plant, known,
        {n: k for k, n in enumerate(plant.parameters) if n in known and n not in stated},
        p,
        {n: float(given.get(n, i.value)) for n, i in plant.inputs.items() if n not in experiment.inputs},
        sensitivities,
        tuple(parameter.get(n, n) for n in sensitivities),
        tuple(plant.outputs) if outputs is None else outputs,
        tolerance, method,
    )  # fmt: skip
