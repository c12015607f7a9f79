"""Models and their text form."""

from hvdc_ident.model.card import parse_card, read_card, save_card, write_card
from hvdc_ident.model.definition import (
    Algebraic,
    Delay,
    Model,
    Output,
    Parameterisation,
    Sampled,
    Signal,
    State,
)

__all__ = [
    "Algebraic",
    "Delay",
    "Model",
    "Output",
    "Parameterisation",
    "Sampled",
    "Signal",
    "State",
    "parse_card",
    "read_card",
    "save_card",
    "write_card",
]
