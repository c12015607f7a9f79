"""A closer look at effects whose size has to be met: levels of a quantiser, the period of a sampler.

Neighbouring sizes leave traces with little in common, so a few finite sizes miss them and no slope leads there; inside a
loop their traces are not near those of a linear answer either. The model itself is run with many sizes instead, the
gains as they stand; around the best, closer still.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hvdc_ident.discrepancy.candidates import Candidate
from hvdc_ident.discrepancy.noise import draws
from hvdc_ident.discrepancy.nominal import Nominal
from hvdc_ident.discrepancy.refit import Refit, added
from hvdc_ident.discrepancy.scores import Scores, two_sided
from hvdc_ident.discrepancy.signatures import Column
from hvdc_ident.effects import Probe, effects
from hvdc_ident.errors import HvdcIdentError, SimulationError
from hvdc_ident.fit.executor import Executor, Progress, mapped
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.simulate.engine import Tolerance
from hvdc_ident.simulate.model_simulator import ModelSimulator
from hvdc_ident.trajectory import Array

SPOTS = 6
"""Sizes of an effect, the best by score at any place, around which is looked closer still."""
PLACES = 3
"""Places of an effect that are refitted then."""
BETWEEN = 10
"""Sizes between one of the scan and its neighbour, then."""
QUICK = Tolerance(rtol=1e-5, atol=1e-8, max_steps=600, search=False)
"""Of a scan's runs: one that takes more steps, chattering in a loop, or hardly comes to rest, is passed over."""
SAMPLE = 16
"""Sizes, spread over all, that are run first: where most of them are passed over, so is the place."""


@dataclass(frozen=True)
class Spot:
    """Where a scan was best at one place: the candidate with that size alone, and its score."""

    candidate: Candidate
    score: float


@dataclass(frozen=True, eq=False)
class Scan:
    """What a closer look found. spots: the best sizes; scores: of them; largest: (B,) of all sizes under noise."""

    spots: tuple[Spot, ...]
    scores: Scores
    largest: Array


@dataclass(frozen=True, eq=False)
class Job:
    """One place: the model without the effect and what it leaves, the candidate with all sizes, and what traces are
    multiplied with."""

    before: Refit
    residual: Array
    candidate: Candidate
    right: Array


def scan(
    before: Refit,
    nominal: Nominal,
    dense: Sequence[Candidate],
    bootstraps: int,
    seed: int,
    executor: Executor | None,
    progress: Progress | None,
    text: str,
) -> Scan:
    """The best sizes of effects that are scanned, and how large a score noise alone gives among so many.

    before: the model without them; nominal: the same at its optimum.
    """
    right = _right_sides(nominal, bootstraps, seed)
    rough = _looked(before, nominal, dense, right, executor, progress, text)
    best = [_neighbourhood(dense[c.candidate], c.probe) for c in _tops(dense, rough)]
    fine = _looked(before, nominal, best, right, executor, progress, f"{text}, closer still")
    chosen = _best(best, fine)
    at = [fine.columns.index(c) for c in chosen]
    kept = [replace(best[c.candidate], probes=(best[c.candidate].probes[c.probe],)) for c in chosen]
    spots = tuple(Spot(c, float(fine.t[k])) for c, k in zip(kept, at, strict=True))
    parts = {n: getattr(fine, n)[at] for n in ("raw", "size", "left", "noise", "sound", "two_sided")}
    columns = tuple(Column(i, 0) for i in range(len(kept)))
    return Scan(spots, Scores(columns, **parts), np.maximum(rough.largest, fine.largest))


def _right_sides(nominal: Nominal, bootstraps: int, seed: int) -> Array:
    """(N, 1 + k + B): the projected residual, the parameters' basis, projected noise."""
    noise = draws(nominal.problem, nominal.blocks, nominal.noise, nominal.fitted(), bootstraps, seed)
    parts = [nominal.projected(nominal.residual[:, None]), nominal.basis, nominal.projected(np.vstack(noise))]
    return np.hstack(parts)


def _tops(found: Sequence[Candidate], scores: Scores) -> list[Column]:
    """The best sizes of every effect at any place, neighbours of better ones left out."""
    kept: dict[str, list[Column]] = {}
    for c in _falling(scores):
        same = kept.setdefault(found[c.candidate].effect, [])
        near = any(k.candidate == c.candidate and abs(k.probe - c.probe) <= 1 for k in same)
        if len(same) < SPOTS and not near:
            same.append(c)
    return [c for group in kept.values() for c in group]


