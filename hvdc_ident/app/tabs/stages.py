"""Run: the stages of a study, their progress, and their results as they come."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nicegui import run, ui

import hvdc_ident as hi
from hvdc_ident.app.compared_runs import ComparedRuns
from hvdc_ident.app.exports import ExportButtons
from hvdc_ident.app.page import Page, Tab
from hvdc_ident.app.result_panels import PANELS
from hvdc_ident.app.results import FoundResults
from hvdc_ident.app.runs import (
    EVERYTHING,
    LETTER,
    RUNS,
    StageStanding,
    StudyRun,
    first_folder,
    folder_name,
    result_folders,
    signature,
    standings,
)
from hvdc_ident.app.study_folder import stamp
from hvdc_ident.errors import HvdcIdentError
from hvdc_ident.text import percentage

LOOK = 0.3
"""Seconds between two looks at the run and at the files: it moves for the eye, and costs a look at some files' times."""
MARKS = {
    "done": ("check_circle", "positive"),
    "stale": ("history", "warning"),
    "failed": ("error", "negative"),
    "interrupted": ("pause_circle", "warning"),
    "not run": ("radio_button_unchecked", "grey"),
    "running": ("autorenew", "primary"),
}
"""Icon and colour of each state."""
COMPARISON = "Comparison"


