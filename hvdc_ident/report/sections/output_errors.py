"""The table of RMSE at the given values and after the fit, by output and experiment."""

from __future__ import annotations

from typing import Any

from hvdc_ident.report.html import number, share, table, text
from hvdc_ident.report.results import Results, Section

MOST = 36
"""Windows that are listed openly; more are folded under their count."""


def _render(results: Results) -> str:
    fit, simulation = results.get("fit"), results.get("simulation")
    after = fit.get("rmse") or {}
    before = fit.get("rmse_given") or simulation.get("rmse") or {}
    if not before and not after:
        return ""
    roles, units = results.experiments, results.units
    rows = []
    for output, line in (after or before).items():
        for name in line:
            b, a = (before.get(output) or {}).get(name), (after.get(output) or {}).get(name)
            noise = (((fit.get("noise") or {}).get(name) or {}).get(output) or {}).get("std")
            role = "held out" if (roles.get(name) or {}).get("role") == "holdout" else "fit"
            rows.append(
                [
                    text(output),
                    text(name),
                    role,
                    number(b, 3),
                    number(a, 3),
                    share(a, b),
                    number(noise, 2),
                    text(units.get(output, "")),
                ]
            )
    header = ["output", "experiment", "role", "RMSE, given values", "RMSE, fitted", "change", "noise", "unit"]
    failed = [(n, e) for n, e in roles.items() if e.get("status") == "failed"]
    told = "".join(
        f"<p>Experiment <strong>{text(n)}</strong> could not be simulated: {text(e.get('reason', ''))}</p>"
        for n, e in failed
    )
    return table(header, rows, words=(0, 1, 2, 7)) + told + _windows(fit) + _held_out(fit)


def _windows(fit: dict[str, Any]) -> str:
    """Largest, mean and mean absolute error before, during and after the event, beside the profile's limits."""
    found = fit.get("windowed_errors") or {}
    profile, units = found.get("profile") or {}, fit.get("units") or {}
    rows = []
    for output, line in (found.get("errors") or {}).items():
        for name, about in line.items():
            if about.get("event") is None:
                continue
            for window in ("before", "during", "after"):
                w = about[window]
                span = f"{number(w['from'])} … {number(w['to'])}" if w["n"] else "–"
                errors = [_error(w, kind) for kind in ("max", "mean", "mean_absolute")]
                rows.append([text(output), text(name), window, span, *errors, text(units.get(output, ""))])
    if not rows:
        return ""
    end = {a.get("end_from") for line in found["errors"].values() for a in line.values()}
    steps = " A step counts as over where its record has settled." if "settling" in end else ""
    told = (
        f"<p class='small'>Model less record. Profile <strong>{text(profile.get('name', ''))}</strong>, version "
        f"{text(profile.get('version', ''))}: {text(profile.get('title', ''))}; {text(profile.get('source', ''))}. "
        f"An error above its limit is marked with its limit.{steps} {text(profile.get('notes', ''))}</p>"
    )
    head = ["output", "experiment", "window", "s", "largest", "mean", "mean absolute", "unit"]
    listed = table(head, rows, words=(0, 1, 2, 7))
    if len(rows) > MOST:
        over = sum("<strong>" in cell for row in rows for cell in row)
        counted = f"{len(rows)} windows, {over} errors above their limits"
        listed = f"<details><summary>{counted}</summary>{listed}</details>"
    return "<h3>Before, during and after the event</h3>" + listed + told


def _error(window: dict[str, Any], kind: str) -> str:
    value, limit = window.get(kind), (window.get("limits") or {}).get(kind)
    if value is None:
        return "–"
    over = limit is not None and abs(value) > limit
    return f"<strong>{number(value, 2)} &gt; {number(limit, 2)}</strong>" if over else number(value, 2)


def _held_out(fit: dict[str, Any]) -> str:
    """Table of the errors at the estimates in experiments that were kept out of the fit."""
    rows = []
    for name, line in (fit.get("validation") or {}).items():
        if line.get("status") != "done":
            rows.append([text(name), "–", "–", "–", "–", "could not be simulated at the estimates"])
        for output, q in (line.get("outputs") or {}).items():
            band = q.get("in_band")
            note = "; ".join(
                f"{n} {number(v)} from this record itself" for n, v in (line.get("nuisance") or {}).items()
            )
            cells = [text(name), text(output), number(q["rmse"], 3), number(q.get("of_fit"), 3)]
            rows.append([*cells, f"{number(100.0 * band, 3)} %" if band is not None else "–", text(note)])
    if not rows:
        return ""
    head = ["held-out experiment", "output", "RMSE", "of the fit's", "samples in the 95 % band", "note"]
    return "<h3>Held-out experiments</h3>" + table(head, rows, words=(0, 1, 5))


SECTION = Section(order=30, title="Error before and after", render=_render)
