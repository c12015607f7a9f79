"""A deadband: 0 inside +-width, else u shifted towards 0 by width."""

from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.expression import deadband
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return the part of u that lies beyond the band."""
    return deadband(u, p["width"])


EFFECT = Effect(
    name="deadband",
    summary="0 inside +-width, else u shifted towards 0 by width",
    parameters=FrozenMap(
        {
            "width": EffectParameter(
                0.01,
                neutral=0.0,
                description="half of the band, from 0 to its edge",
                measure="peak",
                probes=(0.03, 0.1, 0.3),
                search=(1e-4, 1.0),
            )
        }
    ),
    rewrite=rewrite,
    holds=True,
    sentence="{at} is 0 within +-{width} and smaller by that beyond",
    asked="the width of the dead band",
    excited_by="slow ramps both ways through 0",
    example=FrozenMap({"width": 0.02}),
    confusable=FrozenMap(
        {
            "quantisation": "slow ramps both ways: one flat piece at 0 against many",
            "backlash": "slow ramps both ways: the play is flat at each turn, wherever it is",
            "offset": "both signs: the deadband shifts either side towards 0",
        }
    ),
)
