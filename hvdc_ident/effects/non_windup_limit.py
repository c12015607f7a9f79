"""A non-windup limit of a state (IEEE 421.5): x' = 0 while x is at a limit and its derivative points outward, else x' = f."""

import math
from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import TRACKING_TIME, Additions, Effect, EffectParameter
from hvdc_ident.expression import where
from hvdc_ident.immutable import FrozenMap

NEAR = 1e-8
"""Distance from a limit, of 1 and its magnitude, from which on the state counts as being at it. A state held exactly there would
lie on the switch itself, where there is no linear model."""


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return the derivative without what would carry the state beyond a limit that it has reached; there it is held.

    Held, it goes the rest of the way to the limit within 0.2 ms, so that a state at its limit has a linear model. It rests
    where its derivative is 0, or at a limit with the derivative outward: a way from x to its rest that leads beyond a limit
    ends there.
    """
    x = p["state"]

    def held(way: sp.Expr) -> sp.Expr:
        below = sp.Min(way, p["high"] - x) if "high" in p else way
        return sp.Max(below, p["low"] - x) if "low" in p else below

    add.rest(x, u, held)
    derivative = u
    if "high" in p:
        left = p["high"] - x
        derivative = where(left <= _near(p["high"]), sp.Min(derivative, left / TRACKING_TIME), derivative)
    if "low" in p:
        left = p["low"] - x
        derivative = where(left >= -_near(p["low"]), sp.Max(derivative, left / TRACKING_TIME), derivative)
    return derivative


def _near(level: sp.Expr) -> sp.Expr:
    return NEAR * (1 + sp.Abs(level))


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
