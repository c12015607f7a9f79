"""A gain that depends on another signal: u (1 + g + k from)."""

import math
from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return u times a gain that follows the other signal."""
    return u + u * sp.Add(*(p[n] * t for n, t in (("g", sp.S.One), ("k", p["from"])) if n in p))


EFFECT = Effect(
    name="product",
    summary="gain that depends on another signal, u (1 + g + k from)",
    parameters=FrozenMap(
        {
            "g": EffectParameter(
                0.0,
                neutral=0.0,
                min=-math.inf,
                description="gain error where the other signal is 0",
                probes=(0.02,),
                optional=True,
                companion=True,  # on its own it is a gain
            ),
            "k": EffectParameter(
                0.0,
                neutral=0.0,
                min=-math.inf,
                description="gain per unit of the other signal",
                measure="one/source",
                probes=(0.05,),
                optional=True,
            ),
        }
    ),
    rewrite=rewrite,
    sentence="the gain of {at} is larger by [{g}] + [{k} times {from}]",
    excited_by="several levels of both signals, in all combinations",
    example=FrozenMap({"g": -0.05, "k": 0.1}),
    needs_source=True,
    tried_by_default=False,
    outside="term",
    confusable=FrozenMap(
        {
            "coupling": "several levels of the signal itself: what a product adds is in proportion to it",
            "conductance": "several levels of the signal itself: what a product adds is in proportion to it",
            "gain": "several levels of the other signal: the gain does not depend on it",
        }
    ),
)
