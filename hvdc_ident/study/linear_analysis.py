"""The answers to a study's [linearize] beside the linear model: trimming, margins, norms, ports, comparison, reduction."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.errors import LinearizationError, SteadyStateError
from hvdc_ident.model import Model
from hvdc_ident.study import schema
from hvdc_ident.study.measured_responses import port_of
from hvdc_ident.text import quantity, unstable_roots

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
    from hvdc_ident.linearize.export.csv_response import text

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
        files[f"impedance.{table.name}.csv"] = text(z)
    return found, files


MODES_SHOWN = 8
"""Modes on the screen, the least damped first."""
VALUES_SHOWN = 6
"""Inputs and outputs of the operating point in one line of the screen."""


def lines(data: Mapping[str, Any]) -> list[str]:
    """Return the lines that the stage prints."""
    found = [*_point_lines(data), *(f"operating point: {note}" for note in data["notes"]), *_mode_lines(data)]
    if "trim" in data:
        wanted = ", ".join(f"{n} = {v:g}" for n, v in data["trim"]["outputs"].items())
        made = ", ".join(f"{n} = {v:.6g}" for n, v in data["trim"]["found"].items())
        found.append(f"trimmed to {wanted}: {made or 'nothing had to move'}")
    found += _margin_lines(data.get("margins", {}))
    if "locus" in data:
        found += _locus_lines(data["locus"])
    for port in data.get("ports", ()):
        least = port["least_real_part"]
        side = "passive" if least["value"] >= 0 else "not passive"
        found.append(
            f"port {port['name']}: {side} over the band, least real part {least['value']:.4g} at "
            f"{least['omega'] / math.tau:.4g} Hz"
        )
    if "comparison" in data:
        c = data["comparison"]
        found.append(
            f"against {c['other']}: nu-gap {c['nu_gap']:.4g}"
            + ("" if c["winding"] == 0 else " (the winding condition fails)")
            + ("" if c["attainable_margin"] is None else f", attainable margin {c['attainable_margin']:.4g}")
        )
    if "reduced" in data:
        r = data["reduced"]
        found.append(
            f"reduced from {r['states_before']} to {r['order']} states: error {r['error']['value']:.4g}, bound "
            f"{r['bound']:.4g}" + (", dc gain matched" if r["match_dc"] else "")
        )
    for f in data.get("formulas", ()):
        text = f.get("reason") or f"({f['numerator']}) / ({f['denominator']})"
        found.append(f"{f['output']} from {f['input']}: {text}")
    return found


def stability(data: Mapping[str, Any]) -> str:
    """Return whether the operating point is stable, with its rightmost eigenvalue; empty for a model without modes.

    Of a model with delays the number of its unstable roots comes along, which is what the verdict rests on.
    """
    found = data["stability"]
    right = f", rightmost eigenvalue {found['rightmost'][0]:.4g} 1/s" if found["rightmost"] else ""
    if found["method"] == "eigenvalues of A":
        return f"{found['verdict']}{right}" if right else ""
    if found["verdict"] == "not decided":
        return f"stability not decided: {found['reason']}"
    why = f": {found['reason']}" if found["reason"] else ""
    return f"{found['verdict']}{right} ({unstable_roots(found)}, delays exact){why}"


def _point_lines(data: Mapping[str, Any]) -> list[str]:
    """The verdict on stability, the inputs and outputs of the linear model at the point, and the limits that are active."""
    found = [f"operating point: {verdict}"] if (verdict := stability(data)) else []
    for kind in ("input", "output"):
        names = data[f"{kind}_names"]
        values = zip(names, data["u0" if kind == "input" else "y0"], data[f"{kind}_units"], strict=True)
        shown = [f"{n} = {quantity(v, u, 6)}" for n, v, u in list(values)[:VALUES_SHOWN]]
        more = f" and {len(names) - VALUES_SHOWN} more" if len(names) > VALUES_SHOWN else ""
        found += [f"{kind}s: {', '.join(shown)}{more}"] if shown else []
    active = data["operating_point"]["active_limits"]
    for limit in active:
        found.append(f"active limit: {limit['signal']} is held by {limit['level']} ({limit['limit']} limit)")
    return [*found] if active or not data["operating_point"]["margins"] else [*found, "active limits: none"]


def _mode_lines(data: Mapping[str, Any]) -> list[str]:
    """The oscillating modes, the least damped first, and how many decay without oscillation, with the slowest of them."""
    real = [m for m in data["modes"] if m["eigenvalue"][1] == 0.0 and "sliding mean" not in str(m["kind"])]
    swinging = sorted((m for m in data["modes"] if m["eigenvalue"][1] > 0), key=lambda m: m["damping"])
    found = []
    for m in swinging[:MODES_SHOWN]:
        shares = sorted(m["participation"], key=lambda n: -m["participation"][n])[:3]
        found.append(f"mode at {m['frequency_hz']:.4g} Hz, damping {100 * m['damping']:.3g} %: {', '.join(shares)}")
    if len(swinging) > MODES_SHOWN:
        better = swinging[MODES_SHOWN]["damping"]
        found.append(f"and {len(swinging) - MODES_SHOWN} more modes, of damping {100 * better:.3g} % and above")
    if real:
        slowest = max(real, key=lambda m: m["eigenvalue"][0])
        rate = slowest["eigenvalue"][0]
        part = max(slowest["participation"], key=lambda n: slowest["participation"][n])
        how = (
            f"the slowest with a time constant of {quantity(-1.0 / rate, 's')}"
            if rate < 0
            else f"one at {rate:.4g} 1/s"
        )
        found.append(f"modes without oscillation: {len(real)}, {how}: {part}")
    return found


def _locus_lines(found: Mapping[str, Any]) -> list[str]:
    """Return a line for each place along the locus where stability is lost or won."""
    unit = f" {found['unit']}" if found["unit"] else ""
    span = f"{found['parameter']} from {found['values'][0]:g} to {found['values'][-1]:g}{unit}"
    lines = [
        f"along {span} stability is {x['direction']} at {x['value']:.6g}{unit}, "
        f"{abs(x['eigenvalue'][1]) / math.tau:.4g} Hz"
        for x in found["limits"]
    ]
    return lines or [f"along {span} stability is neither lost nor won"]


def without_margins(found: Mapping[str, Any]) -> str:
    """Return the sentence on closed loops that are not stable, or of which it cannot be told."""
    s = found["stability"]
    if s["verdict"] == "not decided":
        return f"whether the closed loops are stable cannot be told, so that no margins are given: {s['reason']}"
    if s["verdict"] != "unstable":
        return "the closed loops are on the limit of stability: they have no margins"
    return f"the closed loops are not stable: they have no margins ({unstable_roots(s)})"


def _at(margin: Mapping[str, float | None], unit: str = "", factor: float = 1.0) -> str:
    """Return a margin with its frequency; one without a limit (infinite, or a factor of 0) is unlimited."""
    value, omega = margin["value"], margin["omega"]
    if value is None or (omega is None and value == 0.0 and not unit) or math.isinf(value):
        return "unlimited"
    where = "at infinite frequency" if omega is None or math.isinf(omega) else f"at {omega / math.tau:.4g} Hz"
    return f"{factor * value:.4g}{unit} {where}"


def _margin_lines(found: Mapping[str, Any]) -> list[str]:
    """The margins of each loop, of all together, and of plant and controller."""
    if not found:
        return []
    result = []
    if "stable" in found and not found["stable"]:
        result.append(without_margins(found))
    for name, m in (found.get("loops") or {}).items() if found.get("stable") else ():
        result.append(
            f"loop at {name}: gain margin {_at(m['gain_margin'])}, lower gain margin {_at(m['lower_gain_margin'])}, phase "
            f"margin {_at(m['phase_margin_deg'], ' degrees')}, delay margin {_at(m['delay_margin_s'], ' ms', 1e3)}, disk "
            f"{m['disk_margin']['value']:.3g}"
        )
    if found.get("stable") and len(found["loops"]) > 1:
        disk = found["disk_margin"]
        result.append(f"all loops at once: disk margin {disk['value']:.3g}, phase {disk['phase_deg']:.3g} degrees")
    if "ncf_margin" in found:
        n = found["ncf_margin"]
        result.append(f"coprime factor margin {n['value']:.4g}; the largest attainable {n['attainable']:.4g}")
    return result
