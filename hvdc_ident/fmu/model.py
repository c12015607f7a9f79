"""An FMU as a model: parameters, inputs, outputs and runs; with model exchange its equations too.

Load only FMUs you trust: their machine code runs on this computer. It runs in a process of its own, which contains
crashes, hangs and leaks, not malice.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.data import Experiment
from hvdc_ident.effects import EffectUse
from hvdc_ident.errors import ModelError, unknown_name
from hvdc_ident.files import digest
from hvdc_ident.fmu.description import Description, Interface, Variable, read_description
from hvdc_ident.fmu.worker_pool import Limits, WorkerPool
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Output
from hvdc_ident.next_step import NextStep
from hvdc_ident.parameters import Input, Parameter, with_values
from hvdc_ident.simulate import Simulation, Tolerance

if TYPE_CHECKING:
    from hvdc_ident.fmu.capabilities import Capabilities


@dataclass(frozen=True)
class FmuState:
    """A continuous state of an FMU. nominal: its typical size."""

    unit: str = ""
    description: str = ""
    nominal: float = 1.0


@dataclass(frozen=True, eq=False)
class FmuModel:
    """An FMU with its parameters' and inputs' values, and effects at its inputs and outputs.

    The start of a run is what the FMU's own initialisation gives for the inputs' first values.
    outputs: what the FMU declares as such (its states where it declares none), and what `recording` added.
    pool: its workers, shared by all models made from this one. effects: in the order they were put on.
    """

    name: str
    pool: WorkerPool
    parameters: FrozenMap[Parameter]
    inputs: FrozenMap[Input]
    outputs: FrozenMap[Output]
    states: FrozenMap[FmuState]
    effects: tuple[EffectUse, ...] = ()
    description: str = ""
    source: str = ""
    signals: FrozenMap[Any] = field(default_factory=FrozenMap)
    algebraic: FrozenMap[Any] = field(default_factory=FrozenMap)

    @property
    def fmu(self) -> Description:
        """The FMU's own description."""
        return self.pool.description

    @property
    def capabilities(self) -> Capabilities:
        """Return what the FMU says of itself and what short runs of it show; `print` gives a screen of it."""
        from hvdc_ident.fmu.capabilities import tested_capabilities

        return tested_capabilities(self)

    @property
    def has_equations(self) -> bool:
        """True for model exchange, whose derivatives can be asked for."""
        return self.fmu.interface == "model-exchange"

    @cached_property
    def insertion_points(self) -> tuple[str, ...]:
        """Names at which an effect may sit: inputs, and outputs as "outputs.NAME" where an input has the name."""
        return (*self.inputs, *(o if o not in self.inputs else f"outputs.{o}" for o in self.outputs))

    @property
    def values(self) -> dict[str, float]:
        """The parameters' values by name."""
        return {n: p.value for n, p in self.parameters.items()}

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Parameters, inputs and states."""
        return (*self.parameters, *self.inputs, *self.states)

    @cached_property
    def text(self) -> str:
        """Text that differs where the file, the values or the effects do."""
        inputs = {n: i.value for n, i in self.inputs.items()}
        recorded = tuple(self.outputs)
        return "\n".join(
            map(repr, (self.name, self.source, self.fmu.interface, self.values, inputs, recorded, self.effects))
        )

    @property
    def sensitivity_error(self) -> float:
        """The largest relative error of a derivative so far, where they were differences; 0 where none was."""
        return self.pool.sensitivity_error

    def with_values(self, values: Mapping[str, float]) -> FmuModel:
        """Return the model with other parameter or input values. Raises UnknownNameError, or ModelError outside the bounds."""
        parameters, inputs = with_values(self.parameters, self.inputs, values, self._unknown)
        return replace(self, parameters=parameters, inputs=inputs)

    def _unknown(self, name: str) -> Exception:
        for kind in (self.fmu.parameters, self.fmu.inputs):
            for v in kind.values():
                if name in v.also:
                    return ModelError(
                        f"'{name}' is another name of '{v.name}'", where=f"model '{self.name}'", expected=f"'{v.name}'"
                    )
        known = [*self.parameters, *self.inputs]
        return unknown_name("parameter or input", name, known, where=f"model '{self.name}'", listing=self._listing)

    def recording(self, names: Iterable[str]) -> FmuModel:
        """Return the model with these variables among its outputs: any number of the FMU that changes in a run.

        Raises UnknownNameError for what is no variable, ModelError for a parameter or an array.
        """
        new = {n: self._recorded(n) for n in names if n not in self.outputs}
        return replace(self, outputs=self.outputs | new) if new else self

    def records(self, name: str) -> bool:
        """Return whether `recording` takes the name."""
        return name in self.outputs or (name in self.fmu.variables and self.fmu.variables[name].recordable)

    def _recorded(self, name: str) -> Output:
        fmu, where = self.fmu, f"model '{self.name}'"
        variable = fmu.variables.get(name) or fmu.states.get(name)
        if variable is not None and variable.recordable:
            return _output(variable)
        if variable is not None:
            raise ModelError(
                f"'{name}' is a parameter, which stays where it is put", where=where, expected="a variable to record"
            )
        if name in fmu.arrays:
            raise ModelError(
                f"'{name}' is an array of {fmu.arrays[name]}, and arrays are not recorded",
                where=where,
                expected="a scalar variable",
                hint="export its elements as scalars, or take an output of the FMU that is one",
            )
        known = dict.fromkeys((*self.outputs, *(n for n, v in fmu.variables.items() if v.recordable)))
        raise unknown_name("output", name, known, where=where, listing=self._listing)

    @property
    def _listing(self) -> NextStep:
        """The step that lists the FMU's variables."""
        return NextStep("find", self.fmu.path.name)

    def with_effects(self, effects: Iterable[Any]) -> FmuModel:
        """Return the model with effects at its inputs and outputs, one after the other; neutral ones change nothing."""
        from hvdc_ident.fmu.terminal_effects import with_effects

        return with_effects(self, effects)

    def driven(self, points: Iterable[str]) -> FmuModel:
        """Return the model itself where only inputs are driven. Raises ModelError for any other insertion point."""
        for name in points:
            if name not in self.inputs:
                raise ModelError(
                    f"'{name}' cannot be driven", where=f"model '{self.name}'", expected="an input: an FMU is closed"
                )
        return self

    def parameterised(self, name: str) -> FmuModel:
        """Raise UnknownNameError: an FMU has one parameterisation."""
        raise unknown_name("parameterisation", name, (), where=f"model '{self.name}'")

    def simulate(
        self,
        experiment: Experiment,
        values: Mapping[str, float] | None = None,
        sensitivities: Sequence[str] = (),
        *,
        outputs: Sequence[str] | None = None,
        tolerance: Tolerance | None = None,
        partial: bool = False,
    ) -> Simulation:
        """Return a run of the experiment in the FMU's worker.

        values: parameters, and inputs that stay constant, where they differ from the model's. outputs: names of any
        variables that change; default, what the experiment measured, else all outputs. notes: how derivatives were had
        and, where by differences, their relative error. partial: whether a run that the FMU ends is given with the rows
        up to there (status "ended", the instant in the notes), without sensitivities and effects; else it has failed.

        Raises UnknownNameError for names it has not, SimulationError where the run fails.
        """
        from hvdc_ident.fmu.terminal_effects import simulate

        chosen = outputs if outputs is not None else (experiment.outputs or None)
        return simulate(self, experiment, values or {}, tuple(sensitivities), chosen, tolerance or Tolerance(), partial)

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in self.__dict__.items() if k in self.__dataclass_fields__}


