"""The truth beside what was found, where the recordings were made by a model that is known (`hvdc-ident demo`)."""

from __future__ import annotations

from typing import Any

from hvdc_ident.report.answers import Answers, beyond_noise
from hvdc_ident.report.html import estimate, number, table, text
from hvdc_ident.report.results import Results, Section
from hvdc_ident.text import interval_words, listed


def _render(results: Results) -> str:
    truth, fit, diagnosis = (results.get(name) for name in ("truth", "fit", "discrepancy"))
    if not truth:
        return ""
    after = diagnosis.get("parameters_after") or {} if diagnosis.get("augmented_model") else {}
    after = {n: v for n, v in after.items() if n not in (diagnosis.get("values_by_place") or {})}
    rows = []
    for name, true in truth["parameters"].items():
        given = (fit.get("candidates") or {}).get(name) or {}
        fitted = (fit.get("estimates") or {}).get(name) or {}
        values = (given.get("given"), fitted.get("value"), after.get(name), true["value"])
        rows.append([text(name), *("" if v is None else number(v) for v in values), text(true["unit"])])
    header = ["parameter", "given", "fitted", "with the effect", "true", "unit"]
    lead = f"<p>The recordings were made by {text(truth['plant'])}, so that the truth is known.</p>"
    answers = Answers(results)
    told = f"<p class='small'>With the effect: {text(answers.condition)}</p>" if after and answers.condition else ""
    return lead + table(header, rows, words=(0, 5)) + told + _missing(truth, diagnosis)


def _missing(truth: dict[str, Any], diagnosis: dict[str, Any]) -> str:
    """Return the table of delays, found and true."""
    words = interval_words(beyond_noise=beyond_noise(diagnosis))
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
