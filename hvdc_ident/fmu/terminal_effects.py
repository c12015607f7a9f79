"""Effects at an FMU's terminals: its inputs pass through them before they enter, its outputs before they are recorded.

The effects are those of the catalogue, in a model that passes signals u0, u1 ... through to y0, y1 ..., which the engine
simulates. Signals between it and the FMU are piecewise linear: inputs on a grid refined until lines hold to 1e-5 of their
range, outputs on the experiment's rows, or on at least MIN_ROWS rows where an effect has memory. An effect at an input
that reads an output would close a loop around the FMU: it is refused.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import chain, count
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, Experiment, InputSignal, Trajectory
from hvdc_ident.effects import EffectUse, apply_effects, effects, joined_sources
from hvdc_ident.errors import HvdcIdentError, InputError, ModelError, require_known, unknown_name
from hvdc_ident.expression import parse, symbol
from hvdc_ident.fmu.evaluate import inputs_of, simulate_without_effects
from hvdc_ident.fmu.gradients import Varied
from hvdc_ident.fmu.piecewise_linear import kept_rows, refined_grid, sampling_grid, signal_of
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model, Output
from hvdc_ident.parameters import Input, Parameter
from hvdc_ident.simulate import Simulation, Tolerance, chains_of
from hvdc_ident.simulate import simulate as engine_run

if TYPE_CHECKING:
    from hvdc_ident.fmu.model import FmuModel


MIN_ROWS = 4000  # on which outputs are recorded where an effect at them has memory
JUMP_RATIO = 2.0  # of the changes on the two sides of a parameter's value, above which one of them has a jump in it
SPIKE_SHARE = 0.02  # share of the run for which a derivative would have its largest value to have its mean
PARAMETER_SHIFT = 0.01  # of a parameter whose derivative comes from runs, in its sizes
DIRECTION_SHARE = "share_of_the_direction"
"""Parameter by which the FMU's outputs move along signals s0, s1 ...: its sensitivity passes theirs through the effects."""
Side = Literal["input", "output"]


def with_effects(model: FmuModel, uses: Iterable[Any]) -> FmuModel:
    """Return the model with the effects at its terminals; their parameters join the model's."""
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
    tried = chain([first], (f"{first}_{k}" for k in count(2)))
    return next(p for p in tried if not any(f"{p}_{n}" in model.parameters for n in names))


def simulate(
    model: FmuModel,
    experiment: Experiment,
    values: Mapping[str, float],
    sensitivities: tuple[str, ...],
    outputs: Sequence[str] | None,
    tolerance: Tolerance,
    partial: bool = False,
) -> Simulation:
    """Return the run with its recording chains and effects. See `FmuModel.simulate`."""
    where = f"experiment '{experiment.name}'"
    given = {**experiment.values, **values}
    names = tuple(model.outputs if outputs is None else outputs)
    try:
        recording = model.recording((*names, *experiment.instrument))
        checked = recording.driven(experiment.drive).with_effects(chains_of(experiment.instrument))
    except InputError as e:
        raise e.at(where) from None
    known = {**checked.parameters, **checked.inputs}
    require_known("parameter or input", (*given, *experiment.inputs, *sensitivities), known, where)
    if experiment.starts:
        raise ModelError(
            "an FMU begins where its own initialisation puts it",
            where=where,
            expected="no starts of states",
            got=", ".join(experiment.starts),
            hint="a parameter of the FMU that is a start value, where it has one",
        )
    require_known("input", experiment.offsets, checked.inputs, f"{where}, offsets")
    try:
        if checked.effects:
            return RunWithEffects(checked, experiment, given, names, tolerance).simulation(sensitivities)
        accept_end = partial and not sensitivities
        return simulate_without_effects(checked, experiment, given, sensitivities, names, tolerance, partial=accept_end)
    except HvdcIdentError as e:
        raise e.at(where) from None


