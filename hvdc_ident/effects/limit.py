"""A hard limiter: clip(u, -level, level)."""

import math
from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.expression import clip
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return u limited to +-level."""
    return clip(u, -p["level"], p["level"])


EFFECT = Effect(
    name="limit",
    summary="hard limit, clip(u, -level, level)",
    parameters=FrozenMap(
        {
            "level": EffectParameter(
                1.0,
                neutral=math.inf,
                description="largest magnitude",
                measure="excursion",
                probes=(0.3, 0.5, 0.7, 0.85, 0.95),
            )
        }
    ),
    rewrite=rewrite,
    sentence="{at} cannot exceed {level} in magnitude",
    asked="the limit",
    excited_by="a step large enough that the signal reaches the limit, held, then released",
    example=FrozenMap({"level": 0.45}),
    confusable=FrozenMap(
        {
            "saturation": "steps to several levels: the soft one bends long before the hard one cuts",
            "rate-limit": "two slopes: the level does not depend on how fast it is reached",
            "gain": "two sizes: only the larger one is cut",
        }
    ),
)
