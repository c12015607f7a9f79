"""A periodic disturbance: u + amplitude sin(2 pi frequency t + phase)."""

import math
from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.expression import TIME
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return u plus the sine, t being the time of the experiment."""
    return u + p["amplitude"] * sp.sin(2 * sp.pi * p["frequency"] * TIME + p["phase"])


EFFECT = Effect(
    name="disturbance",
    summary="periodic disturbance, u + amplitude sin(2 pi frequency t + phase)",
    parameters=FrozenMap(
        {
            "amplitude": EffectParameter(
                0.0,
                neutral=0.0,
                description="amplitude",
                measure="range",
                probes=(0.05,),
                search=(1e-4, 2.0),
            ),
            "frequency": EffectParameter(
                50.0,
                unit="Hz",
                min=1e-9,
                description="frequency",
                measure="rate",
                probes=(0.8, 0.6, 0.4, 0.2),
                search_factor=1.3,
            ),
            "phase": EffectParameter(
                0.0,
                unit="rad",
                min=-math.inf,
                description="phase at time 0",
                probes=(0.0, math.pi / 2),
                search=(-2.0 * math.pi, 2.0 * math.pi),
            ),
        }
    ),
    rewrite=rewrite,
    sentence="{at} carries a sine of {amplitude} at {frequency}, phase {phase}",
    excited_by="a record without any step, longer than several periods",
    example=FrozenMap({"amplitude": 0.01, "frequency": 30.0, "phase": 0.3}),
    self_exciting=True,
)