class RunWithEffects:
    """One run through the effects at the inputs, the FMU, and the effects at the outputs."""

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
        self.signals = inputs_of(model, experiment, self.given)
        self.values = {n: float(given.get(n, p.value)) for n, p in model.parameters.items()}
        self.input_chain, self.output_chain = input_chain(model), output_chain(model)
        breaks = [b for s in experiment.inputs.values() for b in s.breaks.tolist()]
        self.breaks = np.unique(np.array(breaks))
        memory = bool(self.output_chain.states or self.output_chain.delays or self.output_chain.sampled)
        self.time = sampling_grid(experiment.time, self.breaks, MIN_ROWS) if memory else experiment.time
        self.fmu_outputs = tuple(model.outputs) if self.output_chain.parameters else names

    def simulation(self, sensitivities: tuple[str, ...]) -> Simulation:
        """Return the run with its derivatives by the parameters and inputs."""
        direct = {*self.model.fmu.parameters, *(() if self.input_chain.parameters else self.model.inputs)}
        by_fmu = tuple(n for n in sensitivities if n in direct)
        before = {*self.input_chain.parameters, *self.model.inputs} - direct
        by_inputs = tuple(n for n in sensitivities if n in before)
        inputs, derivatives = self._inputs(by_inputs)
        # A parameter may move a jump, as a delay does, or an edge, which no derivative at an instant shows. A constant
        # added to an input moves none.
        jumps = any(np.setdiff1d(s.breaks, self.breaks).size for s in inputs.values())
        by_runs = [
            n
            for n in by_inputs
            if n in self.input_chain.parameters and (jumps or any(map(_has_spikes, derivatives[n].values())))
        ]
        directions = {n: _direction(n, inputs, derivatives[n]) for n in by_inputs if n not in by_runs}
        run = self._fmu_run(inputs, by_fmu, [d for d, size in directions.values() if size > 0.0])
        outputs = run.trajectory.values
        gradients = {n: run.gradients[:, :, k] for k, n in enumerate(run.parameters)}
        for n, (_, size) in directions.items():
            gradients[n] = gradients[n] * size if size > 0.0 else np.zeros(outputs.shape)
        for n in by_runs:
            gradients[n] = self._difference(n, inputs, outputs)
        values, columns = self._recorded(outputs, gradients, sensitivities)
        table = np.empty((self.experiment.time.size, len(self.names), len(sensitivities)))
        for k, n in enumerate(sensitivities):
            table[:, :, k] = columns[n]
        units = tuple(self.model.outputs[n].unit for n in self.names)
        trajectory = Trajectory(self.experiment.time, values, self.names, units)
        return Simulation(trajectory, sensitivities, table, run.statistics, run.notes)

    def _inputs(
        self, sensitivities: tuple[str, ...] = (), values: Mapping[str, float] | None = None
    ) -> tuple[dict[str, InputSignal], dict[str, dict[str, InputSignal]]]:
        """Return the signals that enter the FMU, by input, and their derivatives by each parameter, with jumps in place.

        values: of all parameters, where they are not this run's.
        """
        if not self.input_chain.parameters:
            return self.signals, {}
        names = list(self.signals)
        parameters = tuple(f"u{names.index(n)}" if n in names else n for n in sensitivities)
        signals = FrozenMap({f"u{k}": s for k, s in enumerate(self.signals.values())})
        chosen = {n: (values or self.values)[n] for n in self.input_chain.parameters}

        def run(time: Array) -> Simulation:
            experiment = Experiment(time, "effects at the inputs", inputs=signals)
            return engine_run(self.input_chain, experiment, chosen, parameters, tolerance=self.tolerance)

        grid = refined_grid(lambda time: run(time).trajectory.values, self.experiment.time, self.breaks)
        result = run(grid)
        inputs: dict[str, InputSignal] = {}
        derivatives: dict[str, dict[str, InputSignal]] = {n: {} for n in sensitivities}
        for k, name in enumerate(names):
            column = result[f"y{k}"]
            inputs[name] = signal_of(grid, column, self.breaks)
            for n, gradient in zip(sensitivities, result.gradient(f"y{k}").T, strict=True):
                derivatives[n][name] = InputSignal(inputs[name].times, gradient[kept_rows(grid, column)], np.empty(0))
        return inputs, derivatives

    def _fmu_run(
        self,
        inputs: Mapping[str, InputSignal],
        sensitivities: tuple[str, ...] = (),
        directions: Sequence[Varied] = (),
    ) -> Simulation:
        """Return the FMU's run on inputs, with derivatives by its parameters and along directions of its inputs."""
        return simulate_without_effects(
            self.model,
            Experiment(self.time, self.experiment.name, inputs=FrozenMap(inputs)),
            self.given,
            sensitivities,
            self.fmu_outputs,
            self.tolerance,
            noise_key=_digest_of(self.signals),
            directions=directions,
        )

    def _difference(self, name: str, inputs: Mapping[str, InputSignal], outputs: Array) -> Array:
        """(n, outputs) derivative by a parameter of the effects at the inputs, from runs on both sides of its value.

        An output that jumps with an input shows the jump, not a derivative, at a row over which it passes between two of
        the runs: there, the difference is that of the side on which none passes.
        """
        parameter, value = self.model.parameters[name], self.values[name]
        h = PARAMETER_SHIFT * parameter.size
        low, high = max(value - h, parameter.min), min(value + h, parameter.max)
        runs, passed = {}, {}
        for shifted in (low, high):
            moved, _ = self._inputs((), {**self.values, name: shifted})
            runs[shifted] = self._fmu_run(moved).trajectory.values
            passed[shifted] = _passed_over(self.time, inputs, moved)
        result = np.asarray((runs[high] - runs[low]) / (high - low))
        for side, other in ((low, high), (high, low)):
            if side == value:
                continue
            change, change_there = runs[side] - outputs, runs[other] - outputs
            # Without a jump the changes on the two sides differ by the curvature alone; one no larger than at other rows
            # does no harm.
            elsewhere = np.abs(change_there)[~passed[other]].max(axis=0, initial=0.0)
            jumped = np.abs(change_there) > np.maximum(JUMP_RATIO * np.abs(change), elsewhere)
            rows = (passed[other] & ~passed[side])[:, None] & jumped
            result[rows] = change[rows] / (side - value)
        return result

    def _recorded(
        self, outputs: Array, gradients: Mapping[str, Array], sensitivities: tuple[str, ...]
    ) -> tuple[Array, dict[str, Array]]:
        """Return the recorded values, (n, names), and their derivative by each parameter."""
        if not self.output_chain.parameters:
            return outputs, {n: gradients[n] for n in sensitivities}
        by_outputs = tuple(n for n in sensitivities if n in self.output_chain.parameters)
        values, columns = self._through_outputs(outputs, by_outputs)
        totals = {}
        for n in sensitivities:
            total = np.zeros(values.shape)
            if n in gradients:
                total += self._through_outputs(outputs, (DIRECTION_SHARE,), gradients[n])[1][:, :, 0]
            if n in by_outputs:
                total += columns[:, :, by_outputs.index(n)]
            totals[n] = total
        return values, totals

    def _through_outputs(
        self, outputs: Array, sensitivities: tuple[str, ...], direction: Array | None = None
    ) -> tuple[Array, Array]:
        """Return what is recorded of given outputs of the FMU, (n, names), and its derivatives, (n, names, parameters).

        direction: (rows, outputs) in which the FMU's outputs move with DIRECTION_SHARE.
        """
        names = list(self.model.outputs)

        def signals(letter: str, rows: Array) -> dict[str, InputSignal]:
            columns = [rows[:, self.fmu_outputs.index(n)] for n in names]
            return {f"{letter}{k}": signal_of(self.time, c, self.breaks) for k, c in enumerate(columns)}

        inputs = signals("u", outputs) | (signals("s", direction) if direction is not None else {})
        chain = self.output_chain if direction is None else output_chain(self.model, directed=True)
        values = {n: self.values[n] for n in self.output_chain.parameters}
        experiment = Experiment(self.experiment.time, "effects at the outputs", inputs=FrozenMap(inputs))
        run = engine_run(chain, experiment, values, sensitivities, tolerance=self.tolerance)
        recorded = [f"y{names.index(n)}" for n in self.names]
        return np.column_stack([run[y] for y in recorded]), np.stack([run.gradient(y) for y in recorded], axis=1)


