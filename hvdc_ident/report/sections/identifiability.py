"""What the data tell about each parameter: verdicts, profiles, information by experiment, what to measure next."""

from __future__ import annotations

from typing import Any

from hvdc_ident.report.drawing import svg
from hvdc_ident.report.html import number, table, text
from hvdc_ident.report.profiles import pair_map, profiles
from hvdc_ident.report.results import Results
from hvdc_ident.report.section import Section


def _render(results: Results) -> str:
    found = results.get("identifiability")
    parameters = found.get("parameters") or {}
    if not parameters:
        return ""
    parts = [_lead(found), _verdicts(parameters), _model(found), _pictures(found), _experiments(found), _next(found)]
    notes = "".join(f"<p class='small'>{text(n)}</p>" for n in found.get("notes") or [])
    return "".join(parts) + notes


def _lead(found: dict[str, Any]) -> str:
    fitted, held = found.get("identifiable") or [], found.get("held") or {}
    told = (
        f"A fit uses {text(', '.join(map(str, fitted)))}" if fitted else "No candidate can be estimated from these data"
    )
    rest = f"; held: {text(', '.join(held))}" if held else ""
    structural = found.get("structural") or {}
    method = f" Structure: {text(structural.get('status', ''))} ({text(structural.get('method', ''))})."
    combos = "".join(f"<p>{text(_capital(c['words']))}.</p>" for c in found.get("combinations") or [])
    return f"<p><strong>{told}</strong>{rest}.{method}</p>{combos}"


def _verdicts(parameters: dict[str, Any]) -> str:
    rows = []
    for name, v in parameters.items():
        low, high = v.get("ci95") or (None, None)
        interval = f"{number(low)} … {number(high)}" if v.get("ci95") else "–"
        rows.append(
            [
                f"<strong>{text(name)}</strong>",
                text(v.get("verdict", "")),
                number(v.get("value")),
                interval,
                text(v.get("unit", "")),
                number(v.get("collinearity"), 3),
                text(v.get("partner") or "–"),
                text(v.get("reason", "")),
            ]
        )
    header = ["parameter", "verdict", "value", "95 % interval", "unit", "collinearity", "with", "why"]
    return table(header, rows, words=(0, 1, 4, 6, 7))


def _model(found: dict[str, Any]) -> str:
    if not found.get("misspecified"):
        return ""
    detail = found.get("misspecification") or {}
    signs = "; ".join(str(s) for s in detail.get("signs") or [])
    return f"<p><strong>The model does not explain these data:</strong> {text(signs)}. {text(_capital(detail.get('next', '')))}.</p>"


def _pictures(found: dict[str, Any]) -> str:
    drawn = {n: p for n, p in (found.get("profiles") or {}).items() if len(p.get("values") or []) > 1}
    if not drawn:
        return ""
    both = found.get("pair")
    more = svg(pair_map(both, found.get("parameters") or {}), "common profile of two parameters") if both else ""
    picture = svg(profiles(drawn, found.get("parameters") or {}), "profiles of the cost by parameter")
    return f"<h3>Profiles</h3><figure>{picture}{more}</figure>"


def _experiments(found: dict[str, Any]) -> str:
    experiments = found.get("experiments") or {}
    names: list[str] = [n for line in list(experiments.values())[:1] for n in line.get("information") or {}]
    if not names:
        return ""
    rows = [
        [text(e), *(f"{number(100.0 * line['information'].get(n, 0.0), 3)} %" for n in names)]
        for e, line in experiments.items()
    ]
    return "<h3>Share of the information, by experiment</h3>" + table(["experiment", *map(text, names)], rows)


def _next(found: dict[str, Any]) -> str:
    advice = found.get("recommended_experiment") or {}
    return f"<p><strong>What to measure next.</strong> {text(advice['text'])}</p>" if advice.get("text") else ""


def _capital(words: str) -> str:
    return words[:1].upper() + words[1:]


SECTION = Section(order=15, title="What the data tell about the parameters", render=_render)
