"""The first screen of the report: four answers as tiles, and the worst signal with the model's runs laid over it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from markupsafe import Markup

from hvdc_ident.fit.uncertainty import MOVED
from hvdc_ident.next_step import Door, NextStep, next_phrase, next_sentence
from hvdc_ident.report.html import badge, estimate, number, prose, rows_of, table_of, text, typeset
from hvdc_ident.report.overlay import Sheet, worst_signal
from hvdc_ident.summary import Results, RunSummary
from hvdc_ident.summary.phrases import (
    AT_BOUND,
    advice,
    by_place,
    condition,
    finding_name,
    interval_name,
    noise_sentence,
    not_judged,
    place_texts,
    remainder_sentence,
    size_text,
    values_line,
    verdict_sentence,
    which_values,
)
from hvdc_ident.summary.run_summary import FindingSummary, ParameterSummary, Quantity
from hvdc_ident.summary.tables import PLACES, sets_table
from hvdc_ident.text import capital, change_text, percentage, probability_text

ROWS = 9
"""Parameters that are shown; the section has all."""


@dataclass(frozen=True)
class Tile:
    """One answer. answer: its sentence; more: what stands below it; brief: the answer where there is room for a line or two; all HTML."""

    name: str
    title: str
    answer: str
    more: str = ""
    brief: str = ""

    @property
    def html(self) -> str:
        """The tile as HTML."""
        return _framed(self.name, self.title, f"<p class='answer'>{self.answer}</p>{self.more}")


def tiles(s: RunSummary, door: Door = "shell") -> tuple[Tile, Tile, Tile, Tile]:
    """Return verdict, values, what is missing and what to do next. door: where they are read."""
    return (
        Tile("verdict", "Does the model follow the recordings?", *_verdict(s)),
        Tile("values", "The values", *_values(s, door), brief=text(values_line(s))),
        Tile("missing", "What does the model lack?", *_missing(s, door), brief="; ".join(map(_found, s.findings))),
        Tile("next", "What to record next", _next(s, door)),
    )


def first_screen(results: Results) -> str:
    """The answers as HTML; only warnings, or "", where no recording and no parameter was asked about."""
    s = results.summary
    warnings = "".join(f"<p class='warning'>{line}</p>" for line in _warnings(results, s))
    if not s.sets and not s.parameters:
        return warnings
    verdict, values, missing, step = (tile.html for tile in tiles(s))
    figure = _framed("figure", "", _figure(results, s))
    return f"{warnings}<main class='first'>{verdict}{values}{figure}<div class='side'>{missing}{step}</div></main>"


def _framed(name: str, title: str, body: str) -> str:
    heading = f"<h2>{title}</h2>" if title else ""
    return f"<section class='tile' data-tile='{name}'>{heading}{body}</section>" if body else ""


def _warnings(results: Results, s: RunSummary) -> list[str]:
    """Stages that failed, experiments without a run, and results of an earlier state of the study."""
    unfinished = {
        data.get("stage")
        for data in results.stages.values()
        if data.get("status") == "unfinished" or "not_tried" in data
    }
    lines = [
        f"<strong>{text(n)} {'is unfinished' if n in unfinished else 'failed'}</strong>: {prose(why.rstrip('.'))}."
        for n, why in s.failures.items()
    ]
    lines += [
        f"Experiment <strong>{text(n)}</strong> could not be simulated: {prose(e.reason.rstrip('.'))}."
        for n, e in results.experiments.items()
        if e.status == "failed"
    ]
    for name, data in results.stages.items():
        if data.get("sources") != results.heading.get("sources"):
            lines.append(f"{text(name)}.json comes from an earlier state of the study: run it again.")
    return lines


def _verdict(s: RunSummary) -> tuple[str, str]:
    """The verdict, then what noise it rests on, and the errors of its worst signal with each set of values."""
    signal = s.signal(s.judged.worst) if s.judged is not None else None
    unknown = f"<p>{text(noise_sentence(s))}</p>" if s.noise_from_misfit else ""
    if signal is None:
        return text(verdict_sentence(s)), unknown
    passed = {"pass": True, "fail": False}.get(s.verdict)
    answer = f"{badge(passed)} {text(verdict_sentence(s))}" if passed is not None else text(verdict_sentence(s))
    worst = f"Worst signal: <strong>{text(signal.output)}</strong> in <strong>{text(signal.experiment)}</strong>"
    noise = f"{number(signal.noise, 2)} {text(signal.unit)}".strip() if signal.noise else ""
    worst += f", noise {noise}." if noise else ". Its noise is not known."
    return answer, f"{unknown}<p>{worst}</p>{table_of(sets_table(s))}{_basis(s)}"


def _basis(s: RunSummary) -> str:
    """One line on what the columns compare with what."""
    parts, last = [], [*s.sets.values()][-1]
    if any(one.on_noise.judged for one in s.sets.values()):
        parts.append(
            "On the noise: the error has at most twice the noise’s power, or what chance allows so few independent rows. "
            "Behind FAIL: signals that fail."
        )
        if rest := not_judged(s, last, limits=False):
            parts.append(f"On the noise, {text(rest)}.")
    windowed = next((one for one in reversed([*s.sets.values()]) if one.in_limits.judged), None)
    if s.tolerance:
        units = {x.output: x.unit for x in s.signals}
        each = ", ".join(f"{text(o)} {number(v)} {text(units.get(o, ''))}".rstrip() for o, v in s.tolerance.items())
        parts.append(f"Tolerance of the RMSE: {each}.")
    elif windowed is not None or s.profile.get("named"):
        parts.append(_windows(s))
    if (windowed is not None or s.by_limits) and (rest := not_judged(s, windowed or last, limits=True)):
        parts.append(f"In the {'tolerance' if s.tolerance else 'windows'}, {text(rest)}.")
    return f"<p class='small'>{' '.join(parts)}</p>"


def _windows(s: RunSummary) -> str:
    source = str(s.profile.get("source", "")).split(" (")[0]
    named = "named by the study" if s.profile.get("named") else "the default, for the study names none"
    name = f"profile {text(s.profile.get('name', ''))} ({text(source)})"
    return f"Windows: before, during and after the event, without its edges; {name}, {named}."


def _values(s: RunSummary, door: Door) -> tuple[str, str]:
    """Which values count, then one value of each parameter, the one that counts."""
    if not s.parameters:
        return "No parameter was to be estimated.", ""
    rows = [_value_row(p) for p in s.parameters[:ROWS]]
    beyond = len(s.parameters) - ROWS
    more = f"<p class='small'>And {beyond} more, in the section on parameters.</p>" if beyond > 0 else ""
    name = interval_name(s, "effect" if s.counting.name == "effect" else "fitted")
    header = ["parameter, unit", "given", "value", name, "change", ""]
    if not any(p.interval for p in s.parameters):  # none is given where the model lacks something
        rows = [(*row[:3], "", *row[4:]) for row in rows]
    not_fitted = prose(f"Not fitted: {next_phrase(NextStep('fit'), door)}.")
    which = " ".join(t for t in (text(which_values(s)) or not_fitted, text(condition(s))) if t)
    placed = [p for p in s.parameters if p.by_place]
    depend = "".join(f"<p>{text(p.name)} depends on the place: it is {text(by_place(p))}.</p>" for p in placed)
    return which, f"{rows_of(header, rows)}{depend}{more}{_moved(s)}"


def _value_row(p: ParameterSummary) -> tuple[Any, ...]:
    shown, interval = map(Markup, estimate(p.value, p.interval))
    name = Markup(f"<strong>{text(p.name)}</strong>" + (f", {text(p.unit)}" if p.unit else ""))
    if p.by_place:
        return name, p.given, "by place", "–", "", ""
    note = AT_BOUND if p.at_bound else "held" if p.reason else ""
    about = Markup(f"<span class='about' title='{text(p.reason)}'>{note}</span>" if note else "")
    value = Markup(f"<strong>{shown}</strong>") if p.value is not None else shown
    return name, p.given, value, interval, change_text(p.value, p.given), about


def _moved(s: RunSummary) -> str:
    """Return what a fit without the effect, or with it where the other counts, does to the parameter that the former moves most."""
    p = s.most_moved
    if p is None or p.effect is None or p.fitted is None:
        return ""
    counts = s.counting.name == "fit"
    other = p.effect if counts else p.fitted
    size = typeset(size_text(Quantity(other, p.unit, p.effect_interval if counts else p.fitted_interval)))
    size += f" ({typeset(change_text(other, p.given))})"
    if counts:
        told = f"With {text(s.counting.added)} a fit puts {text(p.name)} at {size}."
    else:
        told = f"Without it a fit would put {text(p.name)} at {size}, to make up for what is missing."
    return f"<p class='small'>{told} Changes are from the given values.</p>"


def _figure(results: Results, s: RunSummary) -> str:
    overlay = worst_signal(results, s.about, tuple(s.sets))
    if overlay is None:
        return ""
    caption = f"The worst signal, {text(overlay.output)} in {text(overlay.experiment)}; below, recorded less simulated."
    more = " The dotted line is the event." if overlay.event is not None else ""
    return overlay.figure(Sheet.new(7.6, 4.35, 0.55), caption + more, overlay.span, "worst signal, ")


def _missing(s: RunSummary, door: Door) -> tuple[str, str]:
    """The likeliest finding of the diagnosis, then the others, and what is left with them."""
    if not s.diagnosis:
        return _undiagnosed(s, door), ""
    if not s.findings:
        return f"<strong>{text(_verdict_word(s))}.</strong> {prose(s.said.rstrip('.'))}.", ""
    parts: list[str] = []
    for f in s.findings:
        told = f"{_found(f)}. {text(f.text)}."
        parts.append(f"<p class='answer'>{told}</p>" if parts else told)
        places = place_texts(f)
        if len(places) > 1:
            shown = "; ".join(f"{text(at)} ({text(probability_text(p))})" for at, p in [*places.items()][:PLACES])
            rest = f"; {len(places) - PLACES} more" if len(places) > PLACES else ""
            parts.append(f"<p>Where, by probability: {shown}{rest}.</p>")
    if left := remainder_sentence(s):
        parts.append(f"<p><strong>Not all of it:</strong> {text(left)}.</p>")
    elif s.remainder.doubt:
        parts.append(f"<p><strong>In doubt:</strong> {text(s.remainder.doubt)}.</p>")
    return parts[0], "".join(parts[1:])


def _found(f: FindingSummary) -> str:
    """Return what was found, with its probability."""
    name = finding_name(f)
    sure = f", <strong>{text(probability_text(f.probability))}</strong> likely" if f.effect != "parameter" else ""
    return f"<strong>{text(name[:1].upper() + name[1:])}</strong>{sure}"


def _verdict_word(s: RunSummary) -> str:
    verdict = s.diagnosis
    if verdict == "no-evidence" and s.noise_from_misfit:
        return "Not told by these recordings"
    return {
        "no-evidence": "Nothing that these recordings show",
        "not-excited": "Not excited",
        "unnameable": "Something without a name",
    }.get(verdict, verdict[:1].upper() + verdict[1:])


def _undiagnosed(s: RunSummary, door: Door) -> str:
    if not s.parameters:
        return "Not asked: a diagnosis needs parameters that may be fitted, in <code>[parameters]</code>."
    if s.verdict == "pass" and s.judged is not None and s.judged.on_noise.verdict:
        return "No sign of anything: what is left is noise."
    if "diagnose" in s.failures:
        return "Asked, and not answered: the line above says why."
    asked = f"Not asked{' yet' if s.verdict == 'fail' else ''}."
    if any(step.kind == "diagnose" for step in s.next) and not advice(s):  # the tile on what to do next says how
        return asked
    return prose(f"{asked} {capital(next_phrase(NextStep('diagnose'), door))}.")


def _next(s: RunSummary, door: Door) -> str:
    """Return what to record next; where nothing is advised, why, and what else to do."""
    if said := advice(s):
        return prose(said)
    if not s.parameters:
        return "No advice: there is no parameter to be determined."
    if all(p.determined for p in s.parameters):
        why = f"Nothing for the values: each is known to {percentage(MOVED)} or better."
    elif s.counting.name == "effect":
        why = "No recording is advised."
    else:
        why = s.unadvised or ("" if s.next else f"No advice yet: {next_phrase(NextStep('identify'), door)}.")
    return prose(" ".join([why, *(next_sentence(step, door) for step in s.next)]).strip())
