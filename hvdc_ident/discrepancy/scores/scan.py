"""A closer look at effects whose trace is another one at every size, or with every bias of the gains.

Levels of a quantiser and periods of a sampler have to be met: neighbouring sizes leave traces with little in common, so a
few finite sizes miss them and no slope leads there. What bends its signal (a limit, a play, a rate limit) shows where that
signal is, and gains that are biased by what is missing put it elsewhere. Many sizes are put on the slot's signal as the
model has it and as the records tell it (`inversion`); at the best the model itself is run, around those that have to
be met at sizes closer still, with the gains that would go with them. A model that is closed inside is run from the
beginning, at sizes that have to be met.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.noise.records import draws
from hvdc_ident.discrepancy.refits.begin import added
from hvdc_ident.discrepancy.refits.nominal import Nominal
from hvdc_ident.discrepancy.refits.refit import Refit
from hvdc_ident.discrepancy.scores.dense import Dense, has_to_be_met, sized
from hvdc_ident.discrepancy.scores.inversion import Inversion
from hvdc_ident.discrepancy.scores.scored import Path, Scores, two_sided
from hvdc_ident.discrepancy.signatures.block import block, parameter
from hvdc_ident.discrepancy.signatures.finite import SignatureColumn, kind_of
from hvdc_ident.discrepancy.signatures.response import Along
from hvdc_ident.errors import HvdcIdentError, SimulationError
from hvdc_ident.executor import Executor, Progress, mapped
from hvdc_ident.simulate import ModelSimulator, Tolerance

SPOTS = 10
"""Sizes of an effect, the best at any place, at which the model is run."""
EACH = 3
"""Of these at one place at most, where there are others."""
PLACES = 4
"""Places of an effect that are refitted then."""
WORTH = 0.3
"""Share of the best fall of chi2 that another one has to bring to be refitted too."""
COARSE = 2
"""Parts of an interval that an effect with corners is stepped in: what is looked at are means over many."""
THIN = 150
"""Sizes at which a closed model is run at first."""
QUICK = Tolerance(rtol=1e-5, atol=1e-8, max_steps=600, search=False)
"""Of runs at many sizes: one that takes more steps, chattering in a loop, or hardly comes to rest, is passed over."""
PATIENT = replace(QUICK, max_steps=5000, search=True)
"""The same where few sizes are left: a record that never rests crosses hundreds of levels."""
SAMPLE = 16
"""Sizes, spread over all, that are run first: where most of them are passed over, so is the place."""


@dataclass(frozen=True, eq=False)
class Spot:
    """A size worth a look: the candidate with it alone, or with the sizes around it, and its score.

    fall: by how much chi2 would fall. theta: the unknowns of the model before that go with it.
    """

    dense: Dense
    score: float
    fall: float
    theta: Array


@dataclass(frozen=True, eq=False)
class Scan:
    """Result of a grid refinement. spots: the best sizes; scores: of them; largest: (B,) of all sizes under noise."""

    spots: tuple[Spot, ...]
    scores: Scores
    largest: Array


@dataclass(frozen=True, eq=False)
class View:
    """The model with some gains, and its runs with their answers, by experiment."""

    nominal: Nominal
    paths: Mapping[str, Path]


@dataclass(frozen=True, eq=False)
class Slot:
    """One slot's share of a grid refinement: the model's runs, the candidates there, and (N, B) noise.

    own: whether the model's own signal is looked at too, not only the one that the records tell.
    """

    view: View
    found: tuple[Dense, ...]
    noise: Array
    own: bool


@dataclass(frozen=True, eq=False)
class ScanJob:
    """One place: the model without the effect and what it leaves, what is looked at there, what traces are multiplied with,
    and how patiently the model is run."""

    before: Refit
    residual: Array
    dense: Dense
    right: Array
    tolerance: Tolerance


def scan(
    before: Refit,
    views: Sequence[View],
    dense: Sequence[Dense],
    bootstraps: int,
    seed: int,
    executor: Executor | None,
    progress: Progress | None,
    text: str,
) -> Scan:
    """The best sizes of effects that are scanned, and how large a score noise alone gives among those that were run.

    before: the model without them; views: the same at its optimum, and with other gains that the records may be looked
    at with, through the signals that they tell then.
    """
    nominal = views[0].nominal
    right, known = _right_sides(nominal, bootstraps, seed), nominal.basis.shape[1]
    if all(isinstance(p, Along) for p in views[0].paths.values()):
        spots, largest = _told(views, dense, right[:, 1 + known :], executor, progress, text)
    else:
        thin = [replace(d, sizes=d.sizes[:: max(d.sizes.size // THIN, 1)]) for d in dense]
        rough = _looked(
            [ScanJob(before, nominal.residual, d, right, QUICK) for d in thin], right, known, executor, progress, text
        )
        spots, largest = _spots(thin, rough, before.theta), rough.largest
    best = _tops(spots)
    jobs = [ScanJob(replace(before, theta=s.theta), nominal.residual, s.dense, right, PATIENT) for s in best]
    fine = _looked(jobs, right, known, executor, progress, f"{text}, closer still")
    chosen = _best(best, fine)
    kept = [replace(best[c.candidate], dense=best[c.candidate].dense.only(c.probe)) for c in chosen]
    at = [fine.columns.index(c) for c in chosen]
    spots = [replace(s, score=float(fine.t[k]), fall=float(fine.falls[k])) for s, k in zip(kept, at, strict=True)]
    parts = {n: getattr(fine, n)[at] for n in ("raw", "size", "left", "noise", "sound", "two_sided")}
    columns = tuple(SignatureColumn(i, 0) for i in range(len(kept)))
    return Scan(tuple(spots), Scores(columns, **parts), np.maximum(largest, fine.largest))


def _right_sides(nominal: Nominal, bootstraps: int, seed: int) -> Array:
    """(N, 1 + k + B): the projected residual, the parameters' basis, projected noise."""
    noise = draws(nominal.problem, nominal.blocks, nominal.noise, nominal.fitted(), bootstraps, seed)
    parts = [nominal.projected(nominal.residual[:, None]), nominal.basis, nominal.projected(np.vstack(noise))]
    return np.hstack(parts)


