"""The mean over a sliding window, as a one-cycle measurement takes it."""

from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return the state y' = (u - u(t - T)) / T; its value at rest, u, does not follow from the derivative."""
    before = add.delay(u, p["T"])
    return add.state("y", lambda y: (u - before) / p["T"], rest=u)


EFFECT = Effect(
    name="window-mean",
    summary="mean of u over the last T (a one-cycle measurement)",
    parameters=FrozenMap(
        {
            "T": EffectParameter(
                0.02, neutral=0.0, unit="s", description="window", measure="time", probes=(0.1, 0.35, 0.6, 0.85)
            )
        }
    ),
    rewrite=rewrite,
    equivalent_delay=lambda p: p["T"] / 2,
    sentence="{at} is the mean over the last {T}",
    asked="the length of the averaging window",
    excited_by="a step of the signal, recorded at several samples per window",
    example=FrozenMap({"T": 0.01}),
    states="y, one per insertion point, and the signal's history over T",
    confusable=FrozenMap(
        {
            "lag": "excitation up to 1/T: the mean is a straight line after a step and ends after T",
            "delay": "a step: the mean is a ramp over T, the delay a late step",
        }
    ),
)
