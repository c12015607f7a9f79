"""The parameters: every value by its name, the outcome of the fit, and what specialists ask of its estimates."""

from __future__ import annotations

from typing import Any

from hvdc_ident.report.html import Section, estimate, folded, number, table, text, typeset
from hvdc_ident.summary import Results
from hvdc_ident.summary.phrases import by_place, interval_name, remarks
from hvdc_ident.text import change_text, interval_words


def _render(results: Results) -> str:
    fit = results.get("fit")
    candidates = fit.get("candidates") or {}
    if not candidates:
        return ""
    held = fit.get("held") or {}
    fixed = [n for n in held if n not in candidates]
    rest = f"<p class='small'>Not candidates, at the model's values: {text(', '.join(fixed))}.</p>" if fixed else ""
    return _outcome(fit) + _by_name(results, fit) + _weights(fit) + rest + _more(fit)


def _by_name(results: Results, fit: dict[str, Any]) -> str:
    """Table of every value that a parameter has, each column with its name."""
    s = results.summary
    rows = []
    for p in s.parameters:
        fitted, interval = estimate(p.fitted, p.fitted_interval)
        after, later = estimate(p.effect, p.effect_interval) if p.effect is not None else (text(by_place(p)), "")
        rows.append(
            [
                f"<strong>{text(p.name)}</strong>",
                number(p.given),
                fitted,
                interval,
                typeset(change_text(p.fitted, p.given)),
                number(p.refitted) if p.effect is not None or p.by_place else "",
                after,
                later,
                typeset(change_text(p.effect, p.given)),
                text(p.unit),
            ]
        )
    header = ["parameter", "given", "fitted", interval_name(s, "fitted"), "change", "refitted by the diagnosis"]
    header += ["with the effect", interval_name(s, "effect"), "change", "unit"]
    if s.counting.name == "effect":
        counting = "these are the values that count"
    else:
        counting = f"{text(s.counting.doubt)}, so exports take the fitted ones unless --values effect asks for these"
    conditions = ", if nothing else is missing: what remains is more than the noise" if s.counts_conditional else ""
    told = (
        "<p class='small'>Refitted by the diagnosis: all at once to the fitted recordings, with nothing added to the model. With the "
        f"effect: the same with the finding in the model; {counting}{conditions}.</p>"
    )
    words = (0, 6, 9) if any(p.by_place for p in s.parameters) else (0, 9)
    return table(header, rows, words=words) + (told if s.counting.kind else "") + _notes(fit)


def _notes(fit: dict[str, Any]) -> str:
    """Why parameters are held, and on what the intervals rest."""
    lines = "".join(f"<li><strong>{text(n)}</strong>: {text(said)}.</li>" for n, said in remarks(fit).items())
    return f"<ul class='small'>{lines}</ul>" if lines else ""


STATUS = {
    "converged": "The fit converged",
    "at-bound": "The fit ended on a bound",
    "two-optima": "The fit found two optima that are as good: neither is the answer by itself",
    "not-converged": "The fit did not converge: its numbers are no estimates",
    "failed": "The fit failed",
}


def _outcome(fit: dict[str, Any]) -> str:
    """Paragraph on the status of the fit."""
    status = str(fit.get("status", ""))
    judged = fit.get("adequacy") or {}
    word = "" if status == "converged" else f" ({text(status)})"
    said = f"<p><strong>{text(STATUS.get(status, status))}</strong>{word}: {text(fit.get('message', ''))}.</p>"
    said += f"<p>The residuals: {text(judged['text'])}.</p>" if judged.get("text") else ""
    if fit.get("roughness"):
        said += f"<p>{text(fit['roughness']['text'])}.</p>"
    return said


def _more(fit: dict[str, Any]) -> str:
    """Derived quantities and nuisances; then, folded, bounds, correlations and fits one by one."""
    about = "For specialists: bounds, standard deviations, correlations, and each recording fitted alone."
    special = _searched(fit) + _correlation(fit) + _one_by_one(fit)
    return _derived(fit) + _nuisances(fit) + folded("How the estimates were found", special, about)


