"""A limit on the rate of a state: x' = clip(f, -down, up), f the derivative that the model gives it."""

import math
from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.expression import Max, Min, clip
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return the derivative between -down and up; the state rests where it does without a limit, which a clipped derivative hides."""
    add.rest(p["state"], u)
    if "up" in p and "down" in p:
        return clip(u, -p["down"], p["up"])
    return Min(u, p["up"]) if "up" in p else Max(u, -p["down"])


EFFECT = Effect(
    name="state-rate-limit",
    summary="rate limit of a state (servo, gate, order): x' = clip(f, -down, up) instead of x' = f",
    parameters=FrozenMap(
        {
            "up": EffectParameter(
                math.inf,
                neutral=math.inf,
                unit="1/s",
                min=1e-12,
                description="largest rate upwards",
                measure="range/time",
                probes=(1.3, 0.9, 0.7, 0.5, 0.3),
                search=(1.8, -0.5),
                optional=True,
                companion=True,
            ),
            "down": EffectParameter(
                math.inf,
                neutral=math.inf,
                unit="1/s",
                min=1e-12,
                description="largest rate downwards, a magnitude",
                measure="of up",
                probes=(1.0,),
                optional=True,
                companion=True,
            ),
        }
    ),
    rewrite=rewrite,
    sentence="{at} cannot rise faster than {up} nor fall faster than {down}",
    asked="the limits of the rate of change, upwards and downwards",
    excited_by="steps of two sizes in both directions, so that the state would be asked for several slopes",
    example=FrozenMap({"up": 0.4, "down": 0.2}),
    insertion_kinds=("state",),
    of_derivative=True,
    confusable=FrozenMap(
        {
            "lag": "two steps of different size: the lag scales with them, the rate does not",
            "rate-limit": "a reversal while it limits: a limited state turns at once; where what its readers see is limited, it has run on",
            "limit": "two slopes: the level does not depend on how fast it is reached",
        }
    ),
)
