"""Answers of a folder of results: does the model follow, with which values, what does it lack, what is to be recorded next.

The first screen of the report and the letter both show these answers, each in its own words.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from hvdc_ident.fit.judgement import Count
from hvdc_ident.report.overlay import STAGES, Overlay, overlay_of
from hvdc_ident.report.results import Results
from hvdc_ident.report.values_that_count import ValuesThatCount, values_that_count
from hvdc_ident.text import figures, interval_words, listed, one_of, percentage, quantity, value_by_place

Signal = tuple[str, str]
"""An output and an experiment."""
Table = Mapping[str, Mapping[str, float | None]]

ADDED = {"term": "formula", "filter": "filter", "curve": "curve"}
"""Words for what stands in the model in place of an effect of the catalogue."""
AT_BOUND = "at its bound"
"""Note on a value that stands on a bound of the search."""


@dataclass(frozen=True)
class Errors:
    """Errors of the model with one set of values, as its judgement has them.

    name: "given", "fitted" or "effect". rmse, peak: in the worst signal, in its unit; times: rmse over the noise, there. follows:
    the verdict; by_limits: whether it is by a tolerance or by windows, and not by the noise. on_noise, in_limits: the signals that
    are followed to their noise, and that keep the study's tolerance or, where it states none, the limits of the windows.
    """

    name: str
    rmse: float | None
    peak: float | None
    times: float | None
    follows: bool | None
    by_limits: bool
    on_noise: Count
    in_limits: Count

    @property
    def deciding(self) -> Count:
        """The signals that the verdict is by."""
        return self.in_limits if self.by_limits else self.on_noise


@dataclass(frozen=True)
class Value:
    """A parameter: the value that counts with its interval, and the others by name; None where there is none.

    value: that of the model with what it lacks where that was named, else the fitted one. note: why it is held, or that it
    stands on a bound. with_effect: whether the value with the effect counts; effect_interval: its 95 % interval. by_place: its
    values with what is missing, in words, where they depend on what that is and where; no other value counts then.
    """

    name: str
    unit: str
    given: float | None
    fitted: float | None
    effect: float | None
    interval: tuple[float | None, float | None] | None
    note: str = ""
    with_effect: bool = True
    effect_interval: tuple[float | None, float | None] | None = None
    by_place: str = ""

    @property
    def value(self) -> float | None:
        """The value that counts; None where it depends on what is missing."""
        if self.by_place:
            return None
        return self.effect if self.with_effect and self.effect is not None else self.fitted

    @property
    def differs(self) -> bool | None:
        """True where the interval leaves out the given value, False where it holds it; None where there is no interval."""
        low, high = self.interval or (None, None)
        if self.given is None or self.value is None or (low is None and high is None):
            return None
        return not (-math.inf if low is None else low) <= self.given <= (math.inf if high is None else high)

    @property
    def change(self) -> float | None:
        """The value that counts less the given one, over the given one; None where there is none, or the given one is 0."""
        return self.value / self.given - 1.0 if self.value is not None and self.given else None


@dataclass(frozen=True)
class Missing:
    """One finding: a sentence, its probability, the likely places with theirs, and the delay of a slow signal in words."""

    name: str
    text: str
    probability: float
    places: tuple[tuple[str, float], ...]
    delay: str = ""


class Answers:
    """The answers of a folder of results; what a study did not ask for is empty."""

    def __init__(self, results: Results) -> None:
        self.results = results
        self.fit = results.get("fit")
        self.diagnosis = results.get("discrepancy")

    @cached_property
    def judgements(self) -> dict[str, Mapping[str, Any]]:
        """The judgement of the model with each set of values that there is: "given", "fitted" and "effect"."""
        found: dict[str, Mapping[str, Any]] = {}
        for stage in STAGES.values():
            for name, judgement in (self._judged(stage).get("sets") or {}).items():
                found.setdefault(name, judgement)
        wanted = {"given": True, "fitted": bool(self.fitted), "effect": bool(self.added)}
        return {n: found[n] for n, there in wanted.items() if there and (found.get(n) or {}).get("signals")}

    def _judged(self, stage: str) -> Mapping[str, Any]:
        return self.results.get(stage).get("judgement") or {}

    def signals(self, name: str) -> dict[Signal, Mapping[str, Any]]:
        """The judgement of each signal with a set of values, empty without one."""
        return self._signals.get(name, {})

    @cached_property
    def _signals(self) -> dict[str, dict[Signal, Mapping[str, Any]]]:
        tables = {n: judgement["signals"] for n, judgement in self.judgements.items()}
        return {n: {(o, e): about for o, line in t.items() for e, about in line.items()} for n, t in tables.items()}

    @property
    def fitted(self) -> tuple[str, ...]:
        """The parameters that a fit estimated; none where it failed."""
        done = self.fit.get("status") not in (None, "failed", "not-converged")
        return tuple(self.fit.get("fitted") or ()) if done else ()

    @property
    def added(self) -> str:
        """Kind of the addition in the augmented model: "effect", "formula", "filter" or "curve"; empty where nothing was added."""
        return added_to(self.diagnosis)

    @property
    def conditional(self) -> bool:
        """True where the values that count hold only if nothing else is missing: what their model leaves is more than noise."""
        return values_conditional(self.fit, self.diagnosis, effect=self.counting.name == "effect")

    @property
    def condition(self) -> str:
        """Sentences on what the values that count rest on; empty where the search was sure and what is left is noise."""
        found = []
        if self.counting.name == "fit" and (doubt := str(self.fit.get("search_doubt") or "")):
            found.append(f"They may not be the best there are: {doubt}.")
        if self.conditional:
            found.append("They hold only if nothing else is missing: what remains is more than the noise.")
        return " ".join(found)

    def interval_words(self, *, effect: bool) -> str:
        """Return the name of the intervals of the values with the effect, or else of the fitted ones."""
        return interval_words(beyond_noise=values_conditional(self.fit, self.diagnosis, effect=effect))

    @cached_property
    def counting(self) -> ValuesThatCount:
        """Which values count: those with the effect, where the diagnosis named one, else those of the fit."""
        return values_that_count(self.fit, self.diagnosis)

    @cached_property
    def worst(self) -> Signal | None:
        """The signal with the largest error at the given or the fitted values: over its tolerance, else its noise, else its range."""
        shares: dict[int, dict[Signal, float]] = {0: {}, 1: {}, 2: {}}
        for name in ("given", "fitted"):
            for signal, about in self.signals(name).items():
                scales = (about["tolerance"], about["noise"])
                swing = None if any(scales) else self._swing(*signal)
                for kind, scale in enumerate((*scales, swing)):
                    if scale:
                        shares[kind][signal] = max(about["rmse"] / scale, shares[kind].get(signal, 0.0))
        ranked = next((s for s in shares.values() if s), {})
        return max(ranked, key=lambda signal: ranked[signal], default=None)

    def noise(self, signal: Signal) -> float | None:
        """The standard deviation of a signal's noise, in its unit; None where it is not known."""
        return next((about["noise"] for n in self.judgements if (about := self.signals(n).get(signal))), None)

    def interval(self, name: str, stage: str) -> tuple[float | None, float | None] | None:
        """The 95 % interval of a parameter as the fit or the diagnosis ("discrepancy") found it."""
        estimates = self.fit.get("estimates") if stage == "fit" else self.diagnosis.get("estimates_after")
        ends = ((estimates or {}).get(name) or {}).get("ci95")
        return (ends[0], ends[1]) if ends else None

    @property
    def tolerance(self) -> Mapping[str, float]:
        """The study's tolerance of the RMSE by output, in its unit."""
        return self._about.get("tolerance") or {}

    @property
    def profile(self) -> Mapping[str, Any]:
        """The tolerance profile of windows before, during and after the event; empty where no error was held against one."""
        return self._about.get("profile") or {}

    @cached_property
    def _about(self) -> Mapping[str, Any]:
        """The tolerance and the profile that the errors were held against, by the last stage that judged."""
        return next((j for stage in reversed(STAGES.values()) if (j := self._judged(stage))), {})

    @property
    def by_tolerance(self) -> bool:
        """True where the study names a tolerance, which then is what the verdict is against, where a signal has one."""
        return bool(self.tolerance) or bool(self.profile.get("named"))

    @cached_property
    def errors(self) -> tuple[Errors, ...]:
        """The errors by set of values, in the order given, fitted, with the effect."""
        return tuple(self._errors(name) for name in self.judgements)

    @property
    def judged(self) -> Errors | None:
        """The errors that the verdict is about: those of the fitted model where there is one, else of the given one."""
        plain = [e for e in self.errors if e.name != "effect"]
        return plain[-1] if plain else None

    @property
    def follows(self) -> bool | None:
        """The verdict on the model as it is, fitted where it was; None where neither a tolerance nor a noise is known."""
        return None if self.judged is None else self.judged.follows

    def not_judged(self, errors: Errors, *, limits: bool) -> str:
        """Phrase on the signals that are not judged, by the limits or else by the noise, and what to state; empty without any."""
        count = (errors.in_limits if limits else errors.on_noise).not_judged
        if not count:
            return ""
        said = f"{count} signal{'s' if count > 1 else ''} not judged"
        each = self.signals(errors.name)
        if not limits:
            unknown = dict.fromkeys(o for (o, _), about in each.items() if about["follows"]["noise"] is None)
            return f"{said}: state the noise of {listed(list(unknown))}"
        if self.tolerance:
            rest = list(dict.fromkeys(o for o, _ in each if o not in self.tolerance))
            return f"{said}: the study states no tolerance for {listed(rest)}"
        why: dict[str, list[str]] = {}
        for (output, _), about in each.items():
            if about["follows"]["windows"] is None:
                names = why.setdefault(str(about["windows"].get("reason") or "no limit in its unit"), [])
                names += [] if output in names else [output]
        reasons = [f"{one_of(names)} ({reason})" for reason, names in why.items()]
        return f"{said}: {'; '.join(reasons)}" if reasons else said

    def _errors(self, name: str) -> Errors:
        judgement = self.judgements[name]
        about = self.signals(name).get(self.worst) if self.worst is not None else None
        rmse, peak, noise = (about[k] for k in ("rmse", "peak", "noise")) if about else (None, None, None)
        counts = {by: Count(**count) for by, count in judgement["counts"].items()}
        return Errors(
            name,
            rmse,
            peak,
            rmse / noise if rmse is not None and noise else None,
            judgement["follows"],
            judgement["by"] != "noise",
            counts["noise"],
            counts["tolerance" if self.tolerance else "windows"],
        )

    def _swing(self, output: str, experiment: str) -> float | None:
        """Peak-to-peak value of a recorded signal, in its unit; None where its recording is not at hand."""
        found = overlay_of(self.results, experiment, output)
        record = None if found is None else found.record[f"{output}.measured"]
        return None if record is None or not np.isfinite(record).any() else float(np.nanmax(record) - np.nanmin(record))

    @property
    def overlay(self) -> Overlay | None:
        """The recording of the worst signal with the model's runs."""
        if self.worst is None:
            return None
        sets = tuple(self.judgements)
        return overlay_of(self.results, self.worst[1], self.worst[0], sets)

    @cached_property
    def values(self) -> tuple[Value, ...]:
        """Every candidate with the value that counts, or with those that it has by place."""
        depend = self.diagnosis.get("values_by_place") or {}
        return tuple(
            replace(v, effect=None, interval=None, effect_interval=None, by_place=value_by_place(depend[v.name]))
            if depend.get(v.name)
            else v
            for v in self._values
        )

    @property
    def _values(self) -> tuple[Value, ...]:
        """Every candidate with the values that the fit and the diagnosis have put into their models."""
        told = self.results.get("identifiability")
        lines = (
            self.fit.get("candidates")
            or told.get("candidates")
            or self.results.get("simulation").get("candidates")
            or {}
        )
        after = self.diagnosis.get("parameters_after") or {} if self.added else {}
        lines = lines or {n: {"given": g} for n, g in (self.diagnosis.get("parameters_before") or {}).items()}
        later = self.diagnosis.get("estimates_after") or {}
        held = self.fit.get("held") or {n: h.get("reason", "") for n, h in (told.get("held") or {}).items()}
        rows, with_effect = [], self.counting.name != "fit"  # without a fit there are no others
        for name, line in lines.items():
            fitted = (self.fit.get("values") or {}).get(name) if name in self.fitted else self._on_bound.get(name)
            effect = after.get(name) if name in self.fitted or name in later or not self.fit else None
            counts = with_effect and effect is not None
            value = effect if counts else fitted
            ends = self.interval(name, "discrepancy" if counts else "fit") if value is not None else None
            with_it = self.interval(name, "discrepancy") if effect is not None else None
            note = "" if value is not None else str(held.get(name) or "")
            if value is not None and (
                (not counts and name in self._on_bound) or value in (line.get("min"), line.get("max"))
            ):
                note = AT_BOUND
            unit = str(line.get("unit") or "")
            rows.append(Value(name, unit, line.get("given"), fitted, effect, ends, note, with_effect, with_it))
        return tuple(rows)

    @property
    def _on_bound(self) -> dict[str, float]:
        """The parameters that a fit holds on the bound where the search for them ended, with that bound."""
        if not self.fitted:
            return {}
        estimates = self.fit.get("estimates") or {}
        return {n: e["value"] for n, e in estimates.items() if n not in self.fitted and e.get("method") == "one-sided"}

    @cached_property
    def missing(self) -> tuple[Missing, ...]:
        """The findings of the diagnosis, the likeliest first."""
        own = {
            (e["effect"], tuple(e["at"]), e.get("from", "")): str(e["text"])
            for e in self.diagnosis.get("effects") or []
        }
        found = []
        for f in self.diagnosis.get("findings") or []:
            places = f.get("places") or []
            first = places[0] if places else {"at": ()}
            said = own.get((f["effect"], tuple(first["at"]), first.get("from", "")), "")
            if self.diagnosis.get("values_by_place"):  # the finding's own sentence tells what each place implies
                said = ""
            late = f.get("equivalent_delay") or {}
            parameters = f["effect"] == "parameter"
            found.append(
                Missing(
                    "parameter" if parameters else one_of(f["same_as"]),
                    (said or str(f["text"])).rstrip("."),
                    float(f["probability"]),
                    () if parameters else tuple(places_of(places).items()),
                    quantity(late["value"], "s", 3) if late.get("value") is not None else "",
                )
            )
        return tuple(found)

    @property
    def remainder(self) -> str:
        """Sentence on what is left with the additions in the model; empty where that is noise, or where nothing was added."""
        if not self.added or not beyond_noise(self.diagnosis):
            return ""
        # Of a formula, a filter or a curve no more is known: the shares are those of the best of the catalogue.
        left = self.diagnosis.get("remainder") or {} if self.added == "effect" else {}
        share, held = left.get("share"), left.get("held_out")
        parts = []
        if (
            isinstance(share, int | float)
            and not math.isnan(share)
            and (left.get("p") or 0.0) < 0.05
            and share >= 0.005
        ):
            at = f"; an unknown input at {left['at']} would explain it" if left.get("at") else ""
            parts.append(f"{percentage(share)} of the gap is left and is not noise{at}")
        if isinstance(held, int | float) and held >= 0.005:
            where = f", most of it in {left['record']}" if left.get("record") else ""
            times = (
                f" ({figures(left['record_units'], 3)} times the noise)"
                if left.get("record") and left.get("record_units")
                else ""
            )
            parts.append(f"on held-out recordings {percentage(held)} is left{where}{times}")
        told = ". ".join(p[:1].upper() + p[1:] for p in parts)
        adequate = (self.diagnosis.get("remaining") or {}).get("adequate", bool(self.doubt))
        return told or ("" if adequate else "What is left is still not noise")

    @property
    def doubt(self) -> str:
        """Return what tells that something else stands behind the additions, as a sentence goes on; empty where nothing does."""
        return str(self.diagnosis.get("doubt") or "") if self.added else ""

    @property
    def next(self) -> str:
        """Return what to record next: what tells likely effects apart, else what tells the parameters best; empty where none is known."""
        for advice in (
            self.diagnosis.get("separating_experiment"),
            self.results.get("identifiability").get("recommended_experiment"),
        ):
            said = str((advice or {}).get("text") or "").strip()
            if said:
                return said[:1].upper() + said[1:].rstrip(".") + "."
        return ""

    @property
    def failures(self) -> dict[str, str]:
        """The reason of every stage that failed, by its name."""
        stages = self.results.get("run").get("stages") or {}
        found = {n: str(s["failed"]) for n, s in stages.items() if s.get("failed")}
        for name, data in self.results.stages.items():
            if data.get("status") == "failed" and data.get("stage") not in found:
                found[str(data.get("stage") or name)] = str(data.get("message", ""))
        return found


