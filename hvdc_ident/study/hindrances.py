"""Hindrances of a run: what keeps it from ending, or its results from being right, found before a stage runs: `check` ends with it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from hvdc_ident.data import Contradiction
from hvdc_ident.errors import HvdcIdentError
from hvdc_ident.simulate import ModelSimulator
from hvdc_ident.study.checks import need_start
from hvdc_ident.study.initial_values import InitialValues, outputs_of
from hvdc_ident.study.linear_analysis import operating_point
from hvdc_ident.study.stages import stages

if TYPE_CHECKING:
    from hvdc_ident.study.study import Study


def hindrances(study: Study, values: InitialValues, contradictions: Sequence[Contradiction] = ()) -> list[str]:
    """Return what hinders a run, in sentences; empty where nothing was found.

    values: of this study; they come from a run of every recorded experiment at the given values, whose failures they hold, with
    the recordings that seem to have another sign or unit. Besides these, experiments without a recording are run at the given
    values, and all at the start values where these differ and a search begins there. contradictions: in the recordings; those that are
    mended already hinder nothing, and of an experiment with one that is not, nothing else is told.
    """
    sentences = [c.text for c in contradictions if not c.done]
    sentences += [*values.failures, *values.mistakes, *_bounds(study), *_nothing_recorded(study)]
    sentences += _runs(study, at_start=False)
    searches = any(s.searches and s.wanted(study) for s in stages())
    if searches and study.start != study.given:
        sentences += _runs(study, at_start=True)
    for begins, asked in ((searches, need_start), (study.settings.linearize is not None, operating_point)):
        if begins and not sentences:
            try:
                asked(study)
            except HvdcIdentError as error:
                sentences.append(str(error))
    return list(dict.fromkeys(sentences))


def _nothing_recorded(study: Study) -> list[str]:
    """Return a sentence where stages are asked for that compare with records, and the study has none."""
    asked = [s.name for s in stages() if s.wanted(study) and s.name in ("screen", "identify", "fit", "diagnose")]
    if not asked or study.experiments or study.responses:
        return []
    return [
        f"{study.path.name} has no record for {', '.join(asked)}: no [[experiment]] with data and outputs, and no [[response]]; "
        "take out the # before the lines of one that are right"
    ]


def _bounds(study: Study) -> list[str]:
    """Return a sentence for each candidate whose given value lies outside the bounds of its search."""
    units = {n: study.model.parameters[n].unit for n in study.candidates}
    return [
        f"parameters.{n}: the given value {c.given:.6g} lies outside the bounds of the search, {c.min:.6g} to "
        f"{c.max:.6g} {units[n]}".rstrip()
        + ", so no fit can return it: is it right, and are they?"
        for n, c in study.candidates.items()
        if not c.min <= c.given <= c.max
    ]


def _runs(study: Study, *, at_start: bool) -> list[str]:
    """Return why experiments cannot be simulated: all at the start values, or at the given ones those without a recording."""
    simulator, values = ModelSimulator(study.model), dict(study.start if at_start else study.given)
    where = ", at the start values" if at_start else ""
    runs = {e.name: outputs_of(simulator, e, values) for e in study.experiments if at_start or not e.outputs}
    return [f"{name}{where}: {run}" for name, run in runs.items() if isinstance(run, str)]
