"""Panels of the tab Run: what the recordings tell, the fit, the diagnosis, and what to record next."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from nicegui import ui

from hvdc_ident.app.next_panel import NextExperiment
from hvdc_ident.app.page import Page
from hvdc_ident.app.plot import EFFECT, GIVEN, NOW, RECORDED, Grid, Plot, Trace, thinned
from hvdc_ident.app.results import FoundResults
from hvdc_ident.axes import joined
from hvdc_ident.data import Array
from hvdc_ident.display import Table
from hvdc_ident.fit.profile import Profile
from hvdc_ident.identifiability.verdicts import Verdict
from hvdc_ident.report.html import table_of
from hvdc_ident.report.overlay import Overlay, overlay_of
from hvdc_ident.summary import Results
from hvdc_ident.summary.phrases import WORDS, advice
from hvdc_ident.summary.tables import findings_table, sets_table, values_table, verdicts_table
from hvdc_ident.text import with_unit

SETS = {"given": (GIVEN, True), "fitted": (NOW, False), "effect": (EFFECT, False)}
"""Sets of values whose runs are drawn, with their colour and whether dashed."""
TALL = 150
"""Height of one output's picture, px."""
KINDS = ("signals", "errors")
"""Pictures of an experiment: recorded and simulated, or recorded less simulated."""


@dataclass(frozen=True)
class Panel:
    """A panel of results. uses: the stages it shows, the first of which it needs. build: builds its elements on the page."""

    title: str
    uses: tuple[str, ...]
    build: Callable[[FoundResults, Page], None]

    def key(self, shown: FoundResults) -> tuple[Any, ...]:
        """Return what changes whenever the panel has something else to show."""
        marks = tuple(shown.of(n).get("fingerprint") for n in self.uses)
        return shown.folder, tuple(shown.study.sources.items()), marks


def show_table(table: Table) -> None:
    """Show a table as the report does; nothing without rows."""
    if table.rows:
        ui.html(table_of(table), sanitize=False).classes("w-full")


def _identifiability(shown: FoundResults, page: Page) -> None:
    """Build the verdicts, and the profile of the parameter that is chosen."""
    report = shown.objects.identified
    if report.misspecified:
        ui.label(f"The model does not explain these data: {'; '.join(report.misspecification.signs)}.")
    show_table(verdicts_table(report))
    profiles = {n: p for n, p in report.profiles.items() if p.values.size > 1}
    if not profiles:
        return
    first = next(iter(profiles))
    which = ui.toggle(list(profiles), value=first).props("dense no-caps unelevated").classes("q-mt-sm")
    place = ui.element("div").classes("w-full")

    def draw() -> None:
        _draw_profile(profiles[which.value], report.parameters[which.value], place)

    which.on_value_change(draw)
    draw()


def _draw_profile(profile: Profile, verdict: Verdict, place: Any) -> None:
    place.clear()
    with place:
        ui.label(f"Profile of {verdict.name}: the least cost over all other parameters").classes("small")
        curves = (
            Trace("rise of the cost", NOW),
            Trace("computed", NOW, mark="dot", size=6),
            Trace("95 % level", GIVEN, dashed=True),
            Trace("ends of the interval", RECORDED, mark="ring", size=10),
        )
        grid = Grid("rise of the cost / 95 % level", curves)
        unit = with_unit(verdict.name, verdict.unit)
        plot = Plot([grid], unit, 330, f"Profile of {verdict.name}").classes("w-full")
        plot.whole(0, profile_columns(profile))


def profile_columns(profile: Profile) -> list[Array]:
    """Return the columns of a profile's picture, (n,) each: the values, the rise of the cost between what was computed, the
    rise computed, the 95 % level, and the ends of the interval; the rise in units of that level, nan where there is none.
    """
    x, rise = profile.values, profile.rises / profile.threshold
    ends = [end for end in profile.ci95 if end is not None]
    dense, between = joined(x, rise)
    at = np.unique(np.concatenate([dense, x, ends]))

    def only(places: Any, values: Any) -> Array:
        column = np.full(at.size, np.nan)
        column[np.searchsorted(at, places)] = values
        return column

    return [at, np.interp(at, dense, between), only(x, rise), np.ones(at.size), only(ends, 1.0)]


