"""An FMU evaluated in its workers: over an experiment or at a point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.data import Array, Experiment, InputSignal, Trajectory
from hvdc_ident.errors import ModelError
from hvdc_ident.fmu.gradients import DifferentiatedRun, Differentiation, Varied
from hvdc_ident.fmu.last_runs import LastRuns
from hvdc_ident.fmu.request import FmuPoint, RunRequest
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.simulate import Simulation, Statistics, Tolerance

if TYPE_CHECKING:
    from hvdc_ident.fmu.model import FmuModel

REUSE_NOTES = {
    "instance": "a reset does not bring the FMU back to its start: each run has a new instance",
    "process": "neither a reset nor a new instance brings the FMU back to its start: each run has a new process",
}


def simulate_without_effects(
    model: FmuModel,
    experiment: Experiment,
    given: Mapping[str, float],
    sensitivities: tuple[str, ...],
    names: tuple[str, ...],
    tolerance: Tolerance,
    *,
    partial: bool = False,
    fresh: bool = False,
    noise_key: str = "",
    directions: Sequence[Varied] = (),
) -> Simulation:
    """Return the run of the FMU itself.

    fresh: whether one of the last runs is run all the same. partial: whether the rows up to an end that the FMU asks for are
    accepted. noise_key: shared by runs whose noise and difference steps are
    alike though their inputs differ. directions: in which all inputs move; derivatives along them come after those of the
    sensitivities.
    """
    cache: LastRuns[DifferentiatedRun] = model.pool.cache
    inputs = tuple(inputs_of(model, experiment, given).values())
    values = _set_values(model, given, sensitivities)
    run = RunRequest(values, inputs, experiment.time, names, tolerance.rtol)
    varied = [*_varied(model, run, sensitivities), *directions]
    labels = [v.label for v in varied]
    made = None if fresh else cache.taken(run.key)
    if made is None or not made.has(labels):
        made = Differentiation(model.pool, run, varied, noise_key, partial, made).result()
    if made.end is None:
        cache.keep(run.key, made)
    columns = [made.labels.index(label) for label in labels]
    errors = made.errors[columns]
    notes = {**_learned_notes(model.pool.learned), **made.notes}
    if not model.fmu.outputs and set(names) == set(model.fmu.shown):
        notes["outputs"] = "the FMU declares none: its states are recorded"
    if errors.max(initial=0.0) > 0.0:
        worst = int(np.argmax(errors))
        model.pool.sensitivity_error = max(model.pool.sensitivity_error, float(errors[worst]))
        notes["sensitivity error"] = f"{errors[worst]:.2g} of the derivative by {varied[worst].name}, the least certain"
    time, rows = experiment.time[: made.outputs.shape[0]], made.outputs
    status = "converged" if time.size == experiment.time.size else "ended"
    method = "lsoda" if model.has_equations else "co-simulation"
    accepted, events, evaluations, segments = made.counts
    return Simulation(
        Trajectory(time, rows, names, tuple(model.outputs[n].unit for n in names)),
        tuple(v.name for v in varied),
        made.gradients[:, :, columns],
        Statistics(status, method, accepted, 0, events, evaluations, segments, 0),
        FrozenMap(notes),
    )


def _learned_notes(learned: Mapping[str, Any]) -> dict[str, str]:
    """Return notes for the user on how the FMU has to be run, by subject."""
    texts = {}
    if learned.get("restart") in REUSE_NOTES:
        texts["restart"] = REUSE_NOTES[learned["restart"]]
    if learned.get("reading") == "never":
        texts["outputs at jumps"] = (
            "the FMU loses jumps of its inputs where outputs are read right after them: rows at jumps are before them"
        )
    if learned.get("sloping") == "ignored":
        texts["ramps of inputs"] = (
            "the FMU offers to take slopes of its inputs, but was further off with them than with inputs held at their "
            "mean over each step: they are held"
        )
    if learned.get("steps") == "even":
        texts["steps"] = (
            "the FMU refuses steps of different lengths: it took even ones, rows between are joined by lines"
        )
    if learned.get("own values"):
        listed = ", ".join(f"'{n}' = {v:.6g}" for n, v in learned["own values"].items())
        texts["own values"] = (
            f"the FMU's binary has values that its description does not: {listed}; runs that name none have these"
        )
    if learned.get("outputs held"):
        texts["internal steps"] = (
            f"the FMU takes steps of its own and its outputs at a row are those of the last one, up to "
            f"{learned['behind']:.3g} s earlier"
        )
    return texts


def inputs_of(model: FmuModel, experiment: Experiment, given: Mapping[str, float]) -> dict[str, InputSignal]:
    """Return every input's signal, with its offset added."""
    signals = {}
    for name, default in model.inputs.items():
        signal = experiment.inputs.get(name) or InputSignal.constant(given.get(name, default.value))
        offset = experiment.offsets.get(name, 0.0)
        signals[name] = InputSignal(signal.times, signal.values + offset, signal.breaks) if offset else signal
    return signals


