"""Effects at an FMU's ends: its inputs go through them before they enter, its outputs before they are recorded.

The effects are those of the catalogue, put on a model that passes signals through, and run by the engine. What passes
between it and the FMU are signals joined by lines: inputs on a grid refined until lines hold to 1e-5 of their range,
outputs on at least FINE rows. An effect at an input that looks at an output would close a loop around the FMU: it is
refused.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.effects import EffectUse, effects
from hvdc_ident.errors import unknown_name
from hvdc_ident.experiment import Experiment, InputSignal
from hvdc_ident.fmu.grid import joined, kept_rows, refined, signal_of
from hvdc_ident.fmu.passage import ALONG, added, entrance, exit_
from hvdc_ident.fmu.run import bare, inputs_of
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.simulate.engine import Tolerance
from hvdc_ident.simulate.engine import simulate as engine_run
from hvdc_ident.simulate.recording import chains_of
from hvdc_ident.simulate.result import Simulation
from hvdc_ident.trajectory import Array, Trajectory

if TYPE_CHECKING:
    from hvdc_ident.fmu.model import FmuModel

FINE = 4000
"""Rows, at least, on which outputs are taken where an effect filters them."""
NUDGE = 1e-3
"""Size of the change, in ranges of the signal, by which derivatives enter the FMU."""

BRIEF = 0.02
"""Share of the run that the largest value of a slope would have to last for as much as the slope comes to in all."""


def chains(experiment: Experiment) -> list[EffectUse]:
    """The experiment's recording chains as effects."""
    return chains_of(experiment.instrument)


def with_effects(model: FmuModel, uses: Iterable[Any]) -> FmuModel:
    """The model with the effects at its ends; their parameters join the model's."""
    for given in uses:
        use = EffectUse.of(given)
        catalogue = effects()
        if use.effect not in catalogue:
            raise unknown_name("effect", use.effect, catalogue)
        named = replace(use, prefix=_free_prefix(model, use))
        parameters = added(model, named)
        if parameters:
            model = replace(model, effects=(*model.effects, named), parameters=model.parameters | parameters)
    return model


def _free_prefix(model: FmuModel, use: EffectUse) -> str:
    """Return the prefix of the names of an effect's parameters, such that none takes a name of the model's."""
    place = re.sub(r"\W+", "_", use.at[0].removeprefix("outputs.")).strip("_")  # der(mass.v), a[1]
    first = use.prefix or f"{use.label}_{place}"
    names = effects()[use.effect].parameters
    tried = (first, *(f"{first}_{k}" for k in range(2, 10_000)))
    return next(p for p in tried if not any(f"{p}_{n}" in model.parameters for n in names))


def simulate_with_effects(
    model: FmuModel,
    experiment: Experiment,
    given: Mapping[str, float],
    sensitivities: tuple[str, ...],
    names: tuple[str, ...],
    tolerance: Tolerance,
) -> Simulation:
    """The run with everything at the ends, and its derivatives by parameters of the FMU and of the effects."""
    return _Ends(model, experiment, given, names, tolerance).simulation(sensitivities)


