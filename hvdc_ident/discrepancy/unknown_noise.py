"""Verdicts where the misfit is taken for noise: it can hide a gap or invent one, so no effect is named by it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.conclusion import Conclusion, tests_of
from hvdc_ident.discrepancy.hypothesis import Refit
from hvdc_ident.discrepancy.options import TOLERANCE, SearchContext
from hvdc_ident.fit.adequacy import MATTERS
from hvdc_ident.fit.noise import AT_FLOOR, WHAT_TELLS_NOISE, OutputNoise, floor_of, of_misfit
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.text import listed

NO_EVIDENCE = "No effect is named, and whether one is missing these records do not tell"
NO_NAME = "Something is missing, but no effect is named"


def noise_with(last: Refit) -> FrozenMap[OutputNoise]:
    """Return the noise by output, with the source `AT_FLOOR` for a misfit that is none: `last` meets such a record to its last digits,
    1e-6 of its range."""
    unknown = of_misfit({o: n.source for o, n in last.noise.items()})
    if not unknown:
        return FrozenMap(last.noise)
    blocks = last.problem.blocks(last.theta, derivatives=False)
    misfits = {o: [b.misfit for b in blocks if b.output == o] for o in unknown}
    exact = {o for o, parts in misfits.items() if parts and _is_met(last, o, np.concatenate(parts))}
    return FrozenMap({o: replace(n, source=AT_FLOOR) if o in exact else n for o, n in last.noise.items()})


def _is_met(last: Refit, output: str, misfit: Array) -> bool:
    floor = floor_of(last.problem.fitted_experiments, output)
    return float(np.sqrt(np.mean(misfit**2))) <= floor * (1.0 + 1e-6)


def without_names(
    search: SearchContext, first: Refit, last: Refit, noise: Mapping[str, OutputNoise], found: Conclusion
) -> Conclusion:
    """Return the conclusion, without any name that rests on the misfit of `first`, the refitted model, as noise.

    last: the model with what was put into it; noise: `noise_with` it. A name stands where outputs of unknown noise have next to no
    part in what is explained, or are met to their last digits. Without it something is missing where an output whose noise is known
    shows a gap.
    """
    unknown = of_misfit({o: n.source for o, n in noise.items()})
    if found.verdict not in ("named", "ambiguous", "unnameable") or not unknown:
        return found
    before, after = _chi2(first), _chi2(last)
    fall = sum(before.values()) - sum(after.values())
    part = sum(before[o] - after[o] for o in unknown if o in before)
    if found.verdict != "unnameable" and part <= TOLERANCE * fall:
        return found
    rows = {o: sum(b.residual.size for b in first.nominal().blocks if b.output == o) for o in before}
    shown = any(before[o] > MATTERS * rows[o] for o in before if o not in unknown)
    why = f"that would rest on the misfit of {listed(unknown)}" if shown else "that would rest on the misfit"
    text = f"{NO_NAME if shown else NO_EVIDENCE}: {why}."
    return Conclusion(
        "unnameable" if shown else "no-evidence",
        text,
        tests_of(search, first),
        experiment={"text": f"{WHAT_TELLS_NOISE}."},
    )


def _chi2(refit: Refit) -> dict[str, float]:
    """Return the sum of squared residuals of each output."""
    found: dict[str, float] = {}
    for b in refit.problem.blocks(refit.theta, derivatives=False):
        found[b.output] = found.get(b.output, 0.0) + b.chi2
    return found
