"""The summary of a run: verdicts, values, findings and what to do next, as values."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from hvdc_ident.codec import Coded
from hvdc_ident.display import Shown, Table
from hvdc_ident.fit.judgement import Count, Yardstick
from hvdc_ident.fit.uncertainty import narrow
from hvdc_ident.next_step import NextStep

Outcome = Literal["pass", "fail", "not judged"]
SETS = ("given", "fitted", "effect")
"""Sets of values, in the order of a page."""
Interval = tuple[float | None, float | None]
Signal = tuple[str, str]
"""An output and an experiment."""


@dataclass(frozen=True)
class Quantity:
    """A number with its unit and its interval; an end that is None is open."""

    value: float
    unit: str = ""
    interval: Interval | None = None


@dataclass(frozen=True)
class SignalError:
    """The error of a signal with one set of values. rmse, peak: in its unit; times_noise, of_tolerance: the RMSE over these, None
    without one. on_noise, in_limits: whether it follows the record to its noise, and keeps the tolerance or else the windows."""

    rmse: float
    peak: float
    times_noise: float | None
    of_tolerance: float | None
    on_noise: Outcome
    in_limits: Outcome


@dataclass(frozen=True)
class SignalSummary:
    """One output of one experiment. noise: its standard deviation, tolerance: of the RMSE, in the unit; None without one.

    verdict: of the set of values that the run's verdict is about; reason: why there is none. errors: by set of values.
    """

    output: str
    experiment: str
    role: str
    unit: str
    noise: float | None
    tolerance: float | None
    verdict: Outcome
    reason: str
    errors: Mapping[str, SignalError]


@dataclass(frozen=True)
class SetSummary:
    """The verdict on the model with one set of values. by: what it is held against. on_noise, in_limits: how many signals pass.

    worst: the signal with the largest error over its tolerance, else its noise, else its recorded range. not_judged: outputs by the
    reason for which they have no verdict in the limits; noise_unknown: outputs without one by their noise.
    """

    verdict: Outcome
    by: Yardstick
    on_noise: Count
    in_limits: Count
    worst: Signal | None
    not_judged: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    noise_unknown: tuple[str, ...] = ()

    @property
    def deciding(self) -> Count:
        """The signals that the verdict is by."""
        return self.on_noise if self.by == "noise" else self.in_limits


@dataclass(frozen=True)
class Counting:
    """Set of values that counts. name: "effect" for those fitted together with what a diagnosis named, "fit" for those of the fit without
    it, "" where nothing was fitted.

    added: what the model with the effect has that the model lacks, in words; empty where nothing was put in. kind: "effect",
    "formula", "filter" or "curve". doubt: why no values with an effect count though something is missing.
    """

    name: Literal["effect", "fit", ""]
    added: str = ""
    kind: str = ""
    doubt: str = ""


@dataclass(frozen=True)
class PlacedValue:
    """The value that a parameter has if the effect is at a place. source: the signal brought in there."""

    value: float
    unit: str
    effect: str
    at: tuple[str, ...]
    source: str = ""


@dataclass(frozen=True)
class ParameterSummary:
    """A candidate: the value that counts with its interval, and the others by name; None where there is none.

    moved: whether the interval leaves out the given value, by the value that counts, and where it has no interval but with each
    likely effect the same value, by that; None where neither has one. reason: why it is held. at_bound: whether it stands on a bound
    of the search. by_place: its values with what is missing, where they depend on that; no other value counts then.
    """

    name: str
    unit: str
    value: float | None
    interval: Interval | None
    given: float | None
    fitted: float | None
    fitted_interval: Interval | None
    effect: float | None
    effect_interval: Interval | None
    refitted: float | None = None
    moved: bool | None = None
    reason: str = ""
    at_bound: bool = False
    by_place: tuple[PlacedValue, ...] = ()

    @property
    def asked(self) -> Quantity | None:
        """The value that the recordings ask for, which `moved` judges; None where there is none."""
        if self.interval is None and self.effect_interval is not None and self.effect is not None:
            return Quantity(self.effect, self.unit, self.effect_interval)
        return None if self.value is None else Quantity(self.value, self.unit, self.interval)

    @property
    def asked_with_effect(self) -> bool:
        """True where `asked` is the value with the effect."""
        return self.asked is not None and self.effect is not None and self.asked.value == self.effect

    @property
    def change(self) -> float | None:
        """Change from the given value to `asked`, as a share of the given one; None where there is none, or the given one is 0."""
        return self.asked.value / self.given - 1.0 if self.asked is not None and self.given else None

    @property
    def alone(self) -> float | None:
        """The value of a fit without the effect: that of the table, else that of the diagnosis."""
        return self.refitted if self.fitted is None else self.fitted

    @property
    def determined(self) -> bool:
        """True where the interval is narrow."""
        return self.value is not None and self.interval is not None and narrow(self.value, self.interval)


@dataclass(frozen=True)
class PlaceSummary:
    """A likely place of an effect. source: the signal brought in there. values: the sizes of the effect there, and the values of
    the parameters that depend on the place."""

    at: tuple[str, ...]
    probability: float
    source: str = ""
    values: Mapping[str, Quantity] = field(default_factory=dict)


@dataclass(frozen=True)
class FindingSummary:
    """Something that is missing, with its probability. effect: its name in the catalogue, "parameter" for values that are off.

    same_as: the effects that cannot be told from it. sizes: of the likeliest place. delay: of a slow signal, s.
    """

    effect: str
    same_as: tuple[str, ...]
    text: str
    probability: float
    sizes: Mapping[str, Quantity]
    places: tuple[PlaceSummary, ...]
    delay: float | None = None


@dataclass(frozen=True)
class AddedEffect:
    """An effect in the augmented model. name: with its formula where it is outside the catalogue; source: the signal brought in.

    chosen_from: how many candidates were refitted.
    """

    name: str
    at: tuple[str, ...]
    source: str
    text: str
    sizes: Mapping[str, Quantity]
    chosen_from: int | None = None


@dataclass(frozen=True)
class RivalSummary:
    """An effect at a place that the recordings cannot tell from what was added."""

    name: str
    at: tuple[str, ...]


@dataclass(frozen=True)
class RemainderSummary:
    """Gap that is left with the findings in the model. more_than_noise: whether something else is missing.

    explained: share of the gap that they explain. share: of the gap that is left and is no noise; held_out: of that on held-out
    recordings, most of it in `record`, where it is `record_times` its noise. at: where an unknown input would explain it. doubt: what
    tells that something else stands behind them. shrink: by which share they shrink the error on `against`, which no fit has seen, where
    `times` the noise is left of it.
    """

    more_than_noise: bool = False
    adequate: bool = True
    explained: float | None = None
    share: float | None = None
    held_out: float | None = None
    record: str = ""
    record_times: float | None = None
    at: str = ""
    doubt: str = ""
    shrink: float | None = None
    against: str = "experiments"
    times: float | None = None


@dataclass(frozen=True, repr=False)
class RunSummary(Coded, Shown):
    """Summary of the results of a study, decided once; `to_dict` is `summary.json`, and printed it is the screen of a run.

    verdict: whether the model follows its recordings, with the values that `about` names: the fitted ones where there are some, else
    the given ones. by: what it is held against; limits: whether a study's tolerance or the windows of a profile are the limits.
    sets: by set of values, in the order given, fitted, effect. tolerance: of the RMSE by output. profile: of the windows.
    diagnosis: the verdict of the diagnosis, "" where none has run; said: its text. effects: in the augmented model. rivals: that the
    recordings cannot tell from them; late: the delays of a slow signal, s, between which all of these lie, where each has one.
    stand_ins: where values that are off explain the gap, what explains it as well with these values as given.
    conditional: by set of values, whether they hold only if nothing else is missing. fit: the status of the fit.
    next: what to do, the first thing first. unadvised: why no recording that narrows an interval is advised, where that was asked.
    failures: by stage. noise_from_misfit: the outputs whose noise is not known and is taken from the misfit, in any verdict of the run.
    """

    study: str
    model: str
    software: str
    seed: int
    sources: Mapping[str, str]
    verdict: Outcome
    about: str | None
    limits: Yardstick
    sets: Mapping[str, SetSummary]
    signals: tuple[SignalSummary, ...]
    tolerance: Mapping[str, float]
    profile: Mapping[str, Any]
    counting: Counting
    parameters: tuple[ParameterSummary, ...]
    diagnosis: str
    said: str
    findings: tuple[FindingSummary, ...]
    effects: tuple[AddedEffect, ...]
    rivals: tuple[RivalSummary, ...]
    late: tuple[float, float] | None
    stand_ins: tuple[str, ...]
    remainder: RemainderSummary
    conditional: Mapping[str, bool]
    fit: str
    search_doubt: str
    next: tuple[NextStep, ...]
    unadvised: str
    failures: Mapping[str, str]
    noise_from_misfit: tuple[str, ...] = ()
    schema: int = 1

    def _screen(self) -> Iterable[str | Table]:
        from hvdc_ident.summary.screen import blocks

        return blocks(self, "python")

    @property
    def judged(self) -> SetSummary | None:
        """The verdict on the model as it is: fitted where it was, else as given."""
        return None if self.about is None else self.sets[self.about]

    def signal(self, key: Signal | None) -> SignalSummary | None:
        """The summary of a signal; None where it was not compared."""
        return next((s for s in self.signals if (s.output, s.experiment) == key), None)

    @property
    def by_limits(self) -> bool:
        """True where the study states the limits that the verdict is against."""
        return bool(self.tolerance) or bool(self.profile.get("named"))

    @property
    def counts_conditional(self) -> bool:
        """True where the values that count hold only if nothing else is missing."""
        return self.conditional["effect" if self.counting.name == "effect" else "fitted"]

    @property
    def moved(self) -> tuple[ParameterSummary, ...]:
        """The parameters whose given value the recordings leave out, the farthest first."""
        return tuple(sorted((p for p in self.parameters if p.moved), key=lambda p: -abs(p.change or math.inf)))

    @property
    def most_moved(self) -> ParameterSummary | None:
        """The parameter that a fit without the addition moves farthest from its given value; none whose value depends on the place."""
        known = [p for p in self.parameters if p.given and p.alone is not None and not p.by_place]
        return max(known, key=lambda p: abs((p.alone or 0.0) / (p.given or 1.0) - 1.0), default=None)
