"""The first part of the page where a diagnosis has run: the letter to the owner of the model."""

from __future__ import annotations

from hvdc_ident.report.letter import STAGE, letter_body, letter_of
from hvdc_ident.report.results import Results, Section


def _render(results: Results) -> str:
    return letter_body(letter_of(results)) if "verdict" in results.get(STAGE) else ""


SECTION = Section(order=1, title="To the owner of the model", render=_render)
