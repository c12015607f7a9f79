"""FMUs exported for the tests, driven by FMPy's bindings: an importer that shares no code with the export."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from ctypes import c_double
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from fmpy import extract, read_model_description
from fmpy.fmi2 import FMU2Model, FMU2Slave
from fmpy.fmi3 import FMU3Model, FMU3Slave

from hvdc_ident.data import InputSignal
from hvdc_ident.fmu.export import export_fmu
from hvdc_ident.model import Model


@dataclass(frozen=True, eq=False)
class Exported:
    """An FMU on the disk, unpacked."""

    model: Model
    path: Path
    folder: str
    description: Any

    def reference(self, name: str) -> int:
        """The value reference of a variable."""
        return next(v.valueReference for v in self.description.modelVariables if v.name == name)

    def references(self, names: Sequence[str]) -> list[int]:
        """The value references of variables."""
        return [self.reference(n) for n in names]

    @property
    def second(self) -> bool:
        """Whether it is of FMI 2.0."""
        return str(self.description.fmiVersion) == "2.0"

    @contextmanager
    def instance(self, cosimulation: bool) -> Iterator[Run]:
        """An instance before its initialisation, freed at the end."""
        kinds = (FMU2Model, FMU2Slave) if self.second else (FMU3Model, FMU3Slave)
        kind = self.description.coSimulation if cosimulation else self.description.modelExchange
        made: Any = kinds[cosimulation](
            guid=self.description.guid,
            unzipDirectory=self.folder,
            modelIdentifier=kind.modelIdentifier,
            instanceName="test",
        )
        try:
            made.instantiate()
        except Exception:
            made.freeLibrary()
            raise
        try:
            yield Run(self, made)
        finally:
            made.freeInstance()


def exported(model: Model, path: Path, version: str = "2.0", **options: Any) -> Exported:
    """The model as an FMU at the path, unpacked beside it."""
    export_fmu(model, path, version=version, **options)
    return Exported(model, path, extract(str(path), str(path.with_suffix(""))), read_model_description(str(path)))


@dataclass(eq=False)
class Run:
    """An instance with the same methods for both versions of the standard."""

    fmu: Exported
    raw: Any

    def get(self, names: Sequence[str]) -> np.ndarray:
        """(names,) values."""
        refs = self.fmu.references(names)
        return np.array(self.raw.getReal(refs) if self.fmu.second else self.raw.getFloat64(refs))

    def set(self, values: dict[str, float]) -> None:
        """Set the variables to the values."""
        refs = self.fmu.references(list(values))
        (self.raw.setReal if self.fmu.second else self.raw.setFloat64)(refs, list(values.values()))

    def enter(self, start: float = 0.0, stop: float | None = None, tolerance: float | None = None) -> None:
        """Enter initialisation mode."""
        if self.fmu.second:
            self.raw.setupExperiment(tolerance=tolerance, startTime=start, stopTime=stop)
            self.raw.enterInitializationMode()
        else:
            self.raw.enterInitializationMode(tolerance=tolerance, startTime=start, stopTime=stop)

    def settle(self) -> float | None:
        """The next time event; the discrete part is at rest, in event mode."""
        done = self.raw.newDiscreteStates() if self.fmu.second else self.raw.updateDiscreteStates()
        assert done[0] is False and done[1] is False
        return float(done[5]) if done[4] else None

    def states(self, values: Sequence[float] | None = None) -> np.ndarray:
        """(states,) after they were set, where values are given."""
        n = len(self.fmu.model.states)
        buffer = (c_double * n)(*(values if values is not None else [0.0] * n))
        (self.raw.getContinuousStates if values is None else self.raw.setContinuousStates)(buffer, n)
        return np.array(buffer)

    def rates(self) -> np.ndarray:
        """(states,) derivatives in time."""
        n = len(self.fmu.model.states)
        buffer = (c_double * n)()
        (self.raw.getDerivatives if self.fmu.second else self.raw.getContinuousStateDerivatives)(buffer, n)
        return np.array(buffer)

    def derivative(self, unknowns: Sequence[str], known: str) -> np.ndarray:
        """(unknowns,) partial derivatives by one variable."""
        refs, by = self.fmu.references(unknowns), [self.fmu.reference(known)]
        return np.array(self.raw.getDirectionalDerivative(refs, by, [1.0]))

    def jacobian(self, unknowns: Sequence[str], knowns: Sequence[str]) -> np.ndarray:
        """(unknowns, knowns)."""
        return np.column_stack([self.derivative(unknowns, k) for k in knowns])

    def copy(self) -> Any:
        """A copy of the state."""
        return self.raw.getFMUstate() if self.fmu.second else self.raw.getFMUState()

    def restore(self, state: Any) -> None:
        """Bring the state back to that when copied."""
        (self.raw.setFMUstate if self.fmu.second else self.raw.setFMUState)(state)

    def step(self, t: float, h: float) -> None:
        """Do a communication step."""
        self.raw.doStep(currentCommunicationPoint=t, communicationStepSize=h)


def state_names(fmu: Exported) -> list[str]:
    """The names of the state variables, in order."""
    return [u.variable.derivative.name for u in fmu.description.derivatives]


def rate_names(fmu: Exported) -> list[str]:
    """The names of the derivatives, in order."""
    return [u.variable.name for u in fmu.description.derivatives]


def cosimulate(
    fmu: Exported,
    time: np.ndarray,
    inputs: dict[str, InputSignal],
    outputs: Sequence[str],
    values: dict[str, float] | None = None,
    tolerance: float | None = None,
) -> np.ndarray:
    """(n, outputs) of a co-simulation with communication points at the rows and at every break of an input.

    FMI 2.0 gets the inputs' slopes; FMI 3.0 has none, so inputs have to be steps there. Rows are after a jump.
    """
    with fmu.instance(True) as run:
        run.set({n: float(s(np.nextafter(time[0], -np.inf))) for n, s in inputs.items()} | (values or {}))
        run.enter(float(time[0]), float(time[-1]), tolerance)
        run.raw.exitInitializationMode()
        breaks = [b for s in inputs.values() for b in s.breaks if time[0] < b < time[-1]]
        stops = np.unique(np.concatenate([time, breaks]))
        rows = {float(stops[0]): run.get(outputs)}
        refs = fmu.references(list(inputs))
        for a, b in pairwise(stops):
            if inputs:
                run.set({n: float(s(a)) for n, s in inputs.items()})
                if fmu.second:
                    slopes = [float(s(np.nextafter(b, a)) - s(a)) / (b - a) for s in inputs.values()]
                    run.raw.setRealInputDerivatives(refs, [1] * len(refs), slopes)
            run.step(float(a), float(b - a))
            run.set({n: float(s(b)) for n, s in inputs.items()})
            rows[float(b)] = run.get(outputs)
        return np.array([rows[float(t)] for t in time])
