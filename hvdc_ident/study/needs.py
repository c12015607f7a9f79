"""What a stage needs of a study, or the message that says it is missing."""

from __future__ import annotations

from hvdc_ident.errors import StudyError
from hvdc_ident.study.study import Study


def need_experiments(study: Study, stage: str, role: str | None = None) -> None:
    """Raises StudyError where the study has no experiment, or none of the role."""
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
        hint = f"[parameters] with lines like NAME = {{start = 1, min = 0, max = 10}}; the model has {known}"
        raise StudyError(
            f"{stage} needs parameters to estimate and the study names none", where=study.path.name, hint=hint
        )


def need_start(study: Study) -> None:
    """Raises SteadyStateError where an experiment has no steady state at the start values: the study is then wrong."""
    from contextlib import suppress

    from hvdc_ident.errors import SimulationError
    from hvdc_ident.simulate import simulate

    for experiment in study.experiments:
        with suppress(SimulationError):
            simulate(study.model, experiment.with_(time=experiment.time[:1], measured=None), study.start)