def _told(
    views: Sequence[View],
    dense: Sequence[Dense],
    noise: Array,
    executor: Executor | None,
    progress: Progress | None,
    text: str,
) -> tuple[list[Spot], Array]:
    """The best sizes of every candidate, on the model's signal at its slot and on the one that the records tell; and (B,)
    the largest score of all sizes in each record of noise."""
    by_place: dict[str, list[Dense]] = {}
    for d in dense:
        by_place.setdefault(d.candidate.at[0], []).append(d)
    # With other gains than those that fit, the model's own signal is the one that is known to be wrong.
    jobs = [
        Slot(_at_one(view, p), tuple(group), noise, own=view is views[0])
        for view in views
        for p, group in by_place.items()
    ]
    spots, largest = [], np.zeros(noise.shape[1])
    for k, (more, under) in enumerate(mapped(executor, _at_slot, jobs), start=1):
        spots += more
        largest = np.maximum(largest, under)
        if progress:
            progress(k, len(jobs), text)
    return spots, largest


def _at_one(view: View, place: str) -> View:
    """The view of one slot."""
    return View(view.nominal, {n: p.only(place) for n, p in view.paths.items() if isinstance(p, Along)})


def _at_slot(slot: Slot) -> tuple[list[Spot], Array]:
    """The best sizes of the candidates at one slot, and (B,) the largest score of any in each record of noise."""
    nominal, paths = slot.view.nominal, {n: p for n, p in slot.view.paths.items() if isinstance(p, Along)}
    inverse = Inversion.of(nominal, paths, slot.found[0].candidate.at[0])
    noise = inverse.against(nominal.projected(slot.noise))
    spots, largest = [], np.zeros(slot.noise.shape[1])
    for dense in slot.found:
        met = has_to_be_met(dense.candidate)
        for signals in (inverse.own, inverse.told) if slot.own else (inverse.told,):
            parts = [_at_knots(inverse, part, signals) for part in dense.parts()]
            tables = [inverse.falls(part, noise) for part in parts]
            falls, scores = (np.concatenate([t[k] for t in tables]) for k in range(2))
            largest = np.max([largest, *(t[2] for t in tables)], axis=0)
            at_knots = np.hstack(parts)
            best = _leading(falls, scores if met else np.zeros(scores.size))
            for k, theta in zip(best, inverse.answers(nominal, at_knots[:, best]), strict=True):
                near = dense.around(k) if met else dense.only(k)
                spots.append(Spot(near, float(scores[k]), float(falls[k]), theta))
    return spots, largest


def _at_knots(inverse: Inversion, dense: Dense, signals: Sequence[Array]) -> Array:
    """(k n, C) at the knots: what each size of a candidate makes of a signal, less the signal."""
    kind, count = kind_of(dense.candidate, 0), dense.sizes.size
    changes: list[NDArray[np.floating]] = []
    whole, values = block(kind.effect, kind.present, kind.brings), dense.candidate.probes[0].values
    # Thousands are compared, and the best run again: half the digits take a third of the time.
    digits = np.float32 if whole.quick else np.float64
    own = {parameter(n): np.full(count, values[n]) for n in kind.present} | {
        parameter(sized(dense.candidate)): dense.sizes
    }
    for time, u in zip(inverse.time, signals, strict=True):
        wide = np.broadcast_to(u.astype(digits)[:, None], (u.size, count))
        y = whole.run({n: v.astype(digits) for n, v in own.items()}, time, wide, None, COARSE)
        changes.append((y - wide).astype(np.float32, copy=False))
    found = inverse.knots(changes)
    return found if np.isfinite(found).all() else np.nan_to_num(found)


