"""Expressions: text to sympy and back, safely."""

from hvdc_ident.expression.functions import (
    FUNCTIONS,
    TIME,
    Algebra,
    GrammarFunction,
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
    "EXACT",
    "FUNCTIONS",
    "TIME",
    "Algebra",
    "GrammarFunction",
    "clip",
    "elementary",
    "function_of",
    "is_identifier",
    "is_reserved",
    "normal",
    "parse",
    "symbol",
    "to_text",
    "where",
]
