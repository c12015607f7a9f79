"""A drift with time: u + c t + g t u."""

import math
from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.expression import symbol
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return u with what drifts since the record's time 0."""
    return u + symbol("time") * sp.Add(*(p[n] * t for n, t in (("c", sp.S.One), ("g", u)) if n in p))


EFFECT = Effect(
    name="drift",
    summary="drift of the level or of the gain with time, u + c t + g t u",
    parameters=FrozenMap(
        {
            "c": EffectParameter(
                0.0,
                neutral=0.0,
                unit="1/s",
                min=-math.inf,
                description="rise of the level",
                measure="range/record",
                probes=(0.05,),
                optional=True,
            ),
            "g": EffectParameter(
                0.0,
                neutral=0.0,
                unit="1/s",
                min=-math.inf,
                description="rise of the gain",
                measure="one/record",
                probes=(0.05,),
                optional=True,
            ),
        }
    ),
    rewrite=rewrite,
    sentence="{at} drifts: it is larger by [{c} times the time] + [{g} times the time and itself]",
    excited_by="a long record in which the signal stands still, and another in which it moves",
    example=FrozenMap({"c": 0.02, "g": 0.04}),
    tried_by_default=False,
    outside="term",
    confusable=FrozenMap(
        {
            "offset": "a longer record: the offset stays",
            "gain": "a longer record: the gain stays",
        }
    ),
)
