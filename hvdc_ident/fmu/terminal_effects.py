"""Effects at an FMU's terminals: its inputs pass through them before they enter, its outputs before they are recorded.

The effects are those of the catalogue, in a model that passes signals u0, u1 ... through to y0, y1 ..., which the engine
simulates. Signals between it and the FMU are piecewise linear: inputs on a grid refined until lines hold to 1e-5 of their
range, outputs on the experiment's rows, or on at least FINE rows where an effect has memory. An effect at an input that
reads an output would close a loop around the FMU: it is refused.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, Experiment, InputSignal, Trajectory
from hvdc_ident.effects import EffectUse, apply_effects, effects, joined_sources
from hvdc_ident.errors import InputError, ModelError, unknown_name
from hvdc_ident.expression import parse, symbol
from hvdc_ident.fmu.evaluate import Direction, bare, changed, inputs_of
from hvdc_ident.fmu.piecewise_linear import kept_rows, refined, sampling_grid, signal_of
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model, Output
from hvdc_ident.parameters import Input, Parameter
from hvdc_ident.simulate import Simulation, Tolerance
from hvdc_ident.simulate import simulate as engine_run

if TYPE_CHECKING:
    from hvdc_ident.fmu.model import FmuModel


FINE = 4000
"""Rows, at least, on which outputs are taken where an effect filters them."""
KEPT = 12
"""Runs of an FMU that are kept: refits of what sits at its outputs ask for the same ones many times over."""

JUMP = 2.0
"""How many times as large as on the other side a change is where a jump is in it, at a row that one passes over."""
BRIEF = 0.02
"""Share of the run that the largest value of a slope would have to last for as much as the slope comes to in all."""


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


class TerminalRun:
    """One run with the effects at the inputs, the FMU, and the effects at its outputs."""

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
        self.plain = inputs_of(model, experiment, self.given)
        self.values = {n: float(given.get(n, p.value)) for n, p in model.parameters.items()}
        self.entrance, self.exit = entrance(model), exit_(model)
        self.enters, self.leaves = bool(self.entrance.parameters), bool(self.exit.parameters)
        breaks = [b for s in experiment.inputs.values() for b in s.breaks.tolist()]
        self.breaks = np.unique(np.array(breaks))
        remembers = bool(self.exit.states or self.exit.delays or self.exit.sampled)
        self.time = sampling_grid(experiment.time, self.breaks, FINE) if remembers else experiment.time
        self.raw = tuple(model.outputs) if self.leaves else names

    def simulation(self, sensitivities: tuple[str, ...]) -> Simulation:
        fixed = () if self.enters else tuple(self.model.inputs)
        own = tuple(n for n in sensitivities if n in self.model.fmu.parameters or n in fixed)
        at_entrance = tuple(
            n for n in sensitivities if n in self.entrance.parameters or (n in self.model.inputs and n not in own)
        )
        inputs, slopes = self._inputs(at_entrance)
        # A parameter may move a jump, as a delay does, or an edge: no slope says that. A constant of an input moves none.
        jumps = any(np.setdiff1d(s.breaks, self.breaks).size for s in inputs.values())
        edges = [n for n in at_entrance if n in self.entrance.parameters and (jumps or _brief(slopes[n].values()))]
        ways = {n: _direction(inputs, slopes[n]) for n in at_entrance if n not in edges}
        inside = self._inside(inputs, own, {n: d for n, (d, size) in ways.items() if size > 0.0})
        raw = inside.trajectory.values
        gradients = {n: inside.gradients[:, :, k] for k, n in enumerate(inside.parameters)}
        for n, (_, size) in ways.items():
            gradients[n] = gradients[n] * size if size > 0.0 else np.zeros(raw.shape)
        for n in edges:
            gradients[n] = self._moving(n, inputs, raw)
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
        model, e, plain = self.model, self.experiment, self.plain
        if not self.enters:
            return plain, {}
        asked = tuple(f"u{list(plain).index(n)}" if n in plain else n for n in sensitivities)
        given = {f"u{k}": s for k, s in enumerate(plain.values())}
        chosen = {n: (values or self.values)[n] for n in self.entrance.parameters}

        def run(time: Array) -> Simulation:
            passing = Experiment(time, "entrance", inputs=FrozenMap(given))
            return engine_run(self.entrance, passing, chosen, asked, tolerance=self.tolerance)

        grid = refined(lambda time: run(time).trajectory.values, e.time, self.breaks)
        found = run(grid)
        inputs: dict[str, InputSignal] = {}
        slopes: dict[str, dict[str, InputSignal]] = {n: {} for n in sensitivities}
        for k, name in enumerate(model.inputs):
            inputs[name] = signal_of(grid, found[f"y{k}"], self.breaks)
            for n, column in zip(sensitivities, found.gradient(f"y{k}").T, strict=True):
                slopes[n][name] = InputSignal(inputs[name].times, column[kept_rows(grid, found[f"y{k}"])], np.empty(0))
        return inputs, slopes

    def _inside(
        self,
        inputs: Mapping[str, InputSignal],
        sensitivities: tuple[str, ...] = (),
        directions: Mapping[str, Direction] | None = None,
    ) -> Simulation:
        """The run of the FMU on what enters it, with derivatives by its parameters and along directions of its inputs.

        The last KEPT are had without running it again.
        """
        along = directions or {}
        inner = Experiment(self.time, self.experiment.name, inputs=FrozenMap(inputs))
        kept: dict[bytes, Simulation] = self.model.pool.kept
        key = self._key(inputs, along)
        found = kept.pop(key, None)
        names = (*sensitivities, *along)
        if found is None or not set(names) <= set(found.parameters):
            found = bare(
                self.model, inner, self.given, sensitivities, self.raw, self.tolerance,
                kin=_digest(self.plain), directions=along,
            )  # fmt: skip
        kept[key] = found
        while len(kept) > KEPT:
            del kept[next(iter(kept))]
        columns = [found.parameters.index(n) for n in names]
        return replace(found, parameters=names, gradients=found.gradients[:, :, columns])

    def _key(self, inputs: Mapping[str, InputSignal], along: Mapping[str, Direction]) -> bytes:
        """Return a key of what decides a run, and of the ways in which its inputs move."""
        values = sorted(changed(self.model, self.given).items())
        text = repr((values, self.raw, self.tolerance.rtol, _digest(inputs), sorted(along))).encode()
        return b"".join([self.time.tobytes(), text, *(along[n].points.tobytes() for n in sorted(along))])

    def _moving(self, name: str, inputs: Mapping[str, InputSignal], raw: Array) -> Array:
        """(n, raw) the derivative by a parameter of the entrance, from runs with it a hundredth of its size apart.

        An output that jumps with an input shows the jump, not a derivative, at a row over which it passes between two of
        the runs: there, the difference is that of the side on which none passes.
        """
        parameter = self.model.parameters[name]
        h = 0.01 * parameter.size
        at = self.values[name]
        low, high = max(at - h, parameter.min), min(at + h, parameter.max)
        runs, passed = {}, {}
        for value in (low, high):
            moved, _ = self._inputs((), {**self.values, name: value})
            runs[value] = self._inside(moved).trajectory.values
            passed[value] = _passed_over(self.time, inputs, moved)
        found = np.asarray((runs[high] - runs[low]) / (high - low))
        for side, other in ((low, high), (high, low)):
            if side == at:
                continue
            own, over = runs[side] - raw, runs[other] - raw
            # Without a jump the changes on the two sides differ by the bend alone; one no larger than elsewhere does no harm.
            elsewhere = np.abs(over)[~passed[other]].max(axis=0, initial=0.0)
            jumped = np.abs(over) > np.maximum(JUMP * np.abs(own), elsewhere)
            rows = (passed[other] & ~passed[side])[:, None] & jumped
            found[rows] = own[rows] / (side - at)
        return found

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


def _direction(inputs: Mapping[str, InputSignal], slope: Mapping[str, InputSignal]) -> tuple[Direction, float]:
    """Return the direction of a slope, and the slope's size in it: 0 where nothing moves."""
    ranges = {n: max(np.ptp(s.values), 1e-6 * np.abs(s.values).max(), 1e-12) for n, s in inputs.items()}
    sizes = {n: float(np.abs(slope[n].values).max()) / r for n, r in ranges.items()}
    size = max(sizes.values(), default=0.0)
    points = np.concatenate([slope[n].values for n in inputs]) / (size or 1.0)
    return Direction(points, "along " + ", ".join(n for n, s in sizes.items() if s > 0.0)), size


