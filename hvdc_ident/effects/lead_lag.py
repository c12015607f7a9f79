"""A lead-lag: T2 y' = u - y + T1 u'."""

from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return y = x + T1/T2 (u - x) with T2 x' = u - x, which needs no derivative of u."""
    x = add.state("x", lambda x: (u - x) / p["T2"], rest=u)
    return x + p["T1"] / p["T2"] * (u - x)


EFFECT = Effect(
    name="lead-lag",
    summary="lead-lag, T2 y' = u - y + T1 u'",
    parameters=FrozenMap(
        {
            "T1": EffectParameter(
                2e-3, neutral="T2", unit="s", description="lead time constant", measure="of T2", probes=(0.4, 2.5)
            ),
            "T2": EffectParameter(
                1e-3, unit="s", min=1e-12, description="lag time constant", measure="time", probes=(0.2, 0.45, 0.7)
            ),
        }
    ),
    rewrite=rewrite,
    equivalent_delay=lambda p: p["T2"] - p["T1"],
    generalises=("lag",),
    sentence="{at} passes a lead-lag with T1 = {T1} and T2 = {T2}",
    asked="the two time constants of the lead-lag",
    excited_by="a step of the signal, recorded at several samples per time constant",
    example=FrozenMap({"T1": 0.003, "T2": 0.001}),
    states="x, one per insertion point",
    confusable=FrozenMap(
        {
            "lag": "a step: the lead jumps at once",
            "gain": "a step held long: the lead-lag returns to 1",
        }
    ),
)