class _Ends:
    """One run through entrance, FMU and exit."""

    def __init__(
        self,
        model: FmuModel,
        experiment: Experiment,
        given: Mapping[str, float],
        names: tuple[str, ...],
        tolerance: Tolerance,
    ) -> None:
        self.model, self.experiment, self.tolerance, self.names = model, experiment, tolerance, names
        self.given = dict(given)
        self.values = {n: float(given.get(n, p.value)) for n, p in model.parameters.items()}
        self.entrance, self.exit = entrance(model), exit_(model)
        self.enters, self.leaves = bool(self.entrance.parameters), bool(self.exit.parameters)
        breaks = [b for s in experiment.inputs.values() for b in s.breaks.tolist()]
        self.breaks = np.unique(np.array(breaks))
        self.time = joined(experiment.time, self.breaks, FINE) if self.leaves else experiment.time
        self.raw = tuple(model.outputs) if self.leaves else names

    def simulation(self, sensitivities: tuple[str, ...]) -> Simulation:
        own = tuple(n for n in sensitivities if n in self.model.fmu.parameters)
        at_entrance = [n for n in sensitivities if n in self.entrance.parameters]
        inputs, slopes = self._inputs(tuple(at_entrance))
        inside = self._inside(inputs, own)
        raw = inside.trajectory.values
        gradients = {n: inside.gradients[:, :, k] for k, n in enumerate(own)}
        jumps = any(np.setdiff1d(s.breaks, self.breaks).size for s in inputs.values())
        for n in at_entrance:  # a parameter may move a jump, as a delay does, or an edge: no slope says that
            moves = jumps or any(_brief(s) for s in slopes[n].values())
            gradients[n] = self._moving(n) if moves else self._entering(inputs, slopes[n])
        values, found = self._leave(raw, gradients, sensitivities)
        shape = (self.experiment.time.size, len(self.names), len(sensitivities))
        table = np.empty(shape)
        for k, n in enumerate(sensitivities):
            table[:, :, k] = found[n]
        units = tuple(self.model.outputs[n].unit for n in self.names)
        return Simulation(
            Trajectory(self.experiment.time, values, self.names, units),
            sensitivities,
            table,
            inside.statistics,
            inside.notes,
        )

    # --- in ---

    def _inputs(
        self, sensitivities: tuple[str, ...] = (), values: Mapping[str, float] | None = None
    ) -> tuple[dict[str, InputSignal], dict[str, dict[str, InputSignal]]]:
        """Return the signals that enter the FMU, by input, and their derivatives by each parameter of the entrance, jumps staying in place.

        values: of all parameters, where they are not this run's.
        """
        model, e = self.model, self.experiment
        plain = inputs_of(model, e, self.given)
        if not self.enters:
            return plain, {}
        given = {f"u{k}": s for k, s in enumerate(plain.values())}
        chosen = {n: (values or self.values)[n] for n in self.entrance.parameters}

        def run(time: Array) -> Simulation:
            passing = Experiment(time, "entrance", inputs=FrozenMap(given))
            return engine_run(self.entrance, passing, chosen, sensitivities, tolerance=self.tolerance)

        grid = refined(lambda time: run(time).trajectory.values, e.time, self.breaks)
        found = run(grid)
        inputs: dict[str, InputSignal] = {}
        slopes: dict[str, dict[str, InputSignal]] = {n: {} for n in sensitivities}
        for k, name in enumerate(model.inputs):
            inputs[name] = signal_of(grid, found[f"y{k}"], self.breaks)
            for n, column in zip(sensitivities, found.gradient(f"y{k}").T, strict=True):
                slopes[n][name] = InputSignal(inputs[name].times, column[kept_rows(grid, found[f"y{k}"])], np.empty(0))
        return inputs, slopes

    def _inside(self, inputs: Mapping[str, InputSignal], sensitivities: tuple[str, ...]) -> Simulation:
        inner = Experiment(self.time, self.experiment.name, inputs=FrozenMap(inputs))
        return bare(self.model, inner, self.given, sensitivities, self.raw, self.tolerance)

    def _moving(self, name: str) -> Array:
        """(n, raw) the derivative by a parameter of the entrance, from runs with it a hundredth of its size apart."""
        parameter = self.model.parameters[name]
        h = 0.01 * parameter.size
        low, high = max(self.values[name] - h, parameter.min), min(self.values[name] + h, parameter.max)
        ends = []
        for value in (low, high):
            inputs, _ = self._inputs((), {**self.values, name: value})
            ends.append(self._inside(inputs, ()).trajectory.values)
        return np.asarray((ends[1] - ends[0]) / (high - low))

    def _entering(self, inputs: Mapping[str, InputSignal], slope: Mapping[str, InputSignal]) -> Array:
        """(n, raw) change of what comes out of the FMU as its inputs move along the slopes."""
        ranges = [(max(np.ptp(s.values), 1e-6 * np.abs(s.values).max(), 1e-12), slope[n]) for n, s in inputs.items()]
        sizes = [np.abs(m.values).max() / r for r, m in ranges]
        if max(sizes, default=0.0) == 0.0:
            return np.zeros((self.time.size, len(self.raw)))
        step = NUDGE / max(sizes)
        ends = []
        for sign in (step, -step):
            moved = {n: _moved(s, slope[n], sign) for n, s in inputs.items()}
            ends.append(self._inside(moved, ()).trajectory.values)
        return np.asarray((ends[0] - ends[1]) / (2.0 * step))

    # --- out ---

    def _leave(
        self, raw: Array, gradients: Mapping[str, Array], sensitivities: tuple[str, ...]
    ) -> tuple[Array, dict[str, Array]]:
        """Return the recorded values, (n, names), and their derivative by each parameter."""
        if not self.leaves:
            return raw, {n: gradients[n] for n in sensitivities}
        at_exit = tuple(n for n in sensitivities if n in self.exit.parameters)
        passed = self._passed(raw, at_exit)
        found = {}
        for n in sensitivities:
            total = np.zeros((self.experiment.time.size, len(self.names)))
            if n in gradients:
                total += self._along(raw, gradients[n])
            if n in at_exit:
                total += passed.gradients[:, :, at_exit.index(n)]
            found[n] = total
        return passed.trajectory.values, found

    def _passed(self, raw: Array, sensitivities: tuple[str, ...] = (), slope: Array | None = None) -> Simulation:
        """The exit's run on given outputs of the FMU, and how these move with ALONG."""
        outputs = list(self.model.outputs)
        signals = {f"u{k}": signal_of(self.time, raw[:, self.raw.index(n)], self.breaks) for k, n in enumerate(outputs)}
        if slope is not None:
            signals |= {
                f"s{k}": signal_of(self.time, slope[:, self.raw.index(n)], self.breaks) for k, n in enumerate(outputs)
            }
        values = {n: self.values[n] for n in self.exit.parameters}
        inner = Experiment(self.experiment.time, "exit", inputs=FrozenMap(signals))
        leaving = self.exit if slope is None else exit_(self.model, along=True)
        run = engine_run(leaving, inner, values, sensitivities, tolerance=self.tolerance)
        leaving_as = [f"y{outputs.index(n)}" for n in self.names]
        trajectory = Trajectory(self.experiment.time, np.column_stack([run[y] for y in leaving_as]), self.names)
        gradients = np.stack([run.gradient(y) for y in leaving_as], axis=1)
        return Simulation(trajectory, sensitivities, gradients, run.statistics)

    def _along(self, raw: Array, slope: Array) -> Array:
        """(n, names) change of what is recorded as the FMU's outputs move along the slope, (rows, raw)."""
        return self._passed(raw, (ALONG,), slope).gradients[:, :, 0]


def _brief(slope: InputSignal) -> bool:
    """Return whether a slope is a few spikes: small enough to be a slope, they are lost in the tolerance of the FMU's run."""
    size = np.abs(slope.values)
    span = float(slope.times[-1] - slope.times[0])
    return bool(span > 0 and np.trapezoid(size, slope.times) < BRIEF * span * size.max())


def _moved(signal: InputSignal, slope: InputSignal, by: float) -> InputSignal:
    """The signal moved along another on the same instants."""
    return InputSignal(signal.times, signal.values + by * slope.values, signal.breaks)
