"""Backlash of full width: y follows when u leaves [y - width/2, y + width/2]."""

from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import TRACKING_TIME, Additions, Effect, EffectParameter
from hvdc_ident.expression import clip
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return a state that follows, within 0.2 ms, the part of u - y beyond the play.

    An ideal play would need u', which jumps where u does; so the right-hand side has corners but no jumps. In steady
    state u is taken to lie in the middle of the play.
    """
    half = p["width"] / 2
    return add.state("y", lambda y: (u - y - clip(u - y, -half, half)) / TRACKING_TIME, rest=u)


EFFECT = Effect(
    name="backlash",
    summary="play of full width: y follows when u leaves [y - width/2, y + width/2]",
    parameters=FrozenMap(
        {
            "width": EffectParameter(
                0.01,
                neutral=0.0,
                description="full width of the play",
                measure="range",
                probes=(0.03, 0.1, 0.3),
                search=(1e-4, 1.9),
            )
        }
    ),
    rewrite=rewrite,
    sentence="{at} follows with a play of {width}",
    excited_by="slow ramps both ways, with turns at several levels",
    example=FrozenMap({"width": 0.02}),
    states="y, one per insertion point",
    reversal="width",
    confusable=FrozenMap(
        {
            "deadband": "slow ramps both ways: the deadband is flat at 0 only",
            "quantisation": "slow ramps both ways: the play is flat at turns only",
        }
    ),
)
