"""Effects at an FMU's ends: its inputs go through them before they enter, its outputs before they are recorded.

The effects are those of the catalogue, put on a model that passes signals through, and run by the engine. What passes
between it and the FMU are signals joined by lines: inputs on a grid refined until lines hold to 1e-5 of their range,
outputs on at least FINE rows. An effect at an input that looks at an output would close a loop around the FMU: it is
refused.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.effects import EffectUse, effects
from hvdc_ident.effects.placing import apply
from hvdc_ident.errors import unknown_name
from hvdc_ident.experiment import Experiment, InputSignal
from hvdc_ident.expression.functions import symbol
from hvdc_ident.fmu.grid import joined, kept_rows, refined, signal_of
from hvdc_ident.fmu.run import bare, inputs_of, unit_of
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.model.definition import Model, Output
from hvdc_ident.parameters import Input, Parameter
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
"""Size of the change, in ranges of the signal, by which derivatives pass through an effect or enter the FMU."""


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
        for place in use.at:
            if _end(model, place) is None:
                raise unknown_name("slot", place, model.slots, where=f"model '{model.name}', which is closed inside")
        named = replace(use, prefix=_free_prefix(model, use))
        added = _added(model, named)
        if added:
            model = replace(model, effects=(*model.effects, named), parameters=model.parameters | added)
    return model


def _free_prefix(model: FmuModel, use: EffectUse) -> str:
    """What the effect's parameters are called after, so that none takes a name of the model's."""
    first = use.prefix or f"{use.label}_{use.at[0].removeprefix('outputs.').replace('.', '_')}"
    names = effects()[use.effect].parameters
    tried = (first, *(f"{first}_{k}" for k in range(2, 10_000)))
    return next(p for p in tried if not any(f"{p}_{n}" in model.parameters for n in names))


def _added(model: FmuModel, use: EffectUse) -> dict[str, Parameter]:
    """The parameters that an effect brings; none where it is neutral. Raises ModelError where it cannot sit there."""
    trial = replace(model, effects=(*model.effects, use))
    found: dict[str, Parameter] = {}
    for side in (_entrance(trial), _exit(trial)):
        found |= {n: p for n, p in side.parameters.items() if n not in model.parameters}
    return found


def _end(model: FmuModel, place: str) -> tuple[str, int] | None:
    """("input" | "output", its number) of a slot."""
    name = place.removeprefix("outputs.")
    if place in model.inputs:
        return "input", list(model.inputs).index(place)
    return ("output", list(model.outputs).index(name)) if name in model.outputs else None


def _entrance(model: FmuModel) -> Model:
    """Inputs u0, u1 ... that come out as y0, y1 ... after the effects at the FMU's inputs."""
    return _passage(len(model.inputs), _at_end(model, "input"), tuple(i.value for i in model.inputs.values()))


def _exit(model: FmuModel) -> Model:
    """The FMU's outputs as u0, u1 ... that come out as y0, y1 ... after the effects at them."""
    return _passage(len(model.outputs), _at_end(model, "output"), (0.0,) * len(model.outputs))


def _at_end(model: FmuModel, end: str) -> tuple[EffectUse, ...]:
    """The effects with those of their places that lie at one end, renamed."""
    found = []
    for use in model.effects:
        ends = [e for p in use.at if (e := _end(model, p)) is not None and e[0] == end]
        letter = "u" if end == "input" else "y"
        if ends:
            found.append(replace(use, at=tuple(f"{letter}{k}" for _, k in ends)))
    return tuple(found)


