"""Models, their text form, and models made from models."""

from hvdc_ident.model.card import parse_card, read_card, save_card, write_card
from hvdc_ident.model.check import coerced, dependency_order, ordered_signals, used_names
from hvdc_ident.model.definition import (
    Algebraic,
    AnyModel,
    Delay,
    External,
    Model,
    ModelOrigin,
    Output,
    Parameterisation,
    Sampled,
    Signal,
    State,
    recording,
)
from hvdc_ident.model.transform import (
    blended,
    driven,
    fresh,
    insertion_point,
    insertion_point_of,
    rewritten,
    with_derivative_signal,
    without_delays,
)

__all__ = [
    "Algebraic",
    "AnyModel",
    "Delay",
    "External",
    "Model",
    "ModelOrigin",
    "Output",
    "Parameterisation",
    "Sampled",
    "Signal",
    "State",
    "blended",
    "coerced",
    "dependency_order",
    "driven",
    "fresh",
    "insertion_point",
    "insertion_point_of",
    "ordered_signals",
    "parse_card",
    "read_card",
    "recording",
    "rewritten",
    "save_card",
    "used_names",
    "with_derivative_signal",
    "without_delays",
    "write_card",
]
