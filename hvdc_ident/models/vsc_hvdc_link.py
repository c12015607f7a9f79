"""The phasor link: two VSC stations as current injectors behind their grids, with high-level controls, 6 states.

Per unit on 100 MVA and 640 kV, time in s. Station 1 controls dc voltage and reactive power, station 2 active and
reactive power; positive power flows from a grid into its converter. Equations: Vanfretti, Murad, Gomez Lopez 2017
(doi 10.1109/PESGM.2017.8274525), limits and anti-windup after the authors' average-value model. The model is the card
beside this file, made of components of the shelf.
"""

from __future__ import annotations

from pathlib import Path

from hvdc_ident.model import Model, read_card

SUMMARY = "two-terminal VSC-HVDC link in phasors, 6 states (the model under calibration)"


def model() -> Model:
    """Return the link in the paper's case: 40 MW from station 2 to station 1, gains of Table I."""
    return read_card(Path(__file__).with_suffix(".toml"))
