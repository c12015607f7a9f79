"""Section on the discrepancy of the model: the verdict, the gap before and after, how the gains move, and how sure it is."""

from __future__ import annotations

from typing import Any

from hvdc_ident.report.discrepancy import bode, gap_bars, hidden_curve
from hvdc_ident.report.drawing import svg
from hvdc_ident.report.html import number, share, table, text
from hvdc_ident.report.results import Results
from hvdc_ident.report.section import Section
from hvdc_ident.words import form_of, span

MOST = 12
SHOWN = 5e-3
"""A smaller share of the gap is none."""


def _render(results: Results) -> str:
    found = results.get("discrepancy")
    if not found.get("verdict"):
        return ""
    units = {**(results.get("simulation").get("units") or {}), **(results.get("fit").get("units") or {})}
    parts = [
        _lead(found),
        _effects(found),
        _curve(found),
        _sets(found),
        _gap(found, units),
        _gains(found),
        _where(found),
        _candidates(found),
    ]
    notes = "".join(f"<p class='small'>{text(n)}</p>" for n in found.get("notes") or [])
    return "".join(parts) + notes


def _lead(found: dict[str, Any]) -> str:
    verdict = str(found["verdict"])
    return f"<p><strong>{text(verdict[:1].upper() + verdict[1:])}.</strong> {text(found.get('text', ''))}</p>"


def _curve(found: dict[str, Any]) -> str:
    """The curve of what has no name, where one was found."""
    other = found.get("fallback") or {}
    if not other.get("curve"):
        return ""
    name = f"what is added to {other['at']} over {other['curve']['over']}"
    return f"<figure>{svg(hidden_curve(other['at'], other['curve']), name)}</figure>"


def _effects(found: dict[str, Any]) -> str:
    lines = []
    for e in found.get("effects") or []:
        sizes = []
        for name, p in (e.get("parameters") or {}).items():
            low, high = p.get("ci95") or (None, None)
            interval = f" (95 %: {number(low)} … {number(high)})" if p.get("ci95") else ""
            size = f"{text(name)} = {number(p.get('value'))}{interval} {text(p.get('unit') or '')}"
            sizes.append(size.rstrip())
        among = f"Chosen from {text(e.get('chosen_from'))} candidates that were refitted."
        lines.append(f"<li>{text(str(e.get('text', '')).rstrip('.'))}: {'; '.join(sizes)}. {among}</li>")
    return f"<ul>{''.join(lines)}</ul>" if lines else ""


def _sets(found: dict[str, Any]) -> str:
    parts = []
    for group in (g for g in found.get("ambiguity") or [] if len(g) > 1):
        rows = [
            [
                text(form_of(r)),
                text(", ".join(r["at"])),
                text(r.get("from", "")),
                "" if r.get("late") is None else number(1e3 * r["late"], 3),
                number(r["delta_bic"], 3),
            ]
            for r in group[:MOST]
        ]
        more = f"<p class='small'>and {len(group) - MOST} more</p>" if len(group) > MOST else ""
        parts.append(
            "<h3>As good as what was put in</h3>"
            + table(["effect", "at", "from", "late, ms", "behind the best, BIC"], rows, words=(0, 1, 2))
            + more
        )
    advice = (found.get("separating_experiment") or {}).get("text")
    told = f"<p><strong>What to measure.</strong> {text(advice.rstrip('.'))}.</p>" if advice else ""
    return "".join(parts) + told


