"""The table of gains: start, estimate, spread, interval, and why some are held."""

from __future__ import annotations

from typing import Any

from hvdc_ident.report.html import number, share, table, text
from hvdc_ident.report.results import Results
from hvdc_ident.report.section import Section


def _render(results: Results) -> str:
    fit = results.get("fit")
    candidates = fit.get("candidates") or {}
    if not candidates:
        return ""
    rows = [_row(name, line, fit) for name, line in candidates.items()]
    header = ["parameter", "start", "fitted", "change", "std", "95 % interval", "bounds", "unit", "note"]
    held = fit.get("held") or {}
    fixed = [n for n in held if n not in candidates]
    outcome = f"<p>The fit: <strong>{text(fit.get('status', ''))}</strong>; {text(fit.get('message', ''))}.</p>"
    rest = f"<p class='small'>Not candidates, at the model's values: {text(', '.join(fixed))}.</p>" if fixed else ""
    return outcome + table(header, rows, words=(0, 7, 8)) + _weights(fit) + rest


def _row(name: str, line: dict[str, Any], fit: dict[str, Any]) -> list[str]:
    estimate = (fit.get("estimates") or {}).get(name) or {}
    why = (fit.get("held") or {}).get(name)
    value = estimate.get("value", (fit.get("values") or {}).get(name))
    low, high = estimate.get("ci95") or (None, None)
    interval = f"{number(low)} … {number(high)}" if estimate.get("ci95") else "–"
    notes = [f"held: {why}"] if why else []
    if estimate.get("method") == "one-sided":
        notes.append("on a bound, one-sided interval")
    if estimate.get("conditional_on"):
        notes.append(f"given {', '.join(map(str, estimate['conditional_on']))}")
    if estimate.get("reason"):
        notes.append(str(estimate["reason"]))
    bounds = f"{_end(line.get('min'), '−∞')} … {_end(line.get('max'), '∞')}"
    return [
        f"<strong>{text(name)}</strong>",
        number(line.get("start")),
        f"<strong>{number(value)}</strong>",
        share(value, line.get("start")),
        number(estimate.get("std"), 2),
        interval,
        bounds,
        text(line.get("unit", "")),
        text("; ".join(notes)),
    ]


def _end(value: Any, none: str) -> str:
    return none if value is None else number(value)


def _weights(fit: dict[str, Any]) -> str:
    """Where the standard deviation of each output comes from, for it decides the intervals."""
    sources = fit.get("noise_source") or {}
    if not sources:
        return ""
    misfit = [o for o, s in sources.items() if str(s) == "misfit" or "misfit" in str(s)]
    given = [o for o in sources if o not in misfit]
    parts = []
    if given:
        parts.append(f"Intervals rest on the noise given or estimated before the event for {text(', '.join(given))}.")
    if misfit:
        parts.append(
            f"{text(', '.join(misfit))}: the data are deterministic, so the standard deviation comes from the misfit."
        )
    return f"<p class='small'>{' '.join(parts)}</p>"


SECTION = Section(order=20, title="Gains", render=_render)
