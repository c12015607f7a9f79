"""The parameters: every value by its name, the outcome of the fit, and what specialists ask of its estimates."""

from __future__ import annotations

from hvdc_ident.fit import FitResult
from hvdc_ident.fit.noise import from_misfit
from hvdc_ident.report.html import Section, folded, number, rows_of, text
from hvdc_ident.summary import Results
from hvdc_ident.summary.phrases import by_place, interval_name, remarks, why_conditional
from hvdc_ident.summary.run_summary import Interval
from hvdc_ident.summary.stage_results import Context
from hvdc_ident.text import capital, change_text, estimate_texts, figures, interval_text, interval_words


def _render(results: Results) -> str:
    fit, about = results.objects.fit, results.objects.of_fit
    if fit is None or not about.candidates:
        return ""
    fixed = [n for n in fit.held if n not in about.candidates]
    rest = f"<p class='small'>Not candidates, at the model's values: {text(', '.join(fixed))}.</p>" if fixed else ""
    return _outcome(fit) + _by_name(results, fit) + _weights(fit) + rest + _more(fit, about)


def _by_name(results: Results, fit: FitResult) -> str:
    """Table of every value that a parameter has, each column with its name."""
    s = results.summary
    rows = []
    for p in s.parameters:
        added = p.effect is not None or p.by_place
        with_it = (by_place(p), "", "") if p.by_place else _cells(p.effect, p.effect_interval, p.given)
        alone = _cells(p.fitted, p.fitted_interval, p.given)
        rows.append((p.name, p.given, *alone, p.refitted if added else "", *with_it, p.unit))
    header = ["parameter", "given", "fitted", interval_name(s, "fitted"), "change", "refitted by the diagnosis"]
    header += ["with the effect", interval_name(s, "effect"), "change", "unit"]
    conditions = ""
    if s.counting.name == "effect":
        counting = "these are the values that count"
        conditions = f", if nothing else is missing: {text(why_conditional(s))}" if s.counts_conditional else ""
    else:
        counting = f"{text(s.counting.doubt)}, so exports take the fitted ones unless --values effect asks for these"
    told = (
        "<p class='small'>Refitted by the diagnosis: all at once to the fitted recordings, with nothing added to the model. With the "
        f"effect: the same with the finding in the model; {counting}{conditions}.</p>"
    )
    return rows_of(header, rows) + (told if s.counting.kind else "") + _notes(fit, results.objects.of_fit)


def _cells(value: float | None, interval: Interval | None, given: float | None) -> tuple[str, str, str]:
    """A value, its interval and its change from the given one; empty where there is none."""
    if value is None:
        return "", "", ""
    return estimate_texts(value, interval)[0], interval_text(interval) or "–", change_text(value, given)


def _notes(fit: FitResult, about: Context) -> str:
    """Why parameters are held, and on what the intervals rest."""
    lines = "".join(
        f"<li><strong>{text(n)}</strong>: {text(said)}.</li>" for n, said in remarks(fit, about.candidates).items()
    )
    return f"<ul class='small'>{lines}</ul>" if lines else ""


STATUS = {
    "converged": "The fit converged",
    "at-bound": "The fit ended on a bound",
    "two-optima": "The fit found two optima that are as good: neither is the answer by itself",
    "not-converged": "The fit did not converge: its numbers are no estimates",
    "failed": "The fit failed",
}


def _outcome(fit: FitResult) -> str:
    """Paragraph on the status of the fit."""
    word = "" if fit.status == "converged" else f" ({text(fit.status)})"
    said = f"<p><strong>{text(STATUS.get(fit.status, fit.status))}</strong>{word}: {text(fit.message)}.</p>"
    said += f"<p>{text(capital(fit.adequacy.text))}.</p>" if fit.adequacy is not None and fit.adequacy.text else ""
    return said + (f"<p>{text(fit.roughness['text'])}.</p>" if fit.roughness else "")


