"""Section on the identifiability of each parameter: verdicts, profiles, information by experiment, what to measure next."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.axes import draw_intervals, draw_profile
from hvdc_ident.report.drawing import figure, svg
from hvdc_ident.report.html import Section, captioned, folded, rows_of, table_of, text
from hvdc_ident.summary import Results
from hvdc_ident.summary.tables import verdicts_table
from hvdc_ident.text import capital, figures, listed, with_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SHOWN = 5e-4
"""A smaller share of the information is none."""
COLUMNS = 3


def _render(results: Results) -> str:
    found = results.get("identifiability")
    parameters = found.get("parameters") or {}
    if found.get("first"):
        return _first(found, found["first"])
    if not parameters:
        return ""
    parts = [
        _lead(found),
        table_of(verdicts_table(found)),
        _next(found),
        folded(
            "Profiles of the cost",
            _pictures(found),
            "How fast the fit worsens as one parameter moves and the others follow.",
        ),
        folded(
            "Information by experiment",
            _experiments(found),
            "The share of each recording in what is known of a parameter.",
        ),
        folded(
            "Collinearity",
            _collinearity(parameters),
            "By how much the other parameters can cancel what one does; 1: not at all.",
        ),
    ]
    notes = "".join(f"<p class='small'>{text(n)}</p>" for n in found.get("notes") or [])
    return "".join(parts) + notes


def _first(found: dict[str, Any], first: dict[str, Any]) -> str:
    """The first answer of a stage that was interrupted."""
    rows = [(n, p["value"], p["std"], p["unit"], listed(p["conditional_on"])) for n, p in first["parameters"].items()]
    said = "".join(f"<p>{text(capital(words))}.</p>" for words in first["combinations"])
    header = ["parameter", "given", "std at first order", "unit", "with held"]
    return f"<p><strong>{text(capital(found['message']))}.</strong></p>{said}{rows_of(header, rows)}"


def _lead(found: dict[str, Any]) -> str:
    fitted, held = found.get("identifiable") or [], found.get("held") or {}
    told = (
        f"A fit uses {text(', '.join(map(str, fitted)))}" if fitted else "No candidate can be estimated from these data"
    )
    rest = f"; held: {text(', '.join(held))}" if held else ""
    structural = found.get("structural") or {}
    method = f" {_structure(structural)} ({text(structural.get('method', ''))})." if structural.get("status") else ""
    combos = "".join(f"<p>{text(capital(c['words']))}.</p>" for c in found.get("combinations") or [])
    signs = "; ".join((found.get("misspecification") or {}).get("signs") or ()) if found.get("misspecified") else ""
    against = f"<p>What speaks against the model: {text(signs)}.</p>" if signs else ""
    return f"<p><strong>{told}</strong>{rest}.{method}</p>{combos}{against}"


def _structure(structural: dict[str, Any]) -> str:
    """Sentence on structural identifiability, from perfect data."""
    lost = structural.get("unidentifiable") or []
    if lost:
        return f"Not even perfect data would tell {text(listed(map(str, lost)))}"
    if structural["status"] == "decided":
        return "From perfect data of these signals every candidate could be told"
    return f"What perfect data could tell: {text(structural['status'])}"


def _collinearity(parameters: dict[str, Any]) -> str:
    """Table of the collinearity index of each parameter, with the one that resembles it most."""
    known = {n: v for n, v in parameters.items() if v.get("collinearity") is not None}
    rows = [(n, figures(v["collinearity"], 3), v.get("partner") or "–") for n, v in known.items()]
    return rows_of(["parameter", "collinearity index", "mostly with"], rows)


def _pictures(found: dict[str, Any]) -> str:
    drawn = {n: p for n, p in (found.get("profiles") or {}).items() if len(p.get("values") or []) > 1}
    if not drawn:
        return ""
    both, parameters = found.get("pair"), found.get("parameters") or {}
    parts = [
        captioned(
            svg(intervals(parameters), "intervals of the parameters"),
            "95 % interval of each parameter, and its verdict.",
        ),
        captioned(
            svg(profiles(drawn, parameters), "profiles of the cost by parameter"),
            "Rise of the cost over each parameter; 1 is the 95 % level, dotted lines are the ends of the interval.",
        ),
    ]
    if both:
        pair = svg(pair_map(both, parameters), "common profile of two parameters")
        parts.append(captioned(pair, "Rise of the cost over two parameters; 1.56 is their common 95 % region."))
    return "".join(parts)


def _experiments(found: dict[str, Any]) -> str:
    experiments = found.get("experiments") or {}
    names = list(dict.fromkeys(n for line in experiments.values() for n in line.get("information") or {}))
    rows = [(e, *(_percent(line["information"].get(n, 0.0)) for n in names)) for e, line in experiments.items()]
    return rows_of(["experiment", *names], rows) if names else ""


def _percent(share: float) -> str:
    return f"{figures(100.0 * share, 3)} %" if share >= SHOWN else "–"


def _next(found: dict[str, Any]) -> str:
    advice = found.get("recommended_experiment") or {}
    if not advice.get("text"):
        return ""
    failed = advice.get("failed") or []
    lead = (
        f"<p class='small'>Could not be simulated: {text('; '.join(failed[:3]))}{' …' if failed[3:] else ''}.</p>"
        if failed
        else ""
    )
    lines = [advice, *(advice.get("others") or [])]
    if not advice.get("moves") or len(lines) < 2:
        return lead
    rows = [
        (
            "; then ".join(_move(m) for m in line["moves"]),
            ", ".join(line["new_signals"]) or "–",
            line.get("half_width"),
            line["determinant_gain"],
        )
        for line in lines
    ]
    aim = str(advice.get("aim", ""))
    header = ["experiment", "also record", f"{aim} then known to ±", "gain of ln determinant"]
    note = (
        "<p class='small'>Best first, the best of each kind and input. To first order, with noise as in the recordings; of a "
        "signal not recorded so far, as on others of its unit.</p>"
    )
    about = f"How far each experiment narrows the interval of {text(aim)}, and how much it tells of all parameters together."
    return lead + folded("Experiments compared", rows_of(header, rows) + note, about)


def _move(m: dict[str, Any]) -> str:
    return f"{m['shape']} of {m['input']}, {m['from']:g} to {m['to']:g}"


def profiles(found: Mapping[str, Mapping[str, Any]], parameters: Mapping[str, Mapping[str, Any]]) -> Figure:
    """One small plot a parameter: rise over its threshold against the parameter, in its unit; 1 is the 95 % level."""
    rows = -(-len(found) // COLUMNS)
    high = 1.9 * rows
    edges = {
        "left": 0.085,
        "right": 0.985,
        "bottom": 0.42 / high,
        "top": 1.0 - 0.22 / high,
        "wspace": 0.25,
        "hspace": 0.62,
    }
    fig = figure(7.4, high, edges)
    for place, (name, p) in enumerate(found.items(), start=1):
        axes = fig.add_subplot(rows, COLUMNS, place)
        draw_profile(axes, name, p, parameters.get(name, {}))
        axes.set_ylabel("")
    fig.supylabel("rise of the cost / 95 % level", fontsize=8, x=0.01)
    return fig


def intervals(parameters: Mapping[str, Mapping[str, Any]]) -> Figure:
    """The interval and the verdict of every candidate, a line each."""
    fig = figure(7.0, 0.8 + 0.34 * len(parameters))
    draw_intervals(fig.add_subplot(), parameters)
    return fig


def pair_map(pair: Mapping[str, Any], parameters: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Contours of the rise over two parameters, in units of the 95 % level of one; 1.56 is the joint 95 % region."""
    fig = figure(4.6, 3.6)
    axes = fig.add_subplot()
    rises = np.array([[np.nan if v is None else v for v in row] for row in pair["rises"]], dtype=float).T
    drawn = axes.contour(pair["first"], pair["second"], np.ma.masked_invalid(rises), levels=[0.25, 1.0, 1.56, 4.0])
    axes.clabel(drawn, fontsize=7)
    labels = []
    for name in pair["names"]:
        unit = parameters.get(name, {}).get("unit")
        labels.append(with_unit(str(name), unit or ""))
    axes.set_xlabel(labels[0], fontsize=8)
    axes.set_ylabel(labels[1], fontsize=8)
    axes.ticklabel_format(useOffset=False)
    axes.tick_params(axis="x", labelrotation=20)
    axes.tick_params(labelsize=7)
    axes.spines[["top", "right"]].set_visible(False)
    return fig


SECTION = Section(
    order=50,
    title="What the recordings determine",
    about="Which parameters these recordings tell, how well, and what to record to know them better.",
    render=_render,
)
