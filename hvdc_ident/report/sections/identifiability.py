"""Section on the identifiability of each parameter: verdicts, profiles, information by experiment, what to measure next."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from hvdc_ident.axes import draw_intervals, draw_profile
from hvdc_ident.fit.profile import PairProfile, Profile
from hvdc_ident.identifiability import IdentifiabilityReport
from hvdc_ident.identifiability.experiment_design import Recommendation
from hvdc_ident.identifiability.pilot_fit import CramerRaoBounds
from hvdc_ident.identifiability.structural import StructuralAnalysis
from hvdc_ident.identifiability.verdicts import Verdict
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
    report, kept = results.objects.identified, results.get("identifiability")
    if kept.get("first") and not report.parameters and not report.unsettled:
        return _first(str(kept["message"]), CramerRaoBounds.from_dict(kept["first"]))
    if not report.parameters and not report.unsettled:
        return ""
    if report.unsettled:
        message = f"<p><strong>{text(capital(str(kept['message'])))}.</strong></p>"
        return (
            message
            + table_of(verdicts_table(report))
            + "".join(f"<p class='small'>{text(n)}</p>" for n in report.notes)
        )
    parts = [
        _lead(report),
        table_of(verdicts_table(report)),
        _next(report.recommended),
        folded(
            "Profiles of the cost",
            _pictures(report),
            "How fast the fit worsens as one parameter moves and the others follow.",
        ),
        folded(
            "Information by experiment",
            _experiments(report),
            "The share of each recording in what is known of a parameter.",
        ),
        folded(
            "Collinearity",
            _collinearity(report),
            "By how much the other parameters can cancel what one does; 1: not at all.",
        ),
    ]
    notes = "".join(f"<p class='small'>{text(n)}</p>" for n in report.notes)
    return "".join(parts) + notes


def _first(message: str, first: CramerRaoBounds) -> str:
    """The first answer of a stage that was interrupted."""
    rows = [(n, p.value, p.std, p.unit, listed(p.conditional_on)) for n, p in first.parameters.items()]
    said = "".join(f"<p>{text(capital(words))}.</p>" for words in first.combinations)
    header = ["parameter", "given", "std at first order", "unit", "with held"]
    return f"<p><strong>{text(capital(message))}.</strong></p>{said}{rows_of(header, rows)}"


def _lead(report: IdentifiabilityReport) -> str:
    told = (
        f"A fit uses {text(', '.join(report.identifiable))}"
        if report.identifiable
        else "No candidate can be estimated from these data"
    )
    rest = f"; held: {text(', '.join(report.held))}" if report.held else ""
    method = f" {_structure(report.structure)} ({text(report.structure.method)})." if report.structure.method else ""
    combos = "".join(f"<p>{text(capital(c.words))}.</p>" for c in report.combinations)
    signs = "; ".join(report.misspecification.signs) if report.misspecified else ""
    against = f"<p>What speaks against the model: {text(signs)}.</p>" if signs else ""
    return f"<p><strong>{told}</strong>{rest}.{method}</p>{combos}{against}"


def _structure(structure: StructuralAnalysis) -> str:
    """Sentence on structural identifiability, from perfect data."""
    if structure.unidentifiable:
        return f"Not even perfect data would tell {text(listed(structure.unidentifiable))}"
    if structure.status == "decided":
        return "From perfect data of these signals every candidate could be told"
    return f"What perfect data could tell: {text(structure.status)}"


def _collinearity(report: IdentifiabilityReport) -> str:
    """Table of the collinearity index of each parameter, with the one that resembles it most."""
    lines = report.parameters.items()
    rows = [(n, figures(v.collinearity, 3), v.partner or "–") for n, v in lines if v.collinearity is not None]
    return rows_of(["parameter", "collinearity index", "mostly with"], rows)


def _pictures(report: IdentifiabilityReport) -> str:
    drawn = {n: p for n, p in report.profiles.items() if p.values.size > 1}
    if not drawn:
        return ""
    parts = [
        captioned(
            svg(intervals(report.parameters), "intervals of the parameters"),
            "95 % interval of each parameter, and its verdict.",
        ),
        captioned(
            svg(profiles(drawn, report.parameters), "profiles of the cost by parameter"),
            "Rise of the cost over each parameter; 1 is the 95 % level, dotted lines are the ends of the interval.",
        ),
    ]
    if report.pair is not None:
        pair = svg(pair_map(report.pair, report.parameters), "common profile of two parameters")
        parts.append(captioned(pair, "Rise of the cost over two parameters; 1.56 is their common 95 % region."))
    return "".join(parts)


def _experiments(report: IdentifiabilityReport) -> str:
    names = list(dict.fromkeys(n for line in report.experiments.values() for n in line.information))
    rows = [(e, *(_percent(line.information.get(n, 0.0)) for n in names)) for e, line in report.experiments.items()]
    return rows_of(["experiment", *names], rows) if names else ""


def _percent(share: float) -> str:
    return f"{figures(100.0 * share, 3)} %" if share >= SHOWN else "–"


def _next(advice: Recommendation | None) -> str:
    if advice is None:
        return ""
    some, more = advice.failed[:3], " …" if advice.failed[3:] else ""
    lead = f"<p class='small'>Could not be simulated: {text('; '.join(some))}{more}.</p>" if some else ""
    if not advice.others:
        return lead
    rows = [
        (
            "; then ".join(f"{m.shape} of {m.input}, {m.before:g} to {m.after:g}" for m in r.design.moves),
            ", ".join(r.new) or "–",
            r.half_width,
            advice.determinant_gain(r),
        )
        for r in (advice.best, *advice.others)
    ]
    header = ["experiment", "also record", f"{advice.aim} then known to ±", "gain of ln determinant"]
    note = (
        "<p class='small'>Best first, the best of each kind and input. To first order, with noise as in the recordings; of a "
        "signal not recorded so far, as on others of its unit.</p>"
    )
    about = f"How far each experiment narrows the interval of {text(advice.aim)}, and how much it tells of all parameters together."
    return lead + folded("Experiments compared", rows_of(header, rows) + note, about)


def profiles(by_name: Mapping[str, Profile], parameters: Mapping[str, Verdict]) -> Figure:
    """One small plot a parameter: rise over its threshold against the parameter, in its unit; 1 is the 95 % level."""
    rows = -(-len(by_name) // COLUMNS)
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
    for place, (name, profile) in enumerate(by_name.items(), start=1):
        axes = fig.add_subplot(rows, COLUMNS, place)
        draw_profile(axes, profile, parameters[name])
        axes.set_ylabel("")
    fig.supylabel("rise of the cost / 95 % level", fontsize=8, x=0.01)
    return fig


def intervals(parameters: Mapping[str, Verdict]) -> Figure:
    """The interval and the verdict of every candidate, a line each."""
    fig = figure(7.0, 0.8 + 0.34 * len(parameters))
    draw_intervals(fig.add_subplot(), parameters)
    return fig


def pair_map(pair: PairProfile, parameters: Mapping[str, Verdict]) -> Figure:
    """Contours of the rise over two parameters, in units of the 95 % level of one; 1.56 is the joint 95 % region."""
    fig = figure(4.6, 3.6)
    axes = fig.add_subplot()
    drawn = axes.contour(pair.first, pair.second, np.ma.masked_invalid(pair.rises.T), levels=[0.25, 1.0, 1.56, 4.0])
    axes.clabel(drawn, fontsize=7)
    labels = [with_unit(n, parameters[n].unit) for n in pair.names]
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
