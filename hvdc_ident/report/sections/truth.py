"""The truth beside what was found, where the recordings were made by a model that is known (`hvdc-ident demo`)."""

from __future__ import annotations

from typing import Any

from hvdc_ident.report.html import Section, estimate, number, table, table_of, text
from hvdc_ident.summary import Results, RunSummary
from hvdc_ident.summary.phrases import condition, interval_name
from hvdc_ident.summary.tables import truth_table
from hvdc_ident.text import listed


def _render(results: Results) -> str:
    truth, diagnosis = results.get("truth"), results.get("discrepancy")
    if not truth:
        return ""
    s = results.summary
    lead = f"<p>The recordings were made by {text(truth['plant'])}, so that the truth is known.</p>"
    after = any(p.effect is not None for p in s.parameters)
    told = f"<p class='small'>With the effect: {text(condition(s))}</p>" if after and condition(s) else ""
    return lead + table_of(truth_table(s, truth["parameters"])) + told + _missing(s, truth, diagnosis)


def _missing(s: RunSummary, truth: dict[str, Any], diagnosis: dict[str, Any]) -> str:
    """Return the table of delays, found and true."""
    words = interval_name(s, "effect")
    rows = []
    for f in diagnosis.get("findings") or []:
        delay = f.get("equivalent_delay") or {}
        seconds = delay.get("value")
        ends = [None if v is None else 1e3 * v for v in delay.get("ci95") or (None, None)]
        shown, interval = ("", "") if seconds is None else estimate(1e3 * seconds, None if None in ends else ends)
        rows.append([f"found: {text(f['effect'])}", shown, "" if None in ends else interval, ""])
    for d in truth["delays"]:
        rows.append([f"true, in the loop of {text(d['order'])}", number(1e3 * d["seconds"]), "", number(d["at_hz"], 3)])
    lacking = f"<p>It has further states in its {text(listed(truth['lacking']))}.</p>" if truth["lacking"] else ""
    about = (
        "<p class='small'>True delay: the phase between the open-loop transfers of both models at the frequency where that of the "
        "fitted one has the gain 1, over that frequency; from their linear models at the start values.</p>"
    )
    return lacking + (table(["missing", "delay, ms", f"{words}, ms", "at, Hz"], rows) + about if rows else "")


SECTION = Section(
    order=15,
    title="The truth",
    about="The values and delays that the recordings were made with, beside those found.",
    render=_render,
    printed=True,
)
