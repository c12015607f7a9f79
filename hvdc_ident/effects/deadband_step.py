"""A deadband with a step: 0 inside +-width, u itself outside."""

from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.expression import TRACKING_TIME, deadband_step, where
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return u outside the band and 0 inside, inside the model over a narrow edge (a recorded output jumps).

    Within an algebraic loop a jump may leave no solution at all: there the value is reached within 0.2 ms.
    """
    width = p["width"]
    if add.kind == "output":
        return where(sp.Abs(u) > width, u, 0)
    outside = deadband_step(u, width)
    if not add.circular:
        return outside
    outside = add.signal("outside", outside)
    return add.state("y", lambda y: (outside - y) / TRACKING_TIME, rest=outside)


EFFECT = Effect(
    name="deadband-step",
    summary="0 inside +-width, else u (deadband with a step, type 1 of governors)",
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
    sentence="{at} is 0 within +-{width} and acts in full beyond",
    asked="the width of the dead band, and whether its output jumps at the edge",
    excited_by="slow ramps both ways through 0 and well beyond the band",
    example=FrozenMap({"width": 0.45}),
    confusable=FrozenMap(
        {
            "deadband": "a ramp well beyond the band: with the step the signal comes back in full, without it smaller by the width",
            "quantisation": "slow ramps both ways: one jump at either edge against many",
            "backlash": "slow ramps both ways: the play is flat at each turn, wherever it is",
        }
    ),
)
