"""The result of a diagnosis and its JSON."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from hvdc_ident.codec import NOT_STORED, Coded, stored_as
from hvdc_ident.colours import EFFECT, RECORDED, ROLES
from hvdc_ident.display import Shown, data_frame
from hvdc_ident.display import Table as TextTable
from hvdc_ident.effects import effects
from hvdc_ident.errors import InputError, SteadyStateError
from hvdc_ident.fit.adequacy import ResidualTests
from hvdc_ident.fit.result import Estimate
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.text import gap_text, interval_text, interval_words, value_by_place

if TYPE_CHECKING:
    from hvdc_ident.discrepancy.hypothesis import Refit
    from hvdc_ident.model import AnyModel


Verdict = Literal["named", "no-evidence", "not-excited", "ambiguous", "unnameable", "unfinished"]
VALUE, CARD = "parameter", "card"
"""Names, beside those of the effects, of a stated value that is another, and of a component that is of another type."""
AUGMENTED = "augmented-model.toml"
MAX_DRAWN = 10
"""Candidates in the figure, the best by BIC."""
Table = Mapping[str, Mapping[str, float | None]]
"""By output and experiment, in the output's unit; None where the run fails."""


@dataclass(frozen=True)
class EffectSize:
    """A parameter of an effect, in `unit`. ci95: its 95 % interval; an end that is None is not known."""

    value: float
    ci95: tuple[float | None, float | None] | None = None
    unit: str = ""

    @property
    def interval(self) -> tuple[float | None, float | None] | None:
        """The 95 % interval, `ci95`."""
        return self.ci95


@dataclass(frozen=True)
class FoundEffect:
    """An effect that was put into the model.

    at: its slots. parameters: by the effect's own parameter names. text: one sentence. chosen_from: how many candidates
    it was refitted against. source: the signal it brings in, for those that do.
    """

    effect: str
    at: tuple[str, ...]
    parameters: FrozenMap[EffectSize] = field(default_factory=FrozenMap)
    text: str = ""
    chosen_from: int | None = None
    source: str = field(default="", metadata=stored_as("from", optional=True))
    stored_properties: ClassVar[tuple[str, ...]] = ("late",)

    @property
    def name(self) -> str:
        """The effect by its name in the catalogue."""
        return self.effect

    @property
    def late(self) -> float | None:
        """By how long it delays a slow signal, s; None for what is no delay of any kind."""
        return effects()[self.effect].delay_with({n: size.value for n, size in self.parameters.items()})


@dataclass(frozen=True)
class Rival:
    """A member of an ambiguity set. delta_bic: how far its evidence is behind the best, 0 for the best itself.

    refitted: whether that comes from a refit. expression: of a formula outside the catalogue, with its coefficients' names.
    same_as: the member of the set that is the same equation at the same place; empty where none is. akin: the likeliest effect
    of the set that adds the same to the same signals in these records, within the tolerance; empty where none does. prior: its
    probability before any data: every effect is as likely as another, and so is each of its places and sources. values: of the
    model's own free parameters with it, where it was refitted. off_given: how far these are from the given ones. refit: with it as the
    last effect.
    """

    effect: str
    at: tuple[str, ...]
    delta_bic: float
    parameters: FrozenMap[float] = field(default_factory=FrozenMap)
    source: str = field(default="", metadata=stored_as("from", optional=True))
    refitted: bool = True
    expression: str = field(default="", metadata=stored_as("expression", optional=True))
    same_as: str = field(default="", metadata=stored_as("same_as", optional=True))
    akin: str = field(default="", metadata=stored_as("akin", optional=True))
    prior: float = field(default=1.0, metadata=NOT_STORED)
    values: FrozenMap[EffectSize] = field(default_factory=FrozenMap)
    off_given: float = field(default=0.0, metadata=NOT_STORED)
    refit: Refit | None = field(default=None, metadata=NOT_STORED, compare=False, repr=False)
    stored_properties: ClassVar[tuple[str, ...]] = ("late",)

    @property
    def is_form(self) -> bool:
        """True for a form outside the catalogue."""
        known = effects().get(self.effect) if self.is_effect else None
        return known is not None and bool(known.outside or known.needs_expression)

    @property
    def name(self) -> str:
        """The effect, with its formula where it is outside the catalogue."""
        return f"{self.effect} {self.expression}".rstrip()

    @property
    def is_effect(self) -> bool:
        """Whether it is an effect, and no stated value or component."""
        return self.effect not in (VALUE, CARD)

    @property
    def kind(self) -> str:
        """What it is wherever it is: the effect; of a stated value or a component that itself."""
        return self.effect if self.is_effect else f"{self.effect} {self.at[0]} {self.source}".rstrip()

    @property
    def late(self) -> float | None:
        """By how long it delays a slow signal, s; None for what is no delay of any kind, or was not refitted."""
        known = effects()[self.effect] if self.parameters and self.is_effect and not self.is_form else None
        return None if known is None else known.delay_with(self.parameters)


