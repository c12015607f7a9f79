"""The test before the refit: T = (s'Mr)^2/(s'Ms) for every candidate at every size, judged by the largest of all under noise.

r: whitened residual; M takes out what fitted and nuisance parameters can make good; s: whitened signature. T is the
fall of chi2 that adding the signature, freely scaled, would bring. Under noise alone the largest T of all candidates has
a distribution that a bootstrap from the refitted nominal gives: whatever is scored must beat that.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, Experiment
from hvdc_ident.discrepancy.nominal import Nominal
from hvdc_ident.discrepancy.signatures.candidates import CandidateEffect
from hvdc_ident.discrepancy.signatures.closed import Ends, ends
from hvdc_ident.discrepancy.signatures.finite import LOOSE, SignatureColumn, Task, columns_of, signatures, tasks
from hvdc_ident.discrepancy.signatures.response import Along, along
from hvdc_ident.effects import effects
from hvdc_ident.executor import Executor, mapped
from hvdc_ident.fit.residual import ResidualBlock, Treatment
from hvdc_ident.model import AnyModel, Model
from hvdc_ident.simulate import ModelSimulator

Path = Along | Ends
"""A run with its answers: of equations, or of something closed."""
SEEN = 1.0
"""s's below which a size leaves no trace: no experiment excites it."""
_BY_COLUMN = ("raw", "size", "left", "noise", "sound", "two_sided")
LEFT = 1e-3
"""Share of a signature that has to be left beside the parameters."""
TRACE = 1e-7
"""Share below which what is left may be the error of signature and derivatives, which agree to 1e-4 of their size."""


@dataclass(frozen=True, eq=False)
class Scores:
    """Scores of C columns. raw: (C,) s'Mr. size: (C,) s's. left: (C,) s'Ms. noise: (C, B) s'M of noise. sound: (C,)
    whether the loop closed. two_sided: (C,) whether the effect may be reversed. beside: (B,) the largest score in each
    record of noise of columns that were looked at too and are not here."""

    columns: tuple[SignatureColumn, ...]
    raw: Array
    size: Array
    left: Array
    noise: NDArray[np.float32]
    sound: NDArray[np.bool_]
    two_sided: NDArray[np.bool_]
    beside: Array | None = None

    @cached_property
    def usable(self) -> NDArray[np.bool_]:
        """(C,) whether there is something to score."""
        return np.asarray(self.sound & (self.size >= SEEN) & (self.left > LEFT * self.size) & (self.left > 1e-2 * SEEN))

    @cached_property
    def absorbed_with_trace(self) -> NDArray[np.bool_]:
        """(C,) whether the parameters take up nearly all of a signature that the experiments excite, and not quite all.

        What they leave of it may be all that the model leaves of the records: then another value of the parameters, and the
        effect, explain these as well.
        """
        seen = self.sound & (self.size >= SEEN) & ~self.usable
        return np.asarray(seen & (self.left > TRACE * self.size) & (self.left > 1e-2 * SEEN))

    @cached_property
    def t_absorbed(self) -> Array:
        """(C,) the scores of those, 0 for all others; they are no part of what noise is judged by."""
        allowed = self.absorbed_with_trace & (self.two_sided | (self.raw > 0))
        return np.where(allowed, self.raw**2 / np.where(self.left > 0, self.left, 1.0), 0.0)

    @cached_property
    def t(self) -> Array:
        """(C,) the scores; 0 where there is nothing to score, or the sign is one the effect cannot have."""
        return self._t(self.raw[:, None])[:, 0]

    @cached_property
    def largest(self) -> Array:
        """(B,) the largest score of all candidates in each record of noise."""
        own = np.asarray(self._t(self.noise).max(axis=0, initial=0.0))
        return own if self.beside is None or not own.size else np.maximum(own, self.beside)

    def _t(self, raw: NDArray[np.floating]) -> Array:
        left = np.where(self.left > 0, self.left, 1.0)[:, None]
        allowed = self.usable[:, None] & (self.two_sided[:, None] | (raw > 0))
        return np.where(allowed, raw**2 / left, 0.0)

    def joined(self, more: Scores) -> Scores:
        """These columns and others, against the same noise."""
        pairs = {n: np.concatenate([getattr(self, n), getattr(more, n)]) for n in _BY_COLUMN}
        others = [s.beside for s in (self, more) if s.beside is not None]
        beside = np.max(others, axis=0) if others else None
        return replace(self, columns=(*self.columns, *more.columns), beside=beside, **pairs)

    @property
    def expected(self) -> Array:
        """(C,) the size the data ask for, in units of the probe's."""
        return np.where(self.left > 0, self.raw / np.where(self.left > 0, self.left, 1.0), 0.0)

    @property
    def falls(self) -> Array:
        """(C,) by how much chi2 falls with each size as it is; 0 where there is nothing to score."""
        return np.where(self.usable, 2.0 * self.raw - self.left, 0.0)

    @property
    def absorbed(self) -> Array:
        """(C,) the share of the signature that the parameters take up."""
        return np.where(self.size > 0, 1.0 - self.left / np.where(self.size > 0, self.size, 1.0), 0.0)

    def p(self, t: float) -> float:
        """The chance of a score as large anywhere, under noise."""
        b = self.largest.size
        return float((1 + np.count_nonzero(self.largest >= t)) / (b + 1))

    def threshold(self, significance: float) -> float:
        """The score that noise alone exceeds with this chance."""
        return float(np.quantile(self.largest, 1.0 - significance)) if self.largest.size else 0.0


