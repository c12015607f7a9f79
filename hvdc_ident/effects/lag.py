"""A first-order lag: T y' = u - y."""

from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.frozen import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Symbol], add: Additions) -> sp.Expr:
    """The state that follows u."""
    return add.state("y", lambda y: (u - y) / p["T"])


EFFECT = Effect(
    name="lag",
    summary="first-order lag, T y' = u - y",
    parameters=FrozenMap(
        {
            "T": EffectParameter(
                1e-3, neutral=0.0, unit="s", probes=(5e-4, 2e-3, 1e-2, 5e-2), description="time constant"
            )
        }
    ),
    rewrite=rewrite,
    sentence="{at} follows its order with a first-order lag of {T}",
    excited_by="a step or fast ramp through the slot, recorded at several samples per time constant",
)
