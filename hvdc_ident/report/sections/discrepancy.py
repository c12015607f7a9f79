"""What the model lacks: the verdict, the gap before and after, how the gains move, and how sure it is."""

from __future__ import annotations

from typing import Any

from hvdc_ident.report.discrepancy import bode, gap_bars
from hvdc_ident.report.drawing import svg
from hvdc_ident.report.html import number, share, table, text
from hvdc_ident.report.results import Results
from hvdc_ident.report.section import Section

MOST = 12


def _render(results: Results) -> str:
    found = results.get("discrepancy")
    if not found.get("verdict"):
        return ""
    parts = [_lead(found), _effects(found), _sets(found), _gap(found), _gains(found), _where(found), _candidates(found)]
    notes = "".join(f"<p class='small'>{text(n)}</p>" for n in found.get("notes") or [])
    return "".join(parts) + notes


def _lead(found: dict[str, Any]) -> str:
    return f"<p><strong>{text(found['verdict'])}</strong>. {text(found.get('text', ''))}</p>"


def _effects(found: dict[str, Any]) -> str:
    lines = []
    for e in found.get("effects") or []:
        sizes = []
        for name, p in (e.get("parameters") or {}).items():
            low, high = p.get("ci95") or (None, None)
            interval = f" (95 %: {number(low)} … {number(high)})" if p.get("ci95") else ""
            sizes.append(f"{text(name)} = {number(p.get('value'))} {text(p.get('unit') or '')}{interval}")
        lines.append(
            f"<li>{text(e.get('text', ''))}: {'; '.join(sizes)}; chosen from {text(e.get('chosen_from'))}.</li>"
        )
    return f"<ul>{''.join(lines)}</ul>" if lines else ""


def _sets(found: dict[str, Any]) -> str:
    parts = []
    for group in found.get("ambiguity") or []:
        rows = [
            [text(r["effect"]), text(", ".join(r["at"])), text(r.get("from", "")), number(r["delta_bic"], 3)]
            for r in group[:MOST]
        ]
        more = f"<p class='small'>and {len(group) - MOST} more</p>" if len(group) > MOST else ""
        parts.append(
            "<h3>As good as what was put in</h3>"
            + table(["effect", "at", "from", "ΔBIC"], rows, words=(0, 1, 2))
            + more
        )
    advice = (found.get("separating_experiment") or {}).get("text")
    return "".join(parts) + (f"<p><strong>What to measure.</strong> {text(advice)}</p>" if advice else "")


def _gap(found: dict[str, Any]) -> str:
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
                rows.append([text(output), text(experiment), text(part), *(number(v, 3) for v in (*values, floor))])
    header = ["output", "experiment", "role", "given gains", "refitted", "with effect", "noise"]
    shrink = gap.get("shrink_holdout")
    line = (
        f"<p>Held out, the gap shrinks by {100 * shrink:.1f} %.</p>"
        if shrink is not None and (found.get("augmented_model") or found.get("effects"))
        else ""
    )
    frequency = [c for c in found.get("bode") or [] if c.get("omega")]
    second = svg(bode(frequency), "frequency responses of model and record") if frequency else ""
    errors = table(header, rows, words=(0, 1, 2))
    return f"<h3>Before and after (RMSE)</h3><figure>{picture}</figure>{line}{errors}<figure>{second}</figure>"


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
    outputs = ", ".join(f"{text(n)} {100 * v:.0f} %" for n, v in list((place.get("outputs") or {}).items())[:5])
    experiments = ", ".join(f"{text(n)} {100 * v:.0f} %" for n, v in list((place.get("experiments") or {}).items())[:5])
    window, band, region = place.get("time_window"), place.get("band_hz"), place.get("region")
    parts = [f"Share of the gap by output: {outputs}; by experiment: {experiments}."]
    if window:
        parts.append(f"Most of it lies between {number(window['from'])} and {number(window['to'])} s from the event.")
    if band:
        parts.append(f"Band shared with the inputs: {number(band[0], 3)} to {number(band[1], 3)} Hz.")
    if region:
        parts.append(
            f"Densest where {text(region['signal'])} is in {number(region['from'], 3)} … {number(region['to'], 3)}."
        )
    rest = "noise" if left.get("adequate") else "not all noise"
    explained = left.get("explained_share")
    parts.append(
        f"What is left is {rest}"
        + (f"; {100 * explained:.1f} % of the gap is explained." if explained is not None else ".")
    )
    return "<h3>Where model and data differ</h3><p>" + " ".join(parts) + "</p>"


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
    header = ["effect", "at", "from", "score", "p", "gain in BIC", "held out"]
    return "<h3>Candidates that were refitted</h3>" + table(header, rows, words=(0, 1, 2))


SECTION = Section(order=25, title="What the model lacks", render=_render)
