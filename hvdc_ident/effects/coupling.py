"""Coupling of another signal: u + k (from - from0), from0 its value at the start."""

import math
from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return u plus k times the change of the other signal."""
    return u + p["k"] * (p["from"] - add.start(p["from"]))


EFFECT = Effect(
    name="coupling",
    summary="another signal leaks in, u + k (from - from0)",
    parameters=FrozenMap(
        {
            "k": EffectParameter(
                0.0,
                neutral=0.0,
                min=-math.inf,
                description="share of the other signal",
                measure="range/source",
                probes=(-0.1, 0.1),
            )
        }
    ),
    rewrite=rewrite,
    sentence="{at} takes {k} of the change of {from}",
    excited_by="steps that move the other signal and not this one",
    example=FrozenMap({"k": 0.2}),
    states="the other signal's start value, one per insertion point",
    confusable=FrozenMap(
        {
            "droop": "nothing: a negative coupling is a droop without deadband",
            "conductance": "several start levels: the coupling counts from the start value",
        }
    ),
    needs_source=True,
    equals=FrozenMap(
        {
            "droop": lambda p, source: {"k": -p["k"]} if p["k"] < 0.0 else None,
            # Counted from a start value of 0, the other signal is its change.
            "conductance": lambda p, source: {"g": -p["k"]} if source.size and source[0] == 0.0 else None,
        }
    ),
)