def _leading(falls: Array, scores: Array) -> list[int]:
    """The best columns by one measure and the other, neighbours of better ones left out."""
    kept: list[int] = []
    for by in (np.where(falls > 0, falls, 0.0), scores):
        own: list[int] = []
        for k in np.argsort(-by, kind="stable")[: 20 * EACH]:
            if by[k] > 0 and len(own) < EACH and all(abs(int(k) - j) > 1 for j in (*kept, *own)):
                own.append(int(k))
        kept += own
    return kept


def _spots(found: Sequence[Dense], scores: Scores, theta: Array) -> list[Spot]:
    """The best sizes of candidates that were run at all of theirs."""
    spots: list[Spot] = []
    for i, dense in enumerate(found):
        own = [k for k, column in enumerate(scores.columns) if column.candidate == i]
        spots += [
            Spot(dense.around(k), float(scores.t[own[k]]), float(scores.falls[own[k]]), theta)
            for k in _leading(scores.falls[own], scores.t[own])
        ]
    return spots


def _tops(spots: Sequence[Spot]) -> list[Spot]:
    """The best of every effect at any place, in turn by how much chi2 falls and by their score."""
    chosen: list[Spot] = []
    for effect in dict.fromkeys(s.dense.candidate.effect for s in spots):
        own = [s for s in spots if s.dense.candidate.effect == effect]
        ranks = [sorted(own, key=lambda s: -s.fall), sorted(own, key=lambda s: -s.score)]
        each = max(EACH, SPOTS // len({s.dense.place for s in own}))
        kept: list[Spot] = []
        for s in (s for pair in zip(*ranks, strict=True) for s in pair):
            beside = [k.dense for k in kept if k.dense.place == s.dense.place]
            if (
                len(kept) < SPOTS
                and len(beside) < each
                and not any(np.array_equal(k.sizes, s.dense.sizes) for k in beside)
            ):
                kept.append(s)
        chosen += kept
    return chosen


def _best(spots: Sequence[Spot], scores: Scores) -> list[SignatureColumn]:
    """The best size of each of the best places of every effect, by what the model itself makes of it."""
    kept: dict[str, dict[tuple[str, ...], SignatureColumn]] = {}
    worth = np.where(scores.falls > 0, scores.falls, 1e-6 * scores.t)
    least = WORTH * float(worth.max(initial=0.0))
    for k in np.argsort(-worth, kind="stable"):
        c = scores.columns[k]
        effect, at = spots[c.candidate].dense.place
        places = kept.setdefault(effect, {})
        if worth[k] > 0 and worth[k] >= least and len(places) < PLACES:
            places.setdefault(at, c)
    return [c for places in kept.values() for c in places.values()]


def _looked(
    jobs: Sequence[ScanJob], right: Array, known: int, executor: Executor | None, progress: Progress | None, text: str
) -> Scores:
    """The scores of every size of some candidates, by running the model; none where there is nothing to run.

    right: right-hand sides of the jobs; known: how many of them are what parameters can make good.
    """
    products, squares = [np.zeros((0, right.shape[1]))], [np.zeros(0)]
    for k, (p, s) in enumerate(mapped(executor, _traces, jobs), start=1):
        products.append(p)
        squares.append(s)
        if progress:
            progress(k, len(jobs), text)
    size, product = np.concatenate(squares), np.concatenate(products)
    sound = np.isfinite(size)
    size, product = np.where(sound, size, 0.0), np.where(sound[:, None], product, 0.0)
    left = np.maximum(size - np.sum(product[:, 1 : 1 + known] ** 2, axis=1), 0.0)
    columns = tuple(SignatureColumn(i, n) for i, job in enumerate(jobs) for n in range(job.dense.sizes.size))
    either = np.array([two_sided(jobs[c.candidate].dense.candidate) for c in columns], dtype=bool)
    return Scores(columns, product[:, 0], size, left, product[:, 1 + known :], sound, either)


def _traces(job: ScanJob) -> tuple[Array, Array]:
    """(C, k) traces times the right-hand sides, (C,) their squares; not finite for a size that could not be run."""
    before, sizes = job.before, job.dense.sizes
    products, squares = np.full((sizes.size, job.right.shape[1]), np.nan), np.full(sizes.size, np.nan)
    c = job.dense.alone(0)
    try:
        model, problem, placed, start = added(before.model, before.problem, c, 0, 1.0)
    except HvdcIdentError:  # it cannot sit there: no size of it is sound
        return products, squares
    problem = replace(problem, simulator=ModelSimulator(model, job.tolerance))
    k, at = len(before.problem.free), list(placed.bounds).index(sized(c))
    apart = max(sizes.size // SAMPLE, 1)
    order = sorted(range(sizes.size), key=lambda i: (i % apart > 0, i))
    for n, i in enumerate(order):
        if n == SAMPLE and 2 * np.count_nonzero(np.isfinite(squares)) < SAMPLE:
            break
        start[at] = sizes[i]
        try:
            blocks = problem.blocks(np.concatenate([before.theta[:k], start, before.theta[k:]]), derivatives=False)
        except SimulationError:
            continue
        s = job.residual - np.concatenate([b.residual for b in blocks])
        products[i], squares[i] = s @ job.right, float(s @ s)
    return products, squares