def runs(model: AnyModel, nominal: Nominal) -> dict[str, Path]:
    """The model's runs of the fitted experiments, with their answers, by the experiment's name.

    They are as accurate as those of the refit: a play at the edge of turning runs at one tolerance and not at another.
    """
    experiments, simulator = nominal.problem.fitted_experiments, nominal.problem.simulator
    tolerance = simulator.tolerance if isinstance(simulator, ModelSimulator) else None
    if isinstance(model, Model):
        return {e.name: along(model, e, nominal.values, tolerance) for e in experiments}
    return {e.name: ends(model, e, nominal.values) for e in experiments}


def _largest(paths: Mapping[str, Path]) -> int:
    """Numbers in one answer, of the longest experiment: outputs at rows, and the signal at its instants."""
    return max(len(a.outputs) * a.count + 3 * a.time.size for a in paths.values())


def two_sided(candidate: CandidateEffect) -> bool:
    """Return True where the effect may act either way: a parameter passes its neutral value, or a phase turns it round."""
    entry = effects()[candidate.effect]
    if "phase" in entry.parameters:
        return True
    return any(
        q.neutral is not None and (isinstance(q.neutral, str) or q.min < q.neutral < q.max)
        for q in entry.parameters.values()
    )


def scored(
    nominal: Nominal,
    found: Sequence[CandidateEffect],
    paths: Mapping[str, Path],
    *,
    bootstraps: int,
    seed: int,
    executor: Executor | None = None,
) -> Scores:
    """The scores of all candidates at the nominal model's optimum."""
    columns = columns_of(found)
    plan = tasks(found, columns, _largest(paths))
    noise = nominal.projected(nominal.drawn(bootstraps, seed))
    residual = nominal.projected(nominal.residual[:, None])
    restless = np.array([effects()[found[c.candidate].effect].self_exciting for c in columns], dtype=bool)
    starts = nominal.starts if restless.any() else np.zeros((residual.shape[0], 0))
    right = np.hstack([residual, nominal.basis, starts])
    jobs, at = [], 0
    for e in nominal.problem.fitted_experiments:
        own = [b for b in nominal.blocks if b.experiment == e.name]
        rows = slice(at, at + sum(b.residual.size for b in own))
        jobs.append(
            ScoreJob(paths[e.name], plan, Whitening.of(own, e, nominal), right[rows], noise[rows], len(columns))
        )
        at = rows.stop
    products, under = np.zeros((len(columns), right.shape[1])), np.zeros((len(columns), noise.shape[1]), np.float32)
    squares, change = np.zeros(len(columns)), np.zeros(len(columns))
    for own_products, own_under, own_squares, own_change in mapped(executor, _products, jobs):
        products += own_products
        under += own_under
        squares += own_squares
        change = np.maximum(change, own_change)
    k = 1 + nominal.basis.shape[1]
    raw, left = products[:, 0], squares - np.sum(products[:, 1:k] ** 2, axis=1)
    # What moves the model by itself meets records that do not begin at rest: their starts are for it to make good.
    besides = np.where(restless[:, None], products[:, k:], 0.0)
    left = np.maximum(left - np.sum(besides**2, axis=1), 0.0)
    raw = raw - besides @ (starts.T @ residual[:, 0])
    under -= (besides @ (starts.T @ noise)).astype(np.float32)
    either = np.array([two_sided(found[c.candidate]) for c in columns], dtype=bool)
    return Scores(columns, raw, squares, left, under, change <= LOOSE, either)


