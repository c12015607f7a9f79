"""A pure delay: y = u(t - T)."""

from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return u(t - T)."""
    return add.delay(u, p["T"])


EFFECT = Effect(
    name="delay",
    summary="pure delay, y = u(t - T)",
    parameters=FrozenMap(
        {
            "T": EffectParameter(
                1e-3, neutral=0.0, unit="s", description="delay", measure="time", probes=(0.0, 0.25, 0.5, 0.75)
            )
        }
    ),
    rewrite=rewrite,
    equivalent_delay=lambda p: p["T"],
    sentence="{at} arrives {T} late",
    asked="the dead time of sampling, computation and communication",
    excited_by="a step of the signal, recorded at several samples per delay",
    example=FrozenMap({"T": 0.002}),
    states="the signal's history over T",
    confusable=FrozenMap(
        {
            "lag": "excitation up to 1/T: the delay keeps the shape, the lag rounds it",
            "sample-hold": "recordings finer than the sampling period: the held signal moves in steps",
            "window-mean": "a step: the mean is a ramp over T, the delay a late step",
        }
    ),
)
