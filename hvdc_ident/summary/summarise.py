"""Summary of the results of a study: the one place that decides it, from the JSON of its stages."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from hvdc_ident.fit.judgement import Count, Yardstick
from hvdc_ident.next_step import NextStep
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
    narrow,
)
from hvdc_ident.text import form_of, listed, quantity

Json = Mapping[str, Any]
Swing = Callable[[str, str], float | None]
STAGES: dict[str, str] = {"given": "simulation", "fitted": "fit", "effect": "discrepancy"}
"""Sets of values in the order of a page, with the stage that judges them and whose CSV files hold the runs with them."""
NO_ESTIMATES = (None, "failed", "not-converged")
"""Ends of a fit whose numbers are no estimates."""
ADDED = {"term": "formula", "filter": "filter", "curve": "curve"}
"""Words for what stands in the model in place of an effect of the catalogue."""
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
    heading: study, model, software, seed and sources of the run; results of other sources are of an earlier state of the study, and
    say nothing. Without one it is that of the results.
    """
    heading = heading or stages.get("run") or stages.get("fit") or next(iter(stages.values()), {})
    stages = {n: data for n, data in stages.items() if data.get("sources") == heading.get("sources")}
    fit, diagnosis, identified = (stages.get(n) or {} for n in ("fit", "discrepancy", "identifiability"))
    simulation = stages.get("simulation") or {}
    counting = counting_of(fit, diagnosis)
    judgements = judgements_of(stages)
    about = _about(stages)
    limits: Yardstick = "tolerance" if about.get("tolerance") else "windows"
    sets = {name: _set(j, limits, swing) for name, j in judgements.items()}
    plain = [n for n in sets if n != "effect"]
    judged = plain[-1] if plain else None
    units = {**(simulation.get("units") or {}), **(fit.get("units") or {})}
    experiments = {**(simulation.get("experiments") or {}), **(fit.get("experiments") or {})}
    parameters = _parameters(stages, fit, diagnosis, counting)
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
        signals=_signals(judgements, judged, limits, units, experiments),
        tolerance=dict(about.get("tolerance") or {}),
        profile=dict(about.get("profile") or {}),
        counting=counting,
        parameters=parameters,
        diagnosis=str(diagnosis.get("verdict") or ""),
        said=str(diagnosis.get("text") or ""),
        findings=_findings(diagnosis),
        effects=_effects(diagnosis),
        rivals=_rivals(diagnosis),
        late=_late(diagnosis),
        stand_ins=tuple(str(x["text"]) for x in diagnosis.get("stand_ins") or ()),
        remainder=_remainder(diagnosis, counting),
        conditional={
            "given": False,
            "fitted": conditional(fit, diagnosis, effect=False),
            "effect": conditional(fit, diagnosis, effect=True),
        },
        fit=str(fit.get("status") or ""),
        search_doubt=str(fit.get("search_doubt") or ""),
        next=_next(fit, diagnosis, identified, parameters),
        failures=_failures(stages),
    )


# --- which values count ---


def counting_of(fit: Json, diagnosis: Json) -> Counting:
    """Return which values count. fit, diagnosis: their JSON, empty where they have not run or do not stand."""
    added, kind, verdict = _added(diagnosis), added_to(diagnosis), diagnosis.get("verdict")
    if verdict == "named" and added:
        return Counting("effect", added, kind)
    doubt = ""
    if verdict == "ambiguous" and added:
        depend = diagnosis.get("values_by_place") or {}
        what = f": {listed(depend)} depend{'s' if len(depend) == 1 else ''} on where the effect is" if depend else ""
        doubt = f"the diagnosis is ambiguous{what}"
    elif verdict == "unnameable":
        doubt = "something is missing that the diagnosis cannot name"
    return Counting("" if fit.get("status") in NO_ESTIMATES else "fit", added, kind, doubt)


