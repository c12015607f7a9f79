"""A quantiser: u rounded to multiples of step."""

from collections.abc import Mapping, Sequence

import numpy as np
import sympy as sp

from hvdc_ident.effects.base import Additions, Effect, EffectParameter, Extent
from hvdc_ident.expression import TRACKING_TIME, clip, where
from hvdc_ident.immutable import FrozenMap

BITS = 24
"""Levels from -2^(BITS - 1) to 2^(BITS - 1) steps; beyond, the last one holds, as in a converter."""
EDGE = 2e-3
"""Width of the edge between two levels inside the model, in steps (a recorded output jumps)."""
BORDER = 0.3
"""Position between two edges, in steps, where the count of levels changes: no value that a signal is likely to rest at."""

APART = 10
"""Sizes of the grid per level at the peak, and so per level over the range of a signal that passes few levels."""
PASSED = 40.0
"""Levels over the signal's range at which the grid ends."""
COUNTED = 400.0
"""Levels up to the signal's peak at which the grid ends, where that is later."""
FINEST = 150.0
"""Levels over the signal's range at most: finer ones look like noise."""


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return the level nearest to u.

    In a loop that comes to rest between two levels, an ideal quantiser never rests: the loop slides along the edge. An
    edge of finite width has that sliding rest as its steady state (Filippov's solution, up to the width). Within an
    algebraic loop a jump may leave no solution at all: there the level is reached within 0.2 ms.
    """
    step = p["step"]
    if add.kind == "output":
        return step * _floor(add.signal("scaled", u / step + sp.Float(0.5)), add)
    level = _floor(add.signal("scaled", u / step + sp.Float(BORDER)), add)
    within = u / step - level - sp.Float(0.5)
    rounded = step * (level + clip(within / EDGE + sp.Float(0.5), 0, 1))
    if not add.circular:
        return rounded
    rounded = add.signal("rounded", rounded)
    return add.state("y", lambda y: (rounded - y) / TRACKING_TIME, rest=rounded)


def _levels(signal: Extent) -> Sequence[float]:
    """Return the grid of levels up to the signal's peak, from one that it hardly reaches to hundreds that it passes.

    The quantisation error depends on where the levels lie, to a tenth of a level at the peak, and on how many are passed. A
    signal that moves a little about a high value meets the same positions again with each further level up to its peak, and
    hardly passes more levels: such levels are sampled sparsely.
    """
    share = signal.peak / signal.range
    between = max(1.0, share / APART)
    most = share * min(FINEST, max(PASSED, COUNTED / share))
    whole = np.arange(max(0.8, 0.5 * share), most, between)
    return tuple((whole[:, None] + np.arange(0.0, 1.0, 1.0 / APART)).ravel().tolist())


def _floor(x: sp.Expr, add: Additions) -> sp.Expr:
    """Return the largest integer not above x, by folding as in a Gray-code converter.

    It takes |x|, minus half of the range, its magnitude, and so on. One switch a bit resolves 2^BITS levels, and at each
    border exactly one of them changes, so that nothing jumps in between.
    """
    bits = range(BITS - 2, -1, -1)

    def folded(symbols: tuple[sp.Symbol, ...]) -> list[sp.Expr]:
        folds = (x, *symbols[: BITS - 1])
        levels = (sp.Float(0.5), *symbols[BITS - 1 :])
        values = [sp.Abs(fold) - 2**bit for fold, bit in zip(folds, bits, strict=False)]
        for bit, fold in enumerate(reversed(folds)):
            half = 2 ** (bit - 1) if bit else 0
            values.append(where(fold >= 0, 1, -1) * (levels[bit] + half))
        return values

    labels = [*(f"fold{bit}" for bit in bits), *(f"level{bit}" for bit in range(BITS))]
    return add.signals(labels, folded)[-1] - sp.Float(0.5)


EFFECT = Effect(
    name="quantisation",
    summary="u rounded to multiples of step",
    parameters=FrozenMap(
        {
            "step": EffectParameter(
                0.01,
                neutral=0.0,
                description="distance of two levels",
                measure="peak/n",
                probes=(3.0, 10.0, 30.0, 100.0, 300.0),
                grid=_levels,
            )
        }
    ),
    rewrite=rewrite,
    holds=True,
    sentence="{at} is rounded to multiples of {step}",
    asked="the resolution of the measurement",
    excited_by="slow ramps both ways over several levels",
    example=FrozenMap({"step": 0.03}),
    confusable=FrozenMap(
        {
            "deadband": "slow ramps both ways: one flat piece at 0 against many",
            "backlash": "slow ramps both ways: the play is flat at turns only",
            "sample-hold": "two ramps of different slope: samples are even in time, levels even in size",
        }
    ),
)
