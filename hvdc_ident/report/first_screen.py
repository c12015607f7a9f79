"""The first screen of the report: four answers as tiles, and the worst signal with the model's runs laid over it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hvdc_ident.fit.judgement import Count
from hvdc_ident.report.answers import AT_BOUND, Answers, Errors, Value
from hvdc_ident.report.html import badge, estimate, number, percent, prose, rough, share, table, text
from hvdc_ident.report.overlay import WORDS, Sheet
from hvdc_ident.report.results import Results

PLACES = 4
"""Likely places that are shown of each finding."""
ROWS = 9
"""Parameters that are shown; the section has all."""


def first_screen(results: Results) -> str:
    """The answers as HTML; only warnings, or "", where no recording and no parameter was asked about."""
    found = Answers(results)
    warnings = "".join(f"<p class='warning'>{line}</p>" for line in _warnings(results, found))
    if not found.errors and not found.values:
        return warnings
    side = f"{_tile('missing', 'What does the model lack?', _missing(found))}{_tile('next', 'What to record next', _next(found))}"
    return (
        f"{warnings}<main class='first'>{_tile('verdict', 'Does the model follow the recordings?', _verdict(found))}"
        f"{_tile('values', 'The values', _values(found))}"
        f"{_tile('figure', '', _figure(found))}<div class='side'>{side}</div></main>"
    )


def _tile(name: str, title: str, body: str) -> str:
    heading = f"<h2>{title}</h2>" if title else ""
    return f"<section class='tile' data-tile='{name}'>{heading}{body}</section>" if body else ""


def _warnings(results: Results, found: Answers) -> list[str]:
    """Stages that failed, experiments without a run, and results of an earlier state of the study."""
    lines = [f"<strong>{text(n)} failed</strong>: {prose(why.rstrip('.'))}." for n, why in found.failures.items()]
    lines += [
        f"Experiment <strong>{text(n)}</strong> could not be simulated: {prose(str(e.get('reason', '')).rstrip('.'))}."
        for n, e in results.experiments.items()
        if e.get("status") == "failed"
    ]
    for name, data in results.stages.items():
        if data.get("sources") != results.heading.get("sources"):
            lines.append(f"{text(name)}.json comes from an earlier state of the study: run it again.")
    return lines


def _verdict(found: Answers) -> str:
    """The verdict on the worst signal, then its errors with each set of values."""
    if not found.errors or found.worst is None or found.judged is None:
        return "<p class='answer'>No recording was compared with the model.</p>"
    output, experiment = found.worst
    unit = str(found.results.units.get(output, ""))
    noise = found.noise(found.worst)
    in_unit = f", {text(unit)}" if unit else ""
    limit = "study’s tolerance" if found.tolerance else "windows"
    rows = [
        [
            text(WORDS[e.name]),
            rough(e.rmse),
            rough(e.times) if e.times is not None else "",
            rough(e.peak) if e.peak is not None else "",
            _counted(e.on_noise) if e.on_noise.judged else "",
            _counted(e.in_limits) if e.in_limits.judged or found.by_tolerance else "",
        ]
        for e in found.errors
    ]
    header = ["", f"RMSE{in_unit}", "× noise", f"peak{in_unit}", "on the noise", f"in the {limit}"]
    worst = f"Worst signal: <strong>{text(output)}</strong> in <strong>{text(experiment)}</strong>"
    worst += f", noise {f'{number(noise, 2)} {text(unit)}'.strip()}." if noise else ". Its noise is not known."
    return f"<p class='answer'>{_sentence(found, found.judged)}</p><p>{worst}</p>{table(header, rows, words=(0, 4, 5))}{_basis(found)}"


def _counted(count: Count) -> str:
    """A badge with the number of signals behind it, where it is not all of them, and the number of those that are not judged."""
    parts = []
    if count.failed:
        parts.append(f"{badge(False)} {count.failed} of {count.judged}")
    elif count.judged:
        parts.append(badge(True) + (f" {count.judged}" if count.not_judged else ""))
    return ", ".join([*parts, *([f"not judged {count.not_judged}"] if count.not_judged else [])])


def _sentence(found: Answers, judged: Errors) -> str:
    which = "The fitted model" if judged.name == "fitted" else "The model with its given values"
    held = judged.by_limits
    count = judged.deciding.judged
    if not count:
        return f"{which} is not judged: neither the noise of the recordings nor a tolerance is known."
    if not judged.deciding.failed:
        rest = text(found.not_judged(judged, limits=held))
        signals = f"the {count} signal{'s' if count > 1 else ''} that {'are' if count > 1 else 'is'} judged"
        if held:
            kind = f"keeps the tolerance in {signals}; {rest}" if rest else "keeps the tolerance"
        else:
            kind = f"follows {signals} to the noise; {rest}" if rest else "follows every recorded signal to its noise"
        return f"{badge(True) if not rest else ''} {which} {kind}.".strip()
    kind = "does not keep the tolerance" if held else "does not follow the recordings to their noise"
    completed = next((e for e in found.errors if e.name == "effect"), None)
    mended = ""
    if completed is not None:
        after = completed.in_limits if held else completed.on_noise
        some = ", where it is judged" if after.not_judged else ""
        mended = f"; with the effect it does{some}" if after.passed and not after.failed else ""
    return f"{badge(False)} {which} {kind}{mended}."


def _basis(found: Answers) -> str:
    """One line on what the columns compare with what."""
    parts = []
    if any(e.on_noise.judged for e in found.errors):
        parts.append(
            "On the noise: the error has at most twice the noise’s power, or what chance allows so few independent rows. "
            "Behind FAIL: signals that fail."
        )
        if rest := found.not_judged(found.errors[-1], limits=False):
            parts.append(f"On the noise, {text(rest)}.")
    if found.tolerance:
        each = ", ".join(
            f"{text(o)} {number(v)} {text(found.results.units.get(o, ''))}".rstrip() for o, v in found.tolerance.items()
        )
        parts.append(f"Tolerance of the RMSE: {each}.")
    elif any(e.in_limits.judged for e in found.errors) or found.profile.get("named"):
        parts.append(_windows(found.profile))
    if found.tolerance or found.profile:
        windowed = next((e for e in reversed(found.errors) if e.in_limits.judged), found.errors[-1])
        if (windowed.in_limits.judged or found.by_tolerance) and (rest := found.not_judged(windowed, limits=True)):
            parts.append(f"In the {'tolerance' if found.tolerance else 'windows'}, {text(rest)}.")
    return f"<p class='small'>{' '.join(parts)}</p>"


def _windows(profile: Mapping[str, Any]) -> str:
    source = str(profile.get("source", "")).split(" (")[0]
    named = "named by the study" if profile.get("named") else "the default, for the study names none"
    name = f"profile {text(profile.get('name', ''))} ({text(source)})"
    return f"Windows: before, during and after the event, without its edges; {name}, {named}."


def _values(found: Answers) -> str:
    """One value of each parameter, the one that counts."""
    if not found.values:
        return "<p class='answer'>No parameter was to be estimated.</p>"
    rows = [_value_row(v) for v in found.values[:ROWS]]
    more = (
        f"<p class='small'>And {len(found.values) - ROWS} more, in the section on parameters.</p>"
        if len(found.values) > ROWS
        else ""
    )
    effect = found.counting.name == "effect"
    header = ["parameter, unit", "given", "value", found.interval_words(effect=effect), "change", ""]
    if not any(v.interval for v in found.values):  # none is given where the model lacks something
        header, rows = [header[k] for k in (0, 1, 2, 4, 5)], [[row[k] for k in (0, 1, 2, 4, 5)] for row in rows]
    which = " ".join(s for s in (_which(found), found.condition if found.fitted or effect else "") if s)
    depend = "".join(
        f"<p>{text(v.name)} depends on the place: it is {text(v.by_place)}.</p>" for v in found.values if v.by_place
    )
    return (
        f"<p class='answer'>{which}</p>{table(header, rows, words=(0, len(header) - 1))}{depend}{more}{_moved(found)}"
    )


def _value_row(v: Value) -> list[str]:
    shown, interval = estimate(v.value, v.interval)
    note = AT_BOUND if v.note == AT_BOUND else "held" if v.note else ""
    name = f"<strong>{text(v.name)}</strong>" + (f", {text(v.unit)}" if v.unit else "")
    if v.by_place:
        return [name, number(v.given), "by place", "–", "", ""]
    return [
        name,
        number(v.given),
        f"<strong>{shown}</strong>" if v.value is not None else "–",
        interval if v.value is not None else "–",
        share(v.value, v.given) if v.value is not None else "",
        f"<span class='about' title='{text(v.note)}'>{note}</span>" if note else "",
    ]


def _which(found: Answers) -> str:
    """Which values these are."""
    if found.counting.name == "fit" and found.counting.doubt:
        return f"Fitted without an effect: {text(found.counting.doubt)}. They may make up for what is missing."
    if found.added and any(v.effect is not None or v.by_place for v in found.values):
        kind = "" if found.added == "effect" else f" ({found.added})"
        return f"Fitted together with what the model lacks{kind}."
    if found.fitted:
        return "Fitted; the model has no effect added."
    if found.fit:
        return "The fit has no estimates: the model keeps its given values."
    return "Not fitted: <code>hvdc-ident fit STUDY</code> estimates them."


def _moved(found: Answers) -> str:
    """Return what a fit without the effect, or with it where the other counts, does to the parameter that the former moves most."""
    moved = {v.name: v for v in found.values if v.effect is not None and v.fitted is not None and v.given}
    if not moved:
        return ""
    most = max(moved.values(), key=lambda v: abs((v.fitted or 0.0) / (v.given or 1.0) - 1.0))
    if found.counting.name == "fit":
        return (
            f"<p class='small'>With {text(found.counting.added)} a fit puts {text(most.name)} at {number(most.effect, 4)} "
            f"{text(most.unit)} ({share(most.effect, most.given)}). Changes are from the given values.</p>"
        )
    return (
        f"<p class='small'>Without it a fit would put {text(most.name)} at {number(most.fitted, 3)} {text(most.unit)} "
        f"({share(most.fitted, most.given)}), to make up for what is missing. Changes are from the given values.</p>"
    )


def _figure(found: Answers) -> str:
    overlay = found.overlay
    if overlay is None:
        return ""
    caption = f"The worst signal, {text(overlay.output)} in {text(overlay.experiment)}; below, recorded less simulated."
    more = " The dotted line is the event." if overlay.event is not None else ""
    return overlay.figure(Sheet.new(7.6, 4.35, 0.55), caption + more, overlay.span, "worst signal, ")


def _missing(found: Answers) -> str:
    """The findings of the diagnosis, and what is left with them."""
    diagnosis = found.diagnosis
    if "verdict" not in diagnosis:
        return _undiagnosed(found)
    if not found.missing:
        said = str(diagnosis.get("text", "")).rstrip(".")
        return (
            f"<p class='answer'><strong>{text(_verdict_word(str(diagnosis['verdict'])))}.</strong> {prose(said)}.</p>"
        )
    parts = []
    for f in found.missing:
        sure = f", <strong>{percent(f.probability)}</strong> likely" if f.name != "parameter" else ""
        parts.append(f"<p class='answer'>{_named(f.name)}{sure}. {text(f.text)}.</p>")
        if len(f.places) > 1:
            shown = "; ".join(f"{text(at)} ({percent(p)})" for at, p in f.places[:PLACES])
            rest = f"; {len(f.places) - PLACES} more" if len(f.places) > PLACES else ""
            parts.append(f"<p>Where, by probability: {shown}{rest}.</p>")
    if found.remainder:
        parts.append(f"<p><strong>Not all of it:</strong> {text(found.remainder)}.</p>")
    elif found.doubt:
        parts.append(f"<p><strong>In doubt:</strong> {text(found.doubt)}.</p>")
    return "".join(parts)


def _named(name: str) -> str:
    return (
        "<strong>Values that are off</strong>"
        if name == "parameter"
        else f"<strong>{text(name[:1].upper() + name[1:])}</strong>"
    )


def _verdict_word(verdict: str) -> str:
    return {
        "no-evidence": "Nothing that these recordings show",
        "not-excited": "Not excited",
        "unnameable": "Something without a name",
    }.get(verdict, verdict[:1].upper() + verdict[1:])


def _undiagnosed(found: Answers) -> str:
    if not found.values:
        return "<p class='answer'>Not asked: a diagnosis needs parameters that may be fitted, in <code>[parameters]</code>.</p>"
    command = "<code>hvdc-ident diagnose STUDY</code> looks for what is missing."
    if found.follows is False:
        return f"<p class='answer'>Not asked yet. {command}</p>"
    if found.follows is True and found.judged is not None and found.judged.on_noise.verdict:
        return "<p class='answer'>No sign of anything: what is left is noise.</p>"
    return f"<p class='answer'>Not asked. {command}</p>"


def _next(found: Answers) -> str:
    if found.next:
        return f"<p class='answer'>{prose(found.next)}</p>"
    if not found.values:
        return "<p class='answer'>No advice: there is no parameter to be determined.</p>"
    if found.follows and all(not v.note for v in found.values):
        return "<p class='answer'>Nothing: the values are determined and the model follows.</p>"
    return "<p class='answer'>No advice yet: <code>hvdc-ident identify STUDY</code> says which recording would tell more.</p>"