def _direction(
    name: str, inputs: Mapping[str, InputSignal], derivative: Mapping[str, InputSignal]
) -> tuple[Varied, float]:
    """Return the direction of a derivative, and the derivative's size in it: 0 where nothing moves."""
    ranges = {n: max(np.ptp(s.values), 1e-6 * np.abs(s.values).max(), 1e-12) for n, s in inputs.items()}
    sizes = {n: float(np.abs(derivative[n].values).max()) / r for n, r in ranges.items()}
    size = max(sizes.values(), default=0.0)
    points = tuple(derivative[n].values / (size or 1.0) for n in inputs)
    return Varied(name, "along " + ", ".join(n for n, s in sizes.items() if s > 0.0), points=points), size


def _digest_of(inputs: Mapping[str, InputSignal]) -> str:
    parts = [a.tobytes() + b"|" for s in inputs.values() for a in (s.times, s.values, s.breaks)]
    return hashlib.sha256(b"".join(parts)).hexdigest()


def _passed_over(time: Array, inputs: Mapping[str, InputSignal], moved: Mapping[str, InputSignal]) -> NDArray[np.bool_]:
    """Return which rows, (n,), a jump of the inputs passes over as it moves; a row at a jump is after it."""
    rows = np.zeros(time.size, dtype=bool)
    for before, after in zip(inputs.values(), moved.values(), strict=True):
        for a, b in zip(before.breaks.tolist(), after.breaks.tolist(), strict=False):
            rows |= (time >= min(a, b)) & (time < max(a, b))
    return rows


