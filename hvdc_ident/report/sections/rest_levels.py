"""The levels before the events, recorded and of the model: what does not agree, and what that suggests."""

from __future__ import annotations

from typing import Any

from hvdc_ident.report.html import Section, rows_of, text
from hvdc_ident.summary import Results
from hvdc_ident.text import figures, quantity, times_text


def _render(results: Results) -> str:
    lines = _levels(results)
    compared = [line for line in lines if line.get("recorded") is not None and line.get("model") is not None]
    remarks = [line["text"] for line in lines if line.get("output") is None and line.get("text")]
    told = [line for line in lines if line.get("output") is not None and line.get("text")]
    if not (compared or told or remarks):
        return ""
    parts = [f"<p>{_summary(len(compared), len(told))}</p>"]
    if told:
        header = ["experiment", "output", "recorded", "model", "within the bounds", "noise", "what it suggests"]
        parts.append(rows_of(header, map(_row, told)))
    return "".join([*parts, *(f"<p class='small'>{text(r)}.</p>" for r in remarks)])


def _levels(results: Results) -> list[dict[str, Any]]:
    """Those of a stage of the present state of the study, where there is one."""
    found = [s for s in results.stages.values() if s.get("rest_levels")]
    present = [s for s in found if s.get("sources") == results.heading.get("sources")]
    return list((present or found or [{}])[0].get("rest_levels") or [])


def _summary(compared: int, told: int) -> str:
    if not compared:
        return "No level before an event could be compared." if not told else "No level before an event is known."
    if not told:
        every = "The level" if compared == 1 else f"Each of the {compared} levels"
        return f"{every} recorded before the events is one that the model can rest at, within noise and bounds."
    return f"Of {compared} levels recorded before the events or movements after them, {told} are not the model's."


def _row(line: dict[str, Any]) -> list[str]:
    low, high, unit = line.get("low"), line.get("high"), line.get("unit") or ""
    within = f"{figures(low)} to {figures(high)}" if low is not None and high is not None and low < high else ""
    noise = times_text(line["noise_units"]) if line.get("noise_units") is not None else ""
    levels = [quantity(line[k], unit) if line.get(k) is not None else "" for k in ("recorded", "model")]
    return [line["experiment"], line["output"], *levels, within, noise, line["text"]]


SECTION = Section(
    order=60,
    title="Levels before the event",
    about="Whether recordings and model begin at the same levels: a wrong sign, unit or base shows here.",
    render=_render,
)
