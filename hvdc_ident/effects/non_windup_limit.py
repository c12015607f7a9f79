"""A non-windup limit of a state (IEEE 421.5): x' = 0 while x is at a limit and its derivative points outward, else x' = f."""

import math
from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.expression import Max, Min, nonwindup
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return the derivative without what would carry the state beyond a limit that it has reached; there it is held.

    Held, it goes the rest of the way to the limit within 0.2 ms, so that a state at its limit has a linear model. It rests
    where its derivative is 0, or at a limit with the derivative outward: a way from x to its rest that leads beyond a limit
    ends there.
    """
    x = p["state"]

    def held(way: sp.Expr) -> sp.Expr:
        below = Min(way, p["high"] - x) if "high" in p else way
        return Max(below, p["low"] - x) if "low" in p else below

    add.rest(x, u, held)
    return nonwindup(u, x, p.get("low"), p.get("high"))


EFFECT = Effect(
    name="non-windup-limit",
    summary="non-windup limit of a state: x' = 0 at low or high while f points outward, else x' = f",
    parameters=FrozenMap(
        {
            "low": EffectParameter(
                -math.inf,
                neutral=-math.inf,
                min=-math.inf,
                description="lower level",
                measure="above low",
                probes=(0.05, 0.3),
                optional=True,
            ),
            "high": EffectParameter(
                math.inf,
                neutral=math.inf,
                min=-math.inf,
                description="upper level",
                measure="below high",
                probes=(0.05, 0.3),
                optional=True,
            ),
        }
    ),
    rewrite=rewrite,
    sentence="{at} is held between {low} and {high} without windup",
    asked="the levels of the limit, and that it acts without windup",
    excited_by="a step large enough that the state reaches the limit, held, then reversed: the state leaves the limit at once",
    example=FrozenMap({"low": -0.45, "high": 0.45}),
    insertion_kinds=("state",),
    of_derivative=True,
    confusable=FrozenMap(
        {
            "limit": "a long step, then its reversal: behind a limit of the output the state winds up and comes back late",
            "saturation": "steps to several levels: the soft one bends long before the hard one holds",
            "state-rate-limit": "two slopes: the level does not depend on how fast it is reached",
        }
    ),
)
