"""Result of a simulation, and the statuses with which a run ends."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.codec import Coded, read_fields
from hvdc_ident.data import Array, Trajectory
from hvdc_ident.data.signal_table import SignalTable
from hvdc_ident.display import Shown, Table
from hvdc_ident.errors import require_known
from hvdc_ident.immutable import FrozenMap

if TYPE_CHECKING:
    import xarray


HINTS = {
    "step-limit": "look for a very fast part of the model, or for a jump (`where`) that the state's own derivative turns back: "
    "give it a width, as clip((a - b)/width, 0, 1); from Python, Tolerance(max_steps=..., rtol=...)",
    "not-finite": "a value grew without bound or left a function's domain: check parameter values and limits",
    "chatter": "a limit switches on and off without end: add a hysteresis or a small lag where it acts",
    "inconsistent": "no solution of the algebraic loop was found there: check the operating point, or give the unknown another start",
    "two-slides": "two limits are held at once, each by its own reaction, which is not simulated: give one of them a hysteresis or a "
    "small lag where it acts",
    "stiff": "use the Rosenbrock method",
}


@dataclass(frozen=True)
class Statistics:
    """Statistics of a run: its status, the method, and counts of steps, switches, evaluations and segments between breaks.

    forced: very short steps taken past an instant of infinite slope, where the tolerance cannot be met.
    """

    status: str
    method: str
    accepted: int
    rejected: int
    events: int
    evaluations: int
    segments: int
    forced: int


@dataclass(frozen=True, eq=False)
class _Beside:
    """What the JSON of a simulation has beside its outputs."""

    sensitivities: Mapping[str, Mapping[str, Array]]
    statistics: Statistics


@dataclass(frozen=True, eq=False, repr=False)
class Simulation(SignalTable, Coded, Shown):
    """Simulated outputs and their exact derivatives.

    trajectory: the outputs at the experiment's times. parameters: names of the sensitivity parameters.
    gradients: (n_time, n_outputs, n_parameters), in output unit per parameter unit.
    """

    trajectory: Trajectory
    parameters: tuple[str, ...]
    gradients: Array
    statistics: Statistics
    notes: FrozenMap[str] = field(default_factory=FrozenMap)

    @property
    def status(self) -> str:
        """ "converged", or "ended" where an FMU ended its run and its rows were asked for; else there is an exception."""
        return self.statistics.status

    def table(self) -> Trajectory:
        """Return the outputs over time."""
        return self.trajectory

    def gradient(self, output: str) -> Array:
        """(n_time, n_parameters) derivatives of one output."""
        require_known("output", [output], self.trajectory.names, "")
        return self.gradients[:, self.trajectory.names.index(output), :]

    @property
    def sensitivities(self) -> xarray.DataArray:
        """The derivatives with labelled axes time, output, parameter."""
        import xarray

        axes = {"time": self.trajectory.time, "output": list(self.trajectory.names), "parameter": list(self.parameters)}
        return xarray.DataArray(self.gradients, coords=axes, dims=tuple(axes), name="sensitivity")

    def plot(self, outputs: Any = None, ax: Any = None) -> Any:
        """Axes with the outputs over time."""
        return self.trajectory.plot(outputs, ax)

    def _screen(self) -> Iterator[str | Table]:
        time, s = self.trajectory.time, self.statistics
        yield f"Simulation: {time.size} rows, {time[0]:g} to {time[-1]:g} s, {s.accepted} steps ({s.method})"
        table = self.trajectory
        rows = [
            (n, table.unit(n), float(v[0]), float(v[-1]), float(np.fmin.reduce(v)), float(np.fmax.reduce(v)))
            for n, v in zip(table.names, table.values.T, strict=True)
        ]
        yield Table(("output", "unit", "first", "last", "smallest", "largest"), tuple(rows))
        yield f"Derivatives by {', '.join(self.parameters)}: gradient(output), sensitivities" if self.parameters else ""

    def to_dataframe(self) -> Any:
        """Return the outputs as a pandas DataFrame over time in s. Raises InputError where pandas is not installed."""
        return self.trajectory.to_dataframe()

    def to_xarray(self) -> Any:
        """Return the outputs as an xarray Dataset over time in s; `sensitivities` has the derivatives."""
        return self.trajectory.to_xarray()

    def to_dict(self) -> dict[str, Any]:
        """The outputs, derivatives and statistics as plain lists and numbers."""
        derivatives = {
            o: {p: self.gradient(o)[:, k].tolist() for k, p in enumerate(self.parameters)}
            for o in self.trajectory.names
        }
        return {
            **self.trajectory.to_dict(),
            "sensitivities": derivatives if self.parameters else {},
            "statistics": self.statistics.__dict__,
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Simulation:
        """Return the simulation that `to_dict` wrote, without its notes. Raises InputError for anything else."""
        table, beside = Trajectory.from_dict(data), read_fields(_Beside, data)
        by_output = [list(beside.sensitivities.get(o, {}).values()) for o in table.names]
        parameters = tuple(next(iter(beside.sensitivities.values()), {}))
        gradients = np.reshape(by_output, (len(table.names), len(parameters), table.time.size)).transpose(2, 0, 1)
        return cls(table, parameters, gradients, beside.statistics)
