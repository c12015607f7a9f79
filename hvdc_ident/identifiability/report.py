"""The report on identifiability: verdicts, the set to fit, and the evidence.

It prints one screen, plots profiles and verdicts, and `to_dict` is its JSON.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from hvdc_ident.codec import NOT_STORED, Coded, stored_as
from hvdc_ident.display import Shown, Table, data_frame
from hvdc_ident.errors import ComputationError, unknown_name
from hvdc_ident.fit import StartOutcome
from hvdc_ident.fit.noise import misfit_sentence, of_misfit
from hvdc_ident.fit.profile import PairProfile, Profile
from hvdc_ident.identifiability.experiment_design import Recommendation
from hvdc_ident.identifiability.likelihood_intervals import OtherOptimum
from hvdc_ident.identifiability.misspecification import Misspecification
from hvdc_ident.identifiability.structural import StructuralAnalysis
from hvdc_ident.identifiability.verdicts import Verdict
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.next_step import NextStep, next_sentence
from hvdc_ident.sensitivity import Collinear, Combination
from hvdc_ident.text import capital, interval_text

CONDITIONS = (
    "Every verdict holds for these outputs, experiments, noise and bounds, at the optimum of the pilot fit; with other "
    "data it may be another."
)


@dataclass(frozen=True)
class Held:
    """The value of a parameter that a fit holds, and why."""

    value: float
    reason: str


@dataclass(frozen=True)
class Unsettled:
    """A candidate without a verdict, for the work was ended, with what is known of it.

    value: at the lowest cost so far, None where no start has ended. profile_ends: the ends of its profile that were found, None where no
    part of it was walked. text: what was tried and what was not, in sentences.
    """

    value: float | None
    unit: str
    profile_ends: tuple[float | None, float | None] | None
    text: str


@dataclass(frozen=True)
class Contribution:
    """Share of each parameter's information that comes from an experiment, by parameter."""

    information: FrozenMap[float]


@dataclass(frozen=True)
class Pilot:
    """The pilot fit at whose optimum the verdicts stand.

    search_doubt: in words, that one start alone reached the lowest cost. structure_left: in words, what it leaves of outputs of which no
    noise is known, where that is not white. starts: how many; ends: their outcomes. cost, chi2_per_dof: at
    the optimum of all that is structurally admissible. effective_samples, noise_source: by output. groups: the pilot fits of a
    report by groups, each with its `parameters`; of all together there is none then.
    """

    status: str = ""
    message: str = ""
    search_doubt: str = ""
    starts: int = 0
    ends: tuple[StartOutcome, ...] = ()
    cost: float | None = None
    chi2_per_dof: float | None = None
    effective_samples: Mapping[str, float] = field(default_factory=dict)
    noise_source: Mapping[str, str] = field(default_factory=dict)
    parameters: tuple[str, ...] = field(default=(), metadata=stored_as("parameters", optional=True))
    groups: tuple[Pilot, ...] = field(default=(), metadata=stored_as("groups", optional=True))
    structure_left: str = field(default="", metadata=stored_as("structure_left", optional=True))

    @property
    def doubts(self) -> tuple[str, ...]:
        """Sentences to be said before any verdict: that the optimum may not be the best, or leaves structure, or that no noise
        is known."""
        own = (self.search_doubt, self.structure_left)
        told = [f"{capital(d)}." for d in own if d]
        told += filter(None, [misfit_sentence(of_misfit(self.noise_source))])
        return (*told, *(d for group in self.groups for d in group.doubts))

    @property
    def outputs_of_misfit(self) -> tuple[str, ...]:
        """The outputs whose noise is taken from the misfit, of all groups."""
        own = (*of_misfit(self.noise_source), *(o for group in self.groups for o in group.outputs_of_misfit))
        return tuple(dict.fromkeys(own))

    def ends_over(self, names: Sequence[str]) -> tuple[StartOutcome, ...]:
        """Return the outcomes of the search over these parameters, for a fit of them to take up; none where it made none.

        Of a report by groups those of the group that has them.
        """
        searches = (p for p in self.groups or (self,) if p.ends and set(names) <= set(p.parameters or names))
        return next((p.ends for p in searches), ())


