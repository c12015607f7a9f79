"""Candidates refitted, in a race with each other, and how good what they come to is."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import replace

import numpy as np

from hvdc_ident.discrepancy.context import Round, SearchContext
from hvdc_ident.discrepancy.evidence import CandidateFit, Pick, level_error, unseen_rows
from hvdc_ident.discrepancy.nominal import Nominal, of_held_out
from hvdc_ident.discrepancy.options import SURE
from hvdc_ident.discrepancy.race import Race
from hvdc_ident.discrepancy.refit import FAILURES, Refit, RefitJob, failed_at, unseen
from hvdc_ident.discrepancy.refit_jobs import job
from hvdc_ident.discrepancy.residual_checks import loud_after_breaks, residual_tests
from hvdc_ident.discrepancy.size_profile import hopped
from hvdc_ident.effects import effects
from hvdc_ident.model import AnyModel

PRICE = 8.0
"""Of a parameter, in units of chi2: the logarithm of a few thousand rows."""
NEAR = 0.05
"""Share of what the model before leaves beyond noise that a good candidate may leave too: its noise is not known better."""
LOUD = 1.4
"""Times the noise's power up to which what is left may be noise that is louder than it was taken for."""
SHAPED = 0.05
"""Chance under noise of sums over time below which what is left has a shape."""
FAINT = 0.1
"""Correlation of neighbours up to which nothing is made of it: records that stand still are rounded alike."""
LOOKED_AT = 3
"""Of the refits the best, of which this is asked."""
AGAIN = 4
"""Refits of one effect at most whose size is looked for again beside the gains they came to."""
WORTHY = 0.5
"""Share of the best fall of chi2 from which that is worth its time."""
TELLING = 0.1
"""Share of what the model before leaves beyond noise from which it is: noise that is louder than was told leaves falls too."""


def refitted(
    search: SearchContext,
    opened: Round,
    picks: Sequence[Pick],
    text: str,
    earlier: Sequence[CandidateFit] = (),
) -> list[CandidateFit]:
    """The picks refitted in a race with each other and with those refitted earlier."""
    before, found = opened.before, opened.candidates
    jobs, of, trials = [], [], []
    made: dict[Hashable, AnyModel] = {}
    for p in picks:
        try:
            jobs.append(job(before, found, [p], made))
            of.append(p)
        except FAILURES as error:
            trials.append(CandidateFit(p, failed_at(before, str(error) or type(error).__name__), -np.inf))
    texts = [f"{text}: {found[p.candidate].label}" for p in of]
    best = min((t.refit.chi2 for t in earlier if not t.refit.failure), default=np.inf)
    refits = Race().run(search, before.chi2, jobs, texts, best)
    if sound := [r for r in refits if not r.failure]:
        search.lead(min(sound, key=lambda r: r.chi2))
    return [*trials, *(CandidateFit(p, refit, -np.inf) for p, refit in zip(of, refits, strict=True))]


def once_more(
    search: SearchContext,
    opened: Round,
    trials: Sequence[CandidateFit],
    text: str,
) -> list[CandidateFit]:
    """The trials, with another size where one is found beside the gains that a refit came to.

    Those far behind the best are left as they are. Of each effect the best comes first, and the others where still nothing comes
    near the noise.
    """
    found, was = opened.candidates, opened.before.chi2
    order = by_cost(trials)
    goal = max(WORTHY * (was - min((t.refit.chi2 for t in order), default=was)), telling(opened.before))
    chosen: dict[str, list[CandidateFit]] = {}
    for t in sorted(order, key=lambda t: t.refit.chi2):
        effect = found[t.pick.candidate].effect
        if effects()[effect].needs_grid and was - t.refit.chi2 >= goal and len(chosen.setdefault(effect, [])) < AGAIN:
            chosen[effect].append(t)
    kept = list(trials)
    for heat in ([group[:1] for group in chosen.values()], [group[1:] for group in chosen.values()]):
        kept = _resized(search, opened, kept, [t for group in heat for t in group], text)
        if not all_far(opened.before, kept):
            break
    return kept


