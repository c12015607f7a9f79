"""The errors of every signal, by set of values, and within the windows of the tolerance profile."""

from __future__ import annotations

from hvdc_ident.fit import FitResult
from hvdc_ident.report.html import Section, folded, number, table, table_of, text
from hvdc_ident.summary import Results
from hvdc_ident.summary.tables import signals_table


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
    over: list[list[str]] = []
    rows: list[list[str]] = []
    unjudged: list[list[str]] = []
    why: list[str] = []
    ends = set()
    for output, name, about in results.windows(s.about):
        ends.add(about.end_from)
        for window, w in about.by_name.items():
            span = f"{number(w.begin, 3)} … {number(w.end, 3)}" if w.n else "–"
            limits = w.limits or {}
            kinds = {"max": w.max, "mean": w.mean, "mean_absolute": w.mean_absolute}
            errors = [_error(value, limits.get(kind)) for kind, value in kinds.items()]
            row = [text(output), text(name), window, span, *errors, text(units.get(output, ""))]
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


def _error(value: float | None, limit: float | None) -> str:
    if value is None:
        return "–"
    over = limit is not None and abs(value) > limit
    return f"<strong>{number(value, 2)} &gt; {number(limit, 2)}</strong>" if over else number(value, 2)


def _held_out(fit: FitResult | None) -> str:
    """Table of the errors at the estimates in experiments that were kept out of the fit."""
    rows = []
    for name, line in ({} if fit is None else fit.validation).items():
        if line.status != "done":
            rows.append([text(name), "–", "–", "–", "–", "could not be simulated at the estimates"])
        note = "; ".join(f"{n} {number(v)} from this record itself" for n, v in line.nuisance.items())
        for output, q in line.outputs.items():
            band = q.quality.in_band
            cells = [text(name), text(output), number(q.quality.rmse, 3), number(q.of_fit, 3)]
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
)