def estimates_that_count(fit: Json, diagnosis: Json) -> dict[str, dict[str, Any]]:
    """Return the estimates that count, by parameter, as a fit's JSON has them: `value`, `std`, `ci95`, `unit`, ...

    With an effect, a parameter that was estimated without an interval has its value alone.
    """
    if counting_of(fit, diagnosis).name != "effect":
        return {n: dict(e) for n, e in (fit.get("estimates") or {}).items()}
    after, later = diagnosis.get("parameters_after") or {}, diagnosis.get("estimates_after") or {}
    fitted = (*later, *(fit.get("fitted") or ()))
    return {n: {"value": v, **(later.get(n) or {})} for n, v in after.items() if n in fitted}


def added_to(diagnosis: Json) -> str:
    """Return the kind of the addition in an augmented model: "effect", "formula", "filter" or "curve"; empty without one."""
    if diagnosis.get("effects"):
        return "effect"
    kind = (diagnosis.get("fallback") or {}).get("kind", "") if diagnosis.get("augmented_model") else ""
    return ADDED.get(kind, "")


def _added(diagnosis: Json) -> str:
    """Return the effects with their places and sizes in words, "lag at P (T = 350 ms)"; else the kind of the addition."""
    parts = []
    for e in diagnosis.get("effects") or ():
        sizes = [
            f"{n} = {quantity(p['value'], p.get('unit') or '')}"
            for n, p in (e.get("parameters") or {}).items()
            if p.get("value") is not None
        ]
        source = f" from {e['from']}" if e.get("from") else ""
        parts.append(f"{form_of(e)} at {listed(e['at'])}{source}" + (f" ({', '.join(sizes)})" if sizes else ""))
    kind = added_to(diagnosis)
    return "; ".join(parts) or (f"a {kind}" if kind else "")


def beyond_noise(diagnosis: Json) -> bool:
    """Return True where what the model of a diagnosis leaves is more than noise: something else is missing.

    The diagnosis says so itself; of one of an earlier version its tests do.
    """
    left = diagnosis.get("remaining") or {}
    tested = bool(diagnosis.get("doubt")) or (not left.get("adequate", True) and left.get("material", True))
    return bool(diagnosis.get("beyond_noise", tested))


def conditional(fit: Json, diagnosis: Json, *, effect: bool) -> bool:
    """Return True where values hold only if nothing else is missing, so that no interval of theirs is one of 95 %.

    effect: those with what the model lacks, judged by what is left with it. Else those of a fit of the model as it is: by the
    residuals of the fit, and by a diagnosis that found something missing, or something left that it could not name.
    """
    if effect:
        return beyond_noise(diagnosis)
    misfit = (fit.get("adequacy") or {}).get("verdict") == "does-not-fit"
    return misfit or bool(added_to(diagnosis)) or beyond_noise(diagnosis)


# --- whether the model follows ---


def judgements_of(stages: Mapping[str, Json]) -> dict[str, Json]:
    """Return the judgement of the model with each set of values that there is. stages: their JSON by the name of its file."""
    fit, diagnosis = (stages.get(n) or {} for n in ("fit", "discrepancy"))
    found: dict[str, Json] = {}
    for stage in STAGES.values():
        for name, judgement in (_judged(stages, stage).get("sets") or {}).items():
            found.setdefault(name, judgement)
    wanted = {"given": True, "fitted": bool(_fitted(fit)), "effect": bool(added_to(diagnosis))}
    names = [n for n in SETS if wanted[n] and (found.get(n) or {}).get("signals")]
    return {n: found[n] for n in names}


def _judged(stages: Mapping[str, Json], stage: str) -> Json:
    return (stages.get(stage) or {}).get("judgement") or {}


def _about(stages: Mapping[str, Json]) -> Json:
    """Return the tolerance and the profile that the errors were held against, by the last stage that judged."""
    return next((j for stage in reversed(STAGES.values()) if (j := _judged(stages, stage))), {})


def _outcome(follows: bool | None) -> Outcome:
    return "not judged" if follows is None else "pass" if follows else "fail"


def _set(judgement: Json, limits: Yardstick, swing: Swing) -> SetSummary:
    counts = {by: Count(**count) for by, count in judgement["counts"].items()}
    unknown: dict[str, None] = {}
    why: dict[str, dict[str, None]] = {}
    for output, _, about in lines_of(judgement):
        if about["follows"]["noise"] is None:
            unknown[output] = None
        if about["follows"][limits] is None:
            why.setdefault(_unjudged(about, limits), {})[output] = None
    return SetSummary(
        _outcome(judgement["follows"]),
        judgement["by"],
        counts["noise"],
        counts[limits],
        _worst(judgement, swing),
        {reason: tuple(outputs) for reason, outputs in why.items()},
        tuple(unknown),
    )


