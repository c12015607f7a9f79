"""A term found from data: u + f(signals), f given with its coefficients; what no other effect of the catalogue is."""

from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """u and the term; in it the slot's own name is u."""
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