def _digest(inputs: Mapping[str, InputSignal]) -> str:
    parts = [a.tobytes() + b"|" for s in inputs.values() for a in (s.times, s.values, s.breaks)]
    return hashlib.sha256(b"".join(parts)).hexdigest()


def _passed_over(time: Array, inputs: Mapping[str, InputSignal], moved: Mapping[str, InputSignal]) -> NDArray[np.bool_]:
    """Return which rows, (n,), a jump of the inputs passes over as it moves; a row at a jump is after it."""
    found = np.zeros(time.size, dtype=bool)
    for before, after in zip(inputs.values(), moved.values(), strict=True):
        for a, b in zip(before.breaks.tolist(), after.breaks.tolist(), strict=False):
            found |= (time >= min(a, b)) & (time < max(a, b))
    return found


def _brief(slopes: Iterable[InputSignal]) -> bool:
    """Return whether one of the slopes is a few spikes: small enough to be a slope, they are lost in a run's tolerance."""
    return any(_spiked(s) for s in slopes)


def _spiked(slope: InputSignal) -> bool:
    """Return whether a slope's largest value lasts for a small share of the time."""
    size = np.abs(slope.values)
    span = float(slope.times[-1] - slope.times[0])
    return bool(span > 0 and np.trapezoid(size, slope.times) < BRIEF * span * size.max())


