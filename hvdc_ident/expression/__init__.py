"""Expressions: text to sympy and back, safely."""

from hvdc_ident.expression.functions import TIME, clip, symbol, where
from hvdc_ident.expression.parser import parse
from hvdc_ident.expression.printer import to_text

__all__ = ["TIME", "clip", "parse", "symbol", "to_text", "where"]
