"""A servo: a state that follows u with a lag and a limited rate, y' = clip((u - y)/T, -down, up)."""

from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.expression import clip
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return a state that follows u; its value at rest, u, does not follow from a clipped derivative."""
    return add.state("y", lambda y: clip((u - y) / p["T"], -p["down"], p["up"]), rest=u)


EFFECT = Effect(
    name="servo",
    summary="servo, a lag whose rate is limited: y' = clip((u - y)/T, -down, up)",
    parameters=FrozenMap(
        {
            "T": EffectParameter(
                0.1, neutral=0.0, unit="s", description="time constant", measure="time", probes=(0.25, 0.6)
            ),
            "up": EffectParameter(
                1.0,
                unit="1/s",
                min=1e-12,
                description="largest rate upwards",
                measure="range/time",
                probes=(0.9, 0.5),
                search=(1.8, -0.5),
            ),
            "down": EffectParameter(
                1.0,
                unit="1/s",
                min=1e-12,
                description="largest rate downwards, a magnitude",
                measure="of up",
                probes=(1.0,),
            ),
        }
    ),
    rewrite=rewrite,
    generalises=("lag", "rate-limit"),
    sentence="{at} follows through a servo with a lag of {T}, which rises by {up} at most and falls by {down}",
    asked="the time constant and the rate limits of the servo",
    excited_by="steps of two sizes in both directions: the small one shows the lag, the large one the rates",
    example=FrozenMap({"T": 0.02, "up": 0.6, "down": 0.4}),
    states="y, one per insertion point",
    tried_by_default=False,
    confusable=FrozenMap(
        {
            "lag": "two steps of different size: the lag scales with them, the rate does not",
            "rate-limit": "a small step: the servo rounds it",
            "state-rate-limit": "nothing from outside: on the state of a lag that the model has it is a servo with that lag's T",
        }
    ),
)
