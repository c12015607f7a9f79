"""A sampled block: u is taken every Ts and published `compute` later."""

from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.frozen import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Symbol], add: Additions) -> sp.Expr:
    """The held sample."""
    return add.sampled(u, p["Ts"], p["compute"])


EFFECT = Effect(
    name="sample-hold",
    summary="u held for Ts, then computed for `compute` more",
    parameters=FrozenMap(
        {
            "Ts": EffectParameter(
                1e-4, neutral=0.0, unit="s", probes=(1e-4, 5e-4, 2e-3), description="sampling period"
            ),
            "compute": EffectParameter(0.0, unit="s", description="computation time, at most one period"),
        }
    ),
    rewrite=rewrite,
    sentence="{at} is sampled every {Ts} and published {compute} later",
    excited_by="a step or ramp through the slot, recorded several times per sampling period",
)
