"""What a sweep is asked for: whether it fits the model and the data, and the work of a point that follows from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from hvdc_ident.errors import ComputationError, SteadyStateError, StudyError, unknown_name
from hvdc_ident.experiment import Experiment
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.model.external import AnyModel
from hvdc_ident.sensitivity.axes import Points
from hvdc_ident.sensitivity.point import PointTask, Reference, simulated
from hvdc_ident.simulate.engine import Method, simulate
from hvdc_ident.trajectory import Array

Want = Literal["rmse", "poles", "bode"]


def check(
    model: AnyModel, experiments: Sequence[Experiment], points: Points, base: Mapping[str, float], want: Sequence[str]
) -> None:
    """Nothing; raises InputError for names, values, bounds or experiments that do not fit the sweep."""
    known = [*model.parameters, *model.inputs]
    for name in (*points.names, *base):
        if name not in model.parameters and name not in model.inputs:
            raise unknown_name("parameter or input", name, known, where="sweep")
    for name in want:
        if name not in ("rmse", "poles", "bode"):
            raise unknown_name("result of a sweep", name, ("rmse", "poles", "bode"))
    names = [e.name for e in experiments]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise StudyError("two experiments of one name", where="sweep", got=twice[0], expected="distinct names")
    if "rmse" in want and not experiments:
        raise StudyError("a sweep has nothing to compare", where="sweep", expected="at least one experiment")
    for axis in points.axes:
        for column, name in enumerate(axis.names):
            _check_values(model, experiments, name, axis.values[:, column])


def _check_values(model: AnyModel, experiments: Sequence[Experiment], name: str, values: Array) -> None:
    for e in experiments:
        if name in e.inputs:
            raise StudyError(f"'{name}' is moved by experiment '{e.name}' and cannot be swept", where="sweep")
    own = model.parameters.get(name)
    if own is not None and not (own.min <= values.min() and values.max() <= own.max):
        raise StudyError(
            f"a value of '{name}' lies outside the model's own bounds",
            where=f"sweep of {name}",
            expected=f"values in [{own.min:g}, {own.max:g}]",
            got=f"{values.min():g} to {values.max():g}",
        )


def task_of(
    model: AnyModel,
    experiments: tuple[Experiment, ...],
    names: tuple[str, ...],
    base: FrozenMap[float],
    against: Literal["data", "base"] | AnyModel,
    outputs: Sequence[str] | None,
    want: Sequence[str],
    linear: tuple[Sequence[str], Sequence[str]] | None,
    omega: Array | None,
) -> PointTask:
    """The work of every point; what it is compared with is run once here. Raises ComputationError where that fails."""
    references: list[Reference] = []
    method: Method = "rosenbrock"
    if "rmse" in want:
        method = _method(model, experiments, base)
        for e in experiments:
            references += _references(model, e, base, against, outputs, method)
        if not references:
            raise StudyError(
                "no experiment has a recorded output to compare",
                where="sweep",
                hint='against="base", or another model, needs no recording',
            )
    poles = 0
    channels: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())
    frequencies = np.empty(0)
    if "poles" in want or "bode" in want:
        from hvdc_ident.linearize import find_operating_point, linearize

        try:
            point = find_operating_point(model, base)
        except SteadyStateError as e:
            hint = 'want = ["rmse"], which needs no operating point, or base values in [model.values] that have one'
            raise SteadyStateError(
                e.what, where=f"sweep, {e.where}", expected=e.expected, got=e.got, hint=hint
            ) from None
        at = linearize(
            model,
            point,
            inputs=linear[0] if linear else None,
            outputs=linear[1] if linear else None,
        )
        poles = int(np.size(at.poles())) if "poles" in want else 0
        channels = tuple(at.input_names), tuple(at.output_names)
        if "bode" in want:
            frequencies = np.asarray(omega if omega is not None else at.bode().omega, dtype=float)
    return PointTask(model, experiments, names, base, tuple(references), poles, frequencies, *channels, method=method)


def _method(model: AnyModel, experiments: tuple[Experiment, ...], base: FrozenMap[float]) -> Method:
    """The integrator of every point: the one that serves at the base values."""
    first = experiments[0]
    try:
        found = simulate(model, first, base, outputs=first.outputs or None).statistics.method
    except ComputationError:
        return "rosenbrock"
    except SteadyStateError:
        return "rosenbrock"
    return "explicit" if found == "explicit" else "rosenbrock"


def _references(
    model: AnyModel,
    e: Experiment,
    base: FrozenMap[float],
    against: Literal["data", "base"] | AnyModel,
    outputs: Sequence[str] | None,
    method: Method,
) -> list[Reference]:
    """What each output of one experiment is compared with."""
    if against == "data":
        recorded = [o for o in (e.outputs if outputs is None else outputs) if o in e.outputs]
        found = []
        for o in recorded:
            assert e.measured is not None
            rows = np.flatnonzero(e.compared & np.isfinite(e.measured[o]))
            if not rows.size:
                hint = "a wider window"
                raise StudyError(f"no row of '{o}' can be compared", where=f"experiment '{e.name}'", hint=hint)
            found.append(Reference(e.name, o, rows, np.array(e.measured[o][rows])))
        return found
    chosen = tuple(outputs if outputs is not None else (e.outputs or model.outputs))
    rows = np.flatnonzero(e.compared)
    if not isinstance(against, str) and hasattr(against, "outputs"):
        missing = [o for o in chosen if o not in against.outputs and o not in against.names]
        if missing and outputs is None:
            chosen = tuple(o for o in chosen if o not in missing)
        run = simulate(against, e.with_(measured=None), {}, outputs=chosen).trajectory.values
    elif against == "base":
        run = simulated(model, e, base, chosen, method)
    else:
        raise StudyError(
            "what a sweep is compared with is unknown", expected='"data", "base" or a Model', got=repr(against)[:60]
        )
    return [Reference(e.name, o, rows, np.array(run[rows, k])) for k, o in enumerate(chosen)]