def _unjudged(about: Json, limits: Yardstick) -> str:
    """Return why a signal has no verdict in the limits; "" where the study states no tolerance for it."""
    return "" if limits == "tolerance" else str(about["windows"].get("reason") or "no limit in its unit")


def lines_of(judgement: Json) -> Iterable[tuple[str, str, Json]]:
    """Yield the output, the experiment and the judgement of each signal."""
    for output, line in (judgement.get("signals") or {}).items():
        for experiment, about in line.items():
            yield output, experiment, about


def _worst(judgement: Json, swing: Swing) -> Signal | None:
    """Return the signal with the largest error: over its tolerance, else its noise, else its recorded range."""
    shares: tuple[dict[Signal, float], ...] = ({}, {}, {})
    for output, experiment, about in lines_of(judgement):
        scales = (about["tolerance"], about["noise"])
        for kind, scale in enumerate((*scales, None if any(scales) else swing(output, experiment))):
            if scale:
                shares[kind][output, experiment] = about["rmse"] / scale
    ranked: dict[Signal, float] = next((s for s in shares if s), {})
    return max(ranked, key=lambda signal: ranked[signal], default=None)


def _signals(
    judgements: Mapping[str, Json], judged: str | None, limits: Yardstick, units: Json, experiments: Json
) -> tuple[SignalSummary, ...]:
    errors: dict[Signal, dict[str, Json]] = {}
    for name, judgement in judgements.items():
        for output, experiment, about in lines_of(judgement):
            errors.setdefault((output, experiment), {})[name] = about
    by: Yardstick = judgements[judged]["by"] if judged else "noise"
    found = []
    for (output, experiment), each in errors.items():
        one = each.get(judged) if judged else None
        verdict = _outcome(one["follows"][by] if one else None)
        reason = "no noise is known" if verdict == "not judged" else ""
        if one and by != "noise" and verdict == "not judged":
            reason = _unjudged(one, by) or "the study states no tolerance"
        role = str((experiments.get(experiment) or {}).get("role") or "fit")
        scales = next(iter(each.values()))
        errors_of = {n: _error(a, limits) for n, a in each.items()}
        line = (str(units.get(output, "")), scales["noise"], scales["tolerance"], verdict, reason, errors_of)
        found.append(SignalSummary(output, experiment, role, *line))
    return tuple(found)


def _error(about: Json, limits: Yardstick) -> SignalError:
    rmse = float(about["rmse"])
    noise, tolerance = (rmse / about[k] if about[k] else None for k in ("noise", "tolerance"))
    follows = about["follows"]
    return SignalError(
        rmse, float(about["peak"]), noise, tolerance, _outcome(follows["noise"]), _outcome(follows[limits])
    )


# --- the values ---


def _fitted(fit: Json) -> tuple[str, ...]:
    """Return the parameters that a fit estimated; none where it failed."""
    return () if fit.get("status") in NO_ESTIMATES else tuple(fit.get("fitted") or ())