def _gap(found: dict[str, Any], units: dict[str, Any]) -> str:
    gap = found.get("gap") or {}
    if not gap.get("pooled"):
        return ""
    picture = svg(gap_bars(gap["pooled"]), "residual of the three models in noise units")
    rows = []
    for part in ("fit", "holdout"):
        for output, line in (gap.get("refitted") or {}).get(part, {}).items():
            for experiment in line:
                values = [
                    ((gap.get(m) or {}).get(part, {}).get(output) or {}).get(experiment)
                    for m in ("nominal", "refitted", "augmented")
                ]
                floor = (gap.get("noise_floor") or {}).get(output)
                errors = [number(v, 3) for v in (*values, floor)]
                role = "held out" if part == "holdout" else part
                rows.append([text(output), text(experiment), role, *errors, text(units.get(output, ""))])
    header = ["output", "experiment", "role", "given gains", "refitted", "with effect", "noise", "unit"]
    shrink = gap.get("shrink_holdout")
    line = (
        f"<p>Held out, the gap shrinks by {100 * shrink:.1f} %.</p>"
        if shrink is not None and (found.get("augmented_model") or found.get("effects"))
        else ""
    )
    frequency = [c for c in found.get("bode") or [] if c.get("omega")]
    second = svg(bode(frequency), "frequency responses of model and record") if frequency else ""
    listed = table(header, rows, words=(0, 1, 2, 7))
    note = "<p class='small'>Rows on a jump of an input are left out here: no recorder tells which side they show.</p>"
    told = f"<h3>Before and after (RMSE)</h3><figure>{picture}</figure>{line}{listed}{note}"
    return f"{told}<figure>{second}</figure>" if second else told


def _gains(found: dict[str, Any]) -> str:
    before, middle, after = (found.get(f"parameters_{k}") or {} for k in ("before", "refitted", "after"))
    if not after:
        return ""
    rows = [
        [
            text(n),
            number(before.get(n), 5),
            number(middle.get(n), 5),
            number(after[n], 5),
            share(after[n], middle.get(n)),
        ]
        for n in after
    ]
    return "<h3>How the parameters move</h3>" + table(["parameter", "given", "refitted", "with effect", "change"], rows)


def _where(found: dict[str, Any]) -> str:
    place, left = found.get("location") or {}, found.get("remaining") or {}
    outputs, experiments = _shares(place.get("outputs")), _shares(place.get("experiments"))
    window, band, region = place.get("time_window"), place.get("band_hz"), place.get("region")
    parts = [f"Share of the gap by output: {outputs}; by experiment: {experiments}."] if outputs else []
    if window:
        parts.append(f"Most of it lies between {span(window['from'], window['to'], 's', 3)} after the event.")
    if band:
        parts.append(f"It shares frequencies with the inputs from {number(band[0], 3)} to {number(band[1], 3)} Hz.")
    if region:
        ends = f"{number(region['from'], 3)} and {number(region['to'], 3)}"
        parts.append(f"It is densest where {text(region['signal'])} lies between {ends}.")
    if slots := place.get("slots"):
        listed = ", ".join(f"{text(n)} {100 * min(v, 1.0):.0f} %" for n, v in slots.items())
        parts.append(f"An effect at one slot could make good of it at most: {listed}.")
    explained, rest = left.get("explained_share"), "noise" if left.get("adequate") else "not all noise"
    if explained is not None:
        parts.append(f"{100 * explained:.1f} % of the gap is explained; what is left is {rest}.")
    elif left:
        parts.append(f"What is left is {rest}.")
    if not parts:
        return ""
    return "<h3>Where model and data differ</h3><p>" + " ".join(parts) + "</p>"


def _shares(found: dict[str, float] | None) -> str:
    return ", ".join(f"{text(n)} {100 * v:.0f} %" for n, v in list((found or {}).items())[:5] if v >= SHOWN)


def _candidates(found: dict[str, Any]) -> str:
    lines = [c for c in found.get("candidates") or [] if c.get("delta_bic") is not None][:MOST]
    if not lines:
        return ""
    rows = [
        [
            text(c["effect"]),
            text(", ".join(c["at"])),
            text(c.get("from", "")),
            number(c["score"], 3),
            number(c["p"], 2),
            number(c["delta_bic"], 4),
            number(c.get("holdout_rmse"), 4),
        ]
        for c in lines
    ]
    header = ["effect", "at", "from", "score", "p", "gain in BIC", "held out, noise units"]
    note = (
        "<p class='small'>Score: how much of the residuals the effect's signature takes at its best size, in noise units "
        "squared; p: the chance of such a score anywhere from noise alone.</p>"
    )
    return "<h3>Candidates that were refitted</h3>" + table(header, rows, words=(0, 1, 2)) + note


SECTION = Section(order=25, title="What the model lacks", render=_render)