@dataclass(frozen=True)
class Place:
    """Where an effect may be: its insertion points, the probability given the effect, and the signal that it brings in.

    effect: the likeliest of the finding's effects there. parameters: its sizes if it is there; values: those of the model's own
    free parameters then. Both are empty where it was not refitted there.
    """

    at: tuple[str, ...]
    probability: float
    source: str = field(default="", metadata=stored_as("from", optional=True))
    effect: str = ""
    parameters: FrozenMap[EffectSize] = field(default_factory=FrozenMap)
    values: FrozenMap[EffectSize] = field(default_factory=FrozenMap)


@dataclass(frozen=True)
class ValueAt:
    """The value of a parameter of the model if an effect is at a place: of one that the records do not distinguish from others."""

    value: float
    ci95: tuple[float | None, float | None] | None
    unit: str
    effect: str
    at: tuple[str, ...]
    source: str = field(default="", metadata=stored_as("from", optional=True))


@dataclass(frozen=True)
class Finding:
    """A missing effect, wherever it is, or the parameters whose values are off.

    same_as: all names of it, its own first: effects that are the same equation there, or do the same in these records.
    probability: of the effect, summed over its places. parameters: at the first place; their intervals hold over the
    likely places. places: the likely ones: first that of `parameters`, which of places that explain the records as well is the one
    whose `values` are nearest to the given ones, then the likeliest first. equivalent_delay: by how long it delays a slow signal,
    s, with the interval over the likely places, where one size makes it; None for what is no delay. share: of the gap that it explains
    with the other findings.
    """

    effect: str
    same_as: tuple[str, ...] = ()
    probability: float = 0.0
    parameters: FrozenMap[EffectSize] = field(default_factory=FrozenMap)
    places: tuple[Place, ...] = ()
    text: str = ""
    equivalent_delay: EffectSize | None = None
    share: float | None = None


@dataclass(frozen=True)
class StandIn:
    """An effect that explains the records as well as other values of some parameters, with these as given.

    delta_bic: how far it is behind those. values: the given ones that it goes with. text: one sentence on the effect.
    """

    effect: str
    at: tuple[str, ...]
    delta_bic: float
    parameters: FrozenMap[float]
    values: FrozenMap[float]
    text: str
    source: str = field(default="", metadata=stored_as("from", optional=True))


@dataclass(frozen=True, eq=False)
class DescribedForm(Coded):
    """A form outside the catalogue, described. kind: term, filter, curve, disturbance or nothing.

    at: the insertion point; expression and coefficients: of a term or a filter; curve: of the others, {over, at, value, std}.
    refit: the model with the form; text: a sentence.
    """

    kind: str
    at: str
    text: str
    expression: str = ""
    coefficients: FrozenMap[Any] = field(default_factory=FrozenMap)
    delta_bic: float | None = None
    curve: Mapping[str, Any] | None = None
    refit: Refit | None = field(default=None, metadata=NOT_STORED)


