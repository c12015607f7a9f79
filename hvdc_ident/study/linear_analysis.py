"""The answers to a study's [linearize] beside the linear model: trimming, margins, norms, ports, comparison, reduction."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.errors import LinearizationError, SteadyStateError
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize import (
    LinearModel,
    OperatingPoint,
    RootLocus,
    compare,
    find_operating_point,
    linearize,
    loop,
    loop_margins,
    named,
    ncf_margin,
    parts_of,
    plant_and_controller,
    port_impedance,
    root_locus,
    symbolic_transfer,
)
from hvdc_ident.linearize.distance import ModelDistance
from hvdc_ident.linearize.export import csv_of_response
from hvdc_ident.linearize.gain_limits import Crossing
from hvdc_ident.linearize.modal import NamedMode
from hvdc_ident.model import AnyModel, Model, is_white_box
from hvdc_ident.study import schema
from hvdc_ident.study.measured_responses import port_of
from hvdc_ident.summary.linear import CoprimeMargin, Formula, PortImpedance, StudyMargins, StudyReduction, Trim

if TYPE_CHECKING:
    from hvdc_ident.study.study import Study


MOST_CHANNELS = 12
"""Channels up to which the norms of each are given beside those of the whole, and the frequency response for the report."""


def operating_point(study: Study, values: Mapping[str, float] | None = None) -> OperatingPoint:
    """Return the operating point that [linearize] asks for: at rest, at the given starts, or trimmed.

    values: of the parameters; left out, the given ones. Raises SteadyStateError, with what a study can do
    about it, where there is none.
    """
    asked = study.settings.linearize
    at = asked.at if asked else "steady"
    fixed = dict(study.given if values is None else values)
    if asked is None or asked.trim is None:
        try:
            return find_operating_point(study.model, fixed, at=at)
        except SteadyStateError as e:
            hint = "other values in [model.values], or a `guess` for the states in the model card"
            if at == "steady":
                hint += '; [linearize] at = "start" for states that have a start and never rest'
            raise SteadyStateError(e.what, where=e.where, expected=e.expected, got=e.got, hint=hint) from None
    trim = asked.trim
    free = trim.free or ()
    return find_operating_point(
        study.model,
        {n: v for n, v in fixed.items() if n not in free},
        free,
        guess={n: v for n, v in fixed.items() if n in free},
        inputs=trim.inputs,
        outputs=trim.outputs,
        at=at,
    )


def modes_of(study: Study, linear: LinearModel) -> list[NamedMode]:
    """Return every mode, with a name from the parts of the plant that take part in it where these are known."""
    if not is_white_box(study.model):
        return [NamedMode(m, "", FrozenMap()) for m in linear.modes()]
    parts = parts_of(study.model)
    return [named(m, parts) for m in linear.modes()]


def analyses(study: Study, linear: LinearModel) -> tuple[dict[str, Any], dict[str, str]]:
    """Return what is asked for beside the linear model, by field of `LinearResult`, and the files to write beside it by name."""
    asked = study.settings.linearize or schema.LinearizeTable()
    scaled = linear.scaled(asked.scale)
    ports, files = _ports(asked.port, linear)
    fields = {
        "norms": _norms(scaled),
        "scale": asked.scale,
        "trim": None if asked.trim is None else _trimmed(study.model, asked.trim, linear),
        "margins": _margins(asked, linear) if asked.break_at or asked.plant else None,
        "reduced": None if asked.reduce is None else _reduced(asked.reduce, scaled),
        "comparison": None if study.compared is None else _compared(study, scaled),
        "formulas": _formulas(study, linear, asked.formula) if asked.formula else (),
        "locus": None if asked.locus is None else _locus(asked.locus, linear),
        "ports": ports,
    }
    return fields, files


def _norms(linear: LinearModel) -> dict[str, Any]:
    """Norms of the whole, and of each channel where these are few."""
    pairs = [(i, o) for o in linear.output_names for i in linear.input_names]
    norms: dict[str, Any] = {"whole": linear.norms()}
    if len(pairs) <= MOST_CHANNELS:
        norms["channels"] = [{"input": i, "output": o, **linear.channel(i, o).norms()} for i, o in pairs]
    return norms


def _trimmed(model: AnyModel, trim: schema.TrimTable, linear: LinearModel) -> Trim:
    point = linear.point
    assert point is not None
    free = trim.free
    if free is None:
        search = point.search
        moved = [n for n, i in model.inputs.items() if n not in trim.inputs and point.inputs[n] != i.value]
        free = moved if search is None else [search.system.inputs[k] for k in search.freed_u]
    values = {**point.inputs, **point.parameters}
    return Trim(dict(trim.outputs), dict(trim.inputs), {n: values[n] for n in free})


def _equations(linear: LinearModel) -> tuple[Model, OperatingPoint]:
    """Return the model with equations that was linearised, and its point."""
    point = linear.point
    assert point is not None and is_white_box(point.model)
    return point.model, point


def _margins(asked: schema.LinearizeTable, linear: LinearModel) -> StudyMargins:
    model, point = _equations(linear)
    loops = loop_margins(loop(model, asked.break_at, point)) if asked.break_at else None
    if not asked.plant:
        return StudyMargins(loops)
    inputs, outputs = asked.plant.inputs, asked.plant.outputs
    plant, controller = plant_and_controller(model, inputs, outputs, point)
    margin = CoprimeMargin(ncf_margin(plant, controller), ncf_margin(plant).value, tuple(inputs), tuple(outputs))
    return StudyMargins(loops, margin)


def _reduced(asked: schema.ReduceTable, linear: LinearModel) -> StudyReduction:
    """The reduced model with the error it has and the bound that was known beforehand."""
    reduction = linear.reduce(asked.order, asked.tolerance, match_dc=asked.match_dc)
    return StudyReduction(reduction, reduction.error, len(linear.state_names))


def _compared(study: Study, linear: LinearModel) -> ModelDistance:
    """The other model's linear model at the same inputs and, by name, parameters, against this one's."""
    point, other = linear.point, study.compared
    assert point is not None and other is not None
    same = {n: v for n, v in point.inputs.items() if n in other.inputs}
    at = find_operating_point(other, same)
    second = linearize(other, at, inputs=linear.input_names, outputs=linear.output_names)
    asked = study.settings.linearize
    return compare(linear, second.scaled(asked.scale if asked else {}))


def _formulas(study: Study, linear: LinearModel, parameters: list[str]) -> tuple[Formula, ...]:
    """Each transfer function with some parameters as symbols; where there is none, the reason."""
    model = study.model
    assert is_white_box(model)
    formulas = []
    for o in linear.output_names:
        for i in linear.input_names:
            try:
                f = symbolic_transfer(model, i, o, parameters, linear.point)
            except LinearizationError as e:
                formulas.append(Formula(i, o, reason=e.what))
            else:
                formulas.append(Formula(i, o, *f.rounded(), f.latex()))
    return tuple(formulas)


def _locus(asked: schema.LocusTable, linear: LinearModel) -> RootLocus:
    """The eigenvalues along the parameter, all else as at the operating point."""
    model, point = _equations(linear)
    spread = np.geomspace if asked.scale == "log" else np.linspace
    values = np.asarray(spread(asked.min, asked.max, asked.points), dtype=float)
    fixed = {n: v for n, v in {**point.inputs, **point.parameters}.items() if n != asked.parameter}
    return root_locus(model, asked.parameter, values, fixed)


def _ports(tables: list[schema.PortTable], linear: LinearModel) -> tuple[tuple[PortImpedance, ...], dict[str, str]]:
    """The impedance of each port, and a file of each."""
    impedances, files = [], {}
    for table in tables:
        model, point = _equations(linear)
        omega = 2 * np.pi * np.geomspace(table.band[0], table.band[1], table.points)
        z = port_impedance(model, port_of(table), omega, point)
        passive = np.linalg.eigvalsh(z.values + np.conj(np.swapaxes(z.values, 1, 2)))[:, 0] / 2
        k = int(np.argmin(passive))
        impedances.append(PortImpedance(table.name, z, Crossing(float(omega[k]), float(passive[k]))))
        files[f"impedance.{table.name}.csv"] = csv_of_response(z)
    return tuple(impedances), files