End = Literal["input", "output"]
ALONG = "share_of_the_direction"
"""Parameter by which the FMU's outputs move along signals s0, s1 ...: its sensitivity passes theirs through the effects."""
NAME = re.compile(r"[A-Za-z_]\w*")


def end_of(model: FmuModel, place: str) -> tuple[End, int] | None:
    """Return the side of an insertion point and its number there; None for what is none."""
    name = place.removeprefix("outputs.")
    if place in model.inputs:
        return "input", list(model.inputs).index(place)
    return ("output", list(model.outputs).index(name)) if name in model.outputs else None


def entrance(model: FmuModel) -> Model:
    """Inputs u0, u1 ... that come out as y0, y1 ... after the effects at the FMU's inputs."""
    return _passage(len(model.inputs), _at(model, "input"), tuple(i.value for i in model.inputs.values()), False)


def exit_(model: FmuModel, *, along: bool = False) -> Model:
    """The FMU's outputs as u0, u1 ... that come out as y0, y1 ... after the effects at them.

    along: with inputs s0, s1 ... too, of which ALONG times are added to the outputs.
    """
    return _passage(len(model.outputs), _at(model, "output"), (0.0,) * len(model.outputs), along)


def added(model: FmuModel, use: EffectUse) -> dict[str, Parameter]:
    """The parameters that an effect brings; none where it is neutral.

    Raises UnknownNameError or ModelError where it cannot sit there: at what is no end, or reading what it cannot see.
    """
    _check(model, use)
    trial = replace(model, effects=(*model.effects, use))
    try:
        sides = entrance(trial), exit_(trial)
    except InputError as e:
        raise _in_own_names(model, use, e) from None
    return {n: p for side in sides for n, p in side.parameters.items() if n not in model.parameters}


