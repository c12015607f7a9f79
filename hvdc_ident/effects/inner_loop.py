"""A closed loop with integral action: y'' = wn^2 (u - y) + 2 zeta wn (u' - y')."""

import math
from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return y of the pair y' = wn (i + 2 zeta (u - y)), i' = wn (u - y), with i, the integral part, in the unit of y."""
    wn, zeta = p["wn"], p["zeta"]
    y, _ = add.states(
        ("y", "i"), lambda s: (wn * (s[1] + 2 * zeta * (u - s[0])), wn * (u - s[0])), rests=(u, sp.S.Zero)
    )
    return y


EFFECT = Effect(
    name="inner-loop",
    summary="closed loop with integral action, y'' = wn^2 (u - y) + 2 zeta wn (u' - y')",
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
            # Damped by much more a loop is a lag, and a slow rest of next to nothing beside it.
            "zeta": EffectParameter(0.7, description="damping ratio", probes=(0.4, 1.0), search=(0.02, 1.5)),
        }
    ),
    rewrite=rewrite,
    sentence="{at} is reached through a loop with integral action of {wn} and damping {zeta}",
    asked="the bandwidth and damping of the inner control loop",
    excited_by="a step of the signal, recorded at several samples per 1/wn",
    example=FrozenMap({"wn": 400.0, "zeta": 0.7}),
    states="y and the integral's part i, one pair per insertion point",
    confusable=FrozenMap(
        {
            "second-order": "excitation up to wn: the loop answers at once, overshoots, and slow signals pass it undelayed",
            "lag": "a ramp: behind the loop nothing stays of a lag's error",
        }
    ),
)
