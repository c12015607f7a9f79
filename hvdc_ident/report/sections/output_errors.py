"""The errors of every signal, by set of values, and within the windows of the tolerance profile."""

from __future__ import annotations

from typing import Any

from hvdc_ident.fit.adequacy import MATTERS
from hvdc_ident.report.answers import Answers
from hvdc_ident.report.html import folded, number, share, table, text
from hvdc_ident.report.results import Results, Section

NAMES = {"given": "RMSE, given values", "fitted": "RMSE, fitted", "effect": "RMSE, with the effect"}


def _render(results: Results) -> str:
    found = Answers(results)
    if not found.rmse:
        return ""
    fit, windows = results.get("fit"), _windows(results)
    signals = list(dict.fromkeys((o, e) for t in found.rmse.values() for o, line in t.items() for e in line))
    loud = [s for s in signals if not _on_noise(results, found, s)]
    rest = [s for s in signals if s not in loud]
    quiet = (
        folded(f"{len(rest)} signals on their noise", _table(results, found, rest), "With every set of values.")
        if rest
        else ""
    )
    named = (fit.get("windowed_errors") or {}).get("profile", {}).get("named")
    parts = [
        _table(results, found, loud) if loud else "<p>Every signal is on its noise, with every set of values.</p>",
        quiet,
    ]
    return "".join([windows, *parts] if named else [*parts, windows]) + _held_out(fit)


def _on_noise(results: Results, found: Answers, signal: tuple[str, str]) -> bool:
    """True where the noise of a signal is known and no set of values leaves more than it."""
    output, experiment = signal
    noise = results.noise(experiment, output)
    errors = [(t.get(output) or {}).get(experiment) for t in found.rmse.values()]
    return noise is not None and all(e is not None and e**2 <= MATTERS * noise**2 for e in errors)


def _table(results: Results, found: Answers, signals: list[tuple[str, str]]) -> str:
    """Table of the root mean square errors of some signals."""
    rows = []
    for output, experiment in signals:
        errors = {n: (t.get(output) or {}).get(experiment) for n, t in found.rmse.items()}
        role = "held out" if (results.experiments.get(experiment) or {}).get("role") == "holdout" else "fit"
        cells = [text(output), text(experiment), role, *(number(e, 3) for e in errors.values())]
        change = share(errors["fitted"], errors.get("given")) if "fitted" in errors else ""
        noise = results.noise(experiment, output)
        rows.append([*cells, change, number(noise, 2) if noise else "", text(results.units.get(output, ""))])
    header = ["output", "experiment", "role", *(NAMES[n] for n in found.rmse), "change by the fit", "noise", "unit"]
    return table(header, rows, words=(0, 1, 2, len(header) - 1))


def _windows(results: Results) -> str:
    """Largest, mean and mean absolute error before, during and after the event, beside the profile's limits."""
    found = results.get("fit").get("windowed_errors") or results.get("simulation").get("windowed_errors") or {}
    profile, units = found.get("profile") or {}, results.units
    over: list[list[str]] = []
    rows: list[list[str]] = []
    unjudged: list[list[str]] = []
    why: list[str] = []
    for output, line in (found.get("errors") or {}).items():
        for name, about in line.items():
            if about.get("event") is None:
                continue
            for window in ("before", "during", "after"):
                w = about[window]
                span = f"{number(w['from'], 3)} … {number(w['to'], 3)}" if w["n"] else "–"
                errors = [_error(w, kind) for kind in ("max", "mean", "mean_absolute")]
                row = [text(output), text(name), window, span, *errors, text(units.get(output, ""))]
                {True: rows, False: over, None: unjudged}[w.get("within")].append(row)
                if w.get("within") is None:
                    why.append(f"{output}: {about.get('reason') or 'no row in this window'}")
    if not rows and not over and not unjudged:
        return ""
    end = {a.get("end_from") for line in found["errors"].values() for a in line.values()}
    steps = " A step counts as over where its record has settled." if "settling" in end else ""
    told = (
        f"<p class='small'>Model less record. Profile <strong>{text(profile.get('name', ''))}</strong>, version "
        f"{text(profile.get('version', ''))}: {text(profile.get('title', ''))}; {text(profile.get('source', ''))}. "
        f"An error above its limit is marked with its limit.{steps} {text(profile.get('notes', ''))}</p>"
    )
    head = ["output", "experiment", "window", "from … to, s", "largest", "mean", "mean absolute", "unit"]
    counted = (
        f"{len(rows)} windows within the limits, {len(over)} with an error above its limit, {len(unjudged)} not judged"
    )
    above = table(head, over, words=(0, 1, 2, 7)) if over else ""
    within = folded(f"{len(rows)} windows within the limits", table(head, rows, words=(0, 1, 2, 7))) if rows else ""
    reasons = f"<p class='small'>{text('; '.join(dict.fromkeys(why)))}.</p>"
    within += (
        folded(f"{len(unjudged)} windows not judged", table(head, unjudged, words=(0, 1, 2, 7)) + reasons)
        if unjudged
        else ""
    )
    within += told
    if profile.get("named"):
        return f"<h3>Before, during and after the event: {counted}</h3>{above}{within}"
    return folded(f"Before, during and after the event: {counted}", above + within)


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


SECTION = Section(
    order=20,
    title="Errors",
    about="The error of every signal at the given values and fitted, and within the windows of the tolerance profile.",
    render=_render,
    printed=True,
)
