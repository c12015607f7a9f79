"""Records whose values are rounded: the step of a recorder, seen through the digits of its file, and the noise below it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from hvdc_ident.data.trajectory import Array

CHANCE = 1e-3
"""Chance that levels which stand on no lattice are taken for a recorder's."""
SINGLE = 2.0**-24
"""Relative rounding of a value of 32 bits."""
FLICKER = 0.58
"""Standard error of the logarithm of the noise that the flicker of one record tells, for it stands on few levels; of k records over
sqrt(k). By simulation of noise of 0.3 steps."""

_CHANGES = (
    20  # changes between rows from which they are known to be a recorder's, and not those of a signal that switches
)
_WINDOW = 128  # levels that a lattice is looked for in
_FARTHEST = 400  # steps that they span at most
_AT_ONCE = 2**18  # distances that are looked at together: they stay in the cache
_BELOW = np.geomspace(
    0.05, 1.6, 27
)  # noise below a rounding that is compared, in steps: less adds 2 % to the rounding, more hides it
_PLACES = 33  # places of a level between the steps that are compared at a time
_BINS = 64  # parts of a step to which rows less their line are rounded
_UNLIKELY = 16.0  # logarithm of a likelihood, to the largest, that counts as 0


def resolution(values: ArrayLike) -> float:
    """Return the step that a record's values are rounded to, in its unit; 0 where they are not, or too few change to tell.

    values: (n,), NaN where not recorded. A recorder makes levels a step apart, and a file rounds them once more, to its decimals or to
    32 bits: then the differences of levels are no multiples of the step, but each level lies within half a digit of one. The step is
    the largest for which that holds where it would hold by chance in one of a thousand records; else that of the digits alone. Where
    both count it is the root of the sum of their squares, for so their errors add up.
    """
    v = np.asarray(values, dtype=float)
    return _resolution(v[np.isfinite(v)].tobytes())


# A fit and a diagnosis ask for the same few records again and again.
@lru_cache(maxsize=256)
def _resolution(finite: bytes) -> float:
    v = np.frombuffer(finite)
    change = np.diff(v)
    change = change[change != 0]
    if change.size < _CHANGES:
        return 0.0
    levels = distinct_levels(v)
    if levels.size < 2:  # one value, but for the rounding of floats
        return 0.0
    digit = _digit(levels)
    step = _recorder_step(levels, digit) or digit
    if step == 0.0:
        return 0.0
    multiple = np.round(np.abs(change) / step)
    # a ramp changes by one step in every row, too: different multiples, or a value that flickers, tell a quantised one
    flickers = float(np.mean(change[1:] * change[:-1] < 0)) > 0.25
    if not flickers and np.unique(multiple).size < 3:
        return 0.0
    return step if step == digit else math.hypot(step, digit)


def distinct_levels(values: Array) -> Array:
    """Return the different values in their order, those that differ by the rounding of floats alone taken for one."""
    levels = np.unique(values)
    return levels[np.append(True, np.diff(levels) > _float_error(levels))]


def _float_error(values: Array) -> float:
    return 16.0 * float(np.finfo(float).eps) * float(np.abs(values).max(initial=0.0))


def _digit(levels: Array) -> float:
    """Return the largest number of which all differences of levels are multiples, to the rounding of floats; 0 for none."""
    gaps, error = np.diff(levels), _float_error(levels)
    digit = float(gaps.min(initial=math.inf))
    while 64.0 * error < digit < math.inf:  # Euclid's algorithm, on all of them at once
        multiple = np.round(gaps / digit)
        if 4.0 * error * (1.0 + float(multiple.max())) > digit:
            return 0.0  # so many would fit the floats by chance
        rest = np.abs(gaps - multiple * digit)
        off = rest > error * (1.0 + multiple)
        if not off.any():
            return float(gaps.sum() / multiple.sum())
        digit = float(rest[off].min())
    return 0.0


