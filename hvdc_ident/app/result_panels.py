"""Panels of the tab Run: what the recordings tell, the fit, the diagnosis, and what to record next."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from nicegui import ui

import hvdc_ident as hi
from hvdc_ident.app.next_panel import NextExperiment
from hvdc_ident.app.plot import EFFECT, GIVEN, NOW, RECORDED, Grid, Plot, Trace, thinned
from hvdc_ident.app.result_tables import (
    overlay_columns,
    profile_columns,
)
from hvdc_ident.app.supposed import suppositions
from hvdc_ident.app.what_if import WhatIf
from hvdc_ident.display import Table
from hvdc_ident.errors import HvdcIdentError
from hvdc_ident.report.overlay import overlay_of
from hvdc_ident.study.stages import stage
from hvdc_ident.summary import Results, RunSummary, summarise
from hvdc_ident.summary.phrases import WORDS, advice, verdict_sentence
from hvdc_ident.summary.tables import findings_table, sets_table, values_table, verdicts_table
from hvdc_ident.text import with_unit

SETS = {"given": (GIVEN, True), "fitted": (NOW, False), "effect": (EFFECT, False)}
"""Sets of values whose runs are drawn, with their colour and whether dashed."""
TALL = 150
"""Height of one output's picture, px."""
KINDS = ("signals", "errors")
"""Pictures of an experiment: recorded and simulated, or recorded less simulated."""


@dataclass(frozen=True)
class FoundResults:
    """The results of a study in a folder: the JSON by stage of those that ran to their end."""

    study: hi.Study
    folder: Path
    data: Mapping[str, Mapping[str, Any]]

    def of(self, stage: str) -> Mapping[str, Any]:
        """Return the JSON of a stage; empty where it has not run."""
        return self.data.get(stage, {})

    @cached_property
    def summary(self) -> RunSummary:
        """Summary of the results."""
        return summarise({Path(stage(n).file).stem: data for n, data in self.data.items()})


@dataclass(frozen=True)
class Panel:
    """A panel of results. uses: the stages it shows, the first of which it needs. build: builds its elements on the page."""

    title: str
    uses: tuple[str, ...]
    build: Callable[[FoundResults], None]

    def key(self, found: FoundResults) -> tuple[Any, ...]:
        """Return what changes whenever the panel has something else to show."""
        marks = tuple(found.of(n).get("fingerprint") for n in self.uses)
        return found.folder, tuple(found.study.sources.items()), marks

    def show(self, found: FoundResults, place: Any) -> None:
        """Show the results in an element of the page, in place of what it holds."""
        place.clear()
        with place:
            if found.of(self.uses[0]):
                self.build(found)
            else:
                ui.label(f"Not there yet: run the stage {self.uses[0]}, or all.").classes("text-grey")


def show_table(table: Table) -> Any:
    """Show a table of text, one line of the page for a row."""
    columns = []
    for k, name in enumerate(table.header):
        numbers = all(isinstance(row[k], int | float | None) for row in table.rows)
        columns.append({"name": str(k), "label": name, "field": str(k), "align": "right" if numbers else "left"})
    rows = [
        {str(k): "" if v is None else f"{v:.12g}" if isinstance(v, float) else v for k, v in enumerate(row)}
        for row in table.rows
    ]
    shown = ui.table(columns=columns, rows=rows, row_key="0", pagination=0).props(
        "dense flat wrap-cells hide-pagination"
    )
    return shown.classes("w-full")


def _identifiability(found: FoundResults) -> None:
    """Build the verdicts, and the profile of the parameter that is opened."""
    data = found.of("identify")
    if data.get("misspecified"):
        signs = data["misspecification"]
        ui.label(f"The model does not explain these data: {'; '.join(signs['signs'])}.")
    profiles = {n: p for n, p in (data.get("profiles") or {}).items() if len(p.get("values") or ()) > 1}
    table = show_table(verdicts_table(data))
    table.add_slot(
        "body-cell-0",
        '<q-td :props="props"><q-btn flat dense no-caps no-wrap color="primary" icon-right="show_chart" :label="props.value"'
        " :aria-label=\"'Profile of ' + props.value\" @click=\"$parent.$emit('open', props.value)\" /></q-td>",
    )
    place = ui.column().classes("w-full gap-0")
    table.on("open", lambda event: _open(data, profiles, str(event.args), place))
    if profiles:
        _open(data, profiles, next(iter(profiles)), place)


