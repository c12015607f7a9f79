"""Run: the stages of a study, their progress, and their results as they come."""

from __future__ import annotations

from typing import Any

from nicegui import run, ui

import hvdc_ident as hi
from hvdc_ident.app.desk import Desk
from hvdc_ident.app.exports import ExportButtons
from hvdc_ident.app.result_panels import PANELS, FoundResults, Panel
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
from hvdc_ident.app.server import Tab
from hvdc_ident.errors import HvdcIdentError
from hvdc_ident.next_step import next_sentence
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
NO_STUDY = (
    "No study is open. The tab Recording writes one from your recordings; `hvdc-ident app STUDY` opens one; `hvdc-ident new DIR` "
    "writes one with data to start from."
)


class StageDesk:
    """The tab in one browser: the study as its files are now, the folder of results, and the elements that show both."""

    def __init__(self, desk: Desk, study: hi.Study) -> None:
        self._desk, self._study = desk, study
        self._folder = first_folder(study)
        self._seen: Any = None
        self._busy = False
        self._letter: StudyRun | None = None
        self._panels: list[tuple[Panel, Any]] = []
        self._panel_keys: dict[str, Any] = {}
        self._starts: list[Any] = []
        self._unreadable = ""

    # --- the page ---

    def build(self) -> None:
        """Build the tab's elements, which look after the run and the files from then on."""
        self._panel = ui.context.slot.parent
        with ui.row().classes("w-full no-wrap items-start"):
            with ui.column().classes("gap-1").style("width: 21rem; flex: none"):
                self._build_folder()
                self._build_run()
                self._list = ui.column().classes("w-full gap-0")
                ui.separator()
                self._exports = ExportButtons(lambda: (self._study, self._folder), self._write_letter)
                self._exports.build()
            with ui.column().classes("col gap-1").style("min-width: 0"):
                self._trouble = (
                    ui.label("").classes("text-negative").props('role="alert"').style("white-space: pre-line")
                )
                self._next = ui.label("").classes("text-body2")
                with ui.tabs().props("dense align=left no-caps") as bar:
                    for panel in PANELS:
                        ui.tab(panel.title)
                with ui.tab_panels(bar, value=PANELS[0].title, animated=False).classes("w-full"):
                    for panel in PANELS:
                        with ui.tab_panel(panel.title).classes("q-pa-none"):
                            self._panels.append((panel, ui.column().classes("w-full gap-2 q-pt-sm")))
        ui.timer(LOOK, self._look)

    def _build_folder(self) -> None:
        folders = {str(p): folder_name(self._study, p) for p in result_folders(self._study)}
        if len(folders) > 1:
            ui.select(
                folders,
                value=str(self._folder),
                label="folder of results",
                on_change=self._choose_folder,
            ).props("dense options-dense").classes("w-full")

    def _choose_folder(self, event: Any) -> None:
        chosen = next((p for p in result_folders(self._study) if str(p) == event.value), None)
        if chosen is not None:  # one that is offered, and no other
            self._folder, self._seen = chosen, None

    def _build_run(self) -> None:
        with ui.row().classes("w-full items-center no-wrap"):
            self._all = ui.button("Run all", on_click=lambda: self._start(EVERYTHING)).props("dense").classes("q-px-md")
            self._all.tooltip("Every stage that the study asks for; what stands is kept.")
            self._cancel = (
                ui.button("Cancel", on_click=self._end).props("dense outline color=negative").classes("q-px-md")
            )
            self._cancel.tooltip("Ends the work now. What is finished is kept, and the next run goes on from there.")
        with ui.column().classes("w-full gap-0") as self._progress:
            self._bar = ui.linear_progress(0.0, show_value=False).props("instant-feedback aria-label=progress")
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
        found = RUNS.of(self._folder)
        if found is not None:
            found.cancel()
            self._text.text = "ending"

    def _write_letter(self) -> None:
        self._letter = self._start(LETTER)

    # --- what is seen ---

    async def _look(self) -> None:
        """Show what has changed since the last look, while somebody looks."""
        if self._busy or not self._is_open():
            return
        self._busy = True
        try:
            found = RUNS.of(self._folder)
            self._show_run(found)
            seen = (self._folder, signature(self._study, self._folder), found and (found.stage, found.outcome))
            if seen != self._seen:
                await self._read(seen)
            if found is not None and found is self._letter and found.outcome != "running":
                self._letter = None
                if found.outcome == "done":
                    self._exports.give(self._folder / "letter.html")
        finally:
            self._busy = False

    def _is_open(self) -> bool:
        """Return whether the tab is the one that is open: another one's sliders have the processor for themselves."""
        panels = self._panel.parent_slot.parent if self._panel.parent_slot else None
        return getattr(panels, "value", TAB.title) == TAB.title

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

        found = await run.io_bound(read)
        if found is None:
            return  # the server is ending
        self._study, stages, self._unreadable = found
        self._seen = seen
        self._show_stages(stages)
        data = {s.stage.name: s.data for s in stages if s.data and s.state in ("done", "stale")}
        shown = FoundResults(self._study, self._folder, data)
        for panel, place in self._panels:
            if self._panel_keys.get(panel.title) != (key := panel.key(shown)):
                self._panel_keys[panel.title] = key
                panel.show(shown, place)
        self._next.text = " ".join(next_sentence(step, "page") for step in shown.summary.next)

    def _show_run(self, found: StudyRun | None) -> None:
        working = found is not None and found.outcome == "running"
        for element in (self._progress, self._cancel):
            element.set_visibility(working)
        for button in (self._all, *self._starts):
            button.set_enabled(not working)
        trouble = self._unreadable
        if found is not None and working:
            self._bar.value = found.share
            self._times.text = f"{percentage(found.share)}, {found.times}" if found.share else found.times
            self._text.text = found.text
        elif found is not None:
            said = {"failed": found.message, "cancelled": "Cancelled. What was finished is kept; the next run goes on."}
            trouble = "\n".join(t for t in (trouble, said.get(found.outcome, "")) if t)
        self._trouble.text = trouble

    def _show_stages(self, found: tuple[StageStanding, ...]) -> None:
        at_work = RUNS.of(self._folder)
        working = at_work is not None and at_work.outcome == "running"
        self._list.clear()
        self._starts = []
        with self._list:
            for asked, title in ((True, "Stages that the study asks for"), (False, "Other stages")):
                group = [s for s in found if s.asked is asked]
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
                ui.label(said).classes("text-caption ellipsis w-full").tooltip(said)
            button = ui.button("Again" if state == "done" else "Run", on_click=start).props("flat dense no-caps")
            button.props(f'aria-label="Run {name}"').set_enabled(enabled)
            self._starts.append(button)


def build(desk: Desk) -> None:
    """Build the tab: of a study its stages, else what to do."""
    if desk.study is None:
        ui.markdown(desk.why or NO_STUDY)
        return
    StageDesk(desk, desk.study).build()


TAB = Tab(order=30, title="Run", build=build)
