"""A first-order lag: T y' = u - y."""

from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return a state that follows u."""
    return add.state("y", lambda y: (u - y) / p["T"], rest=u)


EFFECT = Effect(
    name="lag",
    summary="first-order lag, T y' = u - y",
    parameters=FrozenMap(
        {
            "T": EffectParameter(
                1e-3, neutral=0.0, unit="s", description="time constant", measure="time", probes=(0.0, 0.25, 0.5, 0.75)
            )
        }
    ),
    rewrite=rewrite,
    equivalent_delay=lambda p: p["T"],
    sentence="{at} of the plant follows that of the model with a first-order lag of {T}",
    asked="the time constant of the filter or transducer",
    excited_by="a step or fast ramp of the signal, recorded at several samples per time constant",
    example=FrozenMap({"T": 0.002}),
    states="y, one per insertion point",
    confusable=FrozenMap(
        {
            "delay": "excitation up to 1/T: the delay keeps the shape, the lag rounds it",
            "second-order": "excitation up to 1/T: the second order begins with no slope",
            "window-mean": "excitation up to 1/T: the mean ends after T and is a straight line after a step",
            "lead-lag": "a step: the lead jumps at once",
            "rate-limit": "two steps of different size: the lag scales with them, the rate does not",
            "inductance": "nothing from outside: on a current they are the same with T = L/R",
        }
    ),
)
