"""An FMU evaluated in its workers: over an experiment, with effects at its terminals, or at a point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, Experiment, InputSignal, Trajectory
from hvdc_ident.errors import HvdcIdentError, InputError, ModelError, require_known
from hvdc_ident.fmu.piecewise_linear import PackedInputs
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.simulate import Simulation, Statistics, Tolerance, chains_of

if TYPE_CHECKING:
    from hvdc_ident.fmu.model import FmuModel

UNBOUNDED = 1e300  # a bound where there is none: JSON has no infinity


@dataclass(frozen=True, eq=False)
class Direction:
    """A direction in which the inputs of a run move, scaled such that one of them moves by its range.

    points: of all inputs, joined as `PackedInputs.values`. key: shared by directions that need the same difference step.
    """

    points: Array
    key: str


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
    from hvdc_ident.fmu.terminal_effects import RunWithEffects

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
    directions: Mapping[str, Direction] | None = None,
) -> Simulation:
    """Return the run of the FMU itself.

    fresh: whether it is run even where the last run was the same one, whose rows are given else. partial: whether the
    rows up to an end that the FMU asks for are accepted. noise_key: shared by runs whose noise and difference steps are
    alike though their inputs differ. directions: in which all inputs move, by a name that is no parameter's; derivatives
    along them come after those of the sensitivities.
    """
    along = directions or {}
    signals = PackedInputs.of(list(inputs_of(model, experiment, given).values()))
    scales = [*_scales(model, sensitivities), *([1.0, (-UNBOUNDED, UNBOUNDED), 0.0] for _ in along)]
    sizes, bounds, starts = zip(*scales, strict=True) if scales else ((), (), ())
    sensitivities = (*sensitivities, *along)
    heading = {
        "do": "simulate",
        "values": changed(model, given),
        "outputs": names,
        "parameters": sensitivities,
        "sizes": sizes,
        "bounds": bounds,
        "starts": starts,
        "tolerance": tolerance.rtol,
        "partial": partial,
        "fresh": fresh,
        "noise key": noise_key,
        "directions": {n: d.key for n, d in along.items()},
    }
    arrays = {
        "time": experiment.time,
        "sizes": signals.sizes,
        "times": signals.times,
        "points": signals.values,
        "breaks": signals.breaks,
    }
    if along:
        arrays["directions"] = np.array([d.points for d in along.values()])
    answer, out = model.pool.ask(heading, arrays)
    notes = dict(answer["notes"])
    if not model.fmu.outputs and set(names) == set(model.fmu.shown):
        notes["outputs"] = "the FMU declares none: its states are recorded"
    errors = dict(zip(sensitivities, out["errors"].tolist(), strict=True))
    model.pool.sensitivity_error = max([model.pool.sensitivity_error, *errors.values()])
    worst = max(errors, key=lambda n: errors[n], default=None)
    if worst is not None and errors[worst] > 0.0:
        notes["sensitivity error"] = f"{errors[worst]:.2g} of the derivative by {worst}, the least certain"
    rows = out["outputs"]
    status = "converged" if rows.shape[0] == experiment.time.size else "ended"
    method = "lsoda" if model.has_equations else "co-simulation"
    accepted, events, evaluations, segments = answer["counts"]
    return Simulation(
        Trajectory(experiment.time[: rows.shape[0]], rows, names, tuple(model.outputs[n].unit for n in names)),
        sensitivities,
        out["gradients"],
        Statistics(status, method, accepted, 0, events, evaluations, segments, 0),
        FrozenMap(notes),
    )


def inputs_of(model: FmuModel, experiment: Experiment, given: Mapping[str, float]) -> dict[str, InputSignal]:
    """Return every input's signal, with its offset added."""
    signals = {}
    for name, default in model.inputs.items():
        signal = experiment.inputs.get(name) or InputSignal.constant(given.get(name, default.value))
        offset = experiment.offsets.get(name, 0.0)
        signals[name] = InputSignal(signal.times, signal.values + offset, signal.breaks) if offset else signal
    return signals


def changed(model: FmuModel, given: Mapping[str, float]) -> dict[str, float]:
    """Return the values of the FMU's parameters that differ from its starts. Raises ModelError where one cannot be set."""
    values = {}
    for name, variable in model.fmu.parameters.items():
        value = float(given.get(name, model.parameters[name].value))
        if not np.isfinite(value):
            raise ModelError(f"the value of parameter '{name}' is not finite", where=f"model '{model.name}'")
        if variable.whole and value != round(value):
            raise ModelError(
                f"parameter '{name}' takes whole numbers only", where=f"model '{model.name}'", got=f"{value:g}"
            )
        if value != variable.start:
            values[name] = value
    return values


def _scales(model: FmuModel, sensitivities: Sequence[str]) -> list[tuple[float, tuple[float, float], float]]:
    """Return typical size, bounds and start of each parameter or input by which derivatives are asked for."""
    scales = []
    for name in sensitivities:
        variable = model.fmu.parameters.get(name) or model.fmu.inputs[name]
        if variable.whole:
            raise ModelError(
                f"there is no derivative by '{name}', which takes whole numbers only", where=f"model '{model.name}'"
            )
        start = variable.start or 0.0
        if parameter := model.parameters.get(name):
            bounds = max(parameter.min, -UNBOUNDED), min(parameter.max, UNBOUNDED)
            scales.append((parameter.size, bounds, start))
        else:
            size = max(abs(model.inputs[name].value), variable.nominal)
            scales.append((size, (-UNBOUNDED, UNBOUNDED), start))
    return scales


@dataclass(frozen=True, eq=False)
class FmuPoint:
    """x (nx,), its derivatives (nx,), outputs (ny,), and the Jacobian of both by [x, u, p], (nx + ny, nx + nu + np).

    nominals: (nx,) sizes of the states. directional: which columns are the FMU's own. error: of the Jacobian, in shares
    of each row's largest entry. near: whether differences of two step sizes disagree, as beside a limit.
    """

    x: Array
    derivatives: Array
    outputs: Array
    jacobian: Array
    nominals: Array
    directional: NDArray[np.bool_]
    error: float
    near: bool


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
        "values": changed(model, values),
        "time": time,
        "outputs": list(outputs),
        "check": check,
        "parameters": list(parameters),
        "sizes": [size for size, _, _ in _scales(model, parameters)],
    }
    u = np.array([float(values.get(n, i.value)) for n, i in model.inputs.items()])
    answer, out = model.pool.ask(heading, {"u": u, **({} if states is None else {"x": states})})
    return FmuPoint(
        out["x"],
        out["derivatives"],
        out["outputs"],
        out["jacobian"],
        out["nominals"],
        out["directional"] > 0.5,
        float(answer["error"]),
        bool(answer["near"]),
    )
