"""The letter of a study with what is attached to it: the augmented model as a card and as an FMU."""

from __future__ import annotations

from pathlib import Path

from hvdc_ident.errors import ComputationError
from hvdc_ident.model import read_card
from hvdc_ident.report.letter import STAGE, write_letter
from hvdc_ident.report.results import Results
from hvdc_ident.study.export import export
from hvdc_ident.study.pipeline import Done, have_stage
from hvdc_ident.study.stage import Options
from hvdc_ident.study.study import Study


def letter(study: Study, folder: Path, options: Options) -> tuple[Path, Done]:
    """The path of the letter in the folder, and the diagnosis it tells of, which is run where the folder has none.

    Raises ComputationError with the reason where the diagnosis fails.
    """
    done = have_stage(study, "diagnose", folder, options)
    if done.failed:
        raise ComputationError("there is no diagnosis to write a letter about", where="letter", got=done.failed)
    attach(folder)
    return write_letter(folder), done


def attach(folder: Path) -> Path | None:
    """The augmented model as an FMU beside its card; None where nothing was added to the model."""
    name = Results(folder).get(STAGE).get("augmented_model")
    card = folder / Path(str(name)).name
    if not name or not card.is_file():
        return None
    return export(read_card(card), card.with_suffix(".fmu"))