def _searched(fit: dict[str, Any]) -> str:
    """Table of the estimates' standard deviations and of the bounds of the search."""
    estimates, rows = fit.get("estimates") or {}, []
    for name, line in fit["candidates"].items():
        bounds = f"{_end(line.get('min'), '−∞')} … {_end(line.get('max'), '∞')}"
        std = number((estimates.get(name) or {}).get("std"), 2)
        rows.append([text(name), std, bounds, number(line.get("start")), text(line.get("unit", ""))])
    return table(["parameter", "standard deviation", "bounds", "search began at", "unit"], rows, words=(0, 4))


def _derived(fit: dict[str, Any]) -> str:
    lines = fit.get("derived") or {}
    if not lines:
        return ""
    rows = [
        [text(n), number(d["value"]), number(d.get("std"), 2), text(d.get("unit", "")), text(d["expression"])]
        for n, d in lines.items()
    ]
    head = ["parameter", "value", "std", "unit", "expression"]
    return "<h3>What follows from the estimates</h3>" + table(head, rows, words=(0, 3, 4))


def _nuisances(fit: dict[str, Any]) -> str:
    rows = []
    for experiment, line in (fit.get("nuisance") or {}).items():
        for name, e in line.items():
            value, interval = estimate(e["value"], e.get("ci95"))
            cells = [text(experiment), text(name), value, number(e.get("std"), 2), interval]
            rows.append([*cells, text(e.get("unit", "")), text(e.get("reason", ""))])
    if not rows:
        return ""
    words = interval_words(beyond_noise=(fit.get("adequacy") or {}).get("verdict") == "does-not-fit")
    head = ["experiment", "unknown of it alone", "value", "std", words, "unit", "note"]
    return "<h3>Unknown in single experiments</h3>" + table(head, rows, words=(0, 1, 5, 6))


def _correlation(fit: dict[str, Any]) -> str:
    matrix = fit.get("correlation") or {}
    names = [n for n in matrix if n in (fit.get("fitted") or [])]
    if len(names) < 2:
        return ""
    rows = [[text(a), *(number(matrix[a].get(b), 2) for b in names)] for a in names]
    return "<h3>Correlation of the estimates</h3>" + table(["", *map(text, names)], rows, words=(0,))


def _one_by_one(fit: dict[str, Any]) -> str:
    known = fit.get("estimates") or {}  # a weak one has no value with a spread, here neither
    lines = {
        n: d
        for n, d in (fit.get("per_experiment") or {}).items()
        if d.get("std") is not None and (known.get(n) or {}).get("std") is not None
    }
    if not lines:
        return ""
    rows = []
    for name, d in lines.items():
        mean, interval = estimate(d["mean"], d["ci95_of_mean"])
        rows.append([text(name), number(d["n"]), mean, number(d["std"], 2), number(d["variance"], 2), interval])
    head = ["parameter", "fits", "mean", "std over fits", "variance", "95 % interval of the mean"]
    told = (
        "<p class='small'>Each experiment fitted alone. The interval is of the mean over these fits: it shrinks with "
        "their number and is no interval of the parameter.</p>"
    )
    return "<h3>Experiment by experiment</h3>" + table(head, rows, words=(0,)) + told


def _end(value: Any, none: str) -> str:
    return none if value is None else number(value)


def _weights(fit: dict[str, Any]) -> str:
    """Note on the origin of each output's standard deviation, which decides the intervals."""
    sources = fit.get("noise_source") or {}
    if not sources:
        return ""
    misfit = [o for o, s in sources.items() if str(s) == "misfit" or "misfit" in str(s)]
    given = [o for o in sources if o not in misfit]
    parts = []
    if given:
        chi2 = (fit.get("adequacy") or {}).get("chi2_per_dof")
        beside = "" if chi2 is None else f", against which χ² per degree of freedom is {number(chi2, 3)}"
        parts.append(
            f"Intervals rest on the noise given or estimated before the event for {text(', '.join(given))}{beside}."
        )
    if misfit:
        parts.append(
            f"{text(', '.join(misfit))}: the noise is not known, so the standard deviation is that of the misfit."
        )
    return f"<p class='small'>{' '.join(parts)}</p>"


SECTION = Section(
    order=10,
    title="Parameters",
    about="Every value by its name: given, fitted, and with what the model lacks; intervals, and why some are held.",
    render=_render,
    printed=True,
)
