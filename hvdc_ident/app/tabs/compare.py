"""Compare: the results of two folders side by side."""

from __future__ import annotations

from pathlib import Path

from nicegui import run, ui

import hvdc_ident as hi
from hvdc_ident.app.desk import Desk
from hvdc_ident.app.result_panels import show_table
from hvdc_ident.app.runs import folder_name, result_folders
from hvdc_ident.app.server import Tab
from hvdc_ident.errors import HvdcIdentError
from hvdc_ident.study.comparison import APART, SIDES, RunComparison


class ComparedRuns:
    """The tab in one browser: two folders of the study's folder, and what differs."""

    def __init__(self, study: hi.Study) -> None:
        self._study = study
        self._found: RunComparison | None = None

    def build(self) -> None:
        """Build the choices; what differs is shown once both are chosen."""
        with ui.row().classes("w-full items-center gap-3"):
            self._sides = [
                ui.select({}, label=f"{side} result", on_change=self._compare).props("dense options-dense")
                for side in SIDES
            ]
            for side in self._sides:
                side.style("min-width: 16rem")
            ui.button("Look again", on_click=self._offer).props("flat dense no-caps").tooltip("Folders that are new")
            self._page = ui.button("Page", on_click=self._give).props("outline dense no-caps").classes("q-px-sm")
            self._page.tooltip("The comparison as one HTML page")
            self._page.set_enabled(False)
        self._place = ui.column().classes("w-full gap-2")
        self._offer()

    def _offer(self) -> None:
        """Offer the folders that hold results."""
        found = [p for p in result_folders(self._study) if p.is_dir() and any(p.glob("*.json"))]
        names = {str(p): folder_name(self._study, p) for p in found}
        for k, side in enumerate(self._sides):
            first = list(names)[k] if len(names) > 1 else None
            side.set_options(names, value=side.value if side.value in names else first)
        if len(names) < 2 and self._found is None:
            self._place.clear()
            with self._place:
                ui.label(
                    "Fewer than two folders here hold results. `hvdc-ident run STUDY --out OTHER-results` beside the study "
                    "writes another, for example after a change of the study."
                )

    async def _compare(self) -> None:
        offered = {str(p): p for p in result_folders(self._study)}
        chosen = [offered[s.value] for s in self._sides if s.value in offered]  # none that is not offered
        if len(chosen) < 2:
            return
        try:
            found = await run.io_bound(hi.compare_runs, *chosen)
        except HvdcIdentError as error:
            ui.notify(str(error), type="negative", multi_line=True)
            return
        if found is not None:  # None: the server is ending
            self._found = found
            self._page.set_enabled(True)
            self._show(found, chosen)

    def _show(self, found: RunComparison, folders: list[Path]) -> None:
        self._place.clear()
        with self._place:
            ui.label(found.conclusion).classes("text-body1 text-bold")
            names = [f.name for f in folders]
            values, gaps = found.values_table(names), found.gaps_table(names)
            if values.rows:
                show_table(values)
                ui.label(APART).classes("text-caption")
            if gaps.rows:
                ui.label("RMSE over the recordings that both have").classes("text-subtitle2")
                show_table(gaps)
            for line in (*found.input_lines, *found.verdict_lines):
                ui.label(line).classes("text-body2")

    def _give(self) -> None:
        if self._found is not None:
            ui.download.content(self._found.page, "compare.html")


def build(desk: Desk) -> None:
    """Build the tab: of a study the results beside it, else what to do."""
    if desk.study is None:
        ui.markdown("No study is open. `hvdc-ident app STUDY` opens one; its results are compared here.")
        return
    ComparedRuns(desk.study).build()


TAB = Tab(order=40, title="Compare", build=build)