def _check(model: FmuModel, use: EffectUse) -> None:
    """Check an effect; raises what `added` says of places, of the signal brought in, and of parameters that are given by name."""
    where = f"effect '{use.effect}' at {', '.join(use.at)}"
    for place in use.at:
        if end_of(model, place) is None:
            raise unknown_name(
                "insertion point", place, model.insertion_points, where=f"model '{model.name}', which is closed inside"
            )
    for name, value in use.parameters.items():
        if isinstance(value, str):
            raise ModelError(
                "an effect at an end of an FMU cannot share a parameter with what is inside",
                where=f"{where}, parameter '{name}'",
                expected="a number",
                got=repr(value),
            )
    brought = use.sources
    read = []
    if use.expression:
        names = {s.name for s in parse(use.expression, where=f"{where}, expression").free_symbols}
        read = sorted(names - use.parameters.keys() - {"time"})
    for k, place in enumerate(use.at):
        for name, key in [*((n, "from") for n in brought[k : k + 1]), *((n, "expression") for n in read)]:
            _check_reading(model, place, name, f"{where}, {key}")


def _check_reading(model: FmuModel, place: str, name: str, where: str) -> None:
    """Raise where an effect at a place cannot see a signal."""
    here, there = end_of(model, place), end_of(model, name)
    assert here is not None
    if there is None:
        known = model.inputs if here[0] == "input" else [s for s in model.insertion_points if s not in model.inputs]
        raise unknown_name("signal", name, known, where=f"{where} (the model is closed inside)")
    if here[0] == there[0]:
        return
    if here[0] == "input":
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


def _at(model: FmuModel, end: End) -> tuple[EffectUse, ...]:
    """The effects with those of their places that lie at one end, in the passage's names."""
    found = []
    for use in model.effects:
        ends = [end_of(model, p) for p in use.at]
        here = [k for k, e in enumerate(ends) if e is not None and e[0] == end]
        places = [e for k in here if (e := ends[k]) is not None]
        letter = "u" if end == "input" else "y"
        if places:
            read = [e for k in here if use.source and (e := end_of(model, use.sources[k])) is not None]
            found.append(
                replace(
                    use,
                    at=tuple(f"{letter}{k}" for _, k in places),
                    source=joined_sources(f"{letter}{k}" for _, k in read),
                    expression=_renamed(model, use),
                )
            )
    return tuple(found)


def _renamed(model: FmuModel, use: EffectUse) -> str:
    """A term's expression with the FMU's inputs, or its outputs as they come out of it, under the passage's names."""

    def name(match: re.Match[str]) -> str:
        word = match.group()
        place = None if word in use.parameters else end_of(model, word)
        return f"u{place[1]}" if place else word

    return NAME.sub(name, use.expression)


@lru_cache(maxsize=64)
def _passage(count: int, uses: tuple[EffectUse, ...], values: Sequence[float], along: bool) -> Model:
    inputs = {f"u{k}": Input(v) for k, v in enumerate(values)}
    passing = {f"y{k}": symbol(f"u{k}") for k in range(count)}
    if along:
        inputs |= {f"s{k}": Input(0.0) for k in range(count)}
        passing = {n: e + symbol(ALONG) * symbol(f"s{n[1:]}") for n, e in passing.items()}
    model = Model(
        name="ends",
        parameters=FrozenMap({ALONG: Parameter(0.0, scale=1.0)} if along else {}),
        inputs=FrozenMap(inputs),
        outputs=FrozenMap({n: Output(e) for n, e in passing.items()}),
    )
    return apply_effects(model, uses)


def _in_own_names(model: FmuModel, use: EffectUse, error: InputError) -> InputError:
    """The error with the FMU's names in the place of the passage's."""
    outputs = any((e := end_of(model, p)) is not None and e[0] == "output" for p in use.at)
    names = list(model.outputs if outputs else model.inputs)

    def own(text: str) -> str:
        return re.sub(r"\b[uy](\d+)\b", lambda m: names[int(m[1])] if int(m[1]) < len(names) else str(m[0]), text)

    parts = {k: own(getattr(error, k)) for k in ("where", "expected", "got", "hint")}
    return type(error)(own(error.what), **parts)