def _parameters(
    stages: Mapping[str, Json], fit: Json, diagnosis: Json, counting: Counting
) -> tuple[ParameterSummary, ...]:
    identified, simulation = stages.get("identifiability") or {}, stages.get("simulation") or {}
    lines = fit.get("candidates") or identified.get("candidates") or simulation.get("candidates")
    lines = lines or {n: {"given": g} for n, g in (diagnosis.get("parameters_before") or {}).items()}
    fitted, estimates = _fitted(fit), fit.get("estimates") or {}
    bounds = {n: e for n, e in estimates.items() if fitted and n not in fitted and e.get("method") == "one-sided"}
    after = diagnosis.get("parameters_after") or {} if counting.kind else {}
    later = diagnosis.get("estimates_after") or {}
    refitted = diagnosis.get("parameters_refitted") or {}
    held = fit.get("held") or {n: h.get("reason", "") for n, h in (identified.get("held") or {}).items()}
    found = []
    for name, line in lines.items():
        alone = (fit.get("values") or {}).get(name) if name in fitted else (bounds.get(name) or {}).get("value")
        by_place = tuple(
            PlacedValue(v["value"], str(v.get("unit") or ""), v["effect"], tuple(v["at"]), str(v.get("from") or ""))
            for v in (diagnosis.get("values_by_place") or {}).get(name) or ()
        )
        effect = after.get(name) if not by_place and (name in fitted or name in later or not fit) else None
        # Without a fit there are no other values than those with the effect.
        counts = effect is not None and counting.name != "fit"
        value = None if by_place else effect if counts else alone
        own = _interval(estimates.get(name)) if alone is not None else None
        with_it = _interval(later.get(name)) if effect is not None else None
        interval = None if value is None else with_it if counts else own
        bounded = value is not None and ((not counts and name in bounds) or value in (line.get("min"), line.get("max")))
        given = line.get("given")
        found.append(
            ParameterSummary(
                name, str(line.get("unit") or ""), value, interval, given, alone, own, effect, with_it,
                refitted=refitted.get(name),
                moved=_leaves_out(interval or with_it, given),
                reason="" if value is not None or by_place else str(held.get(name) or ""),
                at_bound=bounded,
                by_place=by_place,
            )
        )  # fmt: skip
    return tuple(found)


def _interval(estimate: Json | None) -> Interval | None:
    ends = (estimate or {}).get("ci95")
    return (ends[0], ends[1]) if ends else None


def _leaves_out(interval: Interval | None, given: float | None) -> bool | None:
    """Return True where an interval leaves out the given value, False where it holds it; None where there is neither."""
    low, high = interval or (None, None)
    if given is None or (low is None and high is None):
        return None
    return not (-math.inf if low is None else low) <= given <= (math.inf if high is None else high)


# --- what is missing ---


def _quantities(sizes: Json | None) -> dict[str, Quantity]:
    return {
        n: Quantity(p["value"], str(p.get("unit") or ""), _interval(p))
        for n, p in (sizes or {}).items()
        if p.get("value") is not None
    }


def _findings(diagnosis: Json) -> tuple[FindingSummary, ...]:
    own = {(e["effect"], tuple(e["at"]), e.get("from", "")): str(e["text"]) for e in diagnosis.get("effects") or ()}
    depend = diagnosis.get("values_by_place") or {}
    found = []
    for f in diagnosis.get("findings") or ():
        places = tuple(
            PlaceSummary(
                tuple(p["at"]),
                float(p.get("probability") or 0.0),
                str(p.get("from") or ""),
                _quantities(p.get("parameters")) | _quantities({n: v for n, v in p["values"].items() if n in depend})
                if depend and p.get("values")
                else {},
            )
            for p in f.get("places") or ()
        )
        at = (places[0].at, places[0].source) if places else ((), "")
        # Of a place that the values depend on, the finding's own sentence tells what each implies.
        said = "" if depend else own.get((f["effect"], *at), "")
        delay = (f.get("equivalent_delay") or {}).get("value")
        found.append(
            FindingSummary(
                f["effect"],
                tuple(f.get("same_as") or (f["effect"],)),
                (said or str(f.get("text") or "")).rstrip("."),
                float(f["probability"]),
                _quantities(f.get("parameters")),
                () if f["effect"] == "parameter" else places,
                delay,
            )
        )
    return tuple(found)


def _effects(diagnosis: Json) -> tuple[AddedEffect, ...]:
    found = []
    for e in diagnosis.get("effects") or ():
        about = (str(e.get("from") or ""), str(e.get("text") or "").rstrip("."), _quantities(e.get("parameters")))
        found.append(AddedEffect(form_of(e), tuple(e["at"]), *about, e.get("chosen_from")))
    return tuple(found)


def _rivals(diagnosis: Json) -> tuple[RivalSummary, ...]:
    """Return what the recordings cannot tell from the effects in the model, each once."""
    own = [(e["effect"], list(e["at"]), e.get("from", "")) for e in diagnosis.get("effects") or ()]
    each = [r for group in diagnosis.get("ambiguity") or () for r in group]
    others = [r for r in each if (r["effect"], list(r["at"]), r.get("from", "")) not in own]
    return tuple(dict.fromkeys(RivalSummary(form_of(r), tuple(r["at"])) for r in others))


