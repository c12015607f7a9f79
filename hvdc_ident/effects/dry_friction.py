"""Dry (Coulomb) friction: u - F sign(from), over a narrow transition about standstill."""

import math
from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return u less the friction, which goes over from one sign to the other as tanh(from/v)."""
    return u - p["F"] * sp.tanh(p["from"] / p["v"])


EFFECT = Effect(
    name="dry-friction",
    summary="dry friction by another signal, u - F tanh(from/v)",
    parameters=FrozenMap(
        {
            "F": EffectParameter(
                0.0,
                neutral=0.0,
                min=-math.inf,
                description="friction while the other signal moves",
                measure="range",
                probes=(0.05,),
            ),
            "v": EffectParameter(
                0.01,
                min=1e-12,
                description="width of the transition about standstill, in the unit of the other signal",
                measure="source peak",
                probes=(0.02, 0.2),
                search_factor=50.0,
            ),
        }
    ),
    rewrite=rewrite,
    sentence="{at} loses {F} against the sign of {from} (dry friction, in full beyond +-{v})",
    excited_by="slow motion of the other signal both ways through standstill",
    example=FrozenMap({"F": 0.05, "v": 0.02}),
    needs_source=True,
    tried_by_default=False,
    outside="term",
    confusable=FrozenMap(
        {
            "conductance": "several speeds: dry friction does not grow with speed",
            "loss": "both signs: the loss does not change sign",
            "backlash": "a slow ramp through standstill: the play moves nothing, friction brakes at once",
        }
    ),
)
