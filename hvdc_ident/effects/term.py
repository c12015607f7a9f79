"""A further term found from data: u + f(signals), f given as an expression with its coefficients."""

from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return u plus the term, in which the name of the insertion point stands for u."""
    return u + p["expression"]


EFFECT = Effect(
    name="term",
    summary="a term found from data, u + f(signals), given as an expression",
    parameters=FrozenMap(),
    rewrite=rewrite,
    sentence="{at} has the further term {expression}",
    excited_by="an experiment over the whole range of the signals in the term",
    example=FrozenMap({"k": 0.1}),
    needs_expression=True,
)