@dataclass(frozen=True)
class ComparedHypothesis:
    """A hypothesis beside the others: its terms, by name and place; none for the nominal model.

    log_evidence: in nats over the nominal model, of fitted and held-out data. held_out: root mean square of the held-out
    residual in noise units. probability: among the hypotheses compared. parameters: by effect its sizes; values: of the model's
    own free parameters.
    """

    effects: tuple[str, ...]
    log_evidence: float
    held_out: float | None
    probability: float
    parameters: tuple[FrozenMap[float], ...] = ()
    values: FrozenMap[float] = field(default_factory=FrozenMap)


@dataclass(frozen=True)
class Line:
    """Score, p, size and status of one candidate effect.

    score: fall of chi2 at its best size, with the parameters' answer. p: chance of such a fall anywhere, under the noise.
    delta_bic: gain over the refitted nominal, None where not refitted. holdout_rmse: pooled in noise units. status: refitted,
    screened, not-excited, absorbed (by the fitted parameters), or failed: REASON.
    """

    effect: str
    at: tuple[str, ...]
    score: float
    p: float
    status: str
    size: FrozenMap[float] = field(default_factory=FrozenMap)
    delta_bic: float | None = None
    holdout_rmse: float | None = None
    source: str = field(default="", metadata=stored_as("from", optional=True))
    round: int = 1


@dataclass(frozen=True)
class Gap:
    """RMSE of three models against the data.

    nominal: with the given gains; refitted: the same model, fitted; augmented: with the effects, fitted. Each by "fit"
    and "holdout". noise_floor: standard deviation of the noise by output, in its unit. pooled: the same three by "fit"
    and "holdout" in noise units. shrink_holdout: 1 - augmented/refitted on the held-out experiments, pooled.
    held_out: what "holdout" is: experiments, or (with none of that role) parts of the fitted ones, predicted from the rest.
    """

    nominal: Mapping[str, Table] = field(default_factory=dict)
    refitted: Mapping[str, Table] = field(default_factory=dict)
    augmented: Mapping[str, Table] = field(default_factory=dict)
    noise_floor: FrozenMap[float] = field(default_factory=FrozenMap)
    pooled: Mapping[str, Mapping[str, float | None]] = field(default_factory=dict)
    shrink_holdout: float | None = None
    held_out: str = "experiments"


