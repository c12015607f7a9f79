"""The truth beside what was found, where the recordings were made by a model that is known: on the demo's screen and in its report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hvdc_ident.display import Table
from hvdc_ident.summary.run_summary import RunSummary
from hvdc_ident.summary.tables import values_table
from hvdc_ident.text import figures, listed, probability_text, quantity


def truth_table(s: RunSummary, truth: Mapping[str, Any]) -> Table:
    """Return the candidates with their given values, those that were found, and the true ones. truth: {name: {value, unit}}."""
    values = values_table(s)
    true = {n: figures(p["value"]) for n, p in truth.items()}
    return Table((*values.header, "true"), tuple((*row, true.get(row[0], "")) for row in values.rows))


def found_effect(s: RunSummary) -> str:
    """Return what was found missing, as a delay where it is one; "nothing" where nothing was."""
    said = []
    for f in s.findings:
        size = f" that acts as a delay of {quantity(f.delay, 's')}" if f.delay else ""
        said.append(f"{f.effect}{size} ({probability_text(f.probability)})")
    return "; ".join(said) or "nothing"


def true_effect(truth: Mapping[str, Any]) -> str:
    """Return what is missing in truth: the parts with further states, and the delay that they amount to in each loop."""
    if not truth["lacking"]:
        return "nothing"
    by = [f"{d['order']} by {quantity(d['seconds'], 's')} (at {d['at_hz']:.3g} Hz)" for d in truth["delays"]]
    late = f", which delay the loop of {listed(by)}" if by else ""
    return f"{truth['plant']} has further states in its {listed(truth['lacking'])}{late}"


def truth_lines(truth: Mapping[str, Any], s: RunSummary) -> list[str]:
    """Return the table of the screen, with the truth beside what was found."""
    return [
        f"The recordings were made by {truth['plant']}, so that the truth is known:",
        "",
        *str(truth_table(s, truth["parameters"])).splitlines(),
        "",
        f"missing, found: {found_effect(s)}",
        f"missing, true: {true_effect(truth)}",
    ]
