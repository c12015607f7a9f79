"""Remarks on the steady states that a study's runs begin at."""

from __future__ import annotations

from hvdc_ident.errors import HvdcIdentError
from hvdc_ident.experiment import Experiment
from hvdc_ident.model.definition import Model
from hvdc_ident.study.study import Study


def steady_notes(study: Study) -> list[str]:
    """Return a sentence for each start, of the model and of each experiment, that is unstable, off its branch or far out.

    The model stands at its own inputs, an experiment at the first values of its; parameters at the candidates' start.
    Empty where every start is the model's own stable steady state, and for an FMU, which begins where it says.
    """
    model = study.model
    if not isinstance(model, Model) or any(s.start is not None for s in model.states.values()):
        return []
    starts = {"model": (), **{f"experiment {e.name}": _first(e) for e in study.experiments if not e.drive}}
    found: list[str] = []
    for where, inputs in starts.items():
        found += [f"{where}: {note}" for note in _notes(model, {**study.start, **dict(inputs)})]
    # What holds for the model itself need not be repeated by each experiment that begins there.
    return list(dict.fromkeys(found))


def _first(e: Experiment) -> tuple[tuple[str, float], ...]:
    """The inputs before anything happens, by name."""
    return (*e.values.items(), *((n, float(signal.values[0])) for n, signal in e.inputs.items()))


def _notes(model: Model, fixed: dict[str, float]) -> tuple[str, ...]:
    from hvdc_ident.linearize import find_operating_point

    known = {n: v for n, v in fixed.items() if n in model.parameters or n in model.inputs}
    try:
        return find_operating_point(model, known).notes
    except HvdcIdentError as error:  # the stage that needs a steady state ends with it
        return (str(error),)
