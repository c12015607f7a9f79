"""The errors of every signal, by set of values, and within the windows of the tolerance profile."""

from __future__ import annotations

from markupsafe import Markup

from hvdc_ident.fit import FitResult
from hvdc_ident.report.html import Section, folded, number, rows_of, shown, table_of, text
from hvdc_ident.summary import Results
from hvdc_ident.summary.tables import signals_table
from hvdc_ident.text import figures


def _render(results: Results) -> str:
    s = results.summary
    if not s.sets:
        return ""
    quiet = tuple(x for x in s.signals if all(n in x.errors and x.errors[n].on_noise == "pass" for n in s.sets))
    loud = tuple(x for x in s.signals if x not in quiet)
    plural = "s" if len(quiet) > 1 else ""
    rest = table_of(signals_table(s, quiet)) if quiet else ""
    parts = [
        table_of(signals_table(s, loud)) if loud else "<p>Every signal is on its noise, with every set of values.</p>",
        folded(f"{len(quiet)} signal{plural} on their noise", rest, "With every set of values."),
    ]
    windows = _windows(results)
    both = [windows, *parts] if s.profile.get("named") else [*parts, windows]
    return "".join(both) + _held_out(results.objects.fit)


def _windows(results: Results) -> str:
    """Largest, mean and mean absolute error before, during and after the event, beside the profile's limits."""
    s = results.summary
    profile, units = s.profile, results.units
    over: list[tuple[str, ...]] = []
    rows: list[tuple[str, ...]] = []
    unjudged: list[tuple[str, ...]] = []
    why: list[str] = []
    ends = set()
    for output, name, about in results.windows(s.about):
        ends.add(about.end_from)
        for window, w in about.by_name.items():
            span = f"{figures(w.begin, 3)} … {figures(w.end, 3)}" if w.n else "–"
            limits = w.limits or {}
            kinds = {"max": w.max, "mean": w.mean, "mean_absolute": w.mean_absolute}
            errors = [_error(value, limits.get(kind)) for kind, value in kinds.items()]
            row = (output, name, window, span, *errors, units.get(output, ""))
            {True: rows, False: over, None: unjudged}[w.within].append(row)
            if w.within is None:
                why.append(f"{output}: {about.reason or 'no row in this window'}")
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
    above = rows_of(head, over)
    within = folded(f"{len(rows)} windows within the limits", rows_of(head, rows))
    reasons = f"<p class='small'>{text('; '.join(dict.fromkeys(why)))}.</p>" if unjudged else ""
    within += folded(f"{len(unjudged)} windows not judged", rows_of(head, unjudged) + reasons) + told
    if profile.get("named"):
        return f"<h3>Before, during and after the event: {counted}</h3>{above}{within}"
    return folded(f"Before, during and after the event: {counted}", above + within)


def _error(value: float | None, limit: float | None) -> str:
    over = value is not None and limit is not None and abs(value) > limit
    return Markup(f"<strong>{number(value, 2)} &gt; {number(limit, 2)}</strong>") if over else shown(value, 2)


def _held_out(fit: FitResult | None) -> str:
    """Table of the errors at the estimates in experiments that were kept out of the fit."""
    rows = []
    for name, line in ({} if fit is None else fit.validation).items():
        if line.status != "done":
            rows.append((name, "–", "–", "–", "–", "could not be simulated at the estimates"))
        note = "; ".join(f"{n} {figures(v)} from this record itself" for n, v in line.nuisance.items())
        for output, q in line.outputs.items():
            band = f"{figures(100.0 * q.quality.in_band, 3)} %" if q.quality.in_band is not None else "–"
            rows.append((name, output, shown(q.quality.rmse, 3), shown(q.of_fit, 3), band, note))
    head = ["held-out experiment", "output", "RMSE", "of the fit's", "samples in the 95 % band", "note"]
    return f"<h3>Held-out experiments</h3>{rows_of(head, rows)}" if rows else ""


SECTION = Section(
    order=20,
    title="Errors",
    about="The error of every signal at the given values and fitted, and within the windows of the tolerance profile.",
    render=_render,
)
