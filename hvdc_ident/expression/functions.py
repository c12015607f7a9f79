"""The functions of the grammar that sympy lacks, and the one kind of symbol that models are made of."""

from __future__ import annotations

from typing import Any

import sympy as sp


def symbol(name: str) -> sp.Symbol:
    """The symbol of a model variable: real, so that sympy may simplify as engineers do."""
    return sp.Symbol(name, real=True)


TIME = symbol("time")


class clip(sp.Function):
    """clip(x, low, high): the hard limiter, low where x < low, high where x > high, else x."""

    nargs = 3
    is_real = True

    @classmethod
    def eval(cls, x: Any, low: Any, high: Any) -> Any:
        if x.is_number and low.is_number and high.is_number:
            return sp.Min(sp.Max(x, low), high)
        return None

    def fdiff(self, argindex: int = 1) -> Any:
        x, low, high = self.args
        inside = sp.Piecewise((0, x < low), (0, x > high), (1, True))
        return {1: inside, 2: sp.Piecewise((1, x < low), (0, True)), 3: sp.Piecewise((1, x > high), (0, True))}[
            argindex
        ]


def where(condition: Any, a: Any, b: Any) -> sp.Expr:
    """a where the condition holds, else b."""
    return sp.Piecewise((a, condition), (b, True))
