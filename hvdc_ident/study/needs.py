"""What a stage needs of a study, or the message that says it is missing."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from hvdc_ident.errors import ComputationError, InputError, SteadyStateError, StudyError
from hvdc_ident.study.study import Study


def need_experiments(study: Study, stage: str, role: str | None = None, *, responses: bool = False) -> None:
    """Raise StudyError where the study has no experiment, or none of the role.

    responses: whether a measured frequency response does instead.
    """
    if responses and any(r.role == role for r in study.responses):
        return
    if not study.experiments:
        hint = '[[experiment]] with name, data = "file.csv", inputs and outputs'
        raise StudyError(f"{stage} needs an experiment and the study has none", where=study.path.name, hint=hint)
    if role is not None and not any(e.role == role for e in study.experiments):
        hint = f'role = "{role}" for at least one'
        raise StudyError(
            f"{stage} needs an experiment of role '{role}'", where=study.path.name, got="held-out ones only", hint=hint
        )


def need_candidates(study: Study, stage: str) -> None:
    """Raises StudyError where the study names no parameter to estimate."""
    if not study.candidates:
        known = ", ".join(list(study.model.parameters)[:8])
        hint = f"[parameters] with lines like NAME = {{given = 1, min = 0, max = 10}}; the model has {known}"
        raise StudyError(
            f"{stage} needs parameters to estimate and the study names none", where=study.path.name, hint=hint
        )


def need_start(study: Study) -> None:
    """Raise SteadyStateError where an experiment has no steady state at the start values: the study is then wrong.

    LinearizationError where a measured response has no counterpart there.
    """
    from contextlib import suppress

    from hvdc_ident.errors import SimulationError
    from hvdc_ident.simulate import simulate

    for experiment in study.experiments:
        with suppress(SimulationError):
            simulate(study.model, experiment.with_(time=experiment.time[:1], measured=None), study.start)
    for response in study.responses:
        try:
            response.of_model(study.model, study.start)
        except InputError as e:
            raise e.at(f"response '{response.name}'") from None


@contextmanager
def at_given(study: Study) -> Iterator[None]:
    """Run what is inside at the given values.

    A model that has no steady state there is wrong input (SteadyStateError). Where the study's search begins elsewhere it
    is a finding about the vendor's values, a ComputationError, which ends this stage and not those that fit.
    """
    try:
        yield
    except SteadyStateError as e:
        if study.start == study.given:
            raise
        raise ComputationError(
            f"at the given values {e.what}",
            where=e.where,
            expected=e.expected,
            got=e.got,
            hint="given = ... in [parameters] states the vendor's value; a fit begins at `start` and is not touched",
        ) from None
