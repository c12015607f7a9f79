"""Refits compared: the priors of terms, the scale and prices of BIC, and what speaks against naming an effect."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from hvdc_ident.discrepancy.hypothesis import Refit, uncertainty_of
from hvdc_ident.discrepancy.misfit import is_material_fall, misfit_of
from hvdc_ident.discrepancy.options import TOLERANCE, DiagnosisOptions
from hvdc_ident.discrepancy.prediction import held_out, root_mean_square_by_record
from hvdc_ident.discrepancy.result import EffectSize
from hvdc_ident.effects import effects
from hvdc_ident.fit.noise import SURE
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.text import figures, percentage

P_VALUE, P_EFFECT, P_CARD, P_CLOCKS = 0.45, 0.45, 0.1, 0.25
"""Prior probability that a stated value is wrong, that an effect is missing, that a card is of another type, each in the stead of the
others, and that the clocks are off, beside them."""
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


def off_given(refit: Refit, wrong: Collection[str] = ()) -> float:
    """Return how far a refit's own free parameters are from their given values: root of the summed squares of relative differences.

    Each is a difference over the larger of both magnitudes, so that half a value and twice a value are as far. wrong: stated values that a
    hypothesis takes for wrong, whose differences are what it says, as the size of an effect is.
    """
    total = 0.0
    for k in (k for k in refit.gains if refit.problem.free[k].name not in wrong):
        given, value = refit.problem.free[k].given, float(refit.theta[k])
        largest = max(abs(given), abs(value))
        total += ((value - given) / largest) ** 2 if largest else 0.0
    return math.sqrt(total)


def off_by_more_than_chance(refit: Refit) -> tuple[str, ...]:
    """Return the model's own free parameters whose estimates are off the given values by more than chance; none on a bound."""
    known = uncertainty_of(refit.problem, refit.problem.blocks(refit.theta))
    found = []
    for f, value in ((refit.problem.free[k], float(refit.theta[k])) for k in refit.gains):
        std = known.std(f.name)
        # A value on its bound is no estimate.
        if not f.on_bound(value) and std is not None and abs(value - f.given) > SURE * std:
            found.append(f.name)
    return tuple(found)


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
    refit: Refit,
    gain: float,
    p: float,
    options: DiagnosisOptions,
    tolerance: Mapping[str, float],
    *,
    first: bool,
) -> str:
    """Objection to naming the last effect of a refit, in words; empty where there is none.

    before: the model without it; gain: in BIC, over that; p: the chance of its score under noise; tolerance: by output, what error is of
    interest. first: whether no other term is there.
    """
    last = len(refit.placed) - 1
    if p > options.significance:
        return f"its score is what noise gives somewhere (p = {p:.2g})"
    if not gain > options.named_bic:
        return f"it gains {gain:.3g} in BIC, {options.named_bic:g} would be needed"
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
