"""An addition that depends on another signal alone: u + f(from), piecewise linear."""

from collections.abc import Mapping

import numpy as np
import sympy as sp

from hvdc_ident.data import Array
from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.expression import clip
from hvdc_ident.immutable import FrozenMap

KNOTS = 9
VALUES = tuple(f"v{k + 1}" for k in range(KNOTS))


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return u + f(from): f is level beyond its ends and straight between the values that stand in p; the others are 0."""
    place, low, width = p["from"], p["low"], (p["high"] - p["low"]) / (KNOTS - 1)
    values = [p.get(n, sp.S.Zero) for n in VALUES]
    rises = [clip((place - low) / width - k, 0, 1) for k in range(KNOTS - 1)]
    return u + sp.Add(values[0], *((b - a) * r for a, b, r in zip(values, values[1:], rises, strict=False)))


def _values(p: Mapping[str, float]) -> tuple[Array, Array]:
    """Return the knots, and what is added to u there."""
    return np.linspace(p["low"], p["high"], KNOTS), np.array([p[n] for n in VALUES])


EFFECT = Effect(
    name="curve",
    summary=f"addition that depends on another signal alone, u + f(from), straight between {KNOTS} values from low to high",
    parameters=FrozenMap(
        {
            "low": EffectParameter(0.0, min=-np.inf, description="first knot, in the unit of the other signal",
                                   measure="source low", fixed=True, probes=(1.0,)),
            "high": EffectParameter(1.0, min=-np.inf, description="last knot, in the unit of the other signal",
                                    measure="source high", fixed=True, probes=(1.0,)),
        }
        | {
            n: EffectParameter(0.0, neutral=0.0, min=-np.inf, description=f"addition at knot {k + 1}", measure="range",
                               probes=(1e-3,), optional=True, companion=True)
            for k, n in enumerate(VALUES)
        }
    ),
    rewrite=rewrite,
    sentence="{at} is off by what depends on {from} alone, which is given as a curve",
    excited_by="slow ramps of the other signal over its whole range",
    example=FrozenMap({"low": 0.0, "high": 1.2, "v7": 0.05, "v8": -0.05}),
    needs_source=True,
    tried_by_default=False,
    outside="curve",
    curve=_values,
    confusable=FrozenMap(
        {
            "coupling": "levels of the other signal far from each other: the coupling is in proportion to it",
            "conductance": "levels of the other signal far from each other: the leak is in proportion to it",
            "loss": "levels of the other signal of both signs",
        }
    ),
)  # fmt: skip
