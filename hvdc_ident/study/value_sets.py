"""The sets of values of a study's parameters, by name.

given: the values the model came with, the vendor's; everything is simulated with them and compared with them.
start: where a search begins. fit: what the fit in a folder of results estimated, with what it held. effect: what its diagnosis
estimated together with an effect, and the model with that effect. fitted: whichever of the last two counts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, get_args

from hvdc_ident.discrepancy import Diagnosis
from hvdc_ident.errors import StudyError
from hvdc_ident.fit import Estimate, FitResult
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel
from hvdc_ident.next_step import NextKind, NextStep
from hvdc_ident.study.augmented import augmented_model
from hvdc_ident.study.study import Study
from hvdc_ident.summary.decisions import conditional, counting_of
from hvdc_ident.summary.run_summary import Counting
from hvdc_ident.summary.stage_results import NO_ESTIMATES, diagnosis_of, fit_of
from hvdc_ident.text import figures, listed, probability_text, span

SetName = Literal["given", "start", "fitted", "effect", "fit"]
SETS: tuple[SetName, ...] = get_args(SetName)

NOT_BY_ITSELF = ("two-optima",)
"""Ends of a fit that gives several answers that are as good: its best one is taken only where it is asked for."""
NONE = "no fit has run"


@dataclass(frozen=True)
class ValueSet:
    """Values of a study's parameters, in their units.

    name: as it was asked for: given, start, fitted, effect or fit. of: what they are: given, start, fit or effect. note: what is
    to be said of them, in words that stand alone: where they come from, and why they are not the fitted ones where those might
    be expected. fit, diagnosis: the fingerprints of the results that they come from. model: that they hold in, where it has an
    effect that the study's model lacks; None where it is the study's own. next: another set that may be meant. intervals: of 95 %, of
    those that the records determine; unsure: of the other estimates why they have none.
    """

    name: SetName
    values: FrozenMap[float]
    note: str
    of: Literal["given", "start", "fit", "effect"]
    fit: str = ""
    diagnosis: str = ""
    model: AnyModel | None = None
    next: tuple[NextStep, ...] = ()
    intervals: FrozenMap[tuple[float, float]] = field(default_factory=FrozenMap)
    unsure: FrozenMap[str] = field(default_factory=FrozenMap)

    @property
    def told(self) -> FrozenMap[str]:
        """The interval of each estimate in words; of one without, the reason."""
        each = {n: f"{span(low, high)}, 95 %" for n, (low, high) in self.intervals.items()}
        return FrozenMap(each | {n: f"no interval: {why}" for n, why in self.unsure.items()})

    def determined(self, given: Mapping[str, float]) -> ValueSet:
        """Return the values without the estimates that have no interval, in whose place the given ones stand; the note says so."""
        left = {n: v for n, v in given.items() if n in self.values and self.values[n] != v and n not in self.intervals}
        if not left or self.of not in ("fit", "effect"):
            return self
        why = listed(dict.fromkeys(self.unsure.get(n, "it is held there, and not estimated") for n in left))
        names = listed(left)
        note = f"{self.note}; {names} as given, for only a value with a 95 % interval is written: {why}"
        return replace(self, values=self.values | left, note=note)


def value_set(study: Study, wanted: str | None, folder: Path | None = None) -> ValueSet:
    """The set of that name; None: the fitted values where they stand in the folder, else the given ones.

    folder: of results, by default the study's own. A result stands where it came to an end on the study, the files and the
    software as they are now. Raises StudyError for another name, and where values are asked for that do not stand.
    """
    if wanted is not None and wanted not in SETS:
        raise StudyError(
            "no such set of values",
            where="values",
            expected=", ".join(SETS),
            got=repr(wanted),
            hint="given: those the model came with; start: where a search begins; fitted: those that count of a fit "
            "and a diagnosis; effect: those with the effect that a diagnosis found; fit: those of the fit without one",
        )
    if wanted == "given":
        return _given(study)
    if wanted == "start":
        note = f"start values of study '{study.name}', where a search begins"
        return ValueSet("start", study.start, note, "start")
    results = _Results.of(study, folder or study.folder)
    if wanted == "effect":
        return _asked(results, results.with_effect("effect") if results.counts.added else None, results.no_effect)
    if wanted == "fit":
        return _asked(results, results.of_fit("fit") if results.fit else None, results.no_fit)
    fitted, why = results.fitted()
    if wanted == "fitted":
        return _asked(results, fitted, why)
    if fitted is not None and not why:
        return fitted
    return _given(study, "" if why == NONE else why, (NextStep("values", "fitted"),) if fitted is not None else ())


def fitted_values(study: Study, folder: Path) -> tuple[ValueSet | None, str]:
    """The fitted values that count; and why they are not to be taken unasked, "" where they are.

    Those with the effect where a diagnosis in the folder named one, else those of its fit. None where there are none to take at
    all: no fit, one of another state of the study, or one that failed.
    """
    return _Results.of(study, folder).fitted()


def _asked(results: _Results, values: ValueSet | None, why: str) -> ValueSet:
    """The values that were asked for by name. Raises StudyError, with the reason, where there are none."""
    if values is not None:
        return values
    command: NextKind = "diagnose" if why == results.no_effect else "fit"
    raise StudyError(
        f"there are no {'values with an effect' if command == 'diagnose' else 'fitted values'}: {why}",
        where=results.study.path.name,
        expected=f"a finished {command} of the study and its files as they are now, in {results.folder}",
        next=(NextStep(command), NextStep("given")),
    )


def _given(study: Study, why: str = "", next: tuple[NextStep, ...] = ()) -> ValueSet:
    note = f"given values of study '{study.name}'" + (f"; {why}" if why else "")
    return ValueSet("given", study.given, note, "given", next=next)


@dataclass(frozen=True)
class _Results:
    """The fit and the diagnosis that stand in a folder, each None where there is none, and why; marks: their fingerprints."""

    study: Study
    folder: Path
    fit: FitResult | None
    no_fit: str
    diagnosis: Diagnosis | None
    stale: str
    marks: tuple[str, str]

    @classmethod
    def of(cls, study: Study, folder: Path) -> _Results:
        """Return what stands in the folder."""
        from hvdc_ident.study.pipeline import standing

        fit, no_fit = standing(study, "fit", folder)
        result = None if no_fit else fit_of(fit)
        if result is not None and result.status in NO_ESTIMATES:
            no_fit, result = f"the fit in {folder} ended as {result.status}: {result.message}", None
        diagnosis, why = standing(study, "diagnose", folder)
        diagnosed = None if why else diagnosis_of(diagnosis)
        marks = (
            fit["fingerprint"] if result is not None else "",
            diagnosis["fingerprint"] if diagnosed is not None else "",
        )
        return cls(study, folder, result, no_fit, diagnosed, why if diagnosis else "", marks)

    @property
    def counts(self) -> Counting:
        """Set of values that counts."""
        return counting_of(self.fit, self.diagnosis)

    @property
    def no_effect(self) -> str:
        """Why there are no values with an effect, where there are none."""
        if self.diagnosis is None:
            return self.stale or "no diagnose has run"
        return f"the diagnosis in {self.folder} found none to put into the model ({self.diagnosis.verdict})"

    def fitted(self) -> tuple[ValueSet | None, str]:
        """Return the values that count, and why they are not to be taken unasked."""
        if not self.counts.name:
            return None, self.no_fit
        values = self.with_effect("fitted") if self.counts.name == "effect" else self.of_fit("fitted")
        if self.fit is not None and self.fit.status in NOT_BY_ITSELF:
            return values, f"the fit in {self.folder} ended as {self.fit.status}: {self.fit.message}"
        return values, ""

    def of_fit(self, name: Literal["fitted", "fit"]) -> ValueSet:
        """Return the values of the fit, by that name."""
        study, fit, counts = self.study, self.fit, self.counts
        assert fit is not None
        values = study.given | {n: fit.values[n] for n in study.candidates if n in fit.values}
        how = _outcome(fit, list(study.candidates))
        if name == "fitted" and not counts.doubt:
            note = f"fitted values of study '{study.name}' ({how})"
        else:
            note = f"{'fitted values' if name == 'fitted' else 'fit values'} of study '{study.name}', without an effect ({how})"
        why = [counts.doubt, f"with {counts.added} they are others" if counts.added else ""]
        note += f": {'; '.join(filter(None, why))}" if any(why) else ""
        note += f"; {self.stale}" if self.stale else ""
        next_ = (NextStep("values", "effect"),) if counts.added else ()
        known = self._known({n: fit.estimates.get(n) for n in fit.fitted}, effect=False)
        return ValueSet(name, values, note, "fit", *self.marks, None, next_, *known)

    def _known(
        self, estimates: Mapping[str, Estimate | None], *, effect: bool
    ) -> tuple[FrozenMap[tuple[float, float]], FrozenMap[str]]:
        """Return the intervals of the estimates that hold, and why the others have none. effect: of the model with the effect."""
        beyond = conditional(self.fit, self.diagnosis, effect=effect)
        intervals, unsure = dict[str, tuple[float, float]](), dict[str, str]()
        for n, e in estimates.items():
            low, high = (e.ci95 if e is not None else None) or (None, None)
            if beyond:
                unsure[n] = "the model leaves more than the noise of these records"
            elif low is None or high is None:
                unsure[n] = "these records do not bound it"
            else:
                intervals[n] = (low, high)
        return FrozenMap(intervals), FrozenMap(unsure)

    def with_effect(self, name: Literal["fitted", "effect"]) -> ValueSet:
        """Return the values fitted together with the effect, by that name, and the model that they hold in."""
        study, own = self.study, self.study.model.parameters
        assert self.diagnosis is not None
        model = augmented_model(study, self.diagnosis, self.folder)
        moved = {n: q.value for n, q in model.parameters.items() if n not in own or q.value != own[n].value}
        values = FrozenMap({n: model.parameters[n].value for n in study.given} | moved)
        note = f"{name} values of study '{study.name}', with {self.counts.added} in the model, {self._standing_of_effect()}"
        estimates = {
            n: self.diagnosis.estimates_after.get(n) for n in study.candidates if values.get(n) != study.given.get(n)
        }
        return ValueSet(name, values, note, "effect", *self.marks, model, (), *self._known(estimates, effect=True))

    def _standing_of_effect(self) -> str:
        """Return how sure the diagnosis is of the effect, and of its places, in words."""
        if self.counts.name != "effect":
            return f"the best that was found, and not certain: {self.counts.doubt}"
        places = [
            listed(f"{', '.join(p.at)} ({probability_text(p.probability)})" for p in f.places)
            for f in (self.diagnosis.findings if self.diagnosis is not None else ())
            if len(f.places) > 1
        ]
        rest = (
            f"; its likely places: {'; '.join(places)}; at another one than this the values may differ"
            if places
            else ""
        )
        return f"as the diagnosis named it{rest}"


def _outcome(fit: FitResult, candidates: Sequence[str]) -> str:
    """Return how a fit ended, and how far above the noise: what a reader has to know of its values."""
    held = [n for n in candidates if n not in fit.fitted]
    misfit = fit.adequacy is not None and fit.adequacy.verdict == "does-not-fit"
    parts = [f"fit {fit.status}", *(["the model does not fit these records"] if misfit else [])]
    parts += [f"chi2/dof {figures(fit.chi2_per_dof, 3)}"] if fit.chi2_per_dof is not None else []
    parts += [f"held: {', '.join(held)}"] if held else []
    return ", ".join(parts)