@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis(Coded, Shown):
    """The outcome of a diagnosis; `to_dict` is the JSON.

    verdict: named, no-evidence, not-excited, ambiguous or unnameable; text: why, in one or two sentences.
    effects: those put into the model. ambiguity: for each of them the candidates that are as good, the best first, where
    there is more than one, or where that one is in doubt. doubt: what shows that something else stands behind the effects,
    though nothing that was tried explains as much; empty where nothing does. separating_experiment: what would distinguish
    them, or show what was not excited or is in doubt.
    candidates: every candidate's line, the best first. location: where model and data differ.
    gap: before and after. remaining: what is left. beyond_noise: whether that is more than noise; the values and
    the intervals then hold only if nothing else is missing. parameters_*: by name; `parameters_refitted` are the
    nominal model's own best. estimates_after: what is known of `parameters_after`, where something was put in, of those that were
    fitted; residual_tests_after: of what the model then leaves, by output and experiment. augmented: the model with the effects and
    the new values; None where nothing was put in, and where the diagnosis was read from JSON. augmented_model: the name of its card
    in `files`; None where it has none.
    fallback: the form found outside the catalogue, if one was looked for. noise: standard deviation and AR coefficient by output,
    and where they come from.
    findings: what is missing, each effect with its probability and its likely places, the likeliest first. remainder: {share of
    the gap, held_out, noise_units, p, at, below_tolerance}. hypotheses: those compared, the likeliest first.
    values_by_place: of each parameter whose value depends
    on which of the likely effects or places is the true one, the value of each; `parameters_after` has the first of them.
    stand_ins: where values that are off explain the gap, the effects that explain it as well with these values as given.
    """

    verdict: Verdict
    text: str = ""
    effects: tuple[FoundEffect, ...] = ()
    ambiguity: tuple[tuple[Rival, ...], ...] = ()
    separating_experiment: Mapping[str, Any] | None = None
    candidates: tuple[Line, ...] = ()
    location: Mapping[str, Any] = field(default_factory=dict)
    gap: Gap = field(default_factory=Gap)
    remaining: Mapping[str, Any] = field(default_factory=dict)
    parameters_before: FrozenMap[float] = field(default_factory=FrozenMap)
    parameters_refitted: FrozenMap[float] = field(default_factory=FrozenMap)
    parameters_after: FrozenMap[float] = field(default_factory=FrozenMap)
    estimates_after: FrozenMap[Estimate] = field(default_factory=FrozenMap)
    residual_tests_after: ResidualTests = field(default_factory=dict)
    augmented: AnyModel | None = field(default=None, metadata=NOT_STORED)
    augmented_model: str | None = None
    fallback: Mapping[str, Any] | None = None
    noise: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    doubt: str = ""
    findings: tuple[Finding, ...] = ()
    remainder: Mapping[str, Any] = field(default_factory=dict)
    hypotheses: tuple[ComparedHypothesis, ...] = ()
    beyond_noise: bool = False
    values_by_place: FrozenMap[tuple[ValueAt, ...]] = field(default_factory=FrozenMap)
    stand_ins: tuple[StandIn, ...] = ()

    @property
    def params(self) -> FrozenMap[Estimate]:
        """The parameters with what was put into the model, by name, each with its `value` and its 95 % `interval`.

        The interval is None where nothing was put in, where what is left is more than noise, where the value depends on which of
        the likely effects and places is the true one, of a parameter on a bound, and in studies whose experiments have unknowns of
        their own.
        """
        known = {n: replace(e, value=self.parameters_after[n]) for n, e in self.estimates_after.items()}
        return FrozenMap({n: known.get(n) or Estimate(v) for n, v in self.parameters_after.items()})

    @property
    def files(self) -> dict[str, str]:
        """The augmented model's card by its file name; empty where nothing was put in, or the model has no card (an FMU).

        Its description says that the values are the fitted ones, and which were given.
        """
        from hvdc_ident.model import is_white_box, write_card
        from hvdc_ident.simulate import with_guesses

        if self.augmented_model is None or not is_white_box(self.augmented):
            return {}
        try:
            card = with_guesses(self.augmented)
        except SteadyStateError:  # at inputs that only its experiments give it
            card = self.augmented
        given = ", ".join(f"{n} {v:.6g}" for n, v in self.parameters_before.items())
        about = (self.augmented.description or self.augmented.name).rstrip(". ")
        about += f"; fitted values, with what was added to the model; given were {given}"
        for name, values in self._by_place.items():
            about += f"; {name} depends on what is missing where: {values}"
        return {self.augmented_model: write_card(replace(card, description=about))}

    @property
    def _by_place(self) -> dict[str, str]:
        """The values that depend on which of the likely effects and places is the true one, in words, by parameter."""
        return {n: value_by_place(each) for n, each in self.values_by_place.items()}

    def _screen(self) -> Iterator[str | TextTable]:
        yield f"Diagnosis: {self.verdict}. {self.text}"
        rows = [
            (e.effect, ", ".join(e.at), n, size.value, size.unit, interval_text(size.ci95))
            for e in self.effects
            for n, size in e.parameters.items()
        ]
        header = ("effect", "at", "parameter", "value", "unit", interval_words(beyond_noise=self.beyond_noise))
        yield TextTable(header, tuple(rows)) if rows else ""
        gaps = [
            (words, self.gap.pooled[n]["fit"], self.gap.pooled[n]["holdout"])
            for n, words in (("nominal", "given values"), ("refitted", "refitted"), ("augmented", "with effects"))
        ]
        yield TextTable(("residual in noise units", "fitted data", "held out"), tuple(gaps))
        if self.gap.shrink_holdout is not None and self.effects:
            yield f"The held-out gap shrinks by {gap_text(self.gap.shrink_holdout)}."
        found = [
            (f.effect, f.probability, "; ".join(", ".join(p.at) for p in f.places[:4]), len(f.places))
            for f in self.findings
        ]
        yield TextTable(("missing", "probability", "likely at", "places"), tuple(found)) if found else ""
        changed = [
            (n, self.parameters_before[n], self.parameters_refitted[n], self._by_place.get(n, v))
            for n, v in self.parameters_after.items()
        ]
        yield TextTable(("parameter", "given", "refitted", "with effects"), tuple(changed)) if changed else ""
        advice = (self.separating_experiment or {}).get("text")
        yield f"Measure next: {advice}" if advice else ""
        yield "\n".join(self.notes)

    def to_dataframe(self) -> Any:
        """Return the candidate effects as a pandas DataFrame, the best first. Raises InputError where pandas is missing."""
        columns: dict[str, Any] = {
            "effect": [c.effect for c in self.candidates],
            "at": [", ".join(c.at) for c in self.candidates],
            "score": [c.score for c in self.candidates],
            "p": [c.p for c in self.candidates],
            "delta_bic": [c.delta_bic for c in self.candidates],
            "holdout_rmse": [c.holdout_rmse for c in self.candidates],
            "status": [c.status for c in self.candidates],
        }
        return data_frame(columns)

    def plot(self, ax: Any = None) -> Any:
        """Draw bar charts and return their two axes: the pooled gap of the three models on fitted and held-out data, and the BIC of
        the best candidates. ax: two axes to draw on.

        Raises InputError for another number of axes.
        """
        import numpy as np

        axes = np.ravel(ax if ax is not None else _two_axes())
        if axes.size != 2:
            raise InputError("a diagnosis is drawn on two axes", where="ax", expected="two axes", got=str(axes.size))
        left, right = axes
        names = ["nominal", "refitted", "augmented"]
        width = 0.38
        for k, (part, label) in enumerate((("fit", "fitted"), ("holdout", "held out"))):
            values = [self.gap.pooled[n][part] for n in names]
            at = np.arange(3) + (k - 0.5) * width
            left.bar(at, [np.nan if v is None else v for v in values], width, label=label, color=[*ROLES.values()][k])
        left.axhline(1.0, color=RECORDED, linewidth=1.0, linestyle=":", label="noise")
        left.set_yscale("log")
        left.set_xticks(range(3), ["given gains", "refitted", "with effect"])
        left.set_ylabel("residual in noise units")
        left.legend(fontsize="small")
        refitted = [c for c in self.candidates if c.delta_bic is not None and c.round == 1]
        best = sorted(refitted, key=lambda c: -(c.delta_bic or 0.0))[:MAX_DRAWN][::-1]
        if best:
            right.barh(range(len(best)), [c.delta_bic or 0.0 for c in best], color=EFFECT)
            labels = [f"{c.effect} at {', '.join(c.at)}" + (f" from {c.source}" if c.source else "") for c in best]
            right.set_yticks(range(len(best)), labels, fontsize="small")
            right.set_xlabel("gain in BIC over the refitted model")
        else:
            right.set_axis_off()
            right.text(0.5, 0.5, "no candidate was refitted", ha="center", va="center", transform=right.transAxes)
        headline = f"{self.verdict}: {', '.join(e.text for e in self.effects) or self.text}"
        if ax is None:
            left.figure.suptitle(headline, fontsize="medium", wrap=True)
        else:
            left.set_title(headline, fontsize="small", wrap=True)
        return axes


def _two_axes() -> Any:
    """Return two axes beside each other on a new figure."""
    import matplotlib.pyplot as plt

    settings: dict[str, Any] = {"figsize": (10.0, 4.2), "layout": "constrained", "width_ratios": [1.0, 1.4]}
    return plt.subplots(1, 2, **settings)[1]