def _set_values(model: FmuModel, given: Mapping[str, float], varied: Sequence[str] = ()) -> dict[str, float]:
    """Return the values of parameters that the FMU is given: those that are not its starts, and starts that are named or varied.

    A start that the FMU is known to have itself is left out. Raises ModelError where a value cannot be set.
    """
    values, learned = {}, model.pool.learned
    doubtful = {*learned["own values"], *learned["unread"]} if "own values" in learned else model.fmu.parameters.keys()
    asked = doubtful & {*given, *varied}
    for name, variable in model.fmu.parameters.items():
        value = float(given.get(name, model.parameters[name].value))
        if not np.isfinite(value):
            raise ModelError(f"the value of parameter '{name}' is not finite", where=f"model '{model.name}'")
        if variable.whole and value != round(value):
            raise ModelError(
                f"parameter '{name}' takes whole numbers only", where=f"model '{model.name}'", got=f"{value:g}"
            )
        if value != variable.start or name in asked:
            values[name] = value
    return values


def _varied(model: FmuModel, run: RunRequest, names: Sequence[str]) -> list[Varied]:
    """Return parameters and inputs as what a run is differentiated by; inputs by constants added to them."""
    varied = []
    for name in names:
        variable = model.fmu.parameters.get(name) or model.fmu.inputs[name]
        if parameter := model.parameters.get(name):
            value = run.values.get(name, variable.start or 0.0)
            size, low, high = _size(model, name), parameter.min, parameter.max
            varied.append(Varied(name, name, value, size, low, high, variable))
        else:
            points = tuple(
                np.full(i.times.size, float(n == name)) for n, i in zip(model.inputs, run.inputs, strict=True)
            )
            varied.append(Varied(name, name, 0.0, _size(model, name), variable=variable, points=points))
    return varied


def _size(model: FmuModel, name: str) -> float:
    """Return the typical size of a parameter or an input that is a real number. Raises ModelError for any other."""
    variable = model.fmu.parameters.get(name) or model.fmu.inputs[name]
    if variable.whole:
        raise ModelError(
            f"there is no derivative by '{name}', which takes whole numbers only", where=f"model '{model.name}'"
        )
    if parameter := model.parameters.get(name):
        return parameter.size
    return max(abs(model.inputs[name].value), variable.nominal)


def smooth_inputs(model: FmuModel) -> tuple[str, ...]:
    """Return the inputs that may change continuously: those a Jacobian has columns for."""
    return tuple(n for n, v in model.fmu.inputs.items() if v.continuous)


def at_point(
    model: FmuModel,
    values: Mapping[str, float],
    states: Array | None,
    outputs: Sequence[str],
    parameters: Sequence[str] = (),
    time: float = 0.0,
    *,
    check: bool = True,
) -> FmuPoint:
    """Return the FMU at values of parameters and inputs; states None: where its own initialisation puts them.

    parameters: those the Jacobian has columns for. check: whether directional derivatives that once agreed with
    differences are compared again. Raises ModelError where it has no equations, SimulationError where
    it cannot be evaluated.
    """
    if not model.has_equations:
        raise ModelError(
            "a co-simulation FMU shows no equations",
            where=f"model '{model.name}'",
            expected="model exchange",
            hint="export it with model exchange; simulate, sweep, identify and fit work on it as it is",
        )
    heading = {
        "do": "point",
        "values": _set_values(model, values),
        "time": time,
        "outputs": list(outputs),
        "check": check,
        "parameters": list(parameters),
        "sizes": [_size(model, name) for name in parameters],
    }
    u = np.array([float(values.get(n, i.value)) for n, i in model.inputs.items()])
    answer, _ = model.pool.ask(heading, {"u": u, **({} if states is None else {"x": states})})
    point: FmuPoint = answer["point"]
    return point
