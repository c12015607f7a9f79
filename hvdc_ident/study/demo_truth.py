"""The truth behind recordings made here: the parameters of the model that made them, and by how much its loops are later.

What the fitted model lacks is spread over several filters and control loops, so no single time constant is true. True is
the delay it amounts to: both models' loops are opened at the order of a controller, and the phase between the two
open-loop transfers, at the frequency where the fitted model's has the gain 1, over that frequency is the equivalent delay.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from hvdc_ident.linearize import loop, margins
from hvdc_ident.model import AnyModel, Model
from hvdc_ident.summary import RunSummary
from hvdc_ident.summary.tables import truth_table
from hvdc_ident.text import listed, probability_text, quantity

FILE = "truth.json"
"""Name of the file in the folder of results; the report reads it there."""


def truth_of(plant: AnyModel, model: AnyModel, parameters: list[str], orders: list[str]) -> dict[str, Any]:
    """Return the true values, the parts of the plant that the model lacks, and the delay that they amount to in each loop.

    plant: what made the recordings. model: what is fitted. parameters: names that both have. orders: signals that both
    have, at which the loops are opened.
    """
    lacking: list[str] = []
    delays: list[dict[str, Any]] = []
    if isinstance(plant, Model) and isinstance(model, Model):
        parts = (s.description.rstrip(" 0123456789") for n, s in plant.states.items() if n not in model.states)
        lacking = list(dict.fromkeys(part for part in parts if part))
        delays = [d for order in orders if (d := equivalent_delay(plant, model, order)) is not None]
    return {
        "plant": plant.name,
        "parameters": {n: {"value": plant.values[n], "unit": plant.parameters[n].unit} for n in parameters},
        "lacking": lacking,
        "delays": delays,
    }


def equivalent_delay(plant: Model, model: Model, order: str) -> dict[str, Any] | None:
    """Return by how many seconds the plant's loop through a signal is later than the model's, and at which frequency.

    The frequency is that of the model's phase margin; None for a loop that has none.
    """
    opened = loop(model, order)
    omega = margins(opened).phase_margin.omega
    if not math.isfinite(omega):
        return None
    late, prompt = (one.response(np.array([omega])).values.item() for one in (loop(plant, order), opened))
    return {"order": order, "seconds": float(-np.angle(late / prompt) / omega), "at_hz": omega / math.tau}


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
