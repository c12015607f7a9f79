"""Expressions: text to sympy and back, safely."""

from hvdc_ident.expression.blocks import BLOCKS, TRACKING_TIME, deadband, deadband_step, nonwindup
from hvdc_ident.expression.functions import (
    FUNCTIONS,
    TIME,
    Algebra,
    GrammarFunction,
    Max,
    Min,
    at_values,
    clip,
    elementary,
    function_of,
    symbol,
    where,
)
from hvdc_ident.expression.grammar import is_identifier, is_reserved
from hvdc_ident.expression.parser import EXACT, normal, parse
from hvdc_ident.expression.printer import to_text

__all__ = [
    "BLOCKS",
    "EXACT",
    "FUNCTIONS",
    "TIME",
    "TRACKING_TIME",
    "Algebra",
    "GrammarFunction",
    "Max",
    "Min",
    "at_values",
    "clip",
    "deadband",
    "deadband_step",
    "elementary",
    "function_of",
    "is_identifier",
    "is_reserved",
    "nonwindup",
    "normal",
    "parse",
    "symbol",
    "to_text",
    "where",
]
