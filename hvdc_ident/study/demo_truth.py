"""The truth behind recordings made here: the parameters of the model that made them, and by how much its loops are later.

What the fitted model lacks is spread over several filters and control loops, so no single time constant is true. True is
the delay it amounts to: both models' loops are opened at the order of a controller, and the phase between the two
open-loop transfers, at the frequency where the fitted model's has the gain 1, over that frequency is the equivalent delay.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from hvdc_ident.linearize import loop, margins
from hvdc_ident.model import AnyModel, Model, is_white_box

FILE = "truth.json"
"""Name of the file in the folder of results; the report reads it there."""


def truth_of(plant: AnyModel, model: AnyModel, parameters: list[str], orders: list[str]) -> dict[str, Any]:
    """Return the true values, the parts of the plant that the model lacks, and the delay that they amount to in each loop.

    plant: what made the recordings. model: what is fitted. parameters: names that both have. orders: signals that both
    have, at which the loops are opened.
    """
    lacking: list[str] = []
    delays: list[dict[str, Any]] = []
    if is_white_box(plant) and is_white_box(model):
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