def _fitted(shown: FoundResults, page: Page) -> None:
    """Build the values, and recorded, given and fitted waveforms of an experiment."""
    show_table(values_table(shown.summary))
    results = Results(shown.folder)
    names = [n for n in results.experiments if results.table(f"fit.{n}.csv") is not None]
    if not names:
        return
    roles = {n: "held out" if results.experiments[n].role == "holdout" else "fitted" for n in names}
    with ui.element("div").classes("line"):
        which = ui.select({n: f"{n} ({roles[n]})" for n in names}, value=names[0], label="experiment")
        which.props("dense options-dense").style("min-width: 14rem")
        kind = ui.toggle(list(KINDS), value=KINDS[0]).props("dense no-caps unelevated")
    place = ui.element("div").classes("w-full")

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
        recorded = [] if errors else [Trace("recorded", RECORDED)]
        curves = [*recorded, *(Trace(WORDS[n], SETS[n][0], dashed=SETS[n][1]) for n in sets)]
        grids = [Grid(o.title, tuple(curves)) for o in overlays]
        plot = Plot(grids, "time, s", TALL * len(grids) + 30, f"Waveforms of {experiment}").classes("w-full")
        for k, overlay in enumerate(overlays):
            plot.whole(k, thinned(*overlay_columns(overlay, sets, errors=errors)))
            plot.shade(k, overlay.bad)


def overlay_columns(overlay: Overlay, sets: tuple[str, ...], *, errors: bool = False) -> list[Array]:
    """Return the columns of an output's picture, (n,) each: time, recorded, and the runs by set of values; nan where one is not.

    errors: recorded less simulated in place of the runs, and nothing of the recorded signal.
    """
    record = overlay.record
    missing = np.full(record.time.size, np.nan)
    columns = [record.time, *([] if errors else [record[f"{overlay.output}.measured"]])]
    for name in sets:
        run = overlay.runs.get(name)
        if run is None or run.time.size != record.time.size:
            columns.append(missing)
        else:
            columns.append(overlay.error(name) if errors else run[overlay.output])
    return columns


def _diagnosed(shown: FoundResults, page: Page) -> None:
    """Build what the diagnosis says, its findings, and the errors with each set of values."""
    diagnosis, sizes = shown.objects.diagnosis, shown.objects.of_diagnosis.sizes
    ui.label("" if diagnosis is None else diagnosis.text or diagnosis.verdict)
    show_table(findings_table(shown.summary))
    show_table(sets_table(shown.summary))
    models, trouble = shown.supposed
    ui.label(trouble).classes("alert")
    if models:
        button = ui.button("Explore it with sliders", on_click=lambda: page.explore(models[0].name))
        button.props("outline dense").classes("q-px-sm self-start")
        button.tooltip(
            "Opens the model with what was found on the tab Explore; its rivals stand there under “model with”."
        )
    results = Results(shown.folder)
    told = sizes.experiment if sizes is not None else next(iter(results.experiments), "")
    ui.label(f"Recorded less simulated in {told}, without and with what was found").classes("small q-mt-sm")
    _overlay(results, told, ui.element("div").classes("w-full"), errors=True)


def _next(shown: FoundResults, page: Page) -> None:
    """Build what to record next, simulated before it is made."""
    ui.label(advice(shown.summary) or shown.summary.unadvised or "The results ask for no further record.")
    models, trouble = shown.supposed
    ui.label(trouble).classes("alert")
    NextExperiment(shown.study, shown.objects.identified, shown.fitted, models).build()


PANELS = (
    Panel("What the recordings tell", ("identify",), _identifiability),
    Panel("Fit", ("fit", "simulate", "diagnose"), _fitted),
    Panel("Diagnosis", ("diagnose", "fit"), _diagnosed),
    Panel("What to record next", ("identify", "diagnose", "fit"), _next),
)
"""The panels, in the order of the page."""
