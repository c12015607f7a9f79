"""Two folders of results side by side: a panel of the tab Run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nicegui import run, ui

import hvdc_ident as hi
from hvdc_ident.app.result_panels import show_table
from hvdc_ident.app.runs import folder_name
from hvdc_ident.errors import HvdcIdentError
from hvdc_ident.study.comparison import APART, RunComparison


class ComparedRuns:
    """The panel in one browser: the results that are open beside those of another folder."""

    def __init__(self) -> None:
        self._study: hi.Study | None = None
        self._folder = Path()
        self._others: dict[str, Path] = {}
        self._found: RunComparison | None = None

    def build(self) -> None:
        """Build the choice of the other folder."""
        with ui.element("div").classes("line"):
            self._other = ui.select({}, label="beside", on_change=self._compare).props("dense options-dense")
            self._other.style("min-width: min(16rem, 80vw)")
            self._page = ui.button("Page", on_click=self._give).props("outline dense").classes("q-px-sm")
            self._page.tooltip("The comparison as one HTML page")
        self._place = ui.element("div").classes("w-full")

    async def offer(self, study: hi.Study, folder: Path, others: list[Path]) -> None:
        """Offer the other folders that hold results, and compare with the one that is chosen, else the first."""
        self._study, self._folder = study, folder
        self._others = {str(p): p for p in others}
        names = {key: folder_name(study, p) for key, p in self._others.items()}
        chosen = self._other.value if self._other.value in names else next(iter(names), None)
        self._other.set_options(names, value=chosen)
        await self._compare()

    async def _compare(self, _: Any = None) -> None:
        other = self._others.get(self._other.value or "")  # none that is not offered
        if other is None or self._study is None:
            return
        try:
            self._found = await run.io_bound(hi.compare_runs, self._folder, other)
        except HvdcIdentError as error:
            ui.notify(str(error), type="negative", multi_line=True)
            return
        if self._found is not None:  # None: the server is ending
            self._show(self._found, [self._folder.name, other.name])

    def _show(self, comparison: RunComparison, names: list[str]) -> None:
        self._place.clear()
        with self._place:
            ui.label(comparison.conclusion).classes("text-bold")
            values = comparison.values_table(names)
            show_table(values)
            if values.rows:
                ui.label(APART).classes("small")
            ui.label("RMSE over the recordings that both have").classes("small q-mt-sm")
            show_table(comparison.gaps_table(names))
            for line in (*comparison.input_lines, *comparison.verdict_lines):
                ui.label(line)

    def _give(self) -> None:
        if self._found is not None:
            ui.download.content(self._found.page, "compare.html")