def added_to(diagnosis: Mapping[str, Any]) -> str:
    """Return the kind of the addition in an augmented model: "effect", "formula", "filter" or "curve"; empty without one."""
    if diagnosis.get("effects"):
        return "effect"
    kind = (diagnosis.get("fallback") or {}).get("kind", "") if diagnosis.get("augmented_model") else ""
    return ADDED.get(kind, "")


def beyond_noise(diagnosis: Mapping[str, Any]) -> bool:
    """Return True where what the model of a diagnosis leaves is more than noise: something else is missing.

    The diagnosis says so itself; of one of an earlier version its tests do.
    """
    left = diagnosis.get("remaining") or {}
    tested = bool(diagnosis.get("doubt")) or (not left.get("adequate", True) and left.get("material", True))
    return bool(diagnosis.get("beyond_noise", tested))


def values_conditional(fit: Mapping[str, Any], diagnosis: Mapping[str, Any], *, effect: bool) -> bool:
    """Return True where values hold only if nothing else is missing, so that no interval of theirs is one of 95 %.

    effect: those with what the model lacks, judged by what is left with it. Else those of a fit of the model as it is: by the
    residuals of the fit, and by a diagnosis that found something missing, or something left that it could not name.
    """
    if effect:
        return beyond_noise(diagnosis)
    misfit = (fit.get("adequacy") or {}).get("verdict") == "does-not-fit"
    return misfit or bool(added_to(diagnosis)) or beyond_noise(diagnosis)