def _recorder_step(levels: Array, digit: float) -> float:
    """Return the step of the recorder behind a file's digits; 0 where the levels tell of none but that of the digits.

    Two neighbouring levels are a step apart, to a digit. All steps about that are tried: each level has to lie within half a digit of a
    multiple from some origin on, which by chance one level in step/digit does.
    """
    if levels.size < 3:  # any two stand on a lattice
        return 0.0
    slack = max(0.5 * digit, SINGLE * float(np.abs(levels).max()))
    least = float(np.diff(levels).min())
    if least < 2.0 * slack * (1.0 - 1e-6):
        return 0.0
    at = _densest(levels, _FARTHEST * least)
    if at.size < 3:
        return 0.0
    count = int(16.0 * at[-1] / least) + 2
    low, high = max(digit, least - 2.0 * slack), least + 2.0 * slack
    width = (high - low) / count
    steps = np.linspace(low + width, high, count)
    near = steps[_spread(at, steps) < 2.5 * slack]
    finer = (near[:, None] + width * np.linspace(-1.0, 1.0, 33)).ravel()
    finer = finer[finer > slack]  # any level stands on a finer lattice
    # A level half way between two digits goes either way; where a step holds few digits, two of a step would be two levels.
    share = np.where(finer > 3.0 * digit, 1.02, 1.0 - 1e-6)
    fits = np.unique(finer[(_spread(at, finer) < share * 2.0 * slack) & (finer > digit * (1.0 + 1e-6))])
    if not fits.size:
        return 0.0
    apart = np.flatnonzero(np.diff(fits) > width)
    step = float(fits[apart[-1] + 1 if apart.size else 0 :].mean())
    digits = 1.0 if step < 3.0 * digit else 2.0
    by_chance = count * (digits * 2.0 * slack / step) ** (at.size - 2)
    return step if by_chance < CHANCE else 0.0


