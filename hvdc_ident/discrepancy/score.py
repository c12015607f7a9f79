"""Refits of candidates compared: the scale of BIC, what each gains, and what speaks against naming its effect."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from hvdc_ident.discrepancy.hypothesis import Refit
from hvdc_ident.discrepancy.misfit import is_material_fall, misfit_of
from hvdc_ident.discrepancy.options import TOLERANCE, DiagnosisOptions
from hvdc_ident.discrepancy.prediction import held_out, root_mean_square_by_record
from hvdc_ident.discrepancy.result import EffectSize
from hvdc_ident.effects import effects
from hvdc_ident.fit.noise import SURE
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.text import figures, percentage

TIED = 2.0
"""In BIC: evidence up to which one hypothesis is not to be preferred to another (Kass and Raftery, Bayes Factors, JASA 90, 1995)."""

T = TypeVar("T")


def implied(refit: Refit) -> FrozenMap[EffectSize]:
    """Return the values of the model's own free parameters in a refit, by name, with their 95 % intervals where these are known."""
    values = {}
    for k in refit.gains:
        free, value = refit.problem.free[k], float(refit.theta[k])
        std = None if free.on_bound(value) else refit.std.get(free.name)
        interval = None if std is None else (value - 1.96 * std, value + 1.96 * std)
        values[free.name] = EffectSize(value, interval, refit.model.parameters[free.name].unit)
    return FrozenMap(values)


def off_given(refit: Refit) -> float:
    """Return how far a refit's own free parameters are from their given values: root of the summed squares of relative differences.

    Each is a difference over the larger of both magnitudes, so that half a value and twice a value are as far.
    """
    total = 0.0
    for k in refit.gains:
        given, value = refit.problem.free[k].given, float(refit.theta[k])
        largest = max(abs(given), abs(value))
        total += ((value - given) / largest) ** 2 if largest else 0.0
    return math.sqrt(total)


def apart(one: Mapping[str, EffectSize], other: Mapping[str, EffectSize]) -> tuple[str, ...]:
    """Return the parameters whose values in two hypotheses differ by more than chance; none whose deviation is not known."""
    found = []
    for name in (n for n in one if n in other):
        stds = [_std(values[name]) for values in (one, other)]
        if None not in stds:
            deviation = math.hypot(*(s for s in stds if s is not None))
            if abs(one[name].value - other[name].value) > SURE * deviation:
                found.append(name)
    return tuple(found)


def _std(size: EffectSize) -> float | None:
    low, high = size.ci95 or (None, None)
    return None if low is None or high is None else (high - low) / (2.0 * 1.96)


def nearest(
    best: T, tied: Sequence[T], values: Callable[[T], Mapping[str, EffectSize]], off: Callable[[T], float]
) -> T:
    """Return of a hypothesis and those that explain as much the one whose values, where they are others, are nearest to the given.

    values: of the parameters by hypothesis; off: how far these are from the given ones.
    """
    own = values(best)
    others = [t for t in tied if off(t) < off(best) and apart(own, values(t))]
    return min([best, *others], key=off)


CLEAR_CHI2 = 30.0
"""In BIC: from where held-out data speak clearly against a candidate, whatever the fitted ones say. With a smaller squared
difference of their answers, in noise units, two models are one to these data."""
CLEAR_DEVIATIONS = 2.0
"""Standard deviations by which an effect has to be off doing nothing."""


@dataclass(frozen=True)
class Pick:
    """A candidate to refit: the probe it begins at, the size asked for in units of the probe's, and the fall of chi2 expected."""

    candidate: int
    probe: int
    factor: float
    fall: float


@dataclass(frozen=True)
class CandidateFit:
    """A candidate that was refitted: its pick, the refit, and what it gains over the model before (BIC).

    evidence: the same with what it brings on the held-out data, where that is known.
    """

    pick: Pick
    refit: Refit
    gain: float
    evidence: float | None = None

    @property
    def total_gain(self) -> float:
        """Evidence of all data for it, as far as that is known, in BIC."""
        return self.gain if self.evidence is None else self.evidence


def deficits(trials: Sequence[CandidateFit]) -> list[float]:
    """By how much each is behind the best, in BIC: on all data together; or on the fitted ones, where that is less and the
    held-out ones do not speak clearly against it, for a difference of a few units there is not known better than the noise.

    On the fitted ones the best is the best of those that the held-out ones do not speak clearly against either.
    """
    best, gain = max((t.total_gain for t in trials), default=0.0), best_gain(trials)
    return [
        min(gain - t.gain, best - t.total_gain) if best - t.total_gain < CLEAR_CHI2 else best - t.total_gain
        for t in trials
    ]


