"""Tests of the residual against noise: sums over bins of time and of the signals, compared with the same sums of noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.hypothesis import Placed, Refit
from hvdc_ident.discrepancy.nominal import Nominal, unit_columns
from hvdc_ident.effects import effects
from hvdc_ident.fit.noise import SURE

BINS = 8
ROWS_AFTER_BREAK = 10
"""Rows after a break of an input in which a quick answer to it is looked for."""


@dataclass(frozen=True)
class Binned:
    """One binning of the residuals. statistic: sum of squared bin sums; expected: of noise; p: chance under noise.

    excess: statistic - expected, in units of chi2.
    """

    name: str
    statistic: float
    expected: float
    p: float

    @property
    def excess(self) -> float:
        """Statistic beyond its expectation under noise, at least 0."""
        return max(self.statistic - self.expected, 0.0)


def residual_tests(
    nominal: Nominal, signals: Mapping[str, Mapping[str, Array]], *, bootstraps: int, seed: int
) -> tuple[Binned, ...]:
    """The residuals over stretches of time, and over levels and slopes of each signal given (by name and experiment, at its rows)."""
    noise = nominal.projected(nominal.drawn(bootstraps, seed))
    groups = {"time": _time_bins(nominal)}
    for name, by_experiment in signals.items():
        groups[f"level of {name}"] = _level_bins(nominal, by_experiment)
    return tuple(_binned(n, g, nominal.residual, noise) for n, g in groups.items() if g.max(initial=-1) >= 0)


def is_louder_after_breaks(nominal: Nominal) -> bool:
    """Return True where the residual is louder in the first rows after a break of an input than elsewhere, by more than chance.

    However loud the noise is, it knows nothing of the inputs; what answers within a few rows hardly shows in sums over more.
    """
    experiments = {e.name: e for e in nominal.problem.fitted_experiments}
    near, squares = [], []
    for b in nominal.blocks:
        e = experiments[b.experiment]
        breaks = [t for signal in e.inputs.values() for t in signal.breaks.tolist() if t > e.time[0]]
        first = np.searchsorted(e.time[b.rows], breaks)
        near.append(np.isin(np.arange(b.rows.size), np.add.outer(first, np.arange(ROWS_AFTER_BREAK))))
        squares.append(b.squares)
    at, power = np.concatenate(near), np.concatenate(squares)
    if not at.any() or at.all():
        return False
    limit = 1.0 + SURE * float(np.sqrt(2.0 / np.count_nonzero(at)))
    return bool(np.mean(power[at]) > limit * np.mean(power[~at]))


def _binned(name: str, group: NDArray[np.intp], residual: Array, noise: NDArray[np.floating]) -> Binned:
    count = int(group.max()) + 1
    keep = group >= 0
    sizes = np.maximum(np.bincount(group[keep], minlength=count), 1)

    def statistic(r: NDArray[np.floating]) -> float:
        sums = np.bincount(group[keep], weights=r[keep], minlength=count)
        return float(np.sum(sums**2 / sizes))

    under = np.array([statistic(noise[:, b]) for b in range(noise.shape[1])])
    own = statistic(residual)
    p = float((1 + np.count_nonzero(under >= own)) / (under.size + 1))
    return Binned(name, own, float(under.mean()) if under.size else float(count), p)


def _time_bins(nominal: Nominal) -> NDArray[np.intp]:
    """Stretches after the event that double in length, and one before, for each output of each experiment."""
    experiments = {e.name: e for e in nominal.problem.fitted_experiments}
    found, first = [], 0
    for b in nominal.blocks:
        e = experiments[b.experiment]
        t = e.time[b.rows]
        event = e.event if e.event is not None else float(t[0])
        span = max(float(t[-1]) - event, 1e-12)
        edges = event + span * np.concatenate([[0.0], np.geomspace(2.0 ** -(BINS - 1), 1.0, BINS)])
        found.append(first + np.clip(np.searchsorted(edges[:-1], t, "right"), 0, BINS))
        first += BINS + 1
    return np.concatenate(found)


def _level_bins(nominal: Nominal, by_experiment: Mapping[str, Array]) -> NDArray[np.intp]:
    """Levels of a signal, as many rows in each, rising and falling apart, for each output over all experiments."""
    moving = {n: v for n, v in by_experiment.items() if np.ptp(v) > 0}
    whole = np.concatenate(list(by_experiment.values())) if by_experiment else np.zeros(1)
    size = float(np.ptp(whole))
    outputs = list(nominal.problem.outputs)
    if size == 0.0 or not moving:
        return np.full(nominal.residual.size, -1, dtype=np.intp)
    # Most rows of a record stand still: levels are even in value, then halved where there are many rows.
    edges = np.unique(np.quantile(np.unique(np.round(whole / size, 4)) * size, np.linspace(0, 1, BINS + 1)[1:-1]))
    found = []
    for b in nominal.blocks:
        v = by_experiment[b.experiment][b.rows]
        slope = np.gradient(v) if v.size > 1 else np.zeros(v.size)
        rising = (slope > 1e-4 * size).astype(int) - (slope < -1e-4 * size).astype(int) + 1
        level = np.searchsorted(edges, v)
        found.append((outputs.index(b.output) * 3 + rising) * (edges.size + 1) + level)
    return np.concatenate(found).astype(np.intp)


LEAST_INDEPENDENT = 1e-4
"""Share of a slope that has to be left by all the parameters for the data to determine a size in one experiment alone."""


def constancy(refit: Refit, left: Nominal, placed: Placed) -> tuple[float, float]:
    """F test, to first order, that the experiments ask for different sizes of an effect.

    Returned are by how much the squared residuals fall with a size for each, and the chance p of such a fall under noise. p = 1 where
    only one experiment shows it, and for effects whose answer has steps in their size: those have no slopes. left: the refit's residuals.

    Source: Chow, Econometrica 28 (1960), as a score test.
    """
    names = left.problem.names
    own = [names.index(n) for n in placed.names.values() if n in names]
    if effects()[placed.candidate.effect].needs_grid or not own:
        return 0.0, 1.0
    more = _by_experiment(left, own)
    spare = refit.effective - left.basis.shape[1] - more.shape[1]
    if not more.shape[1] or spare < 1.0:
        return 0.0, 1.0
    remains = left.projected(left.residual)
    fall = float(np.sum((more.T @ remains) ** 2))
    share = fall / max(float(remains @ remains) - fall, np.finfo(float).tiny)
    return fall, float(fdtrc(more.shape[1], spare, share * spare / more.shape[1]))


def _by_experiment(left: Nominal, own: list[int]) -> Array:
    """(N, k) orthonormal, and to the basis: what other sizes in single experiments can make of the residual."""
    slopes = np.vstack([b.jacobian for b in left.blocks])[:, own]
    experiment = np.concatenate([np.full(b.residual.size, b.experiment) for b in left.blocks])
    each = np.hstack([np.where((experiment == e)[:, None], slopes, 0.0) for e in dict.fromkeys(experiment.tolist())])
    u, s, _ = np.linalg.svd(left.projected(unit_columns(each)), full_matrices=False)
    return np.asarray(u[:, s > LEAST_INDEPENDENT])


MAX_TONES = 4
LEAST_FILLED = 0.9
"""Share of the rows of an even grid that have to be there; those that are not, on a jump of an input say, count as 0."""
TONE_DEVIATIONS = 6.0
"""Standard deviations by which the power at a frequency, over all records, must exceed that of white noise."""
TONE_DISTANCE = 0.08
"""Tones nearer to each other than this, in the logarithm, are one."""


def tones(nominal: Nominal) -> tuple[float, ...]:
    """Hz, the strongest first; none where no frequency stands out, or rows lie on no even grid.

    The whitened residuals' periodograms are added up over outputs and experiments: a disturbance is in many of them.
    """
    experiments = {e.name: e for e in nominal.problem.fitted_experiments}
    spectra: list[tuple[Array, Array]] = []
    for b in nominal.blocks:
        t = experiments[b.experiment].time[b.rows]
        if t.size < 64:
            continue
        step = float(np.median(np.diff(t)))
        at = np.rint((t - t[0]) / step).astype(np.intp) if step > 0 else np.zeros(1, dtype=np.intp)
        count = int(at[-1]) + 1
        if (
            (np.diff(at) <= 0).any()
            or t.size < LEAST_FILLED * count
            or np.abs(t - t[0] - at * step).max() > 0.02 * step
        ):
            continue
        even = np.zeros(count)
        even[at] = b.residual - b.residual.mean()
        window = np.hanning(count)
        line = np.abs(np.fft.rfft(even * window, 4 * count)) ** 2
        axis = np.asarray(np.fft.rfftfreq(4 * count, step), dtype=float)
        spectra.append((axis, line / float(window @ window)))
    if not spectra:
        return ()
    frequency = max((f for f, _ in spectra), key=len)
    power = np.sum([np.interp(frequency, f, p, right=1.0) for f, p in spectra], axis=0)
    count = len(spectra)
    inner = np.flatnonzero((power[1:-1] > power[:-2]) & (power[1:-1] >= power[2:])) + 1
    # Below two periods a record the residual of anything slow has power.
    inner = inner[(inner > 8) & (power[inner] > count + TONE_DEVIATIONS * np.sqrt(count))]
    found: list[float] = []
    for k in inner[np.argsort(-power[inner])]:
        if all(abs(np.log(frequency[k] / other)) > TONE_DISTANCE for other in found):
            found.append(float(frequency[k]))
    return tuple(found[:MAX_TONES])
