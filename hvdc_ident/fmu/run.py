"""One experiment with an FMU: names looked up, the worker asked, effects at its ends put on, the result made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hvdc_ident.data import Array, Experiment, InputSignal, Trajectory
from hvdc_ident.errors import HvdcIdentError, InputError, ModelError, require_known, unknown_name
from hvdc_ident.fmu.signals import Signals
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.simulate import Simulation, Statistics, Tolerance

if TYPE_CHECKING:
    from hvdc_ident.fmu.model import FmuModel

LARGE = 1e300
"""A bound where there is none: JSON has no infinity."""


@dataclass(frozen=True, eq=False)
class Direction:
    """A way in which the inputs of a run move, of such a size that one of them moves by its range.

    points: of all inputs, one after the other, as `Signals.values`. like: a name shared by directions for which the same
    step of differences does.
    """

    points: Array
    like: str


def simulate(
    model: FmuModel,
    experiment: Experiment,
    values: Mapping[str, float],
    sensitivities: tuple[str, ...],
    outputs: Sequence[str] | None,
    tolerance: Tolerance,
    partial: bool = False,
) -> Simulation:
    """The run, with its recording chains and effects. See `FmuModel.simulate`."""
    from hvdc_ident.fmu.ends import chains, simulate_with_effects

    place = f"experiment '{experiment.name}'"
    given = {**experiment.values, **values}
    names = tuple(model.outputs if outputs is None else outputs)
    try:
        checked = (
            model.recording((*names, *experiment.instrument)).driven(experiment.drive).with_effects(chains(experiment))
        )
    except InputError as e:
        raise e.at(place) from None
    for name in (*given, *experiment.inputs):
        if name not in checked.parameters and name not in checked.inputs:
            known = [*checked.parameters, *checked.inputs]
            raise unknown_name("parameter or input", name, known, where=place)
    for name in sensitivities:
        if name not in checked.parameters and name not in checked.inputs:
            raise unknown_name("parameter or input", name, [*checked.parameters, *checked.inputs], where=place)
    if experiment.starts:
        raise ModelError(
            "an FMU begins where its own initialisation puts it",
            where=place,
            expected="no starts of states",
            got=", ".join(experiment.starts),
            hint="a parameter of the FMU that is a start value, where it has one",
        )
    require_known("input", experiment.offsets, checked.inputs, f"{place}, offsets")
    try:
        if checked.effects:
            return simulate_with_effects(checked, experiment, given, sensitivities, names, tolerance)
        return bare(checked, experiment, given, sensitivities, names, tolerance, partial=partial and not sensitivities)
    except HvdcIdentError as e:
        raise e.at(place) from None


def bare(
    model: FmuModel,
    experiment: Experiment,
    given: Mapping[str, float],
    sensitivities: tuple[str, ...],
    names: tuple[str, ...],
    tolerance: Tolerance,
    *,
    partial: bool = False,
    kin: str = "",
    directions: Mapping[str, Direction] | None = None,
) -> Simulation:
    """The run of the FMU itself, without effects.

    partial: whether the rows up to an end that the FMU asks for do. kin: text that is the same for runs whose noise, and
    whose steps of differences, are alike though their inputs differ. directions: ways in which all inputs move, by a name
    that is no parameter's; derivatives along them come after those of the sensitivities.
    """
    along = directions or {}
    signals = Signals.of(list(inputs_of(model, experiment, given).values()))
    known = about(model, sensitivities)
    heading = {
        "do": "simulate",
        "values": changed(model, given),
        "outputs": names,
        "parameters": (*sensitivities, *along),
        "sizes": [*known["sizes"], *(1.0 for _ in along)],
        "bounds": [*known["bounds"], *([-LARGE, LARGE] for _ in along)],
        "starts": [*known["starts"], *(0.0 for _ in along)],
        "tolerance": tolerance.rtol,
        "partial": partial,
        "kin": kin,
        "directions": {n: d.like for n, d in along.items()},
    }
    sensitivities = (*sensitivities, *along)
    arrays = {
        "time": experiment.time,
        "sizes": signals.sizes,
        "times": signals.times,
        "points": signals.values,
        "breaks": signals.breaks,
    }
    if along:
        arrays["directions"] = np.array([d.points for d in along.values()])
    answer, out = model.host.ask(heading, arrays)
    units = tuple(model.outputs[n].unit for n in names)
    accepted, events, evaluations, segments = answer["counts"]
    method = "lsoda" if model.has_equations else "co-simulation"
    notes = dict(answer["notes"])
    if not model.fmu.outputs and set(names) == set(model.fmu.shown):
        notes["outputs"] = "the FMU declares none: its states are recorded"
    errors = dict(zip(sensitivities, out["errors"].tolist(), strict=True))
    model.host.sensitivity_error = max([model.host.sensitivity_error, *errors.values()])
    worst = max(errors, key=lambda n: errors[n], default=None)
    if worst is not None and errors[worst] > 0.0:
        notes["sensitivity error"] = f"{errors[worst]:.2g} of the derivative by {worst}, the least certain"
    rows = out["outputs"]
    status = "converged" if rows.shape[0] == experiment.time.size else "ended"
    return Simulation(
        Trajectory(experiment.time[: rows.shape[0]], rows, names, units),
        sensitivities,
        out["gradients"],
        Statistics(status, method, accepted, 0, events, evaluations, segments, 0),
        FrozenMap(notes),
    )


def inputs_of(model: FmuModel, experiment: Experiment, given: Mapping[str, float]) -> dict[str, InputSignal]:
    """Every input's signal, its offset added."""
    found = {}
    for name, own in model.inputs.items():
        signal = experiment.inputs.get(name) or InputSignal.constant(given.get(name, own.value))
        offset = experiment.offsets.get(name, 0.0)
        found[name] = InputSignal(signal.times, signal.values + offset, signal.breaks) if offset else signal
    return found


def changed(model: FmuModel, given: Mapping[str, float]) -> dict[str, float]:
    """The values of the FMU's parameters that are not what it starts with. Raises ModelError where one cannot be set."""
    found = {}
    for name, variable in model.fmu.parameters.items():
        value = float(given.get(name, model.parameters[name].value))
        if not np.isfinite(value):
            raise ModelError(f"the value of parameter '{name}' is not finite", where=f"model '{model.name}'")
        if variable.whole and value != round(value):
            raise ModelError(
                f"parameter '{name}' takes whole numbers only", where=f"model '{model.name}'", got=f"{value:g}"
            )
        if value != variable.start:
            found[name] = value
    return found


def about(model: FmuModel, sensitivities: Sequence[str]) -> dict[str, list[object]]:
    """Return what differences need of parameters and inputs: typical sizes, bounds, where they stand if nobody sets them."""
    sizes, bounds, starts = [], [], []
    for name in sensitivities:
        variable = model.fmu.parameters.get(name) or model.fmu.inputs[name]
        if variable.whole:
            raise ModelError(
                f"there is no derivative by '{name}', which takes whole numbers only", where=f"model '{model.name}'"
            )
        own = model.parameters.get(name)
        sizes.append(own.size if own else max(abs(model.inputs[name].value), variable.nominal))
        bounds.append([max(own.min, -LARGE), min(own.max, LARGE)] if own else [-LARGE, LARGE])
        starts.append(variable.start or 0.0)
    return {"sizes": list(sizes), "bounds": list(bounds), "starts": list(starts)}
