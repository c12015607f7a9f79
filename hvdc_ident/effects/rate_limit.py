"""A rate limit: y' = clip((u - y)/2e-4, -rate, rate)."""

import math
from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.expression import TRACKING_TIME, clip
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return a state that follows u no faster than the rate; its value at rest, u, does not follow from a clipped derivative."""
    return add.state("y", lambda y: clip((u - y) / TRACKING_TIME, -p["rate"], p["rate"]), rest=u)


EFFECT = Effect(
    name="rate-limit",
    summary="rate limit, y' = clip((u - y)/2e-4, -rate, rate)",
    parameters=FrozenMap(
        {
            "rate": EffectParameter(
                10.0,
                neutral=math.inf,
                unit="1/s",
                min=1e-12,
                description="largest rate",
                measure="range/time",
                # At the slowest a step hardly passes, as with a set-point that is ramped over minutes.
                probes=(1.3, 0.9, 0.7, 0.5, 0.3),
                search=(1.8, -0.5),
            )
        }
    ),
    rewrite=rewrite,
    sentence="{at} cannot change faster than {rate}",
    asked="the limit of the rate of change",
    excited_by="steps of two sizes of the signal, so that two slopes would be asked for",
    example=FrozenMap({"rate": 1.0}),
    states="y, one per insertion point",
    confusable=FrozenMap(
        {
            "lag": "two steps of different size: the lag scales with them, the rate does not",
            "limit": "two slopes: the level does not depend on how fast it is reached",
        }
    ),
)
