"""Backlash of full width: y follows when u leaves [y - width/2, y + width/2]."""

from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.expression import where
from hvdc_ident.immutable import FrozenMap

PULL = 1e-7
"""Time constant, s, with which y is pulled along: y is behind an ideal play by this times the speed of u, which has to be small
beside the play for the fastest u (a converter's control, 1e3 widths a second)."""
SHARP = 1e-4
"""Share of half the play within which a switch's value grows from 0 to its largest. While y is pulled, u is beyond the play by
`PULL` times its speed only; the tolerance of a switch is relative to its largest value, and would miss that u has turned."""


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return a state that follows, at once, the part of u - y beyond the play.

    An ideal play would need u', which jumps where u does; so the right-hand side has corners but no jumps. In steady
    state u is taken to lie in the middle of the play.
    """
    half = p["width"] / 2

    def derivative(y: sp.Expr) -> sp.Expr:
        above, below = u - y - half, u - y + half
        return (where(_sign(above, half) > 0, above, 0) + where(_sign(below, half) < 0, below, 0)) / PULL

    return add.state("y", derivative, rest=u)


def _sign(excess: sp.Expr, half: sp.Expr) -> sp.Expr:
    """Return -1 to 1 with the sign of the excess, steep at 0."""
    return excess / sp.sqrt(excess**2 + (SHARP * half) ** 2)


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
    asked="the play of the mechanism",
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
