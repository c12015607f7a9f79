"""Refits of candidates compared: the scale of BIC, what each gains, whether its effect is clearly there, and what it leaves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hvdc_ident.discrepancy.hypothesis import Refit
from hvdc_ident.discrepancy.implied import TIED, off_given
from hvdc_ident.discrepancy.nominal import Nominal, of_held_out
from hvdc_ident.discrepancy.options import TOLERANCE, DiagnosisOptions
from hvdc_ident.discrepancy.prediction import held_out, root_mean_square_by_record
from hvdc_ident.discrepancy.residual_checks import is_louder_after_breaks, residual_tests
from hvdc_ident.effects import effects
from hvdc_ident.fit.noise import SURE, freedom_of
from hvdc_ident.text import figures, percentage

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
        share = self.effective / self.rows
        return (before - after) * share / self.scale - more * self.price

    def between(self, before: Refit, after: Refit) -> float:
        """Return the gain of one refit over another, by their chi2 and the number of their parameters."""
        return self.gain(before.chi2, after.chi2, len(after.problem.free) - len(before.problem.free))

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


def material_gap(
    before: float | None, after: float | None, share: float, bands: Mapping[str, float] | None,
    tables: tuple[Mapping[str, float], Mapping[str, float]] | None,
) -> bool:  # fmt: skip
    """Return True where the fall from before to after (pooled, noise units; or by output where bands are given) is of interest."""
    if bands and tables:
        first, second = tables
        return any(first[o] > band and first[o] - second[o] > share * band for o, band in bands.items() if o in first)
    return before is not None and after is not None and before - after > share


def louder_than_noise(refit: Refit, share: float) -> bool:
    """Return True where the fitted residual is larger than the noise by more than a share of it, in amplitude, and by more than
    an estimated noise may be off."""
    return refit.chi2 > ((1.0 + share) ** 2 + SURE * level_error(refit)) * refit.rows


def level_error(refit: Refit) -> float:
    """Relative standard error of the noise's power, where its level is estimated; 0 where it is stated."""
    return float(np.sqrt(2.0 / freedom_of(refit.noise, refit.problem.outputs)))


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
        (now**2 - was**2) * unseen_rows(refit) > options.named_bic or not leaves_holdout_alone(before, refit)
    ):
        pooled = f"held-out data speak against it ({now:.4g} after {was:.4g}, in noise units)"
        return worst_held_out_record(before, refit) or pooled
    tables = (largest_rmse(before), largest_rmse(refit)) if tolerance else None
    fitted = (float(np.sqrt(before.chi2 / refit.rows)), float(np.sqrt(refit.chi2 / refit.rows)))
    if not material_gap(was, now, options.holdout_share, tolerance, tables):
        # Held-out experiments that hardly excite the effect cannot show much of it: then they have to agree, or to have
        # nothing to say, and the fitted ones show the size. Whitening hides a slow gap in slow noise, so the records as
        # they are may show it too.
        then, since = as_recorded(before), as_recorded(refit)
        gaps = (fitted, *((then.get(role), since.get(role)) for role in ("fit", "holdout")))
        shown = not tolerance and any(material_gap(*gap, options.holdout_share, None, None) for gap in gaps)
        if not (
            shown
            and ((was**2 - now**2) * unseen_rows(refit) > options.named_bic or leaves_holdout_alone(before, refit))
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
    share = ruler.effective / ruler.rows / ruler.scale
    return fitted + share * (was**2 - now**2) * unseen_rows(after)


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


def unseen_rows(refit: Refit) -> int:
    """Rows of the data that judge: the held-out ones, or all of the fitted ones, each left out in turn."""
    held = [e for e in refit.problem.experiments if e.role == "holdout" and e.outputs]
    return sum(int(e.compared.sum()) * len(e.outputs) for e in held) or refit.rows


def leaves_holdout_alone(before: Refit, after: Refit) -> bool:
    """Return True where the held-out experiments would look the same with the effect and without."""
    one, two = (held_out(r.problem, r.theta) for r in (before, after))
    if not one or not two:
        return False
    return sum(float(np.sum((a.residual - b.residual) ** 2)) for a, b in zip(one, two, strict=True)) < CLEAR_CHI2


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


def largest_rmse(refit: Refit) -> dict[str, float]:
    """The largest RMSE of each output over all experiments, in its unit."""
    found: dict[str, float] = {}
    for output, row in refit.problem.rmse(refit.theta).items():
        known = [v for v in row.values() if v is not None]
        if known:
            found[output] = max(known)
    return found


PARAMETER_PRICE = 8.0
"""Of a parameter, in units of chi2: the logarithm of a few thousand rows."""
SMALL_REMAINDER = 0.05
"""Share of what the model before leaves beyond noise that a good candidate may leave too: its noise is not known better."""
MAX_NOISE_POWER = 1.4
"""Times the noise's power up to which what is left may be noise that is louder than it was taken for."""
STRUCTURE_P = 0.01
"""Chance under noise of sums over time below which what is left has a shape: as small as for an effect to be named. What is there is
looked for by a whole round more, and by forms outside the catalogue."""
MAX_LAG1_AUTOCORRELATION = 0.1
"""Correlation of neighbours up to which nothing is made of it: records that stand still are rounded alike."""
N_BEST = 3
"""Of the refits the best, of which this is asked."""
LOUD_NOISE_SHARE = 0.1
"""Share of what the model before leaves beyond noise that a fall of chi2 has to come to: noise that is louder than stated falls too."""


def fall_beyond_loud_noise(before: Refit) -> float:
    """Return the fall of chi2 that noise which is louder than stated does not give."""
    return LOUD_NOISE_SHARE * (before.chi2 - before.rows)


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
    return refit.chi2 + PARAMETER_PRICE * refit.count + (held**2 * unseen_rows(refit) if held is not None else 0.0)


def exceeds_noise(refit: Refit) -> bool:
    """Return True where a model leaves more than noise, by size."""
    return refit.chi2 / refit.rows > 1.0 + SURE * _power_error(refit)


def predicts_worse(refit: Refit) -> bool:
    """Return True where a model leaves more of unseen data than of those it was fitted to, by more than chance."""
    seen, now = max(refit.chi2 / refit.rows, 1.0), refit.predicted
    return now is not None and now**2 > seen * (1.0 + SURE * _power_error(refit))


def _power_error(refit: Refit) -> float:
    """Standard error of the mean square of noise over its level: of the rows, and of a level that is estimated (F distribution)."""
    return float(np.hypot(np.sqrt(2.0 / refit.effective), level_error(refit)))


def left_by(refit: Refit) -> float:
    """Misfit beyond noise per row, of the fitted data or of the others."""
    return max(refit.chi2 / refit.rows, (refit.predicted or 0.0) ** 2) - 1.0


def all_far_from_noise(before: Refit, trials: Sequence[CandidateFit], near: float = SMALL_REMAINDER) -> bool:
    """Return True where no refit comes near the noise, or to a small share of the misfit before, on fitted and held-out data."""
    far = all(_leaves_much(before, t.refit, near) for t in trials if not t.refit.failure)
    return far and not any(resembles_noise(t.refit) for t in by_cost(trials)[:N_BEST])


def is_far_from_noise(before: Refit, refit: Refit) -> bool:
    """Return True where this refit does not come near the noise, or to a small share of the misfit before."""
    return _leaves_much(before, refit, SMALL_REMAINDER) and not resembles_noise(refit)


def _leaves_much(before: Refit, refit: Refit, near: float) -> bool:
    return (exceeds_noise(refit) or predicts_worse(refit)) and left_by(refit) > near * left_by(before)


def resembles_noise(refit: Refit) -> bool:
    """Return True where the residual is without shape, though somewhat loud: noise is estimated from few rows.

    Of the held-out data too, where more is left of them: their noise may be louder than that of the others.
    """
    seen, now = max(refit.chi2 / refit.rows, 1.0), refit.predicted
    if (
        seen > MAX_NOISE_POWER
        or refit.correlation > MAX_LAG1_AUTOCORRELATION
        or (now is not None and now**2 > MAX_NOISE_POWER * seen)
    ):
        return False
    left = refit.nominal()
    if is_louder_after_breaks(left) or not is_unstructured(left, 0):
        return False
    if not predicts_worse(refit):
        return True
    held = of_held_out(refit.problem)
    return held is not None and is_unstructured(Nominal(held, refit.theta[: len(held.free)], refit.noise), 0)


def is_noise(refit: Refit, seed: int) -> bool:
    """Return True where the residual is noise, by its size and over time: then there is nothing more to look for."""
    return not exceeds_noise(refit) and is_unstructured(refit.nominal(), seed)


def is_unstructured(nominal: Nominal, seed: int) -> bool:
    """Return True where sums of the residual over time are like those of noise."""
    return all(b.p > STRUCTURE_P for b in residual_tests(nominal, {}, bootstraps=200, seed=seed))