def _more(fit: FitResult, context: Context) -> str:
    """Derived quantities and nuisances; then, folded, bounds, correlations and fits one by one."""
    about = "For specialists: bounds, standard deviations, correlations, and each recording fitted alone."
    special = _searched(fit, context) + _correlation(fit) + _one_by_one(fit)
    return _derived(context) + _nuisances(fit) + folded("How the estimates were found", special, about)


def _searched(fit: FitResult, context: Context) -> str:
    """Table of the estimates' standard deviations and of the bounds of the search."""
    rows = []
    for name, line in context.candidates.items():
        low, high = ("∞" if end is None else figures(end) for end in (line.min, line.max))
        std = fit.estimates[name].std if name in fit.estimates else None
        rows.append((name, std, f"{'-' * (low == '∞')}{low} … {high}", line.start, line.unit))
    return rows_of(["parameter", "standard deviation", "bounds", "search began at", "unit"], rows)


def _derived(context: Context) -> str:
    rows = [(n, d.value, d.std, d.unit, d.expression) for n, d in context.derived.items()]
    shown = rows_of(["parameter", "value", "std", "unit", "expression"], rows)
    return f"<h3>What follows from the estimates</h3>{shown}" if shown else ""


def _nuisances(fit: FitResult) -> str:
    rows = []
    for experiment, line in fit.nuisance.items():
        for name, e in line.items():
            value, ends = estimate_texts(e.value, e.ci95)[0], interval_text(e.ci95) or "–"
            rows.append((experiment, name, value, e.std, ends, e.unit, e.reason))
    words = interval_words(beyond_noise=fit.adequacy is not None and fit.adequacy.verdict == "does-not-fit")
    shown = rows_of(["experiment", "unknown of it alone", "value", "std", words, "unit", "note"], rows)
    return f"<h3>Unknown in single experiments</h3>{shown}" if shown else ""


def _correlation(fit: FitResult) -> str:
    names = [n for n in fit.correlation if n in fit.fitted]
    if len(names) < 2:
        return ""
    lines = fit.correlation
    rows = [(a, *(figures(lines[a][b], 2) if b in lines[a] else None for b in names)) for a in names]
    return "<h3>Correlation of the estimates</h3>" + rows_of(["", *names], rows)


def _one_by_one(fit: FitResult) -> str:
    spread = {
        n for n, e in fit.estimates.items() if e.std is not None
    }  # a weak one has no value with a spread, here neither
    lines = {n: d for n, d in fit.per_experiment.items() if d.get("std") is not None and n in spread}
    if not lines:
        return ""
    rows = []
    for name, d in lines.items():
        mean, ends = estimate_texts(d["mean"], d["ci95_of_mean"])[0], interval_text(d["ci95_of_mean"])
        rows.append((name, d["n"], mean, d["std"], d["variance"], ends))
    told = (
        "<p class='small'>Each experiment fitted alone. The interval is of the mean over these fits: it shrinks with "
        "their number and is no interval of the parameter.</p>"
    )
    head = ["parameter", "fits", "mean", "std over fits", "variance", "95 % interval of the mean"]
    return f"<h3>Experiment by experiment</h3>{rows_of(head, rows)}{told}"


def _weights(fit: FitResult) -> str:
    """Note on the origin of each output's standard deviation, which decides the intervals."""
    misfit = [o for o, source in fit.noise_source.items() if from_misfit(source)]
    given = [o for o in fit.noise_source if o not in misfit]
    parts = []
    if given:
        chi2 = fit.adequacy.chi2_per_dof if fit.adequacy is not None else None
        beside = "" if chi2 is None else f", against which χ² per degree of freedom is {number(chi2, 3)}"
        parts.append(
            f"Intervals rest on the noise given or estimated before the event for {text(', '.join(given))}{beside}."
        )
    if fit.noise_note:
        parts.append(text(fit.noise_note))
    return f"<p class='small'>{' '.join(parts)}</p>" if parts else ""


SECTION = Section(
    order=10,
    title="Parameters",
    about="Every value by its name: given, fitted, and with what the model lacks; intervals, and why some are held.",
    render=_render,
)