@dataclass(frozen=True, eq=False, repr=False)
class IdentifiabilityReport(Coded, Shown):
    """Findings of the experiments about the candidates.

    parameters: the verdicts, in the order of the candidates. identifiable: the set a fit uses. held: the value and the
    reason of each other one. not_judged: those of the held that noise alone would tell, which only the misfit hides: a
    diagnosis leaves them free. optima: others, of the set fitted, that are as good as the best within the noise.
    combinations: what is seen of those that cannot be told apart. collinear: subsets with their index, worst first within
    each size. experiments: what each contributes. profiles: of those that have one; pilot: the fit at whose optimum all stands.
    pair: the common profile of two, its rises in units of the threshold of one. notes: remarks on the data and on what the
    search met. recommended: what to measure next; not_recommended: why nothing is. unsettled: of a report whose work was ended, each
    candidate without a verdict.
    """

    parameters: FrozenMap[Verdict] = field(default_factory=FrozenMap)
    identifiable: tuple[str, ...] = ()
    not_judged: tuple[str, ...] = ()
    optima: tuple[OtherOptimum, ...] = ()
    held: FrozenMap[Held] = field(default_factory=FrozenMap)
    combinations: tuple[Combination, ...] = ()
    collinear: tuple[Collinear, ...] = field(default=(), metadata=stored_as("collinearity"))
    correlation: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    structure: StructuralAnalysis = field(default_factory=StructuralAnalysis, metadata=stored_as("structural"))
    misspecification: Misspecification = field(default_factory=Misspecification)
    experiments: FrozenMap[Contribution] = field(default_factory=FrozenMap)
    recommended: Recommendation | None = field(default=None, metadata=stored_as("recommended_experiment"))
    not_recommended: str = ""
    profiles: FrozenMap[Profile] = field(default_factory=FrozenMap)
    pair: PairProfile | None = None
    pilot: Pilot = field(default_factory=Pilot)
    notes: tuple[str, ...] = ()
    unsettled: FrozenMap[Unsettled] = field(default_factory=FrozenMap, metadata=stored_as("unsettled", optional=True))
    thresholds: FrozenMap[float] = field(default_factory=FrozenMap, metadata=NOT_STORED)
    stored_properties: ClassVar[tuple[str, ...]] = ("misspecified",)

    @property
    def misspecified(self) -> bool:
        """True where the model lacks something."""
        return self.misspecification.flag

    @property
    def params(self) -> FrozenMap[Verdict]:
        """The verdict on each candidate, with its value and its interval, by name."""
        return self.parameters

    @property
    def conditional_on(self) -> dict[str, tuple[str, ...]]:
        """For each fitted one the held ones without which it could not be told."""
        return {n: v.conditional_on for n, v in self.parameters.items() if v.conditional_on and n in self.identifiable}

    def plot(self, parameter: str | None = None, ax: Any = None) -> Any:
        """Axes with one parameter's profile; without a name, with the interval and the verdict of every candidate.

        Raises UnknownNameError for a name that is no candidate, ComputationError for one that has no profile.
        """
        import matplotlib.pyplot as plt

        from hvdc_ident.axes import draw_intervals, draw_profile

        if parameter is not None and parameter not in self.parameters:
            raise unknown_name("candidate", parameter, self.parameters)
        if parameter is not None and parameter not in self.profiles:
            reason = self.parameters[parameter].reason
            raise ComputationError(f"{parameter} has no profile", got=reason, hint="plot() shows every verdict")
        axes = ax if ax is not None else plt.subplots(layout="constrained")[1]
        if parameter is None:
            draw_intervals(axes, self.parameters)
        else:
            draw_profile(axes, self.profiles[parameter], self.parameters[parameter])
        return axes

    def _screen(self) -> Iterator[str | Table]:
        signs = self.misspecification
        yield "\n".join(self.pilot.doubts)
        if signs.flag:
            yield f"The model does not explain these data: {'; '.join(signs.signs)}."
            yield next_sentence(NextStep("diagnose"), "python")
        yield self._counted()
        rows = [(n, v.verdict, v.value, v.unit, interval_text(v.ci95)) for n, v in self.parameters.items()]
        yield Table(("parameter", "verdict", "value", "unit", "95 % interval"), tuple(rows))
        yield "\n".join(f"{n}: {v.reason}" for n, v in self.parameters.items())
        yield "\n".join(f"{n}: no verdict. {u.text}" for n, u in self.unsettled.items())
        if self.recommended is not None:
            yield f"Measure next: {self.recommended.text}"
        elif self.not_recommended:
            yield self.not_recommended
        yield "\n".join(self.notes)

    def _counted(self) -> str:
        """Return the parameters that are identifiable, those that a fit estimates all the same, and those that it holds."""
        told = [n for n, v in self.parameters.items() if v.verdict == "identifiable"]
        also = [n for n in self.identifiable if n not in told]
        text = f"Identifiable: {', '.join(told) or 'none'} (of {len(self.parameters)} asked about)."
        text += f" A fit estimates {', '.join(also)} too, as the table says." if also else ""
        return f"{text} It holds {', '.join(self.held)}." if self.held else text

    def __str__(self) -> str:
        return "\n\n".join(str(block) for block in self._screen() if block)  # reasons stay whole: they are searched for

    def to_dataframe(self) -> Any:
        """Return the verdicts as a pandas DataFrame, a row a parameter. Raises InputError where pandas is missing."""
        verdicts = self.parameters.values()
        ends = [v.ci95 or (None, None) for v in verdicts]
        columns: dict[str, Any] = {
            "verdict": [v.verdict for v in verdicts],
            "value": [v.value for v in verdicts],
            "unit": [v.unit for v in verdicts],
            "std": [v.std for v in verdicts],
            "ci95_low": [low for low, _ in ends],
            "ci95_high": [high for _, high in ends],
            "reason": [v.reason for v in verdicts],
        }
        return data_frame(columns, list(self.parameters), "parameter")
