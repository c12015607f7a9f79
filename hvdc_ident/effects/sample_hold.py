"""A sampled block: u is taken every Ts and published `compute` later."""

from collections.abc import Mapping

import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return the held sample."""
    return add.sampled(u, p["Ts"], p["compute"])


EFFECT = Effect(
    name="sample-hold",
    summary="u held for Ts, then computed for `compute` more",
    parameters=FrozenMap(
        {
            "Ts": EffectParameter(
                1e-4,
                neutral=0.0,
                unit="s",
                description="sampling period",
                measure="time",
                probes=(0.1, 0.4, 0.7),
                # Samples in a record: told apart to a third of one, until a sample is only a few rows long.
                grid=lambda signal: (*(4.0 + 0.3 * k for k in range(390)), *(121.0 * 1.004**k for k in range(440))),
                grid_measure="record/n",
            ),
            # At most one period: a bound that moves with Ts, so a refit leaves it.
            "compute": EffectParameter(0.0, unit="s", description="computation time, at most one period", fixed=True),
        }
    ),
    rewrite=rewrite,
    equivalent_delay=lambda p: p["Ts"] / 2 + p["compute"],
    sentence="{at} is sampled every {Ts}[ and published {compute} later]",
    asked="the sampling time",
    excited_by="a step or ramp of the signal, recorded several times per sampling period",
    example=FrozenMap({"Ts": 0.0013, "compute": 0.0003}),
    states="one held value per insertion point",
    confusable=FrozenMap(
        {
            "delay": "recordings finer than the sampling period: the held signal moves in steps (mean delay Ts/2 + compute)",
            "quantisation": "two ramps of different slope: samples are even in time, levels even in size",
        }
    ),
)
