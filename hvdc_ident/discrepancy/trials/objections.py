"""Objections to naming an effect: noise, its size, held-out data, and what is of interest at all."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hvdc_ident.discrepancy.options import DiagnosisOptions
from hvdc_ident.discrepancy.refits.refit import Refit, held_out, unseen
from hvdc_ident.discrepancy.trials.select import CandidateFit, at_edge, clear, material_gap

AGREED = 10.0
"""By how much chi2 of the held-out data has to fall for them to agree, or to rise for them to speak against an effect."""
SILENT = 30.0
"""Squared difference of held-out answers, in noise units, below which those data cannot judge an effect."""
STEP = 0.05
"""Share of the gap that a second effect has to take away at least."""


def objections(
    before: Refit,
    trial: CandidateFit,
    p: float,
    options: DiagnosisOptions,
    material: Mapping[str, float],
    *,
    first: bool,
) -> str:
    """Objection to naming a trial's effect, in words; empty where there is none.

    before: the model without it; p: the chance of its score under noise; material: by output, what error is of interest.
    """
    refit = trial.refit
    last = len(refit.placed) - 1
    if p > options.significance:
        return f"its score is what noise gives somewhere (p = {p:.2g})"
    if not trial.gain > options.named_bic:
        return f"it gains {trial.gain:.3g} in BIC, {options.named_bic:g} would be needed"
    if at_edge(refit, last) or not clear(refit, last):
        return "its size cannot be told from nothing"
    was, now = unseen(before), unseen(refit)
    if was is None or now is None:
        return "nothing can be left out to judge it by"
    # Records that an effect does not move are better or worse by the noise they hold.
    if not now < was and ((now**2 - was**2) * unseen_rows(refit) > AGREED or not silent(before, refit)):
        return f"held-out data speak against it ({now:.4g} after {was:.4g}, in noise units)"
    tables = (worst(before), worst(refit)) if material else None
    fitted = (float(np.sqrt(before.chi2 / refit.rows)), float(np.sqrt(refit.chi2 / refit.rows)))
    if not material_gap(was, now, options.holdout_share, material, tables):
        # Held-out experiments that hardly excite the effect cannot show much of it: then they have to agree, or to have
        # nothing to say, and the fitted ones show the size. Whitening hides a slow gap in slow noise, so the records as
        # they are may show it too.
        then, since = as_recorded(before), as_recorded(refit)
        gaps = (fitted, *((then.get(role), since.get(role)) for role in ("fit", "holdout")))
        shown = not material and any(material_gap(*gap, options.holdout_share, None, None) for gap in gaps)
        if not (shown and ((was**2 - now**2) * unseen_rows(refit) > AGREED or silent(before, refit))):
            return f"the gap it closes is immaterial ({was:.4g} to {now:.4g} in noise units, held out)"
    if not first and max((was - now) / was, (fitted[0] - fitted[1]) / fitted[0]) < STEP:
        return f"it closes less than {STEP:.0%} of what is left ({was:.4g} to {now:.4g} in noise units, held out)"
    return ""


def evidence(before: Refit, trial: CandidateFit, share: float) -> float:
    """Gain of a trial in BIC on the fitted data plus that in chi2 on the others; share: independent ones of all rows."""
    was, now = unseen(before), unseen(trial.refit)
    if was is None or now is None or not np.isfinite(was) or not np.isfinite(now):
        return trial.gain
    return trial.gain + share * (was**2 - now**2) * unseen_rows(trial.refit)


def unseen_rows(refit: Refit) -> int:
    """Rows of the data that judge: the held-out ones, or all of the fitted ones, each left out in turn."""
    held = [e for e in refit.problem.experiments if e.role == "holdout" and e.outputs]
    return sum(int(e.compared.sum()) * len(e.outputs) for e in held) or refit.rows


def silent(before: Refit, after: Refit) -> bool:
    """Return True where the held-out experiments would look the same with the effect and without."""
    one, two = (held_out(r.problem, r.theta) for r in (before, after))
    if not one or not two:
        return False
    return sum(float(np.sum((a.residual - b.residual) ** 2)) for a, b in zip(one, two, strict=True)) < SILENT


def as_recorded(refit: Refit) -> dict[str, float]:
    """By role of the experiments their misfit in standard deviations of the noise, pooled and not whitened."""
    roles = {e.name: e.role for e in refit.problem.experiments}
    squares: dict[str, list[float]] = {}
    for output, row in refit.problem.rmse(refit.theta).items():
        std = refit.noise[output].std
        for name, rmse in row.items():
            if rmse is not None and std:
                squares.setdefault(roles[name], []).append((rmse / std) ** 2)
    return {role: float(np.sqrt(np.mean(found))) for role, found in squares.items()}


def worst(refit: Refit) -> dict[str, float]:
    """The largest RMSE of each output over all experiments, in its unit."""
    found: dict[str, float] = {}
    for output, row in refit.problem.rmse(refit.theta).items():
        known = [v for v in row.values() if v is not None]
        if known:
            found[output] = max(known)
    return found