def best_gain(trials: Sequence[CandidateFit]) -> float:
    """The largest gain of those that the held-out data do not speak clearly against."""
    best = max((t.total_gain for t in trials), default=0.0)
    return max((t.gain for t in trials if best - t.total_gain < CLEAR_CHI2), default=0.0)


@dataclass(frozen=True)
class Ruler:
    """Scale of BIC. effective: independent residuals; scale: how much larger than noise they are in the best model."""

    rows: int
    effective: float
    scale: float

    @classmethod
    def of(cls, best: Refit) -> Ruler:
        """From the best model found, whose residuals are nearest to noise."""
        return cls(best.rows, best.effective, max(best.chi2 / best.rows, 1.0))

    def gain(self, before: float, after: float, more: int) -> float:
        """The fall of BIC from one chi2 to another with `more` parameters more."""
        return (before - after) * self.share - more * self.price

    def between(self, before: Refit, after: Refit) -> float:
        """Return the gain of one refit over another, by their chi2 and the number of their parameters."""
        return self.gain(before.chi2, after.chi2, len(after.problem.free) - len(before.problem.free))

    @property
    def share(self) -> float:
        """Units of BIC for a unit of chi2."""
        return self.effective / self.rows / self.scale

    @property
    def price(self) -> float:
        """Price of one more parameter, in BIC."""
        return float(np.log(self.effective))


def is_clear(refit: Refit, which: int) -> bool:
    """Return True where the parameters of an effect together are clearly off neutral."""
    return refit.apart[which] > CLEAR_DEVIATIONS


def at_edge(refit: Refit, which: int) -> bool:
    """Return True where the effect's size stands on the bound next to neutral: it is not there."""
    placed = refit.placed[which]
    entry, sizes = effects()[placed.candidate.effect], refit.sizes(placed)
    switches = [n for n, q in entry.parameters.items() if q.neutral is not None and n in placed.bounds]
    edges = []
    for n in switches:
        low, high = placed.bounds[n]
        neutral = entry.parameters[n].neutral
        if isinstance(neutral, str):
            edges.append(sizes[n] == sizes[neutral])
        else:
            edges.append(
                (neutral is not None and neutral <= low and sizes[n] <= low)
                or (np.isinf(neutral or 0.0) and sizes[n] >= high)
            )
    return bool(edges) and all(edges)


LEAST_STEP = 0.05
"""Share of the gap that a second effect has to take away at least."""


def objections(
    before: Refit,
    trial: CandidateFit,
    p: float,
    options: DiagnosisOptions,
    tolerance: Mapping[str, float],
    *,
    first: bool,
) -> str:
    """Objection to naming a trial's effect, in words; empty where there is none.

    before: the model without it; p: the chance of its score under noise; tolerance: by output, what error is of interest.
    """
    refit = trial.refit
    last = len(refit.placed) - 1
    if p > options.significance:
        return f"its score is what noise gives somewhere (p = {p:.2g})"
    if not trial.gain > options.named_bic:
        return f"it gains {trial.gain:.3g} in BIC, {options.named_bic:g} would be needed"
    if at_edge(refit, last) or not is_clear(refit, last):
        return "its size cannot be distinguished from none"
    was, now = before.predicted, refit.predicted
    if was is None or now is None:
        return "nothing can be left out to judge it by"
    # Records that an effect does not move are better or worse by the noise they hold.
    if not now < was and (
        (now**2 - was**2) * refit.unseen_rows > options.named_bic or not leaves_holdout_alone(before, refit)
    ):
        pooled = f"held-out data speak against it ({now:.4g} after {was:.4g}, in noise units)"
        return worst_held_out_record(before, refit) or pooled
    then, since = misfit_of(before), misfit_of(refit)
    fitted = (float(np.sqrt(before.chi2 / refit.rows)), float(np.sqrt(refit.chi2 / refit.rows)))
    if not since.is_fall_material(then, tolerance, options):
        # Held-out experiments that hardly excite the effect cannot show much of it: then they have to agree, or to have
        # nothing to say, and the fitted ones show the size. Whitening hides a slow gap in slow noise, so the records as
        # they are may show it too.
        roles = ((then.as_recorded.get(role), since.as_recorded.get(role)) for role in ("fit", "holdout"))
        shown = not tolerance and any(is_material_fall(*gap, options.holdout_share) for gap in (fitted, *roles))
        if not (
            shown and ((was**2 - now**2) * refit.unseen_rows > options.named_bic or leaves_holdout_alone(before, refit))
        ):
            return f"the gap it closes is immaterial ({was:.4g} to {now:.4g} in noise units, held out)"
    if not first and max((was - now) / was, (fitted[0] - fitted[1]) / fitted[0]) < LEAST_STEP:
        return f"it closes less than {percentage(LEAST_STEP)} of what is left ({was:.4g} to {now:.4g} in noise units, held out)"
    return ""


