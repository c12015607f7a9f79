"""Remarks on the steady states that a study's runs begin at."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from hvdc_ident.data import Experiment
from hvdc_ident.errors import HvdcIdentError
from hvdc_ident.model import Model
from hvdc_ident.study.study import Study


def steady_notes(study: Study, *, searches: bool = False) -> list[str]:
    """Return a sentence for each start, of the model and of each experiment, that is unstable, off its branch or far out.

    The model stands at its own inputs, an experiment at the first values of its; parameters at the given values, which
    every stage runs at. searches: also at the start values, where they differ, for a search begins there.
    Empty where every start is the model's own stable steady state, and for an FMU, which begins where it says.
    """
    model = study.model
    if not isinstance(model, Model) or any(s.start is not None for s in model.states.values()):
        return []
    begins = {"model": (), **{f"experiment {e.name}": _first(e) for e in study.experiments if not e.drive}}
    at_given = {where: _notes(model, study.given, inputs) for where, inputs in begins.items()}
    found = [f"{where}: {note}" for where, notes in at_given.items() for note in notes]
    if searches and study.start != study.given:
        for where, inputs in begins.items():
            notes = _notes(model, study.start, inputs)
            found += [f"{where}, at the start values: {note}" for note in notes if note not in at_given[where]]
    return found


def _first(e: Experiment) -> tuple[tuple[str, float], ...]:
    """The inputs before anything happens, by name."""
    return (*e.values.items(), *((n, float(signal.values[0])) for n, signal in e.inputs.items()))


def _notes(model: Model, values: Mapping[str, float], inputs: Iterable[tuple[str, float]]) -> tuple[str, ...]:
    from hvdc_ident.linearize import find_operating_point

    fixed = {**values, **dict(inputs)}
    known = {n: v for n, v in fixed.items() if n in model.parameters or n in model.inputs}
    try:
        return find_operating_point(model, known).notes
    except HvdcIdentError as error:  # the stage that needs a steady state ends with it
        return (str(error),)
