"""The errors of every signal, by set of values, and within the windows of the tolerance profile."""

from __future__ import annotations

from typing import Any

from hvdc_ident.report.answers import Answers, Signal
from hvdc_ident.report.html import folded, number, share, table, text
from hvdc_ident.report.results import Results, Section

NAMES = {"given": "RMSE, given values", "fitted": "RMSE, fitted", "effect": "RMSE, with the effect"}


def _render(results: Results) -> str:
    found = Answers(results)
    sets = {n: found.signals(n) for n in found.judgements}
    if not sets:
        return ""
    signals = list(dict.fromkeys(s for line in sets.values() for s in line))
    loud = [s for s in signals if not all(s in line and line[s]["follows"]["noise"] for line in sets.values())]
    rest = [s for s in signals if s not in loud]
    quiet = (
        folded(f"{len(rest)} signals on their noise", _table(results, found, rest), "With every set of values.")
        if rest
        else ""
    )
    parts = [
        _table(results, found, loud) if loud else "<p>Every signal is on its noise, with every set of values.</p>",
        quiet,
    ]
    windows = _windows(results, found)
    named = found.profile.get("named")
    return "".join([windows, *parts] if named else [*parts, windows]) + _held_out(results.get("fit"))


def _table(results: Results, found: Answers, signals: list[Signal]) -> str:
    """Table of the root mean square errors of some signals."""
    sets = {n: found.signals(n) for n in found.judgements}
    rows = []
    for output, experiment in signals:
        errors = {n: (line.get((output, experiment)) or {}).get("rmse") for n, line in sets.items()}
        role = "held out" if (results.experiments.get(experiment) or {}).get("role") == "holdout" else "fit"
        cells = [text(output), text(experiment), role, *(number(e, 3) for e in errors.values())]
        change = share(errors["fitted"], errors.get("given")) if "fitted" in errors else ""
        noise = found.noise((output, experiment))
        rows.append([*cells, change, number(noise, 2) if noise else "", text(results.units.get(output, ""))])
    header = ["output", "experiment", "role", *(NAMES[n] for n in sets), "change by the fit", "noise", "unit"]
    return table(header, rows, words=(0, 1, 2, len(header) - 1))


def _windows(results: Results, found: Answers) -> str:
    """Largest, mean and mean absolute error before, during and after the event, beside the profile's limits."""
    judged = found.judged
    profile, units = found.profile, results.units
    over: list[list[str]] = []
    rows: list[list[str]] = []
    unjudged: list[list[str]] = []
    why: list[str] = []
    ends = set()
    for (output, name), signal in found.signals(judged.name).items() if judged is not None else ():
        about = signal["windows"]
        ends.add(about.get("end_from"))
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
    steps = " A step counts as over where its record has settled." if "settling" in ends else ""
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
