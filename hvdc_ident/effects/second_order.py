"""A second-order lag: y'' = wn^2 (u - y) - 2 zeta wn y'."""

import math
from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return y of the pair y' = wn v, v' = wn (u - y - 2 zeta v); v is in the unit of y, so that the states are comparable."""
    wn, zeta = p["wn"], p["zeta"]
    y, _ = add.states(("y", "v"), lambda s: (wn * s[1], wn * (u - s[0] - 2 * zeta * s[1])), rests=(u, sp.S.Zero))
    return y


EFFECT = Effect(
    name="second-order",
    summary="second-order lag, y'' = wn^2 (u - y) - 2 zeta wn y'",
    parameters=FrozenMap(
        {
            "wn": EffectParameter(
                1000.0,
                neutral=math.inf,
                unit="rad/s",
                min=1e-9,
                description="natural frequency",
                measure="rate",
                probes=(0.7, 0.45, 0.2),
            ),
            "zeta": EffectParameter(0.7, description="damping ratio", probes=(0.2, 0.7), search=(0.02, 2.0)),
        }
    ),
    rewrite=rewrite,
    equivalent_delay=lambda p: 2 * p["zeta"] / p["wn"],
    generalises=("lag",),
    sentence="{at} of the plant follows that of the model as a second-order system of {wn} and damping {zeta}, {equivalent_delay} late",
    asked="the natural frequency and damping of the filter or transducer",
    excited_by="a step of the signal, recorded at several samples per 1/wn",
    example=FrozenMap({"wn": 400.0, "zeta": 0.5}),
    states="y and its rate v = y'/wn, one pair per insertion point",
    confusable=FrozenMap(
        {
            "lag": "excitation up to wn: the second order begins with no slope and may ring",
            "delay": "excitation up to wn: the delay keeps the shape",
        }
    ),
)
