"""A leakage proportional to another signal: u - g from."""

import math
from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return u minus the leakage."""
    return u - p["g"] * p["from"]


EFFECT = Effect(
    name="conductance",
    summary="leak proportional to another signal, u - g from",
    parameters=FrozenMap(
        {
            "g": EffectParameter(
                0.0,
                neutral=0.0,
                min=-math.inf,
                description="conductance",
                measure="range/source",
                probes=(0.05,),
            )
        }
    ),
    rewrite=rewrite,
    sentence="{at} loses {g} times {from}",
    excited_by="several levels of the other signal",
    example=FrozenMap({"g": 0.02}),
    confusable=FrozenMap(
        {
            "coupling": "several start levels: the coupling counts from the start value",
            "droop": "several start levels: the droop counts from the start value",
            "loss": "both signs: the loss does not change sign",
            "offset": "several levels of the other signal",
        }
    ),
    needs_source=True,
    # The magnitude of a signal that keeps its sign is that signal, or its opposite.
    equals=FrozenMap({"loss": lambda p, source: {} if (source > 0.0).all() or (source < 0.0).all() else None}),
)
