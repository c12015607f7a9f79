"""A pure delay: y = u(t - T)."""

from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.frozen import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Symbol], add: Additions) -> sp.Expr:
    """u as it was T ago."""
    return add.delay(u, p["T"])


EFFECT = Effect(
    name="delay",
    summary="pure delay, y = u(t - T)",
    parameters=FrozenMap(
        {"T": EffectParameter(1e-3, neutral=0.0, unit="s", probes=(5e-4, 2e-3, 1e-2), description="delay")}
    ),
    rewrite=rewrite,
    sentence="{at} arrives {T} late",
    excited_by="a step through the slot, recorded at several samples per delay",
)