def _best(found: Sequence[Candidate], scores: Scores) -> list[Column]:
    """The best size at each of the best places of every effect."""
    kept: dict[str, dict[tuple[str, ...], Column]] = {}
    for c in _falling(scores):
        places = kept.setdefault(found[c.candidate].effect, {})
        if len(places) < PLACES:
            places.setdefault(found[c.candidate].at, c)
    return [c for places in kept.values() for c in places.values()]


def _falling(scores: Scores) -> list[Column]:
    """The columns with something to score, the best first."""
    return [scores.columns[k] for k in np.argsort(-scores.t, kind="stable") if scores.t[k] > 0]


def _looked(
    before: Refit,
    nominal: Nominal,
    found: Sequence[Candidate],
    right: Array,
    executor: Executor | None,
    progress: Progress | None,
    text: str,
) -> Scores:
    """The scores of every size of some candidates, by running the model."""
    jobs = [Job(before, nominal.residual, c, right) for c in found]
    outcomes = mapped(executor, _traces, jobs)
    products, squares = [np.zeros((0, right.shape[1]))], [np.zeros(0)]
    for k, (p, s) in enumerate(outcomes):
        products.append(p)
        squares.append(s)
        if progress:
            progress(k + 1, len(jobs), text)
    size, product = np.concatenate(squares), np.concatenate(products)
    sound = np.isfinite(size)
    size, product = np.where(sound, size, 0.0), np.where(sound[:, None], product, 0.0)
    k = nominal.basis.shape[1]
    left = np.maximum(size - np.sum(product[:, 1 : 1 + k] ** 2, axis=1), 0.0)
    columns = tuple(Column(i, k) for i, c in enumerate(found) for k in range(len(c.probes)))
    either = np.array([two_sided(found[c.candidate]) for c in columns], dtype=bool)
    return Scores(columns, product[:, 0], size, left, product[:, 1 + k :], sound, either)


def _traces(job: Job) -> tuple[Array, Array]:
    """(C, k) traces times the right-hand sides, (C,) their squares; not finite for a size that could not be run."""
    c, before = job.candidate, job.before
    products = np.full((len(c.probes), job.right.shape[1]), np.nan)
    squares = np.full(len(c.probes), np.nan)
    try:
        model, problem, placed, start = added(before.model, before.problem, c, 0, 1.0)
    except HvdcIdentError:  # it cannot sit there: no size of it is sound
        return products, squares
    problem = replace(problem, simulator=ModelSimulator(model, QUICK))
    k, at = len(before.problem.free), list(placed.bounds).index(scanned(c))
    apart = max(len(c.probes) // SAMPLE, 1)
    order = sorted(range(len(c.probes)), key=lambda i: (i % apart > 0, i))
    for n, i in enumerate(order):
        if n == SAMPLE and 2 * np.count_nonzero(np.isfinite(squares)) < SAMPLE:
            break
        start[at] = c.probes[i].values[scanned(c)]
        try:
            blocks = problem.blocks(np.concatenate([before.theta[:k], start, before.theta[k:]]), derivatives=False)
        except SimulationError:
            continue
        s = job.residual - np.concatenate([b.residual for b in blocks])
        products[i], squares[i] = s @ job.right, float(s @ s)
    return products, squares


def _neighbourhood(candidate: Candidate, probe: int) -> Candidate:
    """The candidate with the sizes around one of its scan, evenly in the logarithm."""
    name = scanned(candidate)
    sizes = sorted(p.values[name] for p in candidate.probes)
    own = candidate.probes[probe].values[name]
    k = sizes.index(own)
    sides = [sizes[max(k - 1, 0)], sizes[min(k + 1, len(sizes) - 1)]]
    tried = {own, *(float(s) for side in sides for s in np.geomspace(own, side, BETWEEN + 2)[1:-1])}
    return replace(candidate, probes=tuple(_resized(candidate.probes[probe], name, s) for s in sorted(tried)))


def scanned(candidate: Candidate) -> str:
    """The parameter that is scanned."""
    return next(n for n, q in effects()[candidate.effect].parameters.items() if q.scan)


def _resized(probe: Probe, name: str, size: float) -> Probe:
    low, high = probe.free[name]
    free = FrozenMap({**probe.free, name: (min(low, 0.9 * size), max(high, 1.1 * size))})
    return replace(probe, values=FrozenMap({**probe.values, name: size}), free=free)


def joined(found: Sequence[Candidate], better: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """The candidates, with the sizes that a scan found after their own."""
    more = {(c.effect, c.at): c.probes for c in better}
    return tuple(replace(c, probes=(*c.probes, *more.get((c.effect, c.at), ()))) for c in found)
