"""The tables of a summary, of text: the same cells on the terminal, in a notebook, on a page and in the workbench."""

from __future__ import annotations

from hvdc_ident.display import Table
from hvdc_ident.fit.judgement import Count
from hvdc_ident.identifiability import IdentifiabilityReport
from hvdc_ident.summary.phrases import (
    WORDS,
    by_place,
    finding_name,
    interval_name,
    note_text,
    place_texts,
)
from hvdc_ident.summary.run_summary import FindingSummary, RunSummary, SignalSummary
from hvdc_ident.text import (
    change_text,
    estimate_text,
    estimate_texts,
    factor_text,
    figures,
    interval_text,
    probability_text,
    quantity,
)

PLACES = 4
"""Likely places of an effect that are shown."""


def values_table(s: RunSummary) -> Table:
    """Return every candidate with its values by name, and the interval of the last of them."""
    added = any(p.effect is not None for p in s.parameters)
    rows = []
    for p in s.parameters:
        placed = by_place(p)
        last = p.effect_interval if p.effect is not None else None if placed else p.fitted_interval
        effect = placed or estimate_texts(p.effect, p.effect_interval)[0]
        fitted = estimate_texts(p.fitted, p.fitted_interval)[0]
        given = "" if p.given is None else figures(p.given, 6)
        rows.append((p.name, p.unit, given, fitted, effect, interval_text(last), note_text(p)))
    name = interval_name(s, "effect" if added else "fitted") + (", with the effect" if added else "")
    header = ("parameter", "unit", "given", "fitted", "with the effect", name, "note")
    return Table(header, tuple(rows)).without_empty() if rows else Table(header, ())


def verdicts_table(report: IdentifiabilityReport) -> Table:
    """Return each candidate's verdict with its value, interval and reason."""
    ratio = report.pilot.chi2_per_dof if report.misspecified else None
    name = "95 % interval" if ratio is None else f"95 % interval (χ²/dof {figures(ratio, 3)})"
    rows: list[tuple[str, ...]] = [
        (n, v.verdict, estimate_texts(v.value, v.ci95)[0], interval_text(v.ci95), v.unit, v.reason)
        for n, v in report.parameters.items()
    ]
    rows += [
        (n, "none yet", "" if u.value is None else estimate_texts(u.value, u.profile_ends)[0], "", u.unit, u.text)
        for n, u in report.unsettled.items()
    ]
    return Table(("parameter", "verdict", "value", name, "unit", "why"), tuple(rows)).without_empty()


def sets_table(s: RunSummary) -> Table:
    """Return the error of the worst signal with each set of values, and how many signals pass."""
    signal = s.signal(s.judged.worst) if s.judged is not None else None
    unit = f", {signal.unit}" if signal is not None and signal.unit else ""
    limits = "in the tolerance" if s.limits == "tolerance" else "in the windows"
    rows = []
    for name, summary in s.sets.items():
        e = signal.errors.get(name) if signal is not None else None
        sizes = ("", "", "")
        if e is not None:
            times = "" if e.times_noise is None else factor_text(e.times_noise)
            sizes = (figures(e.rmse, 2), times, figures(e.peak, 2))
        rows.append((WORDS[name], *sizes, count_text(summary.on_noise), count_text(summary.in_limits)))
    return Table(("", f"RMSE{unit}", "× noise", f"peak{unit}", "on the noise", limits), tuple(rows)).without_empty()


def count_text(count: Count) -> str:
    """Return "PASS 27", "FAIL 3 of 27", each with the number of those that are not judged; empty where none is."""
    parts = (
        [f"FAIL {count.failed} of {count.judged}"] if count.failed else [f"PASS {count.judged}"] if count.judged else []
    )
    return ", ".join([*parts, *([f"not judged {count.not_judged}"] if count.not_judged and count.judged else [])])


def signals_table(s: RunSummary, signals: tuple[SignalSummary, ...]) -> Table:
    """Return the RMSE of signals with each set of values, the change by the fit, and the noise."""
    rows = []
    for x in signals:
        rmse = {n: e.rmse for n, e in x.errors.items()}
        cells = tuple(figures(rmse[n], 3) if n in rmse else "" for n in s.sets)
        change = change_text(rmse.get("fitted"), rmse.get("given"))
        noise = "" if not x.noise else figures(x.noise, 2)
        role = "held out" if x.role == "holdout" else "fit"
        rows.append((x.output, x.experiment, role, *cells, change, noise, x.unit))
    sets = (f"RMSE, {WORDS[n]}" for n in s.sets)
    return Table(
        ("output", "experiment", "role", *sets, "change by the fit", "noise", "unit"), tuple(rows)
    ).without_empty()


def findings_table(s: RunSummary) -> Table:
    """Return what may be missing: effects with probabilities, sizes and likely places."""
    words = interval_name(s, "effect")
    rows = []
    for f in s.findings:
        sizes = "; ".join(f"{n} = {estimate_text(q.value, q.unit, q.interval)}" for n, q in f.sizes.items())
        rows.append((finding_name(f), probability_text(f.probability), sizes, _places(f), _delay(f)))
    return Table(("effect", "probability", f"size ({words})", "likely at", "delay"), tuple(rows)).without_empty()


def _delay(f: FindingSummary) -> str:
    """Return the delay of a slow signal; none that depends on the place."""
    return "" if f.delay is None or any(p.values for p in f.places) else quantity(f.delay, "s", 3)


def _places(f: FindingSummary) -> str:
    places = [f"{at} ({probability_text(p)})" for at, p in place_texts(f).items()]
    more = [f"{len(places) - PLACES} more"] if len(places) > PLACES else []
    return "; ".join([*places[:PLACES], *more])
