"""A loss: u - (a + b |from| + c from^2)."""

import math
from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return u minus the loss caused by the other signal."""
    terms = {"a": sp.S.One, "b": sp.Abs(p["from"]), "c": p["from"] ** 2}
    return u - sp.Add(*(p[n] * t for n, t in terms.items() if n in p))


EFFECT = Effect(
    name="loss",
    summary="loss by another signal, u - (a + b |from| + c from^2)",
    parameters=FrozenMap(
        {
            "a": EffectParameter(
                0.0,
                neutral=0.0,
                min=-math.inf,
                description="loss at no load",
                measure="range",
                probes=(0.02,),
                optional=True,
                companion=True,  # on its own it is an offset
            ),
            "b": EffectParameter(
                0.0,
                neutral=0.0,
                min=-math.inf,
                description="loss per magnitude",
                measure="range/source",
                probes=(0.05,),
                optional=True,
            ),
            "c": EffectParameter(
                0.0,
                neutral=0.0,
                min=-math.inf,
                description="loss per square",
                measure="range/source2",
                probes=(0.05,),
                optional=True,
            ),
        }
    ),
    rewrite=rewrite,
    sentence="{at} loses [{a}] + [{b} |{from}|] + [{c} {from}^2]",
    excited_by="several levels of the other signal, of both signs",
    example=FrozenMap({"a": 0.002, "b": 0.03, "c": 0.02}),
    confusable=FrozenMap(
        {
            "gain": "several levels and both signs: the loss does not change sign",
            "offset": "several levels: the offset is the same at each",
            "conductance": "both signs: the conductance changes sign with the other signal",
        }
    ),
    needs_source=True,
)
