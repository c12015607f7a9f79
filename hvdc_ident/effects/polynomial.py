"""A bend of second and third order: u + b u^2 + c u^3."""

import math
from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return u with the powers that stand in p."""
    return u + sp.Add(*(p[n] * u**power for n, power in (("b", 2), ("c", 3)) if n in p))


def _coefficient(order: str) -> EffectParameter:
    return EffectParameter(
        0.0,
        neutral=0.0,
        min=-math.inf,
        description=f"coefficient of {order} order",
        measure="bend 2" if order == "second" else "bend 3",
        probes=(0.05,),
        optional=True,
    )


EFFECT = Effect(
    name="polynomial",
    summary="bend of second and third order, u + b u^2 + c u^3",
    parameters=FrozenMap({"b": _coefficient("second"), "c": _coefficient("third")}),
    rewrite=rewrite,
    sentence="{at} is larger by [{b} times its square] + [{c} times its cube]",
    excited_by="slow ramps over the whole range of the signal, of both signs",
    example=FrozenMap({"b": 0.1, "c": -0.2}),
    tried_by_default=False,
    outside="term",
    confusable=FrozenMap(
        {
            "saturation": "a ramp far beyond the level: the saturation comes to it, a polynomial bends on",
            "gain": "levels far from each other: the gain is the same at each",
        }
    ),
)
