"""The verb `diagnose`: locate, test, refit, choose, add, show."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Literal

from hvdc_ident.discrepancy.options import Options
from hvdc_ident.discrepancy.result import Diagnosis
from hvdc_ident.experiment import Experiment
from hvdc_ident.fit import Free, Simulator
from hvdc_ident.fit.estimate import Executor, Progress
from hvdc_ident.model.definition import Model


def diagnose(
    subject: Model | Simulator,
    experiments: Iterable[Experiment],
    parameters: Iterable[Free],
    *,
    effects: Iterable[str] | Literal["all"] = "all",
    places: Iterable[str | tuple[str, ...]] | None = None,
    material: Mapping[str, float] | None = None,
    held: Mapping[str, float] | None = None,
    report: Mapping[str, Any] | None = None,
    options: Options | None = None,
    seed: int = 0,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """What the model lacks, if the data tell: the effect with its place and size, the model with it, and the gap before and after.

    subject: a model; or anything that can be simulated, with effects at its inputs and outputs only.
    experiments: with measured outputs; those of role "holdout" judge, the others are fitted. parameters: what may be
    fitted, with start (the given gains) and bounds. effects: names of the catalogue to try. places: slots to try them
    at, a tuple for one effect at several slots with shared parameters (default: every slot, and families of like slots).
    material: by output, an error (in its unit) below which a gap is of no interest. held: values of other parameters.
    report: `IdentifiabilityReport.to_dict()` of these data, whose identifiable set is fitted; without one, the set that
    the sensitivities at the pilot fit can tell apart.

    Raises StudyError or UnknownNameError where there is nothing to diagnose, SimulationError where the nominal model
    cannot be run.
    """
    raise NotImplementedError
