"""The results of the stages of a study as objects, read from their JSON."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from hvdc_ident.codec import Coded, stored_as
from hvdc_ident.data import Array
from hvdc_ident.discrepancy import Diagnosis
from hvdc_ident.errors import located
from hvdc_ident.fit.judgement import Judgements
from hvdc_ident.fit.result import Estimate, FitResult
from hvdc_ident.identifiability import IdentifiabilityReport
from hvdc_ident.summary.candidate import Candidate
from hvdc_ident.summary.compared_responses import ComparedResponse
from hvdc_ident.summary.gaps import SignalGap
from hvdc_ident.summary.levels import NoiseNote

Json = Mapping[str, Any]
NO_ESTIMATES = ("failed", "not-converged", "unfinished")
"""Ends of a fit whose numbers are no estimates."""


@dataclass(frozen=True)
class ExperimentContext:
    """An experiment as the results hold it. event, window: s. recording: `Experiment.recording`. status: of a run at the given values,
    empty where none was made; reason: why there is none."""

    role: str = "fit"
    event: float | None = None
    window: tuple[float, float] | None = None
    recording: Mapping[str, Any] = field(default_factory=dict)
    status: str = field(default="", metadata=stored_as("status", optional=True))
    reason: str = field(default="", metadata=stored_as("reason", optional=True))


@dataclass(frozen=True)
class Derived:
    """A parameter that follows from the estimates, by an expression; std: None where one of them has none."""

    value: float
    std: float | None
    unit: str
    expression: str


@dataclass(frozen=True)
class Context(Coded):
    """Entries that the JSON of a simulation, an identifiability analysis or a fit has beside its result.

    candidates: by name. units: of the outputs. experiments: by name. noise: by experiment and output. gaps: of a simulation, the
    largest first. judgement: of the model with each set of values. derived: what follows from the estimates of a fit. responses:
    measured ones beside the model's.
    """

    candidates: Mapping[str, Candidate] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    experiments: Mapping[str, ExperimentContext] = field(default_factory=dict)
    noise: Mapping[str, Mapping[str, NoiseNote]] = field(default_factory=dict)
    gaps: tuple[SignalGap, ...] = ()
    judgement: Judgements = field(default_factory=Judgements)
    derived: Mapping[str, Derived] = field(default_factory=dict)
    responses: tuple[ComparedResponse, ...] = ()


@dataclass(frozen=True, eq=False)
class SizeCurves:
    """The output that an effect matters most for, recorded and simulated at several sizes of the effect.

    at: its places. parameter: that has the sizes, in `unit`; sizes: None where the effect is absent; shares: of the way from there to
    the size that was found; labels: in words; chosen: the place of the size found, None where it is not among them. time: (n,) s;
    measured: (n,), curves: (sizes, n), in `output_unit`.
    """

    effect: str
    at: tuple[str, ...]
    parameter: str
    unit: str
    experiment: str
    output: str
    output_unit: str
    time: Array
    measured: Array
    chosen: int | None
    sizes: tuple[float | None, ...]
    shares: tuple[float, ...]
    labels: tuple[str, ...]
    curves: Array


@dataclass(frozen=True)
class DiagnosisContext(Coded):
    """Fields of the JSON of a diagnosis beside its own. units: of the outputs. sizes: the model with other sizes of its first effect.

    judgement: of the model with each set of values.
    """

    units: Mapping[str, str] = field(default_factory=dict)
    sizes: SizeCurves | None = None
    judgement: Judgements = field(default_factory=Judgements)


@dataclass(frozen=True)
class StageResults:
    """The results of the stages: each with its context, that of a stage that has not run empty.

    fit: None where none has run. diagnosis: None where none has come to a verdict. identified: empty where it has not run.
    """

    fit: FitResult | None
    identified: IdentifiabilityReport
    diagnosis: Diagnosis | None
    simulated: Context
    of_fit: Context
    of_identified: Context
    of_diagnosis: DiagnosisContext

    @classmethod
    def read(cls, stages: Mapping[str, Json]) -> StageResults:
        """Return the results of the JSON of stages by the name of their file. Raises InputError for what is none of a stage."""
        fit, diagnosis, identified = (stages.get(n) or {} for n in ("fit", "discrepancy", "identifiability"))
        contexts = []
        for name in ("simulation", "fit", "identifiability"):
            with located(f"{name}.json"):
                contexts.append(Context.from_dict(stages.get(name) or {}))
        simulated, of_fit, of_identified = contexts
        with located("discrepancy.json"):
            beside = DiagnosisContext.from_dict(diagnosis)
        return cls(
            fit_of(fit), identified_of(identified), diagnosis_of(diagnosis), simulated, of_fit, of_identified, beside
        )

    @property
    def estimates(self) -> dict[str, Estimate]:
        """The estimates of the fit, by parameter."""
        return dict(self.fit.estimates) if self.fit is not None else {}

    @property
    def fitted(self) -> tuple[str, ...]:
        """The parameters that the fit estimated; none where it failed."""
        return () if self.fit is None or self.fit.status in NO_ESTIMATES else self.fit.fitted


def fit_of(data: Json) -> FitResult | None:
    """Return the fit of a `fit.json`; None where none has run. Raises InputError for what is none."""
    with located("fit.json"):
        return FitResult.from_dict(data) if data.get("status") else None


def diagnosis_of(data: Json) -> Diagnosis | None:
    """Return the diagnosis of a `discrepancy.json`; None where none has come to a verdict. Raises InputError for what is none."""
    with located("discrepancy.json"):
        return Diagnosis.from_dict(data) if data.get("verdict") else None


def identified_of(data: Json) -> IdentifiabilityReport:
    """Return the report of an `identifiability.json`, empty where none has run. Raises InputError for what is none."""
    with located("identifiability.json"):
        return IdentifiabilityReport.from_dict(data)
