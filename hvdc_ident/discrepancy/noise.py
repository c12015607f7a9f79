"""The noise of the records: how large, how correlated from row to row, how coarse, told by what lies before the event.

A fit's own residuals would tell it wrong where an effect is missing: they hold the effect. So the records before the
event decide; given standard deviations stand unless those records are plainly noisier.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from hvdc_ident.errors import StudyError
from hvdc_ident.experiment import Experiment
from hvdc_ident.fit.problem import Problem
from hvdc_ident.fit.residual import Block
from hvdc_ident.fit.whitening import AR, autoregression, segments
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.trajectory import Array
from hvdc_ident.waveform import event_time, noise_floor

FEWEST = 8
"""Rows before an event from which anything is told of the noise."""
SURE = 3.3
"""Standard errors by which the records before the event must exceed a given noise to replace it."""
SOFT = 1e-6
LONG = 120
"""Rows of a record from which more than one AR coefficient is told."""
COMMON = 0.95
"""Share of what sines of free phase explain that one of common phase must."""
STANDS_OUT = 12.0
"""Its power over that of the rest, as an F value."""


@dataclass(frozen=True)
class Noise:
    """The noise of one output. std: in its unit, None where the data are deterministic (the misfit stands in).

    model: its AR coefficients from row to row, () where it is white; error: the standard error of a single one. step:
    what values are rounded to, 0 for nothing. source: where it comes from, in words. rows: how many before an event.
    """

    std: float | None
    model: AR
    error: float
    step: float
    source: str
    rows: int


def noise_of(experiments: Sequence[Experiment]) -> FrozenMap[Noise]:
    """The noise of every measured output, from all its records together."""
    outputs = dict.fromkeys(o for e in experiments for o in e.outputs)
    return FrozenMap({o: _noise(o, [e for e in experiments if o in e.outputs]) for o in outputs})


def _noise(output: str, experiments: Sequence[Experiment]) -> Noise:
    before = [(t, r) for e in experiments for t, r in [_before(e, output)] if r.size >= FEWEST]
    quiet = without_tone([t for t, _ in before], [r for _, r in before])
    records = [e.measured[output][np.isfinite(e.measured[output])] for e in experiments if e.measured is not None]
    step = _step(records)
    given = _given(output, experiments)
    rows = sum(r.size for r in quiet)
    power = sum(float(r @ r) for r in quiet)
    scale = max((float(np.abs(r).max()) for r in records if r.size), default=1.0)
    std = float(np.sqrt(power / max(rows - 2 * len(quiet), 1))) if rows else 0.0
    model: AR = ()
    error = 0.0
    if std <= 1e-12 * scale or (given is not None and std < 1e-3 * given):
        std = 0.0
    elif _even(experiments):
        model, error = _model(quiet, rows, power)
        if len(model) == 1:  # a line takes more of slow noise than of white
            std = float(np.sqrt(power / sum(_detrended(round(model[0], 2), min(r.size, 400))[1] for r in quiet)))
    if given is None and std <= max((noise_floor(r) for r in records), default=0.0):
        if step > 0.0:
            rounded = step * float(np.sqrt(1.0 / 12.0 + _dither(records, step) ** 2))
            return Noise(rounded, (), 0.0, step, "the resolution of the record and its flicker", rows)
        return Noise(None, (), 0.0, step, "none: the misfit stands in for it", rows)
    if given is None:
        return Noise(std, model, error, step, "the records before the event", rows)
    rho = sum(model) if len(model) != 1 else model[0]
    independent = max(rows * (1.0 - min(rho, 0.99) ** 2) / (1.0 + rho**2), 1.0)
    if std > given * (1.0 + SURE / np.sqrt(2.0 * independent)):
        return Noise(std, model, error, step, "the records before the event, noisier than what was given", rows)
    return Noise(given, model, error, step, "given", rows)


def _even(experiments: Sequence[Experiment]) -> bool:
    """Whether the rows are evenly spaced, so that a model from row to row means something."""
    try:
        for e in experiments:
            segments(e.time, e.name)
    except StudyError:
        return False
    return True


def _given(output: str, experiments: Sequence[Experiment]) -> float | None:
    """The root mean square of the standard deviations given; None where one is missing or all are next to nothing."""
    found = [e.noise.get(output) for e in experiments]
    if any(n is None or n <= 0 for n in found):
        return None
    ranges = [float(np.ptp(e.measured[output])) for e in experiments if e.measured is not None]
    value = float(np.sqrt(np.mean([n**2 for n in found if n is not None])))
    return value if value > 1.001 * SOFT * max([*ranges, 0.0]) else None


def without_tone(times: Sequence[Array], records: Sequence[Array]) -> list[Array]:
    """The records less the sine that all of them share at the same times, where there is one: that is no noise.

    times: (n,) s each. A sine of common phase has to hold nearly all that sines of free phase would, and to stand out of
    the rest; noise has no phase in common. A single record is left as it is.
    """
    if len(records) < 2 or min(t.size for t in times) < 3 * FEWEST:
        return list(records)
    span = max(float(np.ptp(t)) for t in times)
    step = min(float(np.median(np.diff(t))) for t in times)
    power = sum(float(r @ r) for r in records)
    rows = sum(r.size for r in records)
    best = (0.0, list(records))
    for f in np.arange(1.5 / span, 0.4 / step, 0.2 / span):
        waves = [np.column_stack([np.cos(2 * np.pi * f * t), np.sin(2 * np.pi * f * t)]) for t in times]
        free = sum(
            float(r @ r - np.linalg.lstsq(w, r, rcond=None)[1].sum()) for w, r in zip(waves, records, strict=True)
        )
        whole = np.vstack(waves)
        c = np.linalg.lstsq(whole, np.concatenate(records), rcond=None)[0]
        left = [r - w @ c for w, r in zip(waves, records, strict=True)]
        shared = power - sum(float(r @ r) for r in left)
        if shared > COMMON * free and shared / 2.0 > STANDS_OUT * (power - shared) / rows and shared > best[0]:
            best = (shared, left)
    return best[1]


def _before(experiment: Experiment, output: str) -> tuple[Array, Array]:
    """The times and rows before the event, less their straight line."""
    assert experiment.measured is not None
    event = experiment.event if experiment.event is not None else event_time(experiment.inputs)
    if event is None:
        return np.empty(0), np.empty(0)
    keep = (experiment.time < event - 1e-12) & np.isfinite(experiment.measured[output])
    t, v = experiment.time[keep], experiment.measured[output][keep]
    if v.size < FEWEST:
        return np.empty(0), np.empty(0)
    x = t - t.mean()
    power = float(x @ x)
    rest = v - v.mean()
    return t, np.asarray(rest - x * (float(x @ rest) / power if power else 0.0))


def _model(quiet: Sequence[Array], rows: int, power: float) -> tuple[AR, float]:
    """The AR model of several records together; of a single coefficient the error, freed of the bias a fitted line makes."""
    n = rows // len(quiet)
    longer = autoregression(quiet)
    if len(longer) > 1 and n >= LONG:
        return longer, 0.0
    raw = sum(float(r[1:] @ r[:-1]) for r in quiet) / power
    grid = np.linspace(-0.5, 0.985, 60)
    seen = [_detrended(float(g), min(n, LONG))[0] for g in grid]
    rho = float(np.interp(raw, seen, grid))
    error = float(np.sqrt(max(1.0 - rho**2, 0.02) / (rows - len(quiet))))
    return ((rho,), error) if abs(rho) > 1.645 * error else ((), 0.0)


@lru_cache(maxsize=512)
def _detrended(rho: float, n: int) -> tuple[float, float]:
    """What n rows of AR(1) noise of variance 1 without their straight line show: lag-1 coefficient, and sum of squares.

    Expected values: tr(L M S M)/tr(M S M) and tr(M S M), with S the correlation and M what takes the line out.
    """
    s = rho ** np.abs(np.subtract.outer(np.arange(n), np.arange(n))) if rho else np.eye(n)
    q = np.linalg.qr(np.column_stack([np.ones(n), np.arange(n, dtype=float)]))[0]
    m = np.eye(n) - q @ q.T
    a = m @ s @ m
    return float(np.trace(a, 1) / np.trace(a)), float(np.trace(a))


def _step(records: Sequence[Array]) -> float:
    """What the records are rounded to; 0 where they are not."""
    steps = []
    for r in records:
        floor = noise_floor(r) if r.size else 0.0
        if r.size and floor > 1.001 * SOFT * float(np.ptp(r)):
            steps.append(float(floor * np.sqrt(12.0)))
    return max(steps, default=0.0)


def _dither(records: Sequence[Array], step: float) -> float:
    """The standard deviation of white noise below a quantiser, in its steps, from how much the records flicker.

    Noise of sigma steps makes rounded values scatter by sigma/sqrt(pi) (variance, averaged over where the level lies
    between two steps) while it is below a third of a step, and by sigma^2 + 1/12 above.
    """
    bends = np.concatenate([(r[2:] - 2.0 * r[1:-1] + r[:-2]) / step for r in records if r.size > 2] or [np.zeros(1)])
    power = np.sort(bends**2)
    scatter = float(power[: max(1, int(0.98 * power.size))].mean()) / 6.0  # the largest are the events
    low = scatter * float(np.sqrt(np.pi))
    return low if low < 1.0 / 3.0 else float(np.sqrt(max(scatter - 1.0 / 12.0, 0.0)))


def draws(
    problem: Problem, blocks: Sequence[Block], noise: FrozenMap[Noise], fitted: Sequence[Array], count: int, seed: int
) -> list[Array]:
    """For each block (m, count) records of nothing but noise, weighted and whitened as the residuals are.

    fitted: the model's output at each block's rows, in its unit: rounding depends on it. A single AR coefficient is
    drawn too, within its error: what is not known of the noise widens what noise can do.
    """
    times = {e.name: e.time for e in problem.fitted_experiments}
    outputs = list(dict.fromkeys(b.output for b in blocks))
    found: list[Array] = []
    for k, (b, y) in enumerate(zip(blocks, fitted, strict=True)):
        n = noise[b.output]
        random = np.random.default_rng([seed, 1, k])
        model = np.repeat(np.array(n.model)[:, None], count, axis=1)
        if len(n.model) == 1:  # one draw an output: its records share the noise
            spread = np.random.default_rng([seed, 2, outputs.index(b.output)]).standard_normal(count)
            model = np.clip(model + n.error * spread, -0.6, 0.99)
        e = _coloured(random.standard_normal((y.size, count)), model)
        if n.step:
            size = max((n.std or 0.0) ** 2 - n.step**2 / 12.0, 0.0) ** 0.5
            placed = y[:, None] + n.step * random.uniform(-0.5, 0.5, count)
            e = (np.round((placed + size * e) / n.step) * n.step - placed) / b.sigma
        found.append(problem.treatment.applied(e, times[b.experiment][b.rows], b.output, b.experiment))
    return found


def _coloured(white: Array, model: Array) -> Array:
    """(m, count) stationary AR noise of variance 1; model: (p, count) coefficients."""
    p = model.shape[0]
    if not p:
        return white
    settle = 200
    lead = np.random.default_rng(0).standard_normal((settle, white.shape[1]))
    e = np.vstack([lead, white])
    for k in range(p, e.shape[0]):
        for lag in range(p):
            e[k] += model[lag] * e[k - 1 - lag]
    kept = e[settle:]
    if p == 1:
        return np.asarray(kept * np.sqrt(1.0 - model[0] ** 2))
    return np.asarray(kept / np.sqrt(np.mean(kept**2)))
