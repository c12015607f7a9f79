"""Summary of the results of a study: the one place that decides it, from the JSON of its stages."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from hvdc_ident.discrepancy import Diagnosis
from hvdc_ident.discrepancy.result import CARD, VALUE, EffectSize
from hvdc_ident.fit.judgement import Judgement, Judgements, SignalJudgement, Yardstick
from hvdc_ident.fit.noise import of_misfit
from hvdc_ident.fit.result import Estimate, FitResult
from hvdc_ident.fit.uncertainty import narrow
from hvdc_ident.identifiability import Verdict
from hvdc_ident.next_step import NextStep
from hvdc_ident.summary.candidate import Candidate
from hvdc_ident.summary.run_summary import (
    SETS,
    AddedEffect,
    Counting,
    FindingSummary,
    Interval,
    Outcome,
    ParameterSummary,
    PlacedValue,
    PlaceSummary,
    Quantity,
    RemainderSummary,
    RivalSummary,
    RunSummary,
    SetSummary,
    Signal,
    SignalError,
    SignalSummary,
)
from hvdc_ident.summary.stage_results import NO_ESTIMATES, Json, StageResults
from hvdc_ident.text import capital, listed, quantity

Swing = Callable[[str, str], float | None]
STAGES: dict[str, str] = {"given": "simulation", "fitted": "fit", "effect": "discrepancy"}
"""Sets of values in the order of a page, with the stage that judges them and whose CSV files hold the runs with them."""
ADDED = {"term": "formula", "filter": "filter", "curve": "curve"}
"""Words for what stands in the model in place of an effect of the catalogue."""
CORRECTED = {VALUE: "corrected value", CARD: "other component"}
"""Words for what the model has otherwise than the card states, where that is no effect."""
SUMMARISED = ("run", "simulation", "identifiability", "fit", "discrepancy", "linearization")
"""Results that a summary is made of."""
NO_SHARE = 0.005
"""A smaller share of the gap is none: it is nothing in whole per cent."""
LEVEL = 0.05
"""Chance below which a remainder is not taken for noise."""


def no_swing(output: str, experiment: str) -> float | None:
    """Return None: no recording is at hand."""
    return None


def summarise(stages: Mapping[str, Json], swing: Swing = no_swing, heading: Json | None = None) -> RunSummary:
    """Return the summary of results. stages: their JSON by the name of its file; what a study did not ask for is missing.

    swing: the peak-to-peak value of a recorded signal by output and experiment, in its unit; None where it is not at hand.
    heading: study, model, software, seed and sources of the run; results of other sources are of an earlier state of the study, or of
    another version, and say nothing. Without one it is that of the results. Raises InputError for what is no result.
    """
    heading = heading or stages.get("run") or stages.get("fit") or next(iter(stages.values()), {})
    stages = {
        n: data for n, data in stages.items() if all(data.get(k) == heading.get(k) for k in ("sources", "software"))
    }
    results = StageResults.read(stages)
    counting = counting_of(results.fit, results.diagnosis)
    judgements = judgements_of(results)
    about = _about(results)
    limits: Yardstick = "tolerance" if about.tolerance else "windows"
    sets = {name: _set(j, limits, swing) for name, j in judgements.items()}
    plain = [n for n in sets if n != "effect"]
    judged = plain[-1] if plain else None
    parameters = _parameters(results, counting)
    diagnosis = results.diagnosis
    return RunSummary(
        study=str(heading.get("study", "")),
        model=str(heading.get("model", "")),
        software=str(heading.get("software", "")),
        seed=int(heading.get("seed") or 0),
        sources=dict(heading.get("sources") or {}),
        verdict=sets[judged].verdict if judged else "not judged",
        about=judged,
        limits=limits,
        sets=sets,
        signals=_signals(judgements, judged, limits, results),
        tolerance=dict(about.tolerance),
        profile=dict(about.profile),
        counting=counting,
        parameters=parameters,
        diagnosis="" if diagnosis is None else diagnosis.verdict,
        said="" if diagnosis is None else diagnosis.text,
        findings=() if diagnosis is None else _findings(diagnosis),
        effects=() if diagnosis is None else _effects(diagnosis),
        rivals=() if diagnosis is None else _rivals(diagnosis),
        late=None if diagnosis is None else _late(diagnosis),
        stand_ins=() if diagnosis is None else tuple(x.text for x in diagnosis.stand_ins),
        remainder=RemainderSummary() if diagnosis is None else _remainder(diagnosis, counting),
        conditional={
            "given": False,
            "fitted": conditional(results.fit, diagnosis, effect=False),
            "effect": conditional(results.fit, diagnosis, effect=True),
        },
        fit="" if results.fit is None else results.fit.status,
        search_doubt="" if results.fit is None else results.fit.search_doubt,
        next=_next(results, parameters),
        unadvised="" if added_to(diagnosis) else results.identified.not_recommended,
        failures=_failures(stages),
        noise_from_misfit=noise_from_misfit(results),
    )


def noise_from_misfit(results: StageResults) -> tuple[str, ...]:
    """Return the outputs whose noise is taken from the misfit by any of the results."""
    fit, diagnosis = results.fit, results.diagnosis
    by_fit = of_misfit(fit.noise_source) if fit is not None else ()
    by_diagnosis = () if diagnosis is None else of_misfit({o: n.get("source", "") for o, n in diagnosis.noise.items()})
    return tuple(dict.fromkeys((*results.identified.pilot.outputs_of_misfit, *by_fit, *by_diagnosis)))


# --- which values count ---


def counting_of(fit: FitResult | None, diagnosis: Diagnosis | None) -> Counting:
    """Return which values count. None: it has not run, or does not stand."""
    added, kind, verdict = _added(diagnosis), added_to(diagnosis), diagnosis.verdict if diagnosis is not None else ""
    if verdict == "named" and added:
        return Counting("effect", added, kind)
    doubt = ""
    if verdict == "ambiguous" and added:
        assert diagnosis is not None
        depend = diagnosis.values_by_place
        what = f": {listed(depend)} depend{'s' if len(depend) == 1 else ''} on where the effect is" if depend else ""
        doubt = f"the diagnosis is ambiguous{what}"
    elif verdict == "unnameable":
        doubt = "something is missing that the diagnosis cannot name"
    elif verdict == "unfinished":
        doubt = "the diagnosis was ended by its budget, before it could tell whether something is missing"
    return Counting("" if fit is None or fit.status in NO_ESTIMATES else "fit", added, kind, doubt)


def estimates_that_count(fit: FitResult | None, diagnosis: Diagnosis | None) -> dict[str, Estimate]:
    """Return the estimates that count, by parameter.

    With an effect, a parameter that was estimated without an interval has its value alone.
    """
    own = {} if fit is None else dict(fit.estimates)
    if diagnosis is None or counting_of(fit, diagnosis).name != "effect":
        return own
    later = diagnosis.estimates_after
    fitted = (*later, *(fit.fitted if fit is not None else ()))
    return {n: later.get(n) or Estimate(v) for n, v in diagnosis.parameters_after.items() if n in fitted}


def added_to(diagnosis: Diagnosis | None) -> str:
    """Return what an augmented model has otherwise: "effect", "formula", "filter", "curve", "other component" or "corrected value".

    Empty without one.
    """
    if diagnosis is None:
        return ""
    if diagnosis.effects:
        return "effect"
    others = {f.effect for f in diagnosis.findings} & CORRECTED.keys()
    if others and diagnosis.augmented_model and diagnosis.verdict in ("named", "ambiguous"):
        return CORRECTED[CARD if CARD in others else VALUE]
    kind = (diagnosis.fallback or {}).get("kind", "") if diagnosis.augmented_model else ""
    return ADDED.get(kind, "")


def _added(diagnosis: Diagnosis | None) -> str:
    """Return the effects with their places and sizes in words, "lag at P (T = 350 ms)", with the values and components that are others;
    else the kind of the addition."""
    parts = []
    for f in diagnosis.findings if diagnosis is not None and diagnosis.augmented_model else ():
        if f.effect == VALUE:
            parts += [f"{n} = {quantity(p.value, p.unit)}" for n, p in f.parameters.items()]
        elif f.effect == CARD:
            parts += [f"{p.source} as {listed(p.at)}" for p in f.places]
    for e in diagnosis.effects if diagnosis is not None else ():
        sizes = [f"{n} = {quantity(p.value, p.unit)}" for n, p in e.parameters.items() if math.isfinite(p.value)]
        source = f" from {e.source}" if e.source else ""
        parts.append(f"{e.effect} at {listed(e.at)}{source}" + (f" ({', '.join(sizes)})" if sizes else ""))
    kind = added_to(diagnosis)
    return "; ".join(parts) or (f"a {kind}" if kind else "")


def conditional(fit: FitResult | None, diagnosis: Diagnosis | None, *, effect: bool) -> bool:
    """Return True where values hold only if nothing else is missing, so that no interval of theirs is one of 95 %.

    effect: those with what the model lacks, judged by what is left with it. Else those of a fit of the model as it is: by the
    residuals of the fit, and by a diagnosis that found something missing, or something left that it could not name.
    """
    beyond = diagnosis is not None and diagnosis.beyond_noise
    if effect:
        return beyond
    misfit = fit is not None and fit.adequacy is not None and fit.adequacy.verdict == "does-not-fit"
    return misfit or bool(added_to(diagnosis)) or beyond


# --- whether the model follows ---


def judgements_of(results: StageResults) -> dict[str, Judgement]:
    """Return the judgement of the model with each set of values that there is."""
    each: dict[str, Judgement] = {}
    for context in (results.simulated, results.of_fit, results.of_diagnosis):
        for name, judgement in context.judgement.sets.items():
            each.setdefault(name, judgement)
    wanted = {"given": True, "fitted": bool(results.fitted), "effect": bool(added_to(results.diagnosis))}
    return {n: each[n] for n in SETS if wanted[n] and n in each and each[n].signals}


def _about(results: StageResults) -> Judgements:
    """Return the tolerance and the profile that the errors were held against, by the last stage that judged."""
    each = (context.judgement for context in (results.of_diagnosis, results.of_fit, results.simulated))
    return next((j for j in each if j.sets), Judgements())


def _outcome(follows: bool | None) -> Outcome:
    return "not judged" if follows is None else "pass" if follows else "fail"


def _set(judgement: Judgement, limits: Yardstick, swing: Swing) -> SetSummary:
    unknown: dict[str, None] = {}
    why: dict[str, dict[str, None]] = {}
    for output, _, about in lines_of(judgement):
        if about.follows["noise"] is None:
            unknown[output] = None
        if about.follows[limits] is None:
            why.setdefault(_unjudged(about, limits), {})[output] = None
    return SetSummary(
        _outcome(judgement.follows),
        judgement.by,
        judgement.count("noise"),
        judgement.count(limits),
        _worst(judgement, swing),
        {reason: tuple(outputs) for reason, outputs in why.items()},
        tuple(unknown),
    )


def _unjudged(about: SignalJudgement, limits: Yardstick) -> str:
    """Return why a signal has no verdict in the limits; "" where the study states no tolerance for it."""
    return "" if limits == "tolerance" else about.windows.reason or "no limit in its unit"


def lines_of(judgement: Judgement) -> Iterable[tuple[str, str, SignalJudgement]]:
    """Yield the output, the experiment and the judgement of each signal."""
    for output, line in judgement.signals.items():
        for experiment, about in line.items():
            yield output, experiment, about


def _worst(judgement: Judgement, swing: Swing) -> Signal | None:
    """Return the signal with the largest error: over its tolerance, else its noise, else its recorded range."""
    shares: tuple[dict[Signal, float], ...] = ({}, {}, {})
    for output, experiment, about in lines_of(judgement):
        scales = (about.tolerance, about.noise)
        for kind, scale in enumerate((*scales, None if any(scales) else swing(output, experiment))):
            if scale:
                shares[kind][output, experiment] = about.rmse / scale
    ranked: dict[Signal, float] = next((s for s in shares if s), {})
    return max(ranked, key=lambda signal: ranked[signal], default=None)


def _signals(
    judgements: Mapping[str, Judgement], judged: str | None, limits: Yardstick, results: StageResults
) -> tuple[SignalSummary, ...]:
    units = {**results.of_diagnosis.units, **results.simulated.units, **results.of_fit.units}
    experiments = {**results.simulated.experiments, **results.of_fit.experiments}
    errors: dict[Signal, dict[str, SignalJudgement]] = {}
    for name, judgement in judgements.items():
        for output, experiment, about in lines_of(judgement):
            errors.setdefault((output, experiment), {})[name] = about
    by: Yardstick = judgements[judged].by if judged else "noise"
    lines = []
    for (output, experiment), each in errors.items():
        one = each.get(judged) if judged else None
        verdict = _outcome(one.follows[by] if one else None)
        reason = "no noise is known" if verdict == "not judged" else ""
        if one and by != "noise" and verdict == "not judged":
            reason = _unjudged(one, by) or "the study states no tolerance"
        role = experiments[experiment].role if experiment in experiments else "fit"
        scales = next(iter(each.values()))
        errors_of = {n: _error(a, limits) for n, a in each.items()}
        line = (units.get(output, ""), scales.noise, scales.tolerance, verdict, reason, errors_of)
        lines.append(SignalSummary(output, experiment, role, *line))
    return tuple(lines)


def _error(about: SignalJudgement, limits: Yardstick) -> SignalError:
    noise, tolerance = (about.rmse / scale if scale else None for scale in (about.noise, about.tolerance))
    on_noise, in_limits = (_outcome(about.follows[by]) for by in ("noise", limits))
    return SignalError(about.rmse, about.peak, noise, tolerance, on_noise, in_limits)


# --- the values ---


def _parameters(results: StageResults, counting: Counting) -> tuple[ParameterSummary, ...]:
    fit, diagnosis, identified = results.fit, results.diagnosis, results.identified
    lines = results.of_fit.candidates or results.of_identified.candidates or results.simulated.candidates
    if not lines and diagnosis is not None:
        known = diagnosis.estimates_after
        lines = {
            n: Candidate(v, unit=known[n].unit if n in known else "") for n, v in diagnosis.parameters_before.items()
        }
    fitted, estimates = results.fitted, results.estimates
    later: Mapping[str, Estimate] = {} if diagnosis is None else diagnosis.estimates_after
    bounds = {n: e for n, e in estimates.items() if fitted and n not in fitted and e.method == "one-sided"}
    after = diagnosis.parameters_after if diagnosis is not None and counting.kind else {}
    refitted = diagnosis.parameters_refitted if diagnosis is not None else {}
    held = fit.held if fit is not None and fit.held else {n: h.reason for n, h in identified.held.items()}
    summaries = []
    for name, line in lines.items():
        alone = bounds[name].value if name in bounds else fit.values.get(name) if fit and name in fitted else None
        by_place = tuple(
            PlacedValue(v.value, v.unit, v.effect, v.at, v.source)
            for v in (diagnosis.values_by_place.get(name, ()) if diagnosis is not None else ())
        )
        effect = after.get(name) if not by_place and (name in fitted or name in later or fit is None) else None
        # Without a fit there are no other values than those with the effect.
        counts = effect is not None and counting.name != "fit"
        value = None if by_place else effect if counts else alone
        own = _interval(estimates.get(name)) if alone is not None else None
        with_it = _interval(later.get(name)) if effect is not None else None
        interval = None if value is None else with_it if counts else own
        bounded = value is not None and ((not counts and name in bounds) or value in (line.min, line.max))
        summaries.append(
            ParameterSummary(
                name, line.unit, value, interval, line.given, alone, own, effect, with_it,
                refitted=refitted.get(name),
                moved=_leaves_out(interval or with_it, line.given),
                reason="" if value is not None or by_place else held.get(name, ""),
                at_bound=bounded,
                by_place=by_place,
            )
        )  # fmt: skip
    return tuple(summaries)


def _interval(estimate: Estimate | EffectSize | Verdict | None) -> Interval | None:
    return estimate.ci95 if estimate is not None else None


def _leaves_out(interval: Interval | None, given: float | None) -> bool | None:
    """Return True where an interval leaves out the given value, False where it holds it; None where there is neither."""
    low, high = interval or (None, None)
    if given is None or (low is None and high is None):
        return None
    return not (-math.inf if low is None else low) <= given <= (math.inf if high is None else high)


# --- what is missing ---


def _quantities(sizes: Mapping[str, EffectSize]) -> dict[str, Quantity]:
    return {n: Quantity(p.value, p.unit, p.ci95) for n, p in sizes.items() if math.isfinite(p.value)}


def _findings(diagnosis: Diagnosis) -> tuple[FindingSummary, ...]:
    own = {(e.effect, e.at, e.source): e.text for e in diagnosis.effects}
    depend = diagnosis.values_by_place
    findings = []
    for f in diagnosis.findings:
        places = tuple(
            PlaceSummary(
                p.at,
                p.probability,
                p.source,
                _quantities(p.parameters) | _quantities({n: v for n, v in p.values.items() if n in depend})
                if depend and p.values
                else {},
            )
            for p in f.places
        )
        at = (places[0].at, places[0].source) if places else ((), "")
        # Of a place that the values depend on, the finding's own sentence tells what each implies.
        said = "" if depend else own.get((f.effect, *at), "")
        delay = f.equivalent_delay.value if f.equivalent_delay is not None else None
        text, listed_places = (said or f.text).rstrip("."), () if f.effect == "parameter" else places
        sizes = _quantities(f.parameters)
        findings.append(
            FindingSummary(f.effect, f.same_as or (f.effect,), text, f.probability, sizes, listed_places, delay)
        )
    return tuple(findings)


def _effects(diagnosis: Diagnosis) -> tuple[AddedEffect, ...]:
    return tuple(
        AddedEffect(e.effect, e.at, e.source, e.text.rstrip("."), _quantities(e.parameters), e.chosen_from)
        for e in diagnosis.effects
    )


def _rivals(diagnosis: Diagnosis) -> tuple[RivalSummary, ...]:
    """Return what the recordings cannot tell from the effects in the model, each once."""
    own = [(e.effect, e.at, e.source) for e in diagnosis.effects]
    others = [r for group in diagnosis.ambiguity for r in group if (r.effect, r.at, r.source) not in own]
    return tuple(dict.fromkeys(RivalSummary(r.name, r.at) for r in others))


def _late(diagnosis: Diagnosis) -> tuple[float, float] | None:
    """Return the least and the largest delay of a slow signal over the only ambiguity set, s; None where one of it has none."""
    late = [r.late for group in diagnosis.ambiguity for r in group if r.refitted]
    known = [v for v in late if v is not None and v > 0.0]
    if len(diagnosis.ambiguity) != 1 or len(late) < 2 or len(known) < len(late):
        return None
    return min(known), max(known)


def _remainder(diagnosis: Diagnosis, counting: Counting) -> RemainderSummary:
    """Return what is left with the additions in the model; nothing where nothing was added."""
    remaining, gap = diagnosis.remaining, diagnosis.gap
    doubt = diagnosis.doubt if counting.kind else ""
    shrink = gap.shrink_holdout if counting.kind else None
    pooled = (gap.pooled.get("augmented") or {}).get("holdout")
    adequate = bool(remaining.get("adequate", bool(doubt)))
    # Of a formula, a filter or a curve no more is known: the shares are those of the best of the catalogue.
    left = diagnosis.remainder if counting.kind == "effect" else {}
    share, held_out = (_share(left.get(k)) for k in ("share", "held_out"))
    if (left.get("p") or 0.0) >= LEVEL:
        share = None
    record = str(left.get("record") or "") if held_out is not None else ""
    times = left.get("record_units") if record else None
    at = str(left.get("at") or "") if share is not None else ""
    told = (remaining.get("explained_share"), share, held_out, record, times, at, doubt, shrink, gap.held_out, pooled)
    return RemainderSummary(diagnosis.beyond_noise, adequate, *told)


def _share(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and value >= NO_SHARE else None


# --- what to do next ---


def _next(results: StageResults, parameters: tuple[ParameterSummary, ...]) -> tuple[NextStep, ...]:
    """Return what to do, the first thing first.

    Advice on narrower intervals is of the model without an effect: it is void once one was put in, and needless where every value
    is known closely enough for any change to be told.
    """
    fit, diagnosis, steps = results.fit, results.diagnosis, []
    if diagnosis is not None and (advice := _advice((diagnosis.separating_experiment or {}).get("text"))):
        steps.append(NextStep("separate", advice))
    if diagnosis is not None and diagnosis.augmented_model:
        steps.append(NextStep("letter"))
    misfit = fit is not None and fit.adequacy is not None and fit.adequacy.verdict == "does-not-fit"
    if diagnosis is None and misfit:
        steps.append(NextStep("diagnose"))
    own = {} if results.estimates else results.identified.parameters
    known = bool(parameters) and all(p.determined or _closely(own.get(p.name)) for p in parameters)
    wanted = results.identified.recommended
    if not added_to(diagnosis) and not known and wanted is not None and (advice := _advice(wanted.text)):
        steps.append(NextStep("narrow", advice))
    if results.estimates and not steps:
        steps.append(NextStep("export"))
    return tuple(steps)


def _closely(verdict: Verdict | None) -> bool:
    """Return whether a parameter is known closely enough by its verdict, where no fit has run."""
    return verdict is not None and verdict.ci95 is not None and narrow(verdict.value, verdict.ci95)


def _advice(text: str | None) -> str:
    """Return what to record, as a sentence; empty where nothing is advised."""
    said = (text or "").strip().rstrip(".")
    return f"{capital(said)}." if said else ""


def _failures(stages: Mapping[str, Json]) -> dict[str, str]:
    """Return the reason of every stage that failed, by its name."""
    reasons = {
        n: str(s["failed"]) for n, s in ((stages.get("run") or {}).get("stages") or {}).items() if s.get("failed")
    }
    for name, data in stages.items():
        if (data.get("status") in ("failed", "unfinished") or "not_tried" in data) and data.get("stage") not in reasons:
            reasons[str(data.get("stage") or name)] = str(data.get("message", ""))
    return reasons
