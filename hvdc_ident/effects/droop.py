"""A droop: u - k (from - from0), from0 the value at the start, with an optional deadband."""

from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.expression import clip
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return u minus k times the part of the other signal's change beyond the deadband."""
    change = p["from"] - add.start(p["from"])
    if "deadband" in p:
        change = change - clip(change, -p["deadband"], p["deadband"])
    return u - p["k"] * change


EFFECT = Effect(
    name="droop",
    summary="droop on another signal, u - k (from - from0), with an optional deadband",
    parameters=FrozenMap(
        {
            "k": EffectParameter(
                0.0,
                neutral=0.0,
                description="droop",
                measure="range/source",
                probes=(0.1, 0.5),
                search=(1e-3, 3.0),
            ),
            "deadband": EffectParameter(
                0.0, neutral=0.0, description="change of the other signal without effect", optional=True
            ),
        }
    ),
    rewrite=rewrite,
    sentence="{at} droops by {k} per unit of {from}",
    excited_by="several levels of the other signal, with this signal's set-point at rest",
    example=FrozenMap({"k": 0.2, "deadband": 0.0001}),
    states="the other signal's start value, one per insertion point",
    confusable=FrozenMap(
        {
            "offset": "several levels of the other signal",
            "coupling": "nothing: a droop without deadband is a negative coupling",
            "conductance": "several start levels: the droop counts from the start value",
        }
    ),
    needs_source=True,
    equals=FrozenMap(
        {
            "coupling": lambda p, source: None if p.get("deadband") else {"k": -p["k"]},
            # Counted from a start value of 0, the other signal is its change.
            "conductance": lambda p, source: (
                {"g": p["k"]} if source.size and source[0] == 0.0 and not p.get("deadband") else None
            ),
        }
    ),
)
