"""An offset: u + c."""

import math
from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return u + c."""
    return u + p["c"]


EFFECT = Effect(
    name="offset",
    summary="constant offset, u + c",
    parameters=FrozenMap(
        {
            "c": EffectParameter(
                0.0,
                neutral=0.0,
                min=-math.inf,
                description="offset",
                measure="range",
                probes=(-0.05, 0.05),
            )
        }
    ),
    rewrite=rewrite,
    sentence="{at} is off by {c}",
    asked="the offset",
    excited_by="a level held long enough, with a record that the loop does not regulate",
    example=FrozenMap({"c": 0.01}),
    confusable=FrozenMap(
        {
            "gain": "several levels: the offset is the same at each",
            "droop": "several levels of the other signal",
            "loss": "several levels: the offset is the same at each",
        }
    ),
)
