"""The noise of rounded records, told again by what a model leaves of them.

Before anything is explained, a record tells of the noise below its steps only where it flickers between two levels, to
about a third. Taken for too small that noise makes mountains of differences between models that are none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hvdc_ident.discrepancy.noise import COARSE, FLICKER, Noise
from hvdc_ident.discrepancy.refit import Refit, judged
from hvdc_ident.fit.executor import Executor, mapped
from hvdc_ident.fit.rounding import noise_below
from hvdc_ident.frozen import FrozenMap

WORTH = 1.1
"""Times the noise as it was told from which it is told again."""
MOST = float(np.exp(2.0 * FLICKER))
"""Times at most: more is a gap and no noise."""

WITHIN = 1.0 - 1e-9
"""Share of the noise that hides the rounding at most: the record stays one that is rounded."""


def told_again(executor: Executor | None, before: Refit, refits: Sequence[Refit]) -> tuple[Refit, list[Refit]]:
    """The model before and the refits, all judged by the noise that the best of these leaves, where that is louder."""
    best = min(refits, key=lambda r: r.chi2)
    louder = _louder(best)
    if not louder:
        return before, list(refits)
    noise = before.noise | louder
    rounding = {o: r for o, n in noise.items() if (r := n.rounding) is not None and o in best.problem.rounding}
    again = [
        replace(r, noise=noise, problem=replace(r.problem, rounding=FrozenMap(rounding))) for r in (before, *refits)
    ]
    first, *others = mapped(executor, judged, again)
    return first, others


def _louder(best: Refit) -> dict[str, Noise]:
    """By output whose record is rounded its noise, where the misfits of a model say that it is louder than told."""
    blocks = best.problem.blocks(best.theta, derivatives=False)
    found = {}
    for output, rounding in best.problem.rounding.items():
        misfit = np.concatenate([b.misfit for b in blocks if b.output == output])
        below = min(noise_below(misfit, rounding.step), MOST * rounding.noise, WITHIN * COARSE * rounding.step)
        if below > WORTH * rounding.noise:
            std = float(np.hypot(below, rounding.step / np.sqrt(12.0)))
            found[output] = replace(best.noise[output], std=std)
    return found