def _spread(at: Array, steps: Array) -> Array:
    """Return (k,) by how much the distances of levels from multiples of each step differ."""
    parts = np.array_split(steps, -(-steps.size * at.size // _AT_ONCE) or 1)
    return np.concatenate([np.ptp(at - np.round(at / s[:, None]) * s[:, None], axis=1) for s in parts])


def _densest(levels: Array, span: float) -> Array:
    """Return the most levels that stand within a span, so many as count, the closest together of several such, less the first."""
    begins = np.arange(levels.size)
    ends = np.minimum(np.searchsorted(levels, levels + span, side="right"), begins + _WINDOW)
    most = np.flatnonzero(ends - begins == (ends - begins).max())
    first = most[np.argmin(levels[ends[most] - 1] - levels[most])]
    return np.asarray(levels[first : ends[first]] - levels[first])


def flicker_of(records: Sequence[Array], step: float) -> float:
    """Return the standard deviation of the white noise below a quantiser, in its steps, from how much records flicker.

    records: (n,) all rows of each, for one level tells only its own flicker: none in the middle of a step, most at its edge. Noise
    of sigma steps makes rounded values scatter by sigma/sqrt(pi) (variance, averaged over where the level lies between
    two steps) while it is below a third of a step, and by sigma^2 + 1/12 above.
    """
    recorded = [r[np.isfinite(r)] for r in records]
    bends = np.concatenate([np.diff(r, 2) / step for r in recorded] or [np.zeros(1)])
    power = np.sort(bends**2)
    scatter = float(power[: max(1, int(0.98 * power.size))].mean()) / 6.0  # the largest are the events
    low = scatter * math.sqrt(math.pi)
    return low if low < 1.0 / 3.0 else math.sqrt(max(scatter - 1.0 / 12.0, 0.0))


@dataclass(frozen=True)
class RoundedNoise:
    """Noise of a record whose rounding it does not hide.

    below: its standard deviation before rounding, in the record's unit; error: the standard error of the logarithm of that. std: with the
    rounding's share, step^2/12, and its degrees of freedom.
    """

    below: float
    error: float
    std: float
    freedom: float


def rounded_noise(records: Sequence[Array], step: float, flicker: float, worth: float = 1.0) -> RoundedNoise:
    """Return the noise below a rounding that rows at rest tell, by the chance of each to be rounded to what it is.

    records: (n,) rows of each less its line; of a record whose level lies anywhere between two steps, so that the likelihood is integrated
    over that. flicker: what all rows tell, in steps (`flicker_of`). worth: independent rows to a row. Beforehand the logarithm of the noise
    is as likely to be anything as to be what the flicker says, for a motion flickers too. Estimates are means of logarithms.
    """
    logs = np.log(_BELOW)
    prior = np.full(logs.size, 1.0 / logs.size)
    if flicker > 0.0:
        told = np.exp(-0.5 * ((logs - math.log(flicker)) / (FLICKER / math.sqrt(len(records) or 1))) ** 2)
        prior = prior + told / (told.sum() or 1.0)
    likely = np.log(prior)
    likely += worth * _likelihood([r / step for r in records])
    weight = np.exp(likely - likely.max())
    weight /= weight.sum()
    mean = float(weight @ logs)
    error = math.sqrt(float(weight @ (logs - mean) ** 2) + (logs[1] - logs[0]) ** 2 / 12.0)
    total = 0.5 * np.log(1.0 / 12.0 + _BELOW**2)
    level = float(weight @ total)
    spread = float(weight @ (total - level) ** 2) + (total[1] - total[0]) ** 2 / 12.0
    return RoundedNoise(step * math.exp(mean), error, step * math.exp(level), float(0.5 / spread))


def _likelihood(records: Sequence[Array]) -> Array:
    """Return the log-likelihood of each noise of `_BELOW` of records, in steps less their lines.

    Records of one plant may rest at one level or each at its own; beforehand both are as likely. Where all flicker between the same two
    levels, one level near the edge says little of the noise, and so many at the edge by chance would say that it is large.
    """
    each = np.sum([_rounded_likelihood(r) for r in records], axis=0)
    known = [x for r in records if (x := _levels(r)) is not None]
    if len(known) < len(records) or len(known) < 2:
        return np.asarray(each)
    one = np.concatenate([x - np.round(x.mean() - known[0].mean()) for x in known])
    return np.asarray(np.logaddexp(each, _rounded_likelihood(one - np.round(one.mean()))))


def _levels(rows: Array) -> Array | None:
    """Return the levels, in whole steps, of rows in steps less a line; None where the line spans a step and more.

    A line that spans less is what a few flickers make of a still level: how far each row lies from the next level tells it.
    """
    line = np.unwrap(2.0 * np.pi * rows) / (2.0 * np.pi)
    return np.round(rows - line) if np.ptp(line) < 1.0 else None


def _rounded_likelihood(rows: Array) -> Array:
    """Return the log-likelihood of each noise of `_BELOW`, integrated over the level. rows: in steps, less a line."""
    from scipy.special import ndtr  # a simulation does without it

    seen, counts = np.unique(np.round(rows * _BINS) / _BINS, return_counts=True)
    low, high = -1.0, 1.0
    while True:
        places = np.linspace(low, high, _PLACES)
        edges = (seen[None, :] - places[:, None])[None] / _BELOW[:, None, None]
        half = 0.5 / _BELOW[:, None, None]
        away = np.abs(edges)  # of the two tails the small one, which has all its digits
        chance = np.maximum(ndtr(half - away) - ndtr(-half - away), 1e-300)
        likelihood = np.log(chance) @ counts
        near = np.flatnonzero((likelihood > likelihood.max() - _UNLIKELY).any(axis=0))
        first, last = max(near[0] - 1, 0), min(near[-1] + 1, places.size - 1)
        if last - first > _PLACES // 3:
            width = (high - low) / (_PLACES - 1)
            return np.asarray(
                np.log(np.exp(likelihood - likelihood.max()).sum(axis=1) * width + 1e-300) + likelihood.max()
            )
        low, high = float(places[first]), float(places[last])