@dataclass(frozen=True, eq=False)
class Whitening:
    """Map from an experiment's answers to whitened rows, block by block."""

    name: str
    treatment: Treatment
    parts: tuple[tuple[ResidualBlock, int, Array], ...]

    @classmethod
    def of(cls, blocks: Sequence[ResidualBlock], experiment: Experiment, nominal: Nominal) -> Whitening:
        slim = [replace(b, jacobian=b.jacobian[:0]) for b in blocks]  # a job is sent to where it is done
        parts = [(b, experiment.outputs.index(b.output), experiment.time[b.rows]) for b in slim]
        return cls(experiment.name, nominal.problem.treatment, tuple(parts))

    def __call__(self, y: Array) -> Array:
        """(rows, nc) of y (o, R, nc)."""
        return np.concatenate([self._rows(b, y[k, b.rows], time) for b, k, time in self.parts])

    def _rows(self, b: ResidualBlock, y: Array, time: Array) -> Array:
        if b.slope is not None:
            return np.asarray(y * b.slope[:, None])
        return self.treatment.applied(b.scaled(y), time, b.output, self.name)


@dataclass(frozen=True, eq=False)
class ScoreJob:
    """One experiment's share of the work."""

    path: Path
    plan: tuple[tuple[Task, ...], ...]
    whitening: Whitening
    right: Array
    noise: NDArray[np.float32]
    columns: int


def _products(job: ScoreJob) -> tuple[Array, NDArray[np.float32], Array, Array]:
    """(C, k) signatures times the right-hand sides, (C, B) times the noise, (C,) their squares, (C,) how far the loop was from
    closed."""
    products = np.zeros((job.columns, job.right.shape[1]))
    under = np.zeros((job.columns, job.noise.shape[1]), np.float32)
    squares, change = np.zeros(job.columns), np.full(job.columns, np.inf)
    for index, y, last in signatures(job.path, job.plan):
        s = job.whitening(y)
        products[index] = s.T @ job.right
        under[index] = s.T.astype(np.float32) @ job.noise
        squares[index] = np.einsum("ij,ij->j", s, s)
        change[index] = last
    return products, under, squares, change


MOST = 4
FULL = 0.9
"""Share of the rows of an even grid that have to be there; those that are not, on a jump of an input say, count as 0."""
OUT = 6.0
"""Standard deviations by which the power at a frequency, over all records, must exceed that of white noise."""
APART = 0.08
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
        if (np.diff(at) <= 0).any() or t.size < FULL * count or np.abs(t - t[0] - at * step).max() > 0.02 * step:
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
    inner = inner[(inner > 8) & (power[inner] > count + OUT * np.sqrt(count))]
    found: list[float] = []
    for k in inner[np.argsort(-power[inner])]:
        if all(abs(np.log(frequency[k] / other)) > APART for other in found):
            found.append(float(frequency[k]))
    return tuple(found[:MOST])
