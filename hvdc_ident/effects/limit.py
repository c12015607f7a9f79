"""A hard limiter: clip(u, -level, level)."""

import math
from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.expression.functions import clip
from hvdc_ident.frozen import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Symbol], add: Additions) -> sp.Expr:
    """u cut at both levels."""
    return clip(u, -p["level"], p["level"])


EFFECT = Effect(
    name="limit",
    summary="hard limit, clip(u, -level, level)",
    parameters=FrozenMap(
        {"level": EffectParameter(1.0, neutral=math.inf, probes=(0.2, 0.5, 0.8, 1.0), description="largest magnitude")}
    ),
    rewrite=rewrite,
    sentence="{at} cannot exceed {level} in magnitude",
    excited_by="a step large enough that the signal reaches the limit, held, then released",
)
