"""A gain: k u."""

import math
from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return k u."""
    return p["k"] * u


EFFECT = Effect(
    name="gain",
    summary="gain or scale error, k u",
    parameters=FrozenMap(
        {
            "k": EffectParameter(
                1.0, neutral=1.0, min=-math.inf, description="gain", probes=(0.9, 1.1), search=(0.2, 5.0)
            )
        }
    ),
    rewrite=rewrite,
    sentence="{at} is {k} times what the model has",
    asked="the scaling",
    excited_by="steps to several levels, with a record that the loop does not regulate",
    example=FrozenMap({"k": 0.9}),
    confusable=FrozenMap(
        {
            "offset": "several levels: the offset is the same at each",
            "loss": "several levels and both signs: the loss does not change sign",
            "saturation": "steps of several sizes: the gain is the same at each",
            "limit": "two sizes: only the larger one is cut",
        }
    ),
)
