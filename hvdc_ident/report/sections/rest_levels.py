"""The levels before the events, recorded and of the model: what does not agree, and what that suggests."""

from __future__ import annotations

from hvdc_ident.report.html import Section, rows_of, text
from hvdc_ident.summary import Results
from hvdc_ident.summary.levels import InitialValue
from hvdc_ident.text import figures, quantity, times_text


def _render(results: Results) -> str:
    levels = results.rest_levels
    compared = [level for level in levels if level.recorded is not None and level.model is not None]
    remarks = [level.text for level in levels if not level.output and level.text]
    told = [level for level in levels if level.output and level.text]
    if not (compared or told or remarks):
        return ""
    parts = [f"<p>{_summary(len(compared), len(told))}</p>"]
    if told:
        header = ["experiment", "output", "recorded", "model", "within the bounds", "noise", "what it suggests"]
        parts.append(rows_of(header, map(_row, told)))
    return "".join([*parts, *(f"<p class='small'>{text(r)}.</p>" for r in remarks)])


def _summary(compared: int, told: int) -> str:
    if not compared:
        return "No level before an event could be compared." if not told else "No level before an event is known."
    if not told:
        every = "The level" if compared == 1 else f"Each of the {compared} levels"
        return f"{every} recorded before the events is one that the model can rest at, within noise and bounds."
    return f"Of {compared} levels recorded before the events or movements after them, {told} are not the model's."


def _row(level: InitialValue) -> list[str]:
    low, high = level.low, level.high
    within = f"{figures(low)} to {figures(high)}" if low is not None and high is not None and low < high else ""
    noise = times_text(level.noise_units) if level.noise_units is not None else ""
    levels = [quantity(v, level.unit) if v is not None else "" for v in (level.recorded, level.model)]
    return [level.experiment, level.output, *levels, within, noise, level.text]


SECTION = Section(
    order=60,
    title="Levels before the event",
    about="Whether recordings and model begin at the same levels: a wrong sign, unit or base shows here.",
    render=_render,
)
