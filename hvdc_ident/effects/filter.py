"""A linear filter of second order: u plus k times a band around wn, with shares of that below and above the band."""

import math
from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return y = u + k (low x + 2 zeta v + high (u - x - 2 zeta v)) of x' = wn v, v' = wn (u - x - 2 zeta v).

    x is the low-pass part, 2 zeta v the band-pass part with gain 1 at wn, the rest of u the high-pass part.
    """
    wn, zeta = p["wn"], p["zeta"]
    x, v = add.states(("x", "v"), lambda s: (wn * s[1], wn * (u - s[0] - 2 * zeta * s[1])), rests=(u, sp.S.Zero))
    band = 2 * zeta * v
    return u + p["k"] * (p["low"] * x + band + p["high"] * (u - x - band))


EFFECT = Effect(
    name="filter",
    summary="linear filter of second order, y = u + k (low wn^2 + 2 zeta wn s + high s^2)/(s^2 + 2 zeta wn s + wn^2) u",
    parameters=FrozenMap(
        {
            "k": EffectParameter(
                -0.5,
                neutral=0.0,
                min=-math.inf,
                description="gain added at wn",
                probes=(0.3,),
                search=(-5.0, 5.0),
            ),
            "low": EffectParameter(0.0, min=-math.inf, description="share of k well below wn"),
            "high": EffectParameter(0.0, min=-math.inf, description="share of k well above wn"),
            "wn": EffectParameter(
                100.0,
                unit="rad/s",
                min=1e-9,
                description="middle of the band",
                measure="rate",
                probes=(0.9, 0.78, 0.67, 0.56, 0.44, 0.33, 0.22, 0.1),
            ),
            "zeta": EffectParameter(
                0.25, description="half the band's width, of wn", probes=(0.3,), search=(0.01, 5.0)
            ),
        }
    ),
    rewrite=rewrite,
    sentence="{at} passes a filter of second order around {wn}, damping {zeta}: {k} more there, low = {low}, high = {high}",
    excited_by="a multisine of the signal over the filter's band",
    example=FrozenMap({"k": -0.5, "low": 0.1, "high": -0.1, "wn": 60.0, "zeta": 0.25}),
    states="x and v = x'/wn, one pair per insertion point",
    tried_by_default=False,
    confusable=FrozenMap(
        {
            "second-order": "a multisine from well below to well above wn: the second order lets nothing through above it",
            "lead-lag": "a multisine from well below to well above wn: a lead-lag's gain goes one way only",
            "lag": "a multisine from well below to well above wn: behind a lag nothing comes back above it",
        }
    ),
)