def places_of(
    places: Iterable[Mapping[str, Any]],
    join: Callable[[Iterable[str]], str] = ", ".join,
    depend: Collection[str] = (),
) -> dict[str, float]:
    """Return likely places with their probabilities, each once, with the signal that is brought in where that tells them apart.

    depend: parameters whose values depend on the place; these, and the sizes of the effect, then stand with each place.
    """
    places = list(places)
    sources: dict[str, set[str]] = {}
    for p in places:
        sources.setdefault(join(p["at"]), set()).add(str(p.get("from") or ""))
    found: dict[str, float] = {}
    for p in places:
        at = join(p["at"])
        at += f" from {p['from']}" if p.get("from") and len(sources[at]) > 1 else ""
        at += _implied(p, depend)
        found[at] = found.get(at, 0.0) + float(p.get("probability", 0.0))
    return found


def _implied(place: Mapping[str, Any], depend: Collection[str]) -> str:
    """Return the sizes of an effect at a place and the values of the parameters that depend on it, in brackets; else nothing."""
    if not depend or not place.get("values"):
        return ""
    sizes = (place.get("parameters") or {}) | {n: v for n, v in place["values"].items() if n in depend}
    told = listed(f"{n} = {quantity(p['value'], p.get('unit') or '')}" for n, p in sizes.items())
    return f" (then {told})"
