"""What `export` writes of a study: the model as a card, or its linear model in the format of the file's ending."""

from __future__ import annotations

from pathlib import Path

from hvdc_ident.errors import StudyError
from hvdc_ident.study.study import Study

LATER = {".fmu": "an FMU"}


def export(study: Study, path: Path, linear: bool = False) -> Path:
    """The path, written. linear: the linear model even where the ending is one of the nonlinear model's.

    Raises StudyError for an ending that is not known, or what is not yet to be had.
    """
    from hvdc_ident.linearize.export import formats, write
    from hvdc_ident.study.stages.linearize import linear_model

    ending = path.suffix.lower()
    if ending == ".toml" and not linear:
        from hvdc_ident.model.card import save_card

        save_card(study.model.with_values(dict(study.values)) if study.values else study.model, path)
        return path
    if ending in formats():
        return write(linear_model(study), path)
    known = [".toml", *formats()]
    if ending in LATER:
        raise StudyError(
            f"{LATER[ending]} cannot be written yet", where=str(path), expected=f"one of {', '.join(known)}"
        )
    raise StudyError("no export has this ending", where=str(path), expected=f"one of {', '.join(known)}")