@lru_cache(maxsize=64)
def _passage(count: int, uses: tuple[EffectUse, ...], values: tuple[float, ...]) -> Model:
    model = Model(
        name="ends",
        inputs=FrozenMap({f"u{k}": Input(v) for k, v in enumerate(values)}),
        outputs=FrozenMap({f"y{k}": Output(symbol(f"u{k}")) for k in range(count)}),
    )
    for use in uses:
        model = apply(model, use, effects()[use.effect])
    return model


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
        self.entrance, self.exit = _entrance(model), _exit(model)
        self.enters, self.leaves = bool(self.entrance.parameters), bool(self.exit.parameters)
        breaks = [b for s in experiment.inputs.values() for b in s.breaks.tolist()]
        self.breaks = np.unique(np.array(breaks))
        self.time = joined(experiment.time, self.breaks, FINE) if self.leaves else experiment.time
        self.raw = tuple(dict.fromkeys([*names, *model.outputs])) if self.leaves else names

    def simulation(self, sensitivities: tuple[str, ...]) -> Simulation:
        own = tuple(n for n in sensitivities if n in self.model.fmu.parameters)
        at_entrance = [n for n in sensitivities if n in self.entrance.parameters]
        inputs, slopes = self._inputs(tuple(at_entrance))
        inside = self._inside(inputs, own)
        raw = inside.trajectory.values
        gradients = {n: inside.gradients[:, :, k] for k, n in enumerate(own)}
        jumps = any(np.setdiff1d(s.breaks, self.breaks).size for s in inputs.values())
        for n in at_entrance:  # a parameter may move a jump, as a delay does: no slope says that
            gradients[n] = self._moving(n) if jumps else self._entering(inputs, slopes[n])
        values, found = self._leave(raw, gradients, sensitivities)
        shape = (self.experiment.time.size, len(self.names), len(sensitivities))
        table = np.empty(shape)
        for k, n in enumerate(sensitivities):
            table[:, :, k] = found[n]
        units = tuple(unit_of(self.model, n) for n in self.names)
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
        """What enters the FMU, by input; and how it moves by each parameter of the entrance, jumps staying in place.

        values: of all parameters, where they are not this run's.
        """
        model, e = self.model, self.experiment
        plain = inputs_of(model, e, self.given)
        if not self.enters:
            return plain, {}
        given = {f"u{k}": s for k, s in enumerate(plain.values())}
        chosen = {n: (values or self.values)[n] for n in self.entrance.parameters}

        def run(time: Array) -> Simulation:
            passing = Experiment("entrance", time, FrozenMap(given))
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
        inner = Experiment(self.experiment.name, self.time, FrozenMap(inputs))
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
        """What is recorded, (n, names), and its derivative by each parameter."""
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

    def _passed(self, raw: Array, sensitivities: tuple[str, ...] = ()) -> Simulation:
        """The exit's run on given outputs of the FMU; what is no output passes as it is."""
        outputs = list(self.model.outputs)
        signals = {f"u{k}": signal_of(self.time, raw[:, self.raw.index(n)], self.breaks) for k, n in enumerate(outputs)}
        values = {n: self.values[n] for n in self.exit.parameters}
        inner = Experiment("exit", self.experiment.time, FrozenMap(signals))
        run = engine_run(self.exit, inner, values, sensitivities, tolerance=self.tolerance)
        columns, slopes = [], []
        for n in self.names:
            if n in outputs:
                columns.append(run[f"y{outputs.index(n)}"])
                slopes.append(run.gradient(f"y{outputs.index(n)}"))
            else:
                place = np.searchsorted(self.time, self.experiment.time, side="right") - 1
                columns.append(raw[place, self.raw.index(n)])
                slopes.append(np.zeros((place.size, len(sensitivities))))
        trajectory = Trajectory(self.experiment.time, np.column_stack(columns), self.names)
        return Simulation(trajectory, sensitivities, np.stack(slopes, axis=1), run.statistics)

    def _along(self, raw: Array, slope: Array) -> Array:
        """(n, names) change of what is recorded as the FMU's outputs move along the slope."""
        ranges = np.maximum(np.ptp(raw, axis=0), np.maximum(1e-6 * np.abs(raw).max(axis=0), 1e-12))
        size = float((np.abs(slope).max(axis=0) / ranges).max())
        if size == 0.0:
            return np.zeros((self.experiment.time.size, len(self.names)))
        step = NUDGE / size
        ends = [self._passed(raw + sign * step * slope).trajectory.values for sign in (1.0, -1.0)]
        return np.asarray((ends[0] - ends[1]) / (2.0 * step))


def _moved(signal: InputSignal, slope: InputSignal, by: float) -> InputSignal:
    """The signal moved along another on the same instants."""
    return InputSignal(signal.times, signal.values + by * slope.values, signal.breaks)