def evidence_between(before: Refit, after: Refit, ruler: Ruler, more: int) -> float:
    """Return the evidence of one model over another in BIC: of the fitted data, and of the held-out ones where they are known.

    more: parameters that the second has more.
    """
    fitted = ruler.gain(before.chi2, after.chi2, more)
    was, now = before.predicted, after.predicted
    if was is None or now is None or not np.isfinite(was) or not np.isfinite(now):
        return fitted
    return fitted + ruler.share * (was**2 - now**2) * after.unseen_rows


def with_gain(trial: CandidateFit, before: Refit, ruler: Ruler) -> CandidateFit:
    """Return the trial with what it gains in BIC over the model before, and what the held-out data add to that."""
    more = len(trial.refit.problem.free) - len(before.problem.free)
    gain = ruler.between(before, trial.refit)
    return CandidateFit(trial.pick, trial.refit, gain, evidence_between(before, trial.refit, ruler, more))


def same_answers(one: Refit, other: Refit, before: Refit) -> bool:
    """Return True for two hypotheses whose answers differ, in the fitted records, by less than the tolerance: that share of the
    square of what the effects do beside the model without them."""
    was, a, b = (
        np.concatenate([x.residual for x in r.problem.blocks(r.theta, derivatives=False)]) for r in (before, one, other)
    )
    return bool(np.sum((a - b) ** 2) <= TOLERANCE * max(np.sum((was - a) ** 2), np.sum((was - b) ** 2)))


def worst_held_out_record(before: Refit, after: Refit) -> str:
    """Return in words which held-out record an effect makes worse most, with what is left there; empty where none is held out."""
    was, now = (root_mean_square_by_record(r.problem, r.theta) for r in (before, after))
    worse = {name: value for name, value in now.items() if name in was and value > was[name]}
    if not worse:
        return ""
    name = max(worse, key=lambda n: worse[n] ** 2 - was[n] ** 2)
    with_it, without = figures(now[name], 3), figures(was[name], 3)
    return f"the held-out record '{name}' speaks against it: {with_it} times the noise with it, {without} without"


def leaves_holdout_alone(before: Refit, after: Refit) -> bool:
    """Return True where the held-out experiments would look the same with the effect and without."""
    one, two = (held_out(r.problem, r.theta) for r in (before, after))
    if not one or not two:
        return False
    return sum(float(np.sum((a.residual - b.residual) ** 2)) for a, b in zip(one, two, strict=True)) < CLEAR_CHI2


PARAMETER_PRICE = 8.0
"""Of a parameter, in units of chi2: the logarithm of a few thousand rows."""


def best_each(trials: Sequence[CandidateFit]) -> list[CandidateFit]:
    """Of the trials of each candidate the best, in their order; of those that are as good the one with the values nearest to the
    given ones."""
    kept: dict[int, CandidateFit] = {}
    for t in trials:
        had = kept.get(t.pick.candidate)
        if had is None or had.refit.failure:
            kept[t.pick.candidate] = t
        elif not t.refit.failure:
            first, other = sorted((had, t), key=cost_of)
            tied = cost_of(other) - cost_of(first) <= TIED and off_given(other.refit) < off_given(first.refit)
            kept[t.pick.candidate] = other if tied else first
    return list(kept.values())


def by_cost(trials: Sequence[CandidateFit]) -> list[CandidateFit]:
    """Those that came to a result, the best first."""
    return sorted((t for t in trials if not t.refit.failure), key=cost_of)


def cost_of(trial: CandidateFit) -> float:
    """Chi2 of a refit on all data plus the price of its parameters, before the scale of BIC is known."""
    refit, held = trial.refit, trial.refit.predicted
    return refit.chi2 + PARAMETER_PRICE * refit.count + (held**2 * refit.unseen_rows if held is not None else 0.0)
