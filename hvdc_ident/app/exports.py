"""Buttons that write a study's report, letter and models, and hand the files to the browser."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

from nicegui import run, ui

import hvdc_ident as hi
from hvdc_ident.app.study_folder import safe_name
from hvdc_ident.errors import HvdcIdentError
from hvdc_ident.report.page import write_report
from hvdc_ident.study.export import write

MODELS = {
    ".dyr": "The unit's .dyr file with its values, the other records as they are",
    ".fmu": "The model for other simulators (FMI 2.0)",
    ".mo": "The model in Modelica",
    ".toml": "The model as a card",
    ".mat": "The linear model for MATLAB",
    ".ssv": "The values of the parameters (SSP)",
}
"""Endings of the files that are offered, with what they hold."""


class ExportButtons:
    """The buttons. of: returns the study and the folder of results as they are now. letter: starts to write the letter,
    which may have to run the diagnosis; `give` hands it over when it is there."""

    def __init__(self, of: Callable[[], tuple[hi.Study, Path]], letter: Callable[[], None]) -> None:
        self._of, self._letter = of, letter

    def build(self) -> None:
        """Build the buttons."""
        ui.label("Take away").classes("small")
        with ui.element("div").classes("line"):
            ui.button("Report", on_click=self._report).props("outline dense no-caps").classes("q-px-sm")
            letter = ui.button("Letter", on_click=self._letter).props("outline dense no-caps").classes("q-px-sm")
            letter.tooltip(
                "One page for the model's owner on what the model lacks; runs the diagnosis where none stands."
            )
            of_a_unit = self._of()[0].settings.model.dyr is not None
            for ending, words in MODELS.items():
                if ending != ".dyr" or of_a_unit:
                    self._model_button(ending, words)

    def _model_button(self, ending: str, words: str) -> None:
        async def export() -> None:
            await self._export(ending)

        button = ui.button(ending, on_click=export).props("outline dense no-caps").classes("q-px-sm")
        button.tooltip(f"{words}, with the fitted values where a fit stands, else the given ones.")

    def give(self, file: Path) -> None:
        """Hand a file to the browser."""
        ui.download.content(file.read_bytes(), file.name)

    async def _report(self) -> None:
        _, folder = self._of()
        try:
            page = await run.io_bound(write_report, folder)
        except HvdcIdentError as error:
            ui.notify(str(error), type="negative", multi_line=True)
            return
        if page is not None:  # None: the server is ending
            self.give(page)

    async def _export(self, ending: str) -> None:
        study, folder = self._of()
        name = safe_name(
            f"{study.model.name}{ending}"
        )  # the model's own: that of the study is another file's beside it

        def made() -> tuple[bytes, str]:
            with tempfile.TemporaryDirectory() as place:
                written = write(study, Path(place) / name, folder=folder)
                return written.path.read_bytes(), written.note

        try:
            exported = await run.io_bound(made)
        except HvdcIdentError as error:
            ui.notify(str(error), type="negative", multi_line=True)
            return
        if exported is not None:
            content, note = exported
            ui.download.content(content, name)
            ui.notify(f"{name}: {note}", type="info", multi_line=True)
