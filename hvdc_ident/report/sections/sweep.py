"""The sweep: the error over each parameter, where it is smallest, the poles, and the points that failed."""

from __future__ import annotations

from typing import Any

import numpy as np

from hvdc_ident.report.drawing import svg
from hvdc_ident.report.html import number, table, text
from hvdc_ident.report.results import Results
from hvdc_ident.report.section import Section
from hvdc_ident.report.sweep import sweep_bode, sweep_errors, sweep_poles
from hvdc_ident.trajectory import Array

MOST = 2000
"""Rows that are drawn; of more, every so many."""
CURVES, CHANNELS = 40, 4
"""Frequency responses drawn in one figure, and figures of them."""


def _render(results: Results) -> str:
    found = results.get("sweep")
    points, parameters = found.get("points") or [], found.get("parameters") or {}
    if not points or not parameters:
        return ""
    names = ", ".join(text(p) for p in parameters)
    against = {"data": "the recordings", "base": "the run at the base values"}.get(
        str(found.get("against")), f"model {found.get('against')}"
    )
    lines = [f"<p>{len(points)} points of {names} against {text(against)}.</p>"]
    failed = [p for p in points if p.get("status") == "failed"]
    if failed:
        reasons = list(dict.fromkeys(str(p.get("reason")) for p in failed))[:3]
        lines.append(f"<p>{len(failed)} points failed: {'; '.join(map(text, reasons))}.</p>")
    good = [p for p in points if p.get("status") == "done"]
    if not good:
        return "".join(lines)
    errors = _errors(good)
    lines.append(_best(good, list(parameters), errors, found.get("units") or {}))
    step = max(1, len(good) // MOST)
    units, omega = found.get("units") or {}, found.get("omega") or []
    lines += [_figures(p, parameters, good[::step], errors, step, units, omega) for p in parameters]
    return "\n".join(lines)


def _errors(points: list[dict[str, Any]]) -> dict[tuple[str, str], Array]:
    """The RMSE of each (output, experiment) over the points."""
    series = [(o, e) for o, line in points[0]["rmse"].items() for e in line]
    return {(o, e): np.array([p["rmse"][o][e] for p in points], dtype=float) for o, e in series}


def _best(
    points: list[dict[str, Any]], names: list[str], errors: dict[tuple[str, str], Array], units: dict[str, Any]
) -> str:
    rows = []
    for (output, experiment), values in errors.items():
        low = int(np.argmin(values))
        at = [number(points[low]["values"][n], 5) for n in names]
        extremes = [number(float(values.min()), 3), number(float(values.max()), 3)]
        rows.append([text(output), text(experiment), *at, *extremes, text(units.get(output, ""))])
    header = ["output", "experiment", *(f"best {text(n)}" for n in names), "smallest RMSE", "largest", "unit"]
    return table(header, rows, words=(0, 1, len(header) - 1)) if rows else ""


def _figures(
    name: str,
    parameters: dict[str, Any],
    points: list[dict[str, Any]],
    errors: dict[tuple[str, str], Array],
    step: int,
    units: dict[str, Any],
    omega: list[float],
) -> str:
    values = np.array([p["values"][name] for p in points], dtype=float)
    about = parameters[name]
    curve = len(parameters) == 1
    order = np.argsort(values, kind="stable") if curve else np.arange(values.size)
    drawn = []
    for unit in dict.fromkeys(str(units.get(o, "")) for o, _ in errors):
        chosen = {f"{o}, {e}": v[::step][order] for (o, e), v in errors.items() if str(units.get(o, "")) == unit}
        fig = sweep_errors(name, str(about.get("unit", "")), values[order], chosen, unit, about.get("base"), curve)
        drawn.append(f"<figure>{svg(fig, f'RMSE over {name}')}</figure>")
    if points[0].get("poles"):
        poles = np.array([p["poles"] for p in points], dtype=float)
        fig = sweep_poles(name, values, poles[..., 0] + 1j * poles[..., 1])
        drawn.append(f"<figure>{svg(fig, f'poles over {name}')}</figure>")
    if points[0].get("bode"):
        drawn += _bode(name, values, points, omega)
    return "\n".join(drawn)


def _bode(name: str, values: Array, points: list[dict[str, Any]], omega: list[float]) -> list[str]:
    """One figure a channel, up to a few, with a curve for every so many points."""
    rows = np.flatnonzero(np.array(omega) > 0)
    some = np.unique(np.linspace(0, len(points) - 1, min(len(points), CURVES)).astype(int))
    channels = [(o, i) for o, line in points[0]["bode"].items() for i in line][:CHANNELS]
    drawn = []
    for output, source in channels:
        pairs = np.array([points[k]["bode"][output][source] for k in some], dtype=float)
        label = f"{output} over {source}"
        responses = (pairs[..., 0] + 1j * pairs[..., 1])[:, rows]
        fig = sweep_bode(name, values[some], np.array(omega)[rows], responses, label)
        drawn.append(f"<figure>{svg(fig, f'frequency response of {label} over {name}')}</figure>")
    return drawn


SECTION = Section(order=35, title="Sweep", render=_render)