def read_fmu(
    source: str | Path,
    *,
    interface: Interface | None = None,
    limits: Limits | Mapping[str, float] | None = None,
) -> FmuModel:
    """Return the model of an FMU, 2.0 or 3.0. Load only FMUs you trust.

    interface: model exchange where the FMU offers both and none is asked for. limits: `Limits`, or by the keys
    of a study, {"deadline": 300.0, "load": 60.0, "memory": 4096}: s for one run, s to begin, and MiB.
    The archive is checked before anything is unpacked; nothing of it is run before it is needed. Raises ModelError
    where it cannot be used, SimulationError where it has to be run (a parameter without start) and fails.
    """
    path = Path(source)
    if not path.is_file():
        raise ModelError("the model file is not there", where=str(path))
    described = read_description(path.resolve(), interface)
    pool = WorkerPool(described, Limits.of(limits))
    if any(v.start is None for v in described.parameters.values()):
        inputs = np.array([[v.start or 0.0 for v in described.inputs.values()]])
        request = {"do": "initial", "values": [{}], "time": 0.0, "tolerance": None}
        starts = pool.ask(request, {"u": inputs})[1]["parameters"][0].tolist()
        pool.rest()  # the next worker gets the starts
        parameters = {
            n: v if v.start is not None else replace(v, start=start)
            for (n, v), start in zip(described.parameters.items(), starts, strict=True)
        }
        pool.description = described = replace(described, parameters=FrozenMap(parameters))
    return FmuModel(
        name=described.name,
        pool=pool,
        parameters=FrozenMap({n: _parameter(v) for n, v in described.parameters.items()}),
        inputs=FrozenMap({n: Input(v.start or 0.0, v.unit, v.description) for n, v in described.inputs.items()}),
        outputs=FrozenMap({n: _output(described.variable(n)) for n in described.shown}),
        states=FrozenMap({n: FmuState(v.unit, v.description, v.nominal) for n, v in described.states.items()}),
        description=described.text,
        source=digest(path.read_bytes()),
    )


def _parameter(v: Variable) -> Parameter:
    """Return a variable as a parameter, without bounds where its own start lies outside them."""
    start = float(v.start or 0.0)
    low, high = (v.min, v.max) if v.min <= start <= v.max else (-np.inf, np.inf)
    text = v.description + (f" (also {', '.join(v.also)})" if v.also else "")
    return Parameter(start, v.unit, low, high, scale=v.nominal if start == 0.0 else 0.0, description=text.strip())


def _output(v: Variable) -> Output:
    import sympy as sp

    return Output(sp.S.Zero, v.unit, v.description)
