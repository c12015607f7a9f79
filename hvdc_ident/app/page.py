"""The page in one browser: what lies on it, the results that it shows, its head with the four answers, and its tabs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from nicegui import ui

from hvdc_ident.app.desk import Desk
from hvdc_ident.app.page_errors import show_errors
from hvdc_ident.app.plot import HEAD
from hvdc_ident.app.results import FoundResults
from hvdc_ident.app.runs import StudyRun
from hvdc_ident.report.first_screen import tiles
from hvdc_ident.report.html import text

HEIGHT_OF_HEAD = """<script>
new MutationObserver((_, seen) => {
  const head = document.querySelector(".q-header");
  if (!head) return;
  seen.disconnect();
  new ResizeObserver(() => document.documentElement.style.setProperty("--head", `${head.offsetHeight}px`)).observe(head);
}).observe(document, { childList: true, subtree: true });
</script>"""
"""Tells the style sheet where the head ends, below which columns stay in view."""


@dataclass(frozen=True)
class Tab:
    """A tab of the page: its place in the order, its title, and a function that builds it inside NiceGUI's context.

    maps: whether it is the one that a desk with a recording opens at. of_study: whether it is about a study, and left out without one.
    """

    order: int
    title: str
    build: Callable[[Page], None]
    maps: bool = False
    of_study: bool = False


class Page:
    """The page in one browser.

    desk: what lies on it. explore: opens a model that the results come to, by name, with its sliders. start: starts a stage in the
    folder of results that is open, and returns the run; None where it cannot.
    """

    def __init__(self, desk: Desk) -> None:
        self.desk = desk
        self._found: FoundResults | None = None
        self._told: list[Callable[[FoundResults], None]] = []
        self._told_run: list[Callable[[StudyRun | None], None]] = []
        self._panels: Any = None
        self.explore: Callable[[str], None] = lambda name: None
        self.start: Callable[[str], StudyRun | None] = lambda stage: None

    def build(self, tabs: tuple[Tab, ...]) -> None:
        """Build the head and the tabs."""
        show_errors()
        ui.add_head_html(HEAD + HEIGHT_OF_HEAD)
        shown = [t for t in tabs if not t.of_study or self.desk.study or self.desk.why]
        with ui.header(elevated=False).classes("bar items-center"):
            ui.html(f"<h1>{text(self.desk.title)}</h1>", sanitize=False)
            ui.label(self._about()).classes("about")
            with ui.tabs().props("dense no-caps") as bar:
                for tab in shown:
                    ui.tab(tab.title)
            self._answers = ui.html("", sanitize=False).classes("answers")
        first = next((t for t in shown if t.maps and self.desk.recording), shown[0])
        self.on_results(self._show_answers)
        with ui.tab_panels(bar, value=first.title, animated=False).classes("w-full") as self._panels:
            for tab in shown:
                with ui.tab_panel(tab.title):
                    tab.build(self)

    def _about(self) -> str:
        """Return what lies on the page, in words."""
        study, model = self.desk.study, self.desk.model
        if study is None:
            return "" if model.name == self.desk.title else f"model {model.name}"
        held = sum(e.role == "holdout" for e in study.experiments)
        recordings = f"{len(study.experiments)} recording{'s' if len(study.experiments) != 1 else ''}"
        return f"model {model.name} · {recordings}{f', {held} of them held out' if held else ''}"

    def is_open(self, title: str) -> bool:
        """Return whether a tab is the one that is open."""
        return bool(self._panels.value == title)

    def open(self, title: str) -> None:
        """Open a tab."""
        self._panels.value = title

    def on_results(self, tell: Callable[[FoundResults], None]) -> None:
        """Have results told, now where there are some, and whenever there are others."""
        self._told.append(tell)
        if self._found is not None:
            tell(self._found)

    def tell(self, results: FoundResults) -> None:
        """Tell all parts of the page that there are these results."""
        self._found = results
        for tell in self._told:
            tell(results)

    def on_run(self, tell: Callable[[StudyRun | None], None]) -> None:
        """Have the run told that is at work in the folder of results, or was the last; None where there was none."""
        self._told_run.append(tell)

    def tell_run(self, study_run: StudyRun | None) -> None:
        """Tell all parts of the page how the run stands."""
        for tell in self._told_run:
            tell(study_run)

    def _show_answers(self, results: FoundResults) -> None:
        """Show the four answers of the report in short; opened, as the report has them."""
        s = results.summary
        if not (s.sets or s.parameters):
            self._answers.content = ""
            return
        every = tiles(s, "page")
        brief = "".join(
            f"<div class='brief' data-tile='{t.name}'><h2>{t.title}</h2><p>{t.brief or t.answer}</p></div>"
            for t in every
        )
        verdict, values, missing, step = (t.html for t in every)
        whole = f"<div class='first'>{verdict}{values}{missing}{step}</div>"
        self._answers.content = (
            f"<details><summary aria-label='The answers'>{brief}</summary><div>{whole}</div></details>"
        )
