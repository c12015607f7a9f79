"""Section on the discrepancy of the model: the verdict, the gap before and after, how the gains move, and how sure it is."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.colours import EFFECT, RECORDED, ROLES
from hvdc_ident.discrepancy import Diagnosis
from hvdc_ident.report.drawing import figure, svg, visible
from hvdc_ident.report.html import Section, captioned, folded, number, rows_of, table_of, text, typeset
from hvdc_ident.report.overlay import Sheet
from hvdc_ident.summary import Results, RunSummary
from hvdc_ident.summary.phrases import by_place, gained_sentence
from hvdc_ident.summary.stage_results import SizeCurves
from hvdc_ident.summary.tables import findings_table
from hvdc_ident.text import capital, estimate_text, gap_text, listed, percentage, quantity, span, with_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MODELS = {"nominal": "given values", "refitted": "refitted, nothing added", "augmented": "with the effect"}
CANDIDATES_SHOWN = 12
SHOWN = 5e-3
"""A smaller share of the gap is none."""


def _render(results: Results) -> str:
    diagnosis = results.objects.diagnosis
    if diagnosis is None:
        return ""
    s = results.summary
    notes = "".join(f"<p class='small'>{text(n)}</p>" for n in diagnosis.notes)
    compared = "For specialists: what else was tried, and how far behind it is on the scale of the Bayesian information criterion (BIC)."
    return "".join(
        [
            f"<p><strong>{text(capital(diagnosis.verdict))}.</strong> {text(diagnosis.text)}</p>",
            _effects(s),
            _findings(s),
            _curve(diagnosis),
            _gap(s, diagnosis),
            _slider(results.objects.of_diagnosis.sizes),
            folded(
                "Where model and recordings differ",
                _where(s, diagnosis),
                "Signals, times, frequencies and levels of the gap.",
            ),
            folded("Hypotheses compared", _sets(diagnosis) + _candidates(diagnosis), compared),
            notes,
        ]
    )


def _curve(diagnosis: Diagnosis) -> str:
    """The curve of what has no name, where one was found."""
    other = diagnosis.fallback or {}
    if not other.get("curve"):
        return ""
    name = f"what is added to {other['at']} over {other['curve']['over']}"
    return captioned(
        svg(hidden_curve(other["at"], other["curve"]), name),
        f"{text(capital(name))}, with its 95 % band.",
    )


def _effects(s: RunSummary) -> str:
    lines = []
    depend = "; ".join(f"{p.name} is {by_place(p)}" for p in s.parameters if p.by_place)
    among = f" This is one of several that the recordings do not tell apart: {depend}." if depend else ""
    for e in s.effects:
        kept = {n: None if s.remainder.more_than_noise else q.interval for n, q in e.sizes.items()}
        sizes = [f"{n} = {estimate_text(q.value, q.unit, kept[n])}" for n, q in e.sizes.items()]
        chosen = f" Chosen from {e.chosen_from} candidates that were refitted." if e.chosen_from else ""
        lines.append(f"<li>{text(e.text)}: {typeset('; '.join(sizes))}.{text(among + chosen)}</li>")
    return f"<ul>{''.join(lines)}</ul>" if lines else ""


def _findings(s: RunSummary) -> str:
    """Return the likely effects and, apart from them, their places, with probabilities, where there is more than one of either."""
    if not s.findings or (len(s.findings) == 1 and len(s.findings[0].places) < 2):
        return ""
    return "<h3>What may be missing, and where</h3>" + table_of(findings_table(s))


def _sets(diagnosis: Diagnosis) -> str:
    parts = []
    for group in (g for g in diagnosis.ambiguity if len(g) > 1):
        late = ["" if r.late is None else quantity(r.late, "s", 3) for r in group]
        rows = [
            (r.name, ", ".join(r.at), r.source, delay, r.delta_bic)
            for r, delay in zip(group[:CANDIDATES_SHOWN], late, strict=False)
        ]
        more = f"<p class='small'>and {len(group) - CANDIDATES_SHOWN} more</p>" if len(group) > CANDIDATES_SHOWN else ""
        shown = rows_of(["effect", "at", "from", "late", "behind the best, BIC"], rows)
        parts.append(f"<h3>As good as what was put in</h3>{shown}{more}")
    return "".join(parts)


def _gap(s: RunSummary, diagnosis: Diagnosis) -> str:
    """Figure of the pooled residual before and after, and a sentence on the held-out recordings."""
    if not diagnosis.gap.pooled:
        return ""
    picture = svg(gap_bars(diagnosis.gap.pooled), "residual of the three models in noise units")
    caption = "Residual of all signals together in units of the noise, on fitted and on held-out recordings."
    gained = gained_sentence(s)
    line = f"<p>{text(gained)}</p>" if gained else ""
    note = "<p class='small'>Rows on a jump of an input are left out here: no recorder tells which side they show.</p>"
    return captioned(picture, caption) + line + note


def _slider(sizes: SizeCurves | None) -> str:
    """The curves at several sizes of the effect in one drawing, of which a slider shows one."""
    if sizes is None:
        return ""
    chosen = sizes.chosen or 0
    data = json.dumps({"labels": sizes.labels}).replace("<", "\\u003c")
    label = f"size of the effect, {sizes.effect} at {listed(sizes.at)}"
    caption = f"{text(sizes.output)} in {text(sizes.experiment)} with another size of the effect; below, recorded less simulated."
    return (
        f'<div data-sizes="1" class="screen">{captioned(_at_sizes(sizes, chosen), caption)}<p class="small"><label>{text(label)}: '
        f'<input type="range" hidden min="0" max="{len(sizes.curves) - 1}" value="{chosen}" aria-label="{text(label)}">'
        f"</label> <output>{text(sizes.labels[chosen])}</output></p>"
        f'<script type="application/json">{data}</script></div>'
    )


def _at_sizes(sizes: SizeCurves, chosen: int) -> str:
    """The drawing: recorded and simulated above, what is left below; the curves of one size are shown."""
    time, measured, unit = sizes.time, sizes.measured, sizes.output_unit
    sheet = Sheet.new(7.4, 3.6, 0.5)
    top, strip = sheet.top, sheet.strip
    top.plot(*visible(time, measured), color=RECORDED, linewidth=1.0, label="recorded")
    for k, values in enumerate(sizes.curves):
        for axes, shown in ((top, values), (strip, measured - values)):
            label = "model" if k == chosen and axes is top else None
            (line,) = axes.plot(*visible(time, shown), color=EFFECT, linewidth=1.3, label=label)
            line.set_gid(f"size-{k}-{'top' if axes is top else 'strip'}")
    top.set_ylabel(with_unit(sizes.output, unit), fontsize=8)
    strip.set_ylabel(with_unit("error", unit), fontsize=8)
    top.legend(frameon=False, fontsize=8)
    drawn = svg(sheet.figure, f"{sizes.output} in {sizes.experiment}: recorded, and the model with the effect")
    for k in range(len(sizes.curves)):
        hidden = "" if k == chosen else ' style="display: none"'
        for place in ("top", "strip"):
            drawn = drawn.replace(f'<g id="size-{k}-{place}">', f'<g class="size" data-k="{k}"{hidden}>', 1)
    return drawn


def _where(s: RunSummary, diagnosis: Diagnosis) -> str:
    place = diagnosis.location
    outputs, experiments = _shares(place.get("outputs")), _shares(place.get("experiments"))
    window, band, region = place.get("time_window"), place.get("band_hz"), place.get("region")
    parts = [f"Share of the gap by output: {outputs}; by experiment: {experiments}."] if outputs else []
    if window:
        parts.append(f"Most of it lies between {span(window['from'], window['to'], 's', 3)} after the event.")
    if band:
        parts.append(f"It shares frequencies with the inputs from {number(band[0], 3)} to {number(band[1], 3)} Hz.")
    if region:
        parts.append(
            f"It is densest where {text(region['signal'])} lies between {span(region['from'], region['to'], '', 3)}."
        )
    if s.remainder.explained is not None:
        parts.append(f"{gap_text(s.remainder.explained)} of the gap is explained.")
    return f"<p>{' '.join(parts)}</p>" if parts else ""


def _shares(shares: dict[str, float] | None) -> str:
    return ", ".join(f"{text(n)} {percentage(v)}" for n, v in list((shares or {}).items())[:5] if v >= SHOWN)


def _candidates(diagnosis: Diagnosis) -> str:
    lines = [c for c in diagnosis.candidates if c.delta_bic is not None][:CANDIDATES_SHOWN]
    if not lines:
        return ""
    rows = [(c.effect, ", ".join(c.at), c.source, c.score, c.p, c.delta_bic, c.holdout_rmse) for c in lines]
    header = ["effect", "at", "from", "score", "p", "gain in BIC", "held out, noise units"]
    note = (
        "<p class='small'>Score: how much of the residuals the effect's signature takes at its best size, in noise units "
        "squared; p: the chance of such a score anywhere from noise alone.</p>"
    )
    return "<h3>Candidates that were refitted</h3>" + rows_of(header, rows) + note


def gap_bars(pooled: Mapping[str, Mapping[str, Any]]) -> Figure:
    """The pooled residual of given gains, refitted and augmented model, on fitted and on held-out data."""
    fig = figure(7.4, 2.1, {"left": 0.08, "right": 0.99, "bottom": 0.13, "top": 0.97})
    axes = fig.subplots()
    names = [n for n in MODELS if n in pooled]
    for k, (part, label, colour) in enumerate(
        (("fit", "fitted recordings", ROLES["fit"]), ("holdout", "held-out recordings", ROLES["holdout"]))
    ):
        values = [pooled[n].get(part) for n in names]
        axes.bar(
            np.arange(len(names)) + (k - 0.5) * 0.38, [v or np.nan for v in values], 0.38, label=label, color=colour
        )
    axes.axhline(1.0, color=RECORDED, linestyle=":", linewidth=1.0, label="noise")
    axes.set_yscale("log")
    axes.set_xticks(range(len(names)), [MODELS[n] for n in names], fontsize=8)
    axes.set_ylabel("residual, in noise units", fontsize=8)
    axes.tick_params(labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=8, frameon=False)
    return fig


def hidden_curve(at: str, curve: Mapping[str, Any]) -> Figure:
    """Figure of the signal added at an insertion point, over time or over a signal, with its 95 % band where that is known."""
    fig = figure(7.4, 2.6, {"left": 0.12, "right": 0.98, "bottom": 0.2, "top": 0.97})
    axes = fig.subplots()
    x, y = np.array(curve["at"]), np.array(curve["value"])
    wide = 1.96 * np.array([np.nan if s is None else s for s in curve["std"]])
    axes.fill_between(x, y - wide, y + wide, color=EFFECT, alpha=0.25, linewidth=0.0)
    axes.plot(x, y, color=EFFECT, linewidth=1.4, marker=".", markersize=5)
    # A level that the records hardly visit has a band that would hide all others.
    known = y[np.isfinite(wide) & (wide < np.ptp(y))] if np.ptp(y) > 0 else y
    room = 0.3 * max(float(np.ptp(known)) if known.size else 0.0, 1e-12)
    if known.size:
        axes.set_ylim(float(known.min()) - room, float(known.max()) + room)
    axes.set_xlabel("time, s" if curve["over"] == "time" else str(curve["over"]))
    axes.set_ylabel(f"added to {at}")
    return fig


SECTION = Section(
    order=30,
    title="What the model lacks",
    about="The diagnosis: what is missing, how likely, where, and how much of the gap it closes.",
    render=_render,
)
