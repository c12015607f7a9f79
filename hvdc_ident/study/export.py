"""What `export` writes: the model as a card, or its linear model in the format of the file's ending."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from hvdc_ident.errors import StudyError
from hvdc_ident.model.definition import Model
from hvdc_ident.study.study import Study

if TYPE_CHECKING:
    from hvdc_ident.linearize import LinearModel

LATER = {".fmu": "an FMU"}


def export(source: Study | Model | LinearModel, path: str | Path, linear: bool = False) -> Path:
    """The path, written in the format of its ending: .toml is the model, the others its linear model.

    source: a study, a model (linearised at its steady state) or a linear model. linear: the linear model even where the
    ending is one of the nonlinear model's. Raises StudyError for an ending that is not known or not yet to be had.
    """
    from hvdc_ident.linearize.export import formats, write

    path = Path(path)
    ending = path.suffix.lower()
    if ending == ".toml" and not linear and isinstance(source, Study | Model):
        from hvdc_ident.model.card import save_card

        return save_card(_model(source), path)
    known = [*([".toml"] if isinstance(source, Study | Model) and not linear else []), *formats()]
    if ending not in formats():
        what = f"{LATER[ending]} cannot be written yet" if ending in LATER else "no export has this ending"
        raise StudyError(what, where=str(path), expected=f"one of {', '.join(known)}")
    return write(_linear(source), path)


def _model(source: Study | Model) -> Model:
    if isinstance(source, Model):
        return source
    if not isinstance(source.model, Model):
        raise StudyError("the model's equations are not here to be written", where=source.path.name, got="an FMU")
    return source.model.with_values(dict(source.values)) if source.values else source.model


def _linear(source: Study | Model | LinearModel) -> LinearModel:
    from hvdc_ident.linearize import linearize
    from hvdc_ident.study.stages.linearize import linear_model

    if isinstance(source, Study):
        return linear_model(source)
    return linearize(source) if isinstance(source, Model) else source
