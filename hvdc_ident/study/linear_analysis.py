"""The answers to a study's [linearize] beside the linear model: trimming, margins, norms, ports, comparison, reduction."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.errors import LinearizationError, SteadyStateError
from hvdc_ident.model import Model
from hvdc_ident.study import schema
from hvdc_ident.study.measured_responses import port_of

if TYPE_CHECKING:
    from hvdc_ident.linearize import LinearModel, OperatingPoint
    from hvdc_ident.study.study import Study


MOST_CHANNELS = 12
"""Channels up to which the norms of each are given beside those of the whole, and the frequency response for the report."""


def operating_point(study: Study, values: Mapping[str, float] | None = None) -> OperatingPoint:
    """Return the operating point that [linearize] asks for: at rest, at the given starts, or trimmed.

    values: of the parameters; left out, the given ones. Raises SteadyStateError, with what a study can do
    about it, where there is none.
    """
    from hvdc_ident.linearize import find_operating_point

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


def modes_of(study: Study, linear: LinearModel) -> list[dict[str, Any]]:
    """Return every mode as plain numbers, with a name from the parts of the plant that take part in it where these are known."""
    from hvdc_ident.linearize import named, parts_of

    if not isinstance(study.model, Model):
        return [m.to_dict() for m in linear.modes()]
    parts = parts_of(study.model)
    modes = [named(m, parts) for m in linear.modes()]
    return [{**m.mode.to_dict(), "name": m.name, "parts": dict(m.parts)} for m in modes]


def analyses(study: Study, linear: LinearModel) -> tuple[dict[str, Any], dict[str, str]]:
    """Return what is asked for beside the linear model, by key of the JSON, and the files to write beside it by name."""
    asked = study.settings.linearize or schema.LinearizeTable()
    scaled = linear.scaled(asked.scale)
    data: dict[str, Any] = {"norms": _norms(scaled)}
    files: dict[str, str] = {}
    if asked.scale:
        data["scale"] = dict(asked.scale)
    if asked.trim is not None:
        data["trim"] = _trimmed(asked.trim, linear)
    if asked.break_at or asked.plant:
        data["margins"] = _margins(asked, linear)
    if asked.reduce is not None:
        data["reduced"] = _reduced(asked.reduce, scaled)
    if study.compared is not None:
        data["comparison"] = _compared(study, scaled)
    if asked.formula:
        data["formulas"] = _formulas(study, linear, asked.formula)
    if asked.locus:
        data["locus"] = _locus(asked.locus, linear)
    if asked.port:
        data["ports"], files = _ports(asked.port, linear)
    return data, files


def _norms(linear: LinearModel) -> dict[str, Any]:
    """Norms of the whole, and of each channel where these are few."""
    pairs = [(i, o) for o in linear.output_names for i in linear.input_names]
    found: dict[str, Any] = {"whole": linear.norms()}
    if len(pairs) <= MOST_CHANNELS:
        found["channels"] = [{"input": i, "output": o, **linear.channel(i, o).norms()} for i, o in pairs]
    return found


def _trimmed(trim: schema.TrimTable, linear: LinearModel) -> dict[str, Any]:
    point = linear.point
    assert point is not None
    free = trim.free
    if free is None:
        search = point.search
        moved = [n for n, i in point.model.inputs.items() if n not in trim.inputs and point.inputs[n] != i.value]
        free = moved if search is None else [search.system.inputs[k] for k in search.freed_u]
    found = {**point.inputs, **point.parameters}
    return {"outputs": dict(trim.outputs), "inputs": dict(trim.inputs), "found": {n: found[n] for n in free}}


def _margins(asked: schema.LinearizeTable, linear: LinearModel) -> dict[str, Any]:
    from hvdc_ident.linearize import loop, loop_margins, ncf_margin, plant_and_controller

    point = linear.point
    assert point is not None and isinstance(point.model, Model)
    found: dict[str, Any] = {}
    if asked.break_at:
        found = loop_margins(loop(point.model, asked.break_at, point)).to_dict()
    if asked.plant:
        plant, controller = plant_and_controller(point.model, asked.plant.inputs, asked.plant.outputs, point)
        found["ncf_margin"] = {
            **ncf_margin(plant, controller).to_dict(),
            "attainable": ncf_margin(plant).value,
            "inputs": asked.plant.inputs,
            "outputs": asked.plant.outputs,
        }
    return found


def _reduced(asked: schema.ReduceTable, linear: LinearModel) -> dict[str, Any]:
    """The reduced model with the error it has and the bound that was known beforehand."""
    found = linear.reduce(asked.order, asked.tolerance, match_dc=asked.match_dc)
    return {**found.to_dict(), "error": found.error.to_dict(), "states_before": len(linear.state_names)}


def _compared(study: Study, linear: LinearModel) -> dict[str, Any]:
    """The other model's linear model at the same inputs and, by name, parameters, against this one's."""
    from hvdc_ident.linearize import compare, find_operating_point, linearize

    point, other = linear.point, study.compared
    assert point is not None and other is not None
    same = {n: v for n, v in point.inputs.items() if n in other.inputs}
    at = find_operating_point(other, same)
    second = linearize(other, at, inputs=linear.input_names, outputs=linear.output_names)
    asked = study.settings.linearize
    return compare(linear, second.scaled(asked.scale if asked else {})).to_dict()


def _formulas(study: Study, linear: LinearModel, parameters: list[str]) -> list[dict[str, Any]]:
    """Each transfer function with some parameters as symbols; where there is none, the reason."""
    from hvdc_ident.linearize import symbolic_transfer

    model = study.model
    assert isinstance(model, Model)
    found: list[dict[str, Any]] = []
    for o in linear.output_names:
        for i in linear.input_names:
            try:
                f = symbolic_transfer(model, i, o, parameters, linear.point)
            except LinearizationError as e:
                found.append({"input": i, "output": o, "reason": e.what})
            else:
                top, bottom = f.rounded()
                found.append({"input": i, "output": o, "numerator": top, "denominator": bottom, "latex": f.latex()})
    return found


def _locus(asked: schema.LocusTable, linear: LinearModel) -> dict[str, Any]:
    """The eigenvalues along the parameter, all else as at the operating point."""

    from hvdc_ident.linearize import root_locus

    point = linear.point
    assert point is not None and isinstance(point.model, Model)
    spread = np.geomspace if asked.scale == "log" else np.linspace
    values = np.asarray(spread(asked.min, asked.max, asked.points), dtype=float)
    fixed = {n: v for n, v in {**point.inputs, **point.parameters}.items() if n != asked.parameter}
    return root_locus(point.model, asked.parameter, values, fixed).to_dict()


def _ports(tables: list[schema.PortTable], linear: LinearModel) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """The impedance of each port, and a file of each."""

    from hvdc_ident.linearize import port_impedance
    from hvdc_ident.linearize.export import csv_of_response

    point = linear.point
    assert point is not None and isinstance(point.model, Model)
    found, files = [], {}
    for table in tables:
        omega = 2 * np.pi * np.geomspace(table.band[0], table.band[1], table.points)
        z = port_impedance(point.model, port_of(table), omega, point)
        passive = np.linalg.eigvalsh(z.values + np.conj(np.swapaxes(z.values, 1, 2)))[:, 0] / 2
        k = int(np.argmin(passive))
        found.append(
            {
                "name": table.name,
                **z.to_dict(),
                "least_real_part": {"value": float(passive[k]), "omega": float(omega[k])},
            }
        )
        files[f"impedance.{table.name}.csv"] = csv_of_response(z)
    return found, files
