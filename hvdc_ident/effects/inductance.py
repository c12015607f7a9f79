"""An inductance in series with a resistance: L y' = R (u - y); an algebraic line current becomes a state."""

from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return the current as a state; u is the current through the resistance alone."""
    return add.state("y", lambda y: p["R"] * (u - y) / p["L"], rest=u)


EFFECT = Effect(
    name="inductance",
    summary="inductance in an algebraic current, L y' = R (u - y), R named",
    parameters=FrozenMap(
        {
            "L": EffectParameter(
                1e-3, neutral=0.0, unit="s", description="inductance", measure="time*R", probes=(0.0, 0.25, 0.5, 0.75)
            ),
            "R": EffectParameter(1.0, min=1e-12, description="resistance of the same path", fixed=True),
        }
    ),
    rewrite=rewrite,
    sentence="{at} has an inductance of {L} in its path",
    excited_by="a fast change of the voltage across the path, recorded at several samples per L/R",
    example=FrozenMap({"L": 0.002, "R": 0.7}),
    states="the current, one per insertion point",
    confusable=FrozenMap({"lag": "nothing from outside: the same with T = L/R"}),
    resistance="R",
    equals=FrozenMap({"lag": lambda p, source: {"T": p["L"] / p["R"]} if p.get("L") and p.get("R") else {}}),
)
