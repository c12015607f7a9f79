"""The screen of a run: the verdict of each stage in a line, the values of the parameters, and what to do next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hvdc_ident.display import Table, rounded
from hvdc_ident.report.answers import values_conditional
from hvdc_ident.report.values_that_count import values_that_count
from hvdc_ident.study.pipeline import Done
from hvdc_ident.text import figures_of, interval_text, interval_words, value_by_place


def run_lines(done: Sequence[Done], truth: Sequence[str] = ()) -> list[str]:
    """Return the screen of a run: for each stage its state and verdict, then the values, then what to do next.

    truth: lines that hold the values beside the true ones, where these are known.
    """
    found = {d.stage.name: d.data for d in done if not d.failed}
    notes = dict.fromkeys(line for d in done for line in d.data.get("steady_state", ()))
    lines = [f"steady state, {line}" for line in notes]
    for d in done:
        state = "failed" if d.failed else "done" if d.fresh else "kept from before"
        verdict = d.failed or d.stage.verdict(d.data)
        lines.append(f"{d.stage.name}: {state}; {verdict}" if verdict else f"{d.stage.name}: {state}")
    table = values_table(found.get("fit", {}), found.get("diagnose", {}))
    lines += ["", *truth] if truth else ["", *str(table).splitlines()] if table.rows else []
    lines += conditions(found.get("fit", {}), found.get("diagnose", {})) if table.rows and not truth else []
    counting = counting_line(found.get("fit", {}), found.get("diagnose", {}))
    lines += [counting] if counting and table.rows else []
    following = next_step(found)
    return [*lines, "", following] if following else lines


def values_table(fit: Mapping[str, Any], diagnosis: Mapping[str, Any]) -> Table:
    """Return the candidates with their given and fitted values, the interval, and the value beside the missing effect."""
    after = diagnosis.get("parameters_after", {}) if diagnosis.get("augmented_model") else {}
    depend = diagnosis.get("values_by_place") or {}
    rows = []
    for name, c in fit.get("candidates", {}).items():
        e = fit["estimates"].get(name) or {}
        held = "" if e else f"held, {fit['held'].get(name, 'not fitted').split(':')[0]}"
        value = (
            rounded(e.get("value"), figures_of(e.get("ci95"), 5)),
            interval_text(e.get("ci95")) or held,
            value_by_place(depend[name]) if depend.get(name) else rounded(after.get(name), 5),
        )
        rows.append((name, c["unit"], rounded(c["given"], 6), *value))
    words = interval_words(beyond_noise=values_conditional(fit, diagnosis, effect=False))
    header = ("parameter", "unit", "given", "fitted", words, "with the effect")
    return Table(header, tuple(rows)).without_empty() if rows else Table(header, ())


def conditions(fit: Mapping[str, Any], diagnosis: Mapping[str, Any]) -> list[str]:
    """Return what the values that count rest on, as a line; none where what is left is noise."""
    effect = values_that_count(fit, diagnosis).name == "effect"
    if not fit.get("estimates") or not values_conditional(fit, diagnosis, effect=effect):
        return []
    which = "The values with the effect" if effect else "The fitted values"
    return [f"{which} hold only if nothing else is missing: what remains is more than the noise."]


def counting_line(fit: Mapping[str, Any], diagnosis: Mapping[str, Any]) -> str:
    """Return which of the fitted values count, in a sentence; empty where there is only one set of them."""
    counts = values_that_count(fit, diagnosis)
    if counts.name == "effect":
        return (
            f"The values that count are those with {counts.added}: fitted-values.* and `hvdc-ident export` take them."
        )
    if counts.name == "fit" and counts.doubt:
        with_it = f" --values effect takes those with {counts.added}." if counts.added else ""
        return f"fitted-values.* and `hvdc-ident export` take the values of the fit without an effect: {counts.doubt}.{with_it}"
    return ""


def next_step(found: Mapping[str, Mapping[str, Any]]) -> str:
    """Return what to do next by the results of the stages, by name: measure, diagnose, or export the values."""
    diagnosis, fit, judged = (found.get(n, {}) for n in ("diagnose", "fit", "identify"))
    if advice := (diagnosis.get("separating_experiment") or {}).get("text"):
        return f"Measure next: {advice.rstrip('.')}."
    if diagnosis.get("augmented_model"):
        return "Next: `hvdc-ident letter STUDY` writes one page on this for the model's owner."
    adequacy = fit.get("adequacy") or {}
    if adequacy.get("verdict") == "does-not-fit" and not diagnosis:
        return f"Next: {adequacy['next']}"
    if advice := (judged.get("recommended_experiment") or {}).get("text"):
        return f"Measure next: {advice}"
    if fit.get("estimates"):
        return "Next: `hvdc-ident export STUDY --to FILE` writes the model with the fitted values (.fmu, .mo, .toml)."
    return ""
