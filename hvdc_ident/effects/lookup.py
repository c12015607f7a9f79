"""A characteristic in place of the signal itself: y = f(u), piecewise linear and rising."""

from collections.abc import Mapping

import numpy as np
import sympy as sp

from hvdc_ident.data import Array
from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.expression import clip
from hvdc_ident.immutable import FrozenMap

PIECES = 8
SLOPES = tuple(f"s{k + 1}" for k in range(PIECES))


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return f(u): of slope 1 beyond the ends of the characteristic, and with the slopes that stand in p in its pieces."""
    low, width = p["low"], (p["high"] - p["low"]) / PIECES
    pieces = [(k, p[n]) for k, n in enumerate(SLOPES) if n in p]
    more = [(s - 1) * clip(u - low - k * width, 0, width) for k, s in pieces]
    return u + sp.Add(p.get("c", sp.S.Zero), *more)


def _characteristic(p: Mapping[str, float]) -> tuple[Array, Array]:
    """Return the ends of the pieces, and what is added to u there."""
    at = np.linspace(p["low"], p["high"], PIECES + 1)
    slopes = np.array([p[n] for n in SLOPES])
    return at, p["c"] + np.concatenate([[0.0], np.cumsum((slopes - 1.0) * np.diff(at))])


EFFECT = Effect(
    name="lookup",
    summary=f"rising characteristic y = f(u), linear in each of {PIECES} pieces from low to high",
    parameters=FrozenMap(
        {
            "low": EffectParameter(0.0, min=-np.inf, description="begin of the first piece", measure="above low",
                                   probes=(0.0,), fixed=True),
            "high": EffectParameter(1.0, min=-np.inf, description="end of the last piece", measure="below high",
                                    probes=(0.0,), fixed=True),
            "c": EffectParameter(0.0, neutral=0.0, min=-np.inf, description="f(low) - low", measure="range",
                                 probes=(1e-3,), optional=True, companion=True),
        }
        | {
            n: EffectParameter(1.0, neutral=1.0, min=-np.inf, description=f"slope of piece {k + 1}", probes=(1.001,),
                               search=(0.0, 20.0), optional=True, companion=True)
            for k, n in enumerate(SLOPES)
        }
    ),
    rewrite=rewrite,
    sentence="{at} follows a characteristic, which is given as a curve",
    excited_by="slow ramps over the whole range of the signal",
    example=FrozenMap({"low": 0.0, "high": 1.0, "s4": 1.4}),
    tried_by_default=False,
    outside="curve",
    curve=_characteristic,
    confusable=FrozenMap(
        {
            "gain": "levels far from each other: the gain is the same at each",
            "saturation": "a ramp far beyond the level",
            "limit": "a ramp far beyond the level",
        }
    ),
)  # fmt: skip