class StageDesk:
    """The tab in one browser: the study as its files are now, the folder of results, and the elements that show both."""

    def __init__(self, page: Page, study: hi.Study) -> None:
        self._page, self._desk, self._study = page, page.desk, study
        self._folder = first_folder(study)
        self._seen: Any = None
        self._stages: Any = None
        self._read_last: Any = None
        self._drawn: Any = None
        self._busy = False
        self._letter: StudyRun | None = None
        self._panels: dict[str, tuple[Any, Any]] = {}
        self._comparison = ComparedRuns()
        self._panel_keys: dict[str, Any] = {}
        self._starts: list[Any] = []
        self._unreadable = ""

    # --- the page ---

    def build(self) -> None:
        """Build the tab's elements, which look after the run and the files from then on."""
        with ui.element("div").classes("bench"):
            with ui.element("div").classes("rail tile"):
                self._folders = ui.select({}, label="folder of results", on_change=self._choose_folder)
                self._folders.props("dense options-dense").classes("w-full")
                with ui.element("div").classes("q-mt-sm"):
                    self._build_run()
                self._list = ui.element("div").classes("w-full")
                ui.separator().classes("q-my-sm")
                self._exports = ExportButtons(lambda: (self._study, self._folder), self._write_letter)
                self._exports.build()
            with ui.element("div").classes("stack"):
                self._trouble = ui.label("").classes("alert").props('role="alert"')
                self._nothing = ui.html(
                    "<p><strong>Nothing has run yet.</strong></p><p>Run all computes every stage that the study asks for. "
                    "The results open here as they come: what the recordings tell, the fit over them, what the model lacks, "
                    "and what to record next.</p>",
                    sanitize=False,
                ).classes("tile empty")
                with ui.element("div").classes("tile") as self._results:
                    self._build_panels()
        self._results.visible = self._nothing.visible = False
        self._page.start = self._start
        ui.timer(LOOK, self._look)

    def _build_panels(self) -> None:
        """Build a tab for each panel; those that have something to show can be seen."""
        titles = [*(p.title for p in PANELS), COMPARISON]
        with ui.tabs().props("dense align=left no-caps outside-arrows mobile-arrows") as self._bar:
            tabs = {title: ui.tab(title) for title in titles}
        with ui.tab_panels(self._bar, value=titles[0], animated=False).classes("w-full"):
            for title in titles:
                with ui.tab_panel(title):
                    self._panels[title] = tabs[title], ui.element("div").classes("stack q-pt-sm")
        for tab, _ in self._panels.values():
            tab.visible = False
        with self._panels[COMPARISON][1]:
            self._comparison.build()

    def _offer_folders(self) -> list[Path]:
        """Offer the folders that hold results, and return those besides the one that is open."""
        folders = result_folders(self._study)
        self._folders.set_options({str(p): folder_name(self._study, p) for p in folders}, value=str(self._folder))
        self._folders.visible = len(folders) > 1
        return [p for p in folders if p != self._folder and p.is_dir() and any(p.glob("*.json"))]

    def _choose_folder(self, event: Any) -> None:
        chosen = next((p for p in result_folders(self._study) if str(p) == event.value), None)
        if chosen is not None:  # one that is offered, and no other
            self._folder, self._seen = chosen, None

    def _build_run(self) -> None:
        with ui.element("div").classes("line"):
            self._all = (
                ui.button("Run all", on_click=lambda: self._start(EVERYTHING))
                .props("dense unelevated")
                .classes("q-px-md")
            )
            self._all.tooltip("Every stage that the study asks for; what stands is kept.")
            self._cancel = (
                ui.button("Cancel", on_click=self._end).props("dense outline color=negative").classes("q-px-md")
            )
            self._cancel.tooltip("Ends the work now. What is finished is kept, and the next run goes on from there.")
        with ui.column().classes("w-full gap-0 q-pt-sm") as self._progress:
            self._share = ui.linear_progress(0.0, show_value=False).props("instant-feedback aria-label=progress")
            self._times = ui.label("").classes("text-caption")
            self._text = ui.label("").classes("text-caption").style("overflow-wrap: anywhere; min-height: 2.6em")
        self._progress.set_visibility(False)
        self._cancel.set_visibility(False)

    # --- work ---

    def _start(self, what: str) -> StudyRun | None:
        try:
            started = RUNS.start(self._study, self._folder, what, trust=self._desk.trust)
        except HvdcIdentError as error:
            ui.notify(str(error), type="warning", multi_line=True)
            return None
        self._show_run(started)
        return started

    def _end(self) -> None:
        study_run = RUNS.of(self._folder)
        if study_run is not None:
            study_run.cancel()
            self._text.text = "ending"

    def _write_letter(self) -> None:
        self._letter = self._start(LETTER)

    # --- what is seen ---

    async def _look(self) -> None:
        """Show what has changed since the last look."""
        if self._busy:
            return
        self._busy = True
        try:
            study_run = RUNS.of(self._folder)
            self._show_run(study_run)
            beside = sorted(p for p in self._study.path.resolve().parent.iterdir() if p.is_dir() and p != self._folder)
            marks = signature(self._study, self._folder)
            seen = (self._folder, marks, study_run and (study_run.stage, study_run.outcome), [stamp(p) for p in beside])
            if seen != self._seen:
                await self._read(seen)
            if self._read_last is not self._drawn and (self._drawn is None or self._page.is_open(TAB.title)):
                await self._draw(*self._read_last)
            if study_run is not None and study_run is self._letter and study_run.outcome != "running":
                self._letter = None
                if study_run.outcome == "done":
                    self._exports.give(self._folder / "letter.html")
        finally:
            self._busy = False

    async def _read(self, seen: Any) -> None:
        """Read the study where its files have changed, and the results."""

        def read() -> tuple[hi.Study, tuple[StageStanding, ...], str]:
            study, trouble = self._study, ""
            before = self._seen
            if before is None or before[1][: len(study.sources)] != seen[1][: len(study.sources)]:
                try:
                    study = hi.load_study(study.path, trust=self._desk.trust)
                except HvdcIdentError as error:
                    trouble = f"The study as its file is now cannot be read; shown is the one before. {error}"
            return study, standings(study, self._folder), trouble

        state = await run.io_bound(read)
        if state is None:
            return  # the server is ending
        self._study, stages, self._unreadable = state
        self._seen = seen
        data = {s.stage.name: s.data for s in stages if s.data and s.state in ("done", "stale")}
        shown = FoundResults(self._study, self._folder, data)
        await run.io_bound(lambda: (shown.summary, shown.supposed))  # what takes a while is made here
        self._read_last = stages, shown
        self._page.tell(shown)

    async def _draw(self, stages: tuple[StageStanding, ...], shown: FoundResults) -> None:
        """Show how the stages stand, and the panels that have something to show.

        A part that is replaced while its tab is closed is not found by its tooltips when that is opened.
        """
        self._drawn = self._read_last
        self._show_stages(stages)
        others = self._offer_folders()
        self._nothing.visible, self._results.visible = not shown.data, bool(shown.data)
        for panel in PANELS:
            tab, place = self._panels[panel.title]
            tab.visible = bool(shown.of(panel.uses[0]))
            if tab.visible and self._panel_keys.get(panel.title) != (key := panel.key(shown)):
                self._panel_keys[panel.title] = key
                place.clear()
                with place:
                    panel.build(shown, self._page)
        self._panels[COMPARISON][0].visible = bool(shown.data and others)
        if not self._panels.get(self._bar.value or "", next(iter(self._panels.values())))[0].visible:
            self._bar.value = next((title for title, (tab, _) in self._panels.items() if tab.visible), self._bar.value)
        if shown.data and others:
            await self._comparison.offer(self._study, self._folder, others)

    def _show_run(self, study_run: StudyRun | None) -> None:
        working = study_run is not None and study_run.outcome == "running"
        for element in (self._progress, self._cancel):
            element.set_visibility(working)
        for button in (self._all, *self._starts):
            button.set_enabled(not working)
        trouble = self._unreadable
        if study_run is not None and working:
            self._share.value = study_run.share
            self._share.props(remove="indeterminate") if study_run.share else self._share.props("indeterminate")
            self._times.text = (
                f"{percentage(study_run.share)}, {study_run.times}" if study_run.share else study_run.times
            )
            self._text.text = study_run.text
        elif study_run is not None:
            said = {
                "failed": study_run.message,
                "cancelled": "Cancelled. What was finished is kept; the next run goes on.",
            }
            trouble = "\n".join(t for t in (trouble, said.get(study_run.outcome, "")) if t)
        self._trouble.text = trouble
        self._page.tell_run(study_run)

    def _show_stages(self, stages: tuple[StageStanding, ...]) -> None:
        at_work = RUNS.of(self._folder)
        working = at_work is not None and at_work.outcome == "running"
        if (shown := (stages, working, at_work and at_work.stage)) == self._stages:
            return
        self._stages = shown
        self._list.clear()
        self._starts = []
        with self._list:
            for asked, title in ((True, "Stages that the study asks for"), (False, "Other stages")):
                group = [s for s in stages if s.asked is asked]
                if group:
                    ui.label(title).classes("text-caption text-grey q-mt-sm")
                for s in group:
                    now = "running" if working and at_work is not None and at_work.stage == s.stage.name else s.state
                    self._show_stage(s, now, enabled=not working)

    def _show_stage(self, standing: StageStanding, state: str, *, enabled: bool) -> None:
        icon, color = MARKS[state]
        name = standing.stage.name

        def start() -> None:
            self._start(name)

        with ui.row().classes("w-full items-center no-wrap gap-2"):
            ui.icon(icon, color=color).classes("text-h6")
            with ui.column().classes("col gap-0").style("min-width: 0"):
                ui.label(name).classes("text-body2").tooltip(standing.stage.summary)
                verdict = standing.stage.verdict(standing.data) if state == "done" else ""
                why = standing.why if state in ("failed", "stale", "interrupted") else verdict
                said = f"{state}: {why}" if why else state
                ui.label(said).classes("text-caption w-full")
            button = ui.button("Again" if state == "done" else "Run", on_click=start).props("flat dense no-caps")
            button.props(f'aria-label="Run {name}"').set_enabled(enabled)
            self._starts.append(button)


def build(page: Page) -> None:
    """Build the tab: of a study its stages, else why it cannot be read."""
    if page.desk.study is None:
        ui.label(page.desk.why).classes("tile empty alert")
        return
    StageDesk(page, page.desk.study).build()


TAB = Tab(order=30, title="Run", build=build, of_study=True)