def _open(data: Mapping[str, Any], profiles: Mapping[str, Any], name: str, place: Any) -> None:
    place.clear()
    with place:
        if name not in profiles:
            ui.label(f"No profile of {name}: it was not fitted, or its cost was not followed.").classes("text-grey")
            return
        unit = data["parameters"].get(name, {}).get("unit", "")
        ui.label(f"Profile of {name}: the least cost over all other parameters").classes("text-subtitle2")
        curves = (
            Trace("rise of the cost", NOW),
            Trace("computed", NOW, mark="dot", size=6),
            Trace("95 % level", GIVEN, dashed=True),
            Trace("ends of the interval", RECORDED, mark="ring", size=10),
        )
        grid = Grid("rise of the cost / 95 % level", curves)
        plot = Plot([grid], with_unit(name, unit), 330, f"Profile of {name}").classes("w-full")
        plot.whole(0, profile_columns(profiles[name]))


def _fitted(found: FoundResults) -> None:
    """Build the values, and recorded, given and fitted waveforms of an experiment."""
    ui.label(verdict_sentence(found.summary))
    show_table(values_table(found.summary))
    results = Results(found.folder)
    try:
        names = [n for n in results.experiments if results.table(f"fit.{n}.csv") is not None]
    except HvdcIdentError as error:
        ui.label(str(error)).classes("text-negative")
        return
    if not names:
        return
    roles = {n: "held out" if results.experiments[n].get("role") == "holdout" else "fitted" for n in names}
    with ui.row().classes("w-full items-center gap-3"):
        which = ui.select({n: f"{n} ({roles[n]})" for n in names}, value=names[0], label="experiment")
        which.props("dense options-dense").style("min-width: 14rem")
        kind = ui.toggle(list(KINDS), value=KINDS[0]).props("dense no-caps")
    place = ui.column().classes("w-full gap-0")

    def draw() -> None:
        _overlay(results, which.value, place, errors=kind.value == KINDS[1])

    which.on_value_change(draw)
    kind.on_value_change(draw)
    draw()


def _overlay(results: Results, experiment: str, place: Any, *, errors: bool) -> None:
    overlays = [o for name in results.units if (o := overlay_of(results, experiment, name)) is not None]
    place.clear()
    with place:
        sets = tuple(n for n in SETS if any(n in o.runs for o in overlays))
        curves = [Trace("recorded", RECORDED), *(Trace(WORDS[n], SETS[n][0], dashed=SETS[n][1]) for n in sets)]
        grids = [Grid(o.title, tuple(curves)) for o in overlays]
        plot = Plot(grids, "time, s", TALL * len(grids) + 30, f"Waveforms of {experiment}").classes("w-full")
        for k, overlay in enumerate(overlays):
            plot.whole(k, thinned(*overlay_columns(overlay, sets, errors=errors)))


def _diagnosed(found: FoundResults) -> None:
    """Build findings, gaps, and the records with what was found at a size that a slider sets."""
    data = found.of("diagnose")
    ui.label(str(data.get("text") or data.get("verdict", ""))).classes("text-body2")
    findings, errors = findings_table(found.summary), sets_table(found.summary)
    if findings.rows:
        show_table(findings)
    if errors.rows:
        with ui.row().style("max-width: 40rem"):
            show_table(errors)
    try:
        models = suppositions(found.study, data, found.folder)
    except HvdcIdentError as error:
        ui.label(str(error)).classes("text-negative")
        return
    if models and found.study.experiments:
        before = data.get("parameters_refitted") or data.get("parameters_before") or {}
        told = str((data.get("sizes") or {}).get("experiment", ""))
        WhatIf(found.study, models, before, told).build()


def _next(found: FoundResults) -> None:
    """Build what to record next, simulated before it is made."""
    identified, diagnosis = found.of("identify"), found.of("diagnose")
    ui.label(advice(found.summary) or found.summary.unadvised or "The results ask for no further record.").classes("text-body2")
    try:
        rivals = suppositions(found.study, diagnosis, found.folder)
    except HvdcIdentError as error:
        ui.label(str(error)).classes("text-negative")
        return
    fitted = {n: v for n, v in (found.of("fit").get("values") or {}).items() if v is not None}
    NextExperiment(found.study, identified, fitted, rivals).build()


PANELS = (
    Panel("What the recordings tell", ("identify",), _identifiability),
    Panel("Fit", ("fit", "simulate", "diagnose"), _fitted),
    Panel("Diagnosis", ("diagnose", "fit"), _diagnosed),
    Panel("What to record next", ("identify", "diagnose", "fit"), _next),
)
"""The panels, in the order of the page."""
