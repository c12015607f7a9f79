"""The page of two results side by side, from the data of a comparison alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hvdc_ident.report.html import number, table, text
from hvdc_ident.report.page import document

SIDES = ("first", "second")


def comparison_page(
    data: Mapping[str, Any], texts: Sequence[Sequence[str]], input_lines: Sequence[str], conclusion: str, about: str
) -> str:
    """Return the page as HTML. texts: both fitted values of each parameter that count, with their intervals.

    input_lines: what went into both, in words. conclusion: what the values come to. about: what the unit of a distance is.
    """
    runs = data["runs"]
    rows = [
        [side, *(text(r[k]) for k in ("study", "folder", "model", "software", "seed"))]
        for side, r in zip(SIDES, runs, strict=True)
    ]
    heads = table(["", "study", "results", "model", "software", "seed"], rows, words=(0, 1, 2, 3, 4, 5))
    inputs = "<ul>" + "".join(f"<li>{text(line)}</li>" for line in input_lines) + "</ul>"
    parts = {
        "What is compared": heads + inputs,
        "Values": f"<p><strong>{text(conclusion)}</strong></p>" + _values(data["values"], texts, about)
        if data["values"]
        else "",
        "Gaps": _gaps(data["gaps"]),
        "Verdicts": _verdicts(data["verdicts"]),
        "What the model lacks": _findings(data["findings"]),
    }
    body = "\n".join(
        f"<section class='tile'>\n<h2>{title}</h2>\n{part}\n</section>" for title, part in parts.items() if part
    )
    names = [str(r["study"]) for r in runs]
    title = f"{names[0]} and {names[1]}" if names[0] != names[1] else f"{names[0]}, twice"
    return document(title, "two results side by side", body)


def _values(values: Sequence[Mapping[str, Any]], texts: Sequence[Sequence[str]], about: str) -> str:
    """Return the table of values, and what the distance in it means. texts: both fitted values with their intervals."""
    rows = []
    for v, (first, second) in zip(values, texts, strict=True):
        change = "" if v["change_percent"] is None else number(v["change_percent"], 3)
        apart = "" if v["apart"] is None else number(v["apart"], 3)
        given, before, after = (_both(v[k]) for k in ("given", "without_effect", "with_effect"))
        cells = [given, text(first), text(second), change, apart, before, after, text(v["unit"])]
        rows.append([text(v["parameter"]), *cells])
    header = ["parameter", "given", *SIDES, "change, %", "apart", "without the effect", "with the effect", "unit"]
    return table(header, rows, words=(0, 8)) + f"<p class='small'>{text(about)}</p>"


def _both(values: Sequence[float | None]) -> str:
    """One number where both are the same, else both; empty where there is none."""
    first, second = (number(v, 5) for v in values)
    if values[0] is None and values[1] is None:
        return ""
    return first if first == second else f"{first} / {second}"


def _gaps(gaps: Sequence[Mapping[str, Any]]) -> str:
    """The RMSE of each output and recording at each set of values."""
    rows = []
    for g in gaps:
        for recording, (a, b) in g["by_recording"].items():
            cells = [number(a), number(b), number(b / a, 3) if a else "–"]
            rows.append([text(g["at"]), text(g["output"]), text(recording), *cells, text(g["unit"])])
    header = ["values", "output", "recording", *(f"RMSE, {s}" for s in SIDES), "ratio", "unit"]
    return table(header, rows, words=(0, 1, 2, 6)) if rows else ""


def _verdicts(verdicts: Mapping[str, Sequence[str]]) -> str:
    rows = [[text(name), *(text(v or "has not run") for v in both)] for name, both in verdicts.items()]
    return table(["stage", *SIDES], rows, words=(0, 1, 2)) if rows else ""


def _findings(findings: Sequence[Sequence[Mapping[str, Any]] | None]) -> str:
    rows = []
    for side, found in zip(SIDES, findings, strict=True):
        for f in found or ():
            rows.append([side, text(f["effect"]), number(100.0 * f["probability"], 3), text(f["text"])])
        if found == []:
            rows.append([side, "nothing was found", "", ""])
    return table(["run", "effect", "probability, %", "in words"], rows, words=(0, 1, 3)) if rows else ""
