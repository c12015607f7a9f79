"""The waveforms of every experiment, one figure an output."""

from __future__ import annotations

from typing import Any

from hvdc_ident.experiment import recording_lines
from hvdc_ident.report.drawing import svg
from hvdc_ident.report.html import text
from hvdc_ident.report.interactive import zoomable
from hvdc_ident.report.results import Results
from hvdc_ident.report.section import Section
from hvdc_ident.report.waveforms import Sheet, curves, waveforms
from hvdc_ident.trajectory import Trajectory

MOST = 60


def _render(results: Results) -> str:
    fit, simulation = results.get("fit"), results.get("simulation")
    experiments = {**(simulation.get("experiments") or {}), **(fit.get("experiments") or {})}
    if not experiments:
        return ""
    units = {**(simulation.get("units") or {}), **(fit.get("units") or {})}
    parts: list[str] = []
    left, sheet = MOST, Sheet.new()
    for name, about in experiments.items():
        before, after = results.table(f"simulation.{name}.csv"), results.table(f"fit.{name}.csv")
        outputs = _outputs(after if after is not None else before)
        drawn = [_figure(sheet, name, o, str(units.get(o, "")), before, after, about) for o in outputs[:left]]
        left -= len(drawn)
        if drawn:
            role = " (held out: not used by the fit)" if about.get("role") == "holdout" else ""
            told = "; ".join(recording_lines(about["recording"])) if about.get("recording") else ""
            note = f"<p class='small'>The recording: {text(told)}.</p>\n" if told else ""
            parts.append(f"<h3>{text(name)}{role}</h3>\n{note}" + "\n".join(drawn))
    if left <= 0:
        parts.append(f"<p>Only the first {MOST} waveforms are drawn; the CSV files beside this page hold all.</p>")
    return "\n".join(parts)


def _outputs(table: Trajectory | None) -> list[str]:
    names = table.names if table is not None else ()
    return [n for n in names if f"{n}.measured" in names]


def _figure(
    sheet: Sheet,
    name: str,
    output: str,
    unit: str,
    before: Trajectory | None,
    after: Trajectory | None,
    about: dict[str, Any],
) -> str:
    tables = [t if t is not None and output in t and f"{output}.measured" in t else None for t in (before, after)]
    window = about.get("window")
    fig = waveforms(sheet, output, unit, tables[0], tables[1], about.get("event"), tuple(window) if window else None)
    label = f"{output} in {name}: measured and simulated"
    return zoomable(svg(fig, label), label, *curves(output, unit, tables[0], tables[1]))


SECTION = Section(order=40, title="Waveforms", render=_render)