def _has_spikes(derivative: InputSignal) -> bool:
    """Return whether a derivative is a few spikes: a step small enough for them is lost in a run's tolerance."""
    size = np.abs(derivative.values)
    span = float(derivative.times[-1] - derivative.times[0])
    return bool(span > 0 and np.trapezoid(size, derivative.times) < SPIKE_SHARE * span * size.max())


# --- the models that signals pass through ---


def terminal_of(model: FmuModel, point: str) -> tuple[Side, int] | None:
    """Return on which side an insertion point lies, and its number there; None for what is none."""
    name = point.removeprefix("outputs.")
    if point in model.inputs:
        return "input", list(model.inputs).index(point)
    return ("output", list(model.outputs).index(name)) if name in model.outputs else None


def input_chain(model: FmuModel) -> Model:
    """Return the model of the effects at the FMU's inputs: u0, u1 ... that come out as y0, y1 ...."""
    return _chain(len(model.inputs), _effects_at(model, "input"), tuple(i.value for i in model.inputs.values()), False)


def output_chain(model: FmuModel, *, directed: bool = False) -> Model:
    """Return the model of the effects at the FMU's outputs: u0, u1 ... that come out as y0, y1 ....

    directed: with inputs s0, s1 ... too, DIRECTION_SHARE times which are added to the outputs.
    """
    return _chain(len(model.outputs), _effects_at(model, "output"), (0.0,) * len(model.outputs), directed)


def added(model: FmuModel, use: EffectUse) -> dict[str, Parameter]:
    """Return the parameters that an effect adds; none where it is neutral.

    Raises UnknownNameError or ModelError for an effect at what is no terminal, or that reads what it cannot see.
    """
    _check(model, use)
    trial = replace(model, effects=(*model.effects, use))
    try:
        sides = input_chain(trial), output_chain(trial)
    except InputError as e:
        raise _in_fmu_names(model, use, e) from None
    return {n: p for side in sides for n, p in side.parameters.items() if n not in model.parameters}


def _check(model: FmuModel, use: EffectUse) -> None:
    """Check an effect's insertion points, the signals that it reads, and its parameters; raises what `added` raises."""
    where = f"effect '{use.effect}' at {', '.join(use.at)}"
    for point in use.at:
        if terminal_of(model, point) is None:
            raise unknown_name(
                "insertion point", point, model.insertion_points, where=f"model '{model.name}', which is closed inside"
            )
    for name, value in use.parameters.items():
        if isinstance(value, str):
            raise ModelError(
                "an effect at an end of an FMU cannot share a parameter with what is inside",
                where=f"{where}, parameter '{name}'",
                expected="a number",
                got=repr(value),
            )
    read = []
    if use.expression:
        names = {s.name for s in parse(use.expression, where=f"{where}, expression").free_symbols}
        read = sorted(names - use.parameters.keys() - {"time"})
    for k, point in enumerate(use.at):
        for name, key in [*((n, "from") for n in use.sources[k : k + 1]), *((n, "expression") for n in read)]:
            _check_reading(model, point, name, f"{where}, {key}")