def _late(diagnosis: Json) -> tuple[float, float] | None:
    """Return the least and the largest delay of a slow signal over the only ambiguity set, s; None where one of it has none."""
    groups = diagnosis.get("ambiguity") or ()
    late = [r.get("late") for group in groups for r in group if r.get("refitted", True)]
    if len(groups) != 1 or len(late) < 2 or any(v is None or v <= 0.0 for v in late):
        return None
    return min(late), max(late)


def _remainder(diagnosis: Json, counting: Counting) -> RemainderSummary:
    """Return what is left with the additions in the model; nothing where nothing was added."""
    more = beyond_noise(diagnosis)
    remaining = diagnosis.get("remaining") or {}
    explained = remaining.get("explained_share")
    doubt = str(diagnosis.get("doubt") or "") if counting.kind else ""
    gap = diagnosis.get("gap") or {}
    shrink = gap.get("shrink_holdout") if counting.kind else None
    against = str(gap.get("held_out") or "experiments")
    pooled = ((gap.get("pooled") or {}).get("augmented") or {}).get("holdout")
    adequate = bool(remaining.get("adequate", bool(doubt)))
    # Of a formula, a filter or a curve no more is known: the shares are those of the best of the catalogue.
    left = diagnosis.get("remainder") or {} if counting.kind == "effect" else {}
    share, held_out = (_share(left.get(k)) for k in ("share", "held_out"))
    if (left.get("p") or 0.0) >= LEVEL:
        share = None
    record = str(left.get("record") or "") if held_out is not None else ""
    times = left.get("record_units") if record else None
    at = str(left.get("at") or "") if share is not None else ""
    return RemainderSummary(
        more, adequate, explained, share, held_out, record, times, at, doubt, shrink, against, pooled
    )


def _share(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and value >= NO_SHARE else None


# --- what to do next ---


def _next(
    fit: Json, diagnosis: Json, identified: Json, parameters: tuple[ParameterSummary, ...]
) -> tuple[NextStep, ...]:
    """Return what to do, the first thing first.

    Advice on narrower intervals is of the model without an effect: it is void once one was put in, and needless where every value
    is known closely enough for any change to be told.
    """
    found = []
    if advice := _advice(diagnosis.get("separating_experiment")):
        found.append(NextStep("separate", advice))
    if diagnosis.get("augmented_model"):
        found.append(NextStep("letter"))
    if not diagnosis.get("verdict") and (fit.get("adequacy") or {}).get("verdict") == "does-not-fit":
        found.append(NextStep("diagnose"))
    own = {n: v for n, v in (identified.get("parameters") or {}).items() if not fit.get("estimates")}
    known = bool(parameters) and all(p.determined or _closely(own.get(p.name)) for p in parameters)
    if not added_to(diagnosis) and not known and (advice := _advice(identified.get("recommended_experiment"))):
        found.append(NextStep("narrow", advice))
    if fit.get("estimates") and not found:
        found.append(NextStep("export"))
    return tuple(found)


def _closely(verdict: Json | None) -> bool:
    """Return whether a parameter is known closely enough by its verdict, where no fit has run."""
    ends, value = _interval(verdict), (verdict or {}).get("value")
    return ends is not None and value is not None and narrow(value, ends)


def _advice(about: Json | None) -> str:
    """Return what to record, as a sentence; empty where nothing is advised."""
    said = str((about or {}).get("text") or "").strip().rstrip(".")
    return f"{said[:1].upper()}{said[1:]}." if said else ""


def _failures(stages: Mapping[str, Json]) -> dict[str, str]:
    """Return the reason of every stage that failed, by its name."""
    found = {n: str(s["failed"]) for n, s in ((stages.get("run") or {}).get("stages") or {}).items() if s.get("failed")}
    for name, data in stages.items():
        if data.get("status") == "failed" and data.get("stage") not in found:
            found[str(data.get("stage") or name)] = str(data.get("message", ""))
    return found
