"""A soft limiter: level tanh(u/level)."""

import math
from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return level tanh(u/level)."""
    return p["level"] * sp.tanh(u / p["level"])


EFFECT = Effect(
    name="saturation",
    summary="soft saturation, level tanh(u/level)",
    parameters=FrozenMap(
        {
            "level": EffectParameter(
                1.0,
                neutral=math.inf,
                min=1e-12,
                description="magnitude it tends to",
                measure="peak",
                probes=(0.8, 1.5, 3.0, 6.0),
                # On a signal that hardly moves a curvature of a few parts in a million shows, as an offset does.
                search=(0.1, 100.0),
            )
        }
    ),
    rewrite=rewrite,
    sentence="{at} saturates softly towards {level}",
    asked="the level of saturation",
    excited_by="steps to several levels of both signs",
    example=FrozenMap({"level": 0.8}),
    confusable=FrozenMap(
        {
            "limit": "steps to several levels: the soft one bends long before the hard one cuts",
            "gain": "steps of several sizes: the gain is the same at each",
            "loss": "several levels and both signs: the saturation is odd and of third order",
        }
    ),
)