def _check_reading(model: FmuModel, point: str, name: str, where: str) -> None:
    """Raise where an effect at a terminal cannot read a signal."""
    terminal, source = terminal_of(model, point), terminal_of(model, name)
    assert terminal is not None
    if source is None:
        known = model.inputs if terminal[0] == "input" else [s for s in model.insertion_points if s not in model.inputs]
        raise unknown_name("signal", name, known, where=f"{where} (the model is closed inside)")
    if terminal[0] == source[0]:
        return
    if terminal[0] == "input":
        raise ModelError(
            f"an effect at an input that reads the output '{name}' would close a loop around the FMU",
            where=where,
            expected=f"one of its inputs: {', '.join(model.inputs)}",
            hint="put the loop into the model before it becomes an FMU",
        )
    outputs = ", ".join(model.outputs)
    raise ModelError(
        f"an effect at an output cannot read the input '{name}'", where=where, expected=f"one of its outputs: {outputs}"
    )


def _effects_at(model: FmuModel, side: Side) -> tuple[EffectUse, ...]:
    """Return the effects with those of their insertion points that lie on one side, in the chain's names."""
    letter = "u" if side == "input" else "y"
    uses = []
    for use in model.effects:
        terminals = {k: t for k, p in enumerate(use.at) if (t := terminal_of(model, p)) is not None and t[0] == side}
        sources = [t for k in terminals if use.source and (t := terminal_of(model, use.sources[k])) is not None]
        if terminals:
            at = tuple(f"{letter}{number}" for _, number in terminals.values())
            source = joined_sources(f"{letter}{number}" for _, number in sources)
            uses.append(replace(use, at=at, source=source, expression=_renamed(model, use)))
    return tuple(uses)


def _renamed(model: FmuModel, use: EffectUse) -> str:
    """Return an effect's expression with the FMU's inputs, or its outputs before the effects, in the chain's names."""

    def name(match: re.Match[str]) -> str:
        word = match.group()
        terminal = None if word in use.parameters else terminal_of(model, word)
        return f"u{terminal[1]}" if terminal else word

    return re.sub(r"[A-Za-z_]\w*", name, use.expression)


@lru_cache(maxsize=64)
def _chain(count: int, uses: tuple[EffectUse, ...], values: Sequence[float], directed: bool) -> Model:
    if count == 0:  # no model is without any signal: one that nothing enters and nobody reads
        count, values = 1, (0.0,)
    inputs = {f"u{k}": Input(v) for k, v in enumerate(values)}
    outputs = {f"y{k}": symbol(f"u{k}") for k in range(count)}
    if directed:
        inputs |= {f"s{k}": Input(0.0) for k in range(count)}
        outputs = {n: e + symbol(DIRECTION_SHARE) * symbol(f"s{n[1:]}") for n, e in outputs.items()}
    model = Model(
        name="ends",
        parameters=FrozenMap({DIRECTION_SHARE: Parameter(0.0, scale=1.0)} if directed else {}),
        inputs=FrozenMap(inputs),
        outputs=FrozenMap({n: Output(e) for n, e in outputs.items()}),
    )
    return apply_effects(model, uses)


def _in_fmu_names(model: FmuModel, use: EffectUse, error: InputError) -> InputError:
    """Return the error with the FMU's names in the place of the chain's."""
    outputs = any((e := terminal_of(model, p)) is not None and e[0] == "output" for p in use.at)
    names = list(model.outputs if outputs else model.inputs)

    def renamed(text: str) -> str:
        return re.sub(r"\b[uy](\d+)\b", lambda m: names[int(m[1])] if int(m[1]) < len(names) else str(m[0]), text)

    parts: dict[str, Any] = {k: renamed(getattr(error, k)) for k in ("where", "expected", "got", "hint")}
    return type(error)(renamed(error.what), **parts)