def _resized(
    search: SearchContext, opened: Round, trials: Sequence[CandidateFit], again: Sequence[CandidateFit], text: str
) -> list[CandidateFit]:
    """The trials, some of them with another size where one is found."""
    jobs = [RefitJob(t.refit.model, t.refit.placed, t.refit.problem, (t.refit.theta,), t.refit.noise) for t in again]
    refits = hopped(search, jobs, [f"{text}: {opened.candidates[t.pick.candidate].label}" for t in again])
    better = {id(t): replace(t, refit=r) for t, r in zip(again, refits, strict=True) if not r.failure}
    return [better.get(id(t), t) for t in trials]


def telling(before: Refit) -> float:
    """The fall of chi2 from which a refit is more than what noise that is louder than was told leaves to take away."""
    return TELLING * (before.chi2 - before.rows)


def best_each(trials: Sequence[CandidateFit]) -> list[CandidateFit]:
    """Of the trials of each candidate the best, in their order."""
    kept: dict[int, CandidateFit] = {}
    for t in trials:
        had = kept.get(t.pick.candidate)
        if had is None or had.refit.failure or (not t.refit.failure and cost_of(t) < cost_of(had)):
            kept[t.pick.candidate] = t
    return list(kept.values())


def by_cost(trials: Sequence[CandidateFit]) -> list[CandidateFit]:
    """Those that came to a result, the best first."""
    return sorted((t for t in trials if not t.refit.failure), key=cost_of)


def cost_of(trial: CandidateFit) -> float:
    """Chi2 of a refit on all data plus the price of its parameters, before the scale of BIC is known."""
    refit, held = trial.refit, unseen(trial.refit)
    return refit.chi2 + PRICE * refit.count + (held**2 * unseen_rows(refit) if held is not None else 0.0)


def excess(refit: Refit) -> bool:
    """Return True where a model leaves more than noise, by size."""
    return refit.chi2 / refit.rows > 1.0 + SURE * _power_error(refit)


def misses(refit: Refit) -> bool:
    """Return True where a model leaves more of unseen data than of those it was fitted to, by more than chance."""
    seen, now = max(refit.chi2 / refit.rows, 1.0), unseen(refit)
    return now is not None and now**2 > seen * (1.0 + SURE * _power_error(refit))


def _power_error(refit: Refit) -> float:
    """Standard error of the mean square of noise over its level: of the rows, and of a level that is estimated (F distribution)."""
    return float(np.hypot(np.sqrt(2.0 / refit.effective), level_error(refit)))


def left_by(refit: Refit) -> float:
    """Misfit beyond noise per row, of the fitted data or of the others."""
    return max(refit.chi2 / refit.rows, (unseen(refit) or 0.0) ** 2) - 1.0


def all_far(before: Refit, trials: Sequence[CandidateFit], near: float = NEAR) -> bool:
    """Return True where no refit comes near the noise, or to a small share of the misfit before, on fitted and held-out data."""
    far = all(_leaves_much(before, t.refit, near) for t in trials if not t.refit.failure)
    return far and not any(like_noise(t.refit) for t in by_cost(trials)[:LOOKED_AT])


def is_far(before: Refit, refit: Refit) -> bool:
    """Return True where this refit does not come near the noise, or to a small share of the misfit before."""
    return _leaves_much(before, refit, NEAR) and not like_noise(refit)


def _leaves_much(before: Refit, refit: Refit, near: float) -> bool:
    return (excess(refit) or misses(refit)) and left_by(refit) > near * left_by(before)


def like_noise(refit: Refit) -> bool:
    """Return True where the residual is without shape, though somewhat loud: noise is told from few rows.

    Of the held-out data too, where more is left of them: their noise may be louder than that of the others.
    """
    seen, now = max(refit.chi2 / refit.rows, 1.0), unseen(refit)
    if seen > LOUD or refit.correlation > FAINT or (now is not None and now**2 > LOUD * seen):
        return False
    left = refit.nominal()
    if loud_after_breaks(left) or not shapeless(left, 0):
        return False
    if not misses(refit):
        return True
    held = of_held_out(refit.problem)
    return held is not None and shapeless(Nominal(held, refit.theta[: len(held.free)], refit.noise), 0)


def is_noise(refit: Refit, seed: int) -> bool:
    """Return True where the residual is noise, by its size and over time: then there is nothing more to look for."""
    return not excess(refit) and shapeless(refit.nominal(), seed)


def shapeless(nominal: Nominal, seed: int) -> bool:
    """Return True where sums of the residual over time are like those of noise."""
    return all(b.p > SHAPED for b in residual_tests(nominal, {}, bootstraps=100, seed=seed))
