"""Proposals: effects worth a refit, each with a size and the parameters that go with it.

Two sources. The scores tell, of every candidate at a few finite sizes, how far chi2 would fall. And what would have to be
added at an insertion point, as the records tell it (`inversion`), gives the signal that is truly there: put on that, an effect
of the right size explains what is missing though the gains are still biased by it, and many sizes are tried at once.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.context import Round, SearchContext, slot_signals
from hvdc_ident.discrepancy.evidence import CandidateFit, Pick
from hvdc_ident.discrepancy.latent import Inversion
from hvdc_ident.discrepancy.nominal import Nominal
from hvdc_ident.discrepancy.options import SHORTLIST
from hvdc_ident.discrepancy.refit import FAILURES, failed_at
from hvdc_ident.discrepancy.refit_jobs import as_given
from hvdc_ident.discrepancy.scores import Scores, runs, scored
from hvdc_ident.discrepancy.signatures.block import block, parameter
from hvdc_ident.discrepancy.signatures.candidates import CandidateEffect
from hvdc_ident.discrepancy.signatures.finite import is_linear, kind_of
from hvdc_ident.discrepancy.signatures.response import Along, alone
from hvdc_ident.discrepancy.size_profile import Dense, every_size, has_to_be_met, sized, widened
from hvdc_ident.effects import SignalScales
from hvdc_ident.errors import SimulationError
from hvdc_ident.executor import Made, mapped
from hvdc_ident.model import Model

SIZES = 3
"""Sizes of one effect at one place that are proposed at most: a cost over sizes may have several minima."""
WORTHY = 0.5
"""Share of the best score from which the trace that the parameters leave of an effect is worth a refit."""
COARSE = 2
"""Parts of an interval that an effect with corners is stepped in: what is looked at are means over many."""


@dataclass(frozen=True, eq=False)
class View:
    """The model with some gains, and its runs with their answers, by experiment."""

    nominal: Nominal
    paths: Mapping[str, Along]


@dataclass(frozen=True, eq=False)
class _PlaceJob:
    """One insertion point's share of the work: the candidates there, and (N, B) noise, without what the parameters of this view
    can make good. own: whether the effects are put on the model's own signal too, not only on the one that the records tell."""

    view: View
    found: tuple[Dense, ...]
    noise: NDArray[np.float32]
    own: bool


@dataclass(frozen=True, eq=False)
class _Spot:
    """A size of a candidate: its score, by how much chi2 falls with it, and (p,) the unknowns that go with it."""

    candidate: CandidateEffect
    score: float
    fall: float
    theta: Array


def by_score(opened: Round) -> list[Pick]:
    """Every candidate within reach at its best size, once for each form it is scored in (optional parts of an effect)."""
    return _best_sizes(opened, opened.scores, ())


def by_score_elsewhere(search: SearchContext, opened: Round, views: Callable[[], Sequence[View]]) -> list[Pick]:
    """The same with the gains as they were given, where `views_of` has them: an effect whose part the gains of the optimum have
    taken leaves no trace beside those.

    Their falls are counted from what the model leaves with these gains, and compare with each other only.
    """
    picks: list[Pick] = []
    for view in views()[1:]:
        search.tell(0, 1, f"scores of {len(opened.candidates)} candidates with the given values")
        scores = scored(
            view.nominal, opened.candidates, view.paths, bootstraps=0, seed=search.seed, executor=search.executor
        )
        picks += _best_sizes(opened, scores, tuple(view.nominal.theta.tolist()))
    return picks


def by_absorbed(opened: Round) -> list[Pick]:
    """The candidates of which the parameters take up all but a trace, begun with the gains as they were given, the best first.

    With gains that stand for such an effect its part of the misfit is gone already, and what is left is what the gains do
    otherwise. Those whose trace is nothing beside the best score explain less than that does.
    """
    scores, before, best = opened.scores, opened.before, dict[int, int]()
    t = scores.t_absorbed
    least = max(scores.threshold(0.5), WORTHY * float(scores.t.max(initial=0.0)))
    for k in map(int, np.flatnonzero(t > least)):
        n = scores.columns[k].candidate
        if opened.reaches(opened.candidates[n]) and (n not in best or t[k] > t[best[n]]):
            best[n] = k
    given = before.theta_at_given
    for i, f in ((i, before.problem.free[i]) for i in before.gains):
        given[i] = min(max(f.given, f.min), f.max)
    picks = []
    for n, k in best.items():
        factor = 1.0 if has_to_be_met(opened.candidates[n]) else float(scores.expected[k])
        probe = scores.columns[k].probe
        picks.append(Pick(n, probe, factor, float(t[k]), tuple(given.tolist()), float(t[k])))
    return sorted(picks, key=lambda p: (-round(p.fall, 6), len(opened.candidates[p.candidate].at), p.candidate))[
        :SHORTLIST
    ]


def _best_sizes(opened: Round, scores: Scores, gains: tuple[float, ...]) -> list[Pick]:
    """The best size of each form by these scores, the best first. What noise is judged by stays the score at the optimum."""
    best: dict[tuple[int, frozenset[str]], int] = {}
    for k, column in enumerate(scores.columns):
        c = opened.candidates[column.candidate]
        form = column.candidate, frozenset(c.probes[column.probe].free)
        if scores.t[k] > 0 and opened.reaches(c) and (form not in best or scores.t[k] > scores.t[best[form]]):
            best[form] = k
    picks = []
    for k in best.values():
        column = scores.columns[k]
        met = has_to_be_met(opened.candidates[column.candidate])
        factor = 1.0 if met else float(scores.expected[k])
        picks.append(Pick(column.candidate, column.probe, factor, float(opened.scores.t[k]), gains, float(scores.t[k])))
    # Of equal scores the simpler: fewer places first, as listed.
    return sorted(picks, key=lambda p: (-round(p.fall, 6), len(opened.candidates[p.candidate].at), p.candidate))


def views_of(opened: Round, nominal: Nominal) -> Callable[[], list[View]]:
    """The model at its optimum, and with the gains as they were given where one has moved so far that it may stand for what is
    missing: a loop with such gains answers otherwise. Worked out when first asked for; none of a model closed inside."""
    return cache(lambda: _views(opened, nominal))


def _views(opened: Round, nominal: Nominal) -> list[View]:
    before, given = opened.before, as_given(opened.before)
    views = []
    with suppress(SimulationError):  # with the gains as given it need not run
        for n in [nominal] if given is None else [nominal, replace(nominal, theta=given)]:
            paths = opened.answers() if n is nominal else runs(before.model, n)
            inner = {name: p for name, p in paths.items() if isinstance(p, Along)}
            if len(inner) == len(paths):
                views.append(View(n, inner))
    return views


def by_latent(
    search: SearchContext,
    opened: Round,
    views: Callable[[], Sequence[View]],
    number: int,
    wanted: Callable[[CandidateEffect], bool],
) -> tuple[Round, list[Pick]]:
    """The round with the sizes found, and the proposals, the most promising first; the round's scores then know of the largest
    score that noise gives over all these sizes. wanted: the candidates looked at, of those at one place with one free size."""
    signals = slot_signals(opened.before.model, opened.paths, opened.before.placed)
    times = [p.time for p in opened.paths.values()]
    chosen = [c for c in opened.candidates if has_one_size(c) and opened.reaches(c) and wanted(c)]
    dense = [
        every_size(c, SignalScales.of(times, signals[c.at[0]])) if has_to_be_met(c) else widened(c) for c in chosen
    ]
    if not dense or not isinstance(opened.before.model, Model) or not (seen := views()):
        return opened, []
    noise = seen[0].nominal.drawn(search.options.bootstraps, search.seed + number)
    places: dict[str, list[Dense]] = {}
    for d in dense:
        places.setdefault(d.candidate.at[0], []).append(d)
    left = {id(v): v.nominal.projected(noise) for v in seen}

    def job(at: tuple[View, str]) -> _PlaceJob:
        """With other gains than those that fit, the model's own signal is the one that is known to be wrong."""
        view, place = at
        there = View(view.nominal, alone(view.paths, place))
        return _PlaceJob(there, tuple(places[place]), left[id(view)], own=view is seen[0])

    jobs = Made(job, [(v, p) for v in seen for p in places])
    # A fall is one from what the model leaves: with other gains than those that fit, more is left to begin with.
    begins = [float(np.sum(v.nominal.projected(v.nominal.residual[:, None]) ** 2)) for v in seen]
    dearer = [b - begins[0] for b in begins for _ in places]
    spots: list[_Spot] = []
    largest = np.zeros(noise.shape[1])
    done = zip(mapped(search.executor, _at_place, jobs), dearer, strict=True)
    failures: dict[str, str] = {}
    for k, ((more, under, failure), extra) in enumerate(done, start=1):
        if failure:
            failures[jobs.of[k - 1][1]] = failure
        spots += [replace(s, fall=s.fall - extra) for s in more]
        largest = np.maximum(largest, under)
        search.tell(k, len(jobs), f"round {number}: many sizes of {len(dense)} candidates")
    beside = opened.scores.beside
    scores = replace(opened.scores, beside=largest if beside is None else np.maximum(beside, largest))
    found = joined(opened.candidates, [s.candidate for s in spots])
    at = {_key(c): k for k, c in enumerate(found)}
    count = {_key(c): len(c.probes) for c in opened.candidates}
    picks = []
    for s in spots:
        key = _key(s.candidate)
        picks.append(Pick(at[key], count[key], 1.0, s.score, tuple(s.theta.tolist()), s.fall))
        count[key] += 1
    failed = tuple(
        CandidateFit(Pick(at[_key(d.candidate)], 0, 1.0, 0.0), failed_at(opened.before, why), -np.inf)
        for place, why in failures.items()
        for d in places[place]
    )
    opened = replace(opened, candidates=found, scores=scores, failed=(*opened.failed, *failed))
    return opened, sorted(picks, key=lambda p: -p.fall)


def has_one_size(candidate: CandidateEffect) -> bool:
    """Return True for a candidate at one place that moves, of which one size is looked for and is not met by proportion."""
    if candidate.still or len(candidate.at) > 1 or candidate.source or not candidate.probes:
        return False
    single = all(len(p.free) == 1 for p in candidate.probes) and not is_linear(kind_of(candidate, 0))
    return has_to_be_met(candidate) or single


def joined(found: Sequence[CandidateEffect], more: Iterable[CandidateEffect]) -> tuple[CandidateEffect, ...]:
    """The candidates, with the probes of others of the same effect and place after their own."""
    extra: dict[Hashable, list] = {}
    for c in more:
        extra.setdefault(_key(c), []).extend(c.probes)
    return tuple(replace(c, probes=(*c.probes, *extra.get(_key(c), ()))) for c in found)


def _key(candidate: CandidateEffect) -> Hashable:
    return candidate.effect, candidate.at, candidate.source, candidate.named


def _at_place(job: _PlaceJob) -> tuple[list[_Spot], Array, str]:
    """What `_sizes_at_place` returns, and why it has no sizes, empty where it has: the other places are looked at all the same."""
    try:
        return *_sizes_at_place(job), ""
    except FAILURES as error:
        return [], np.zeros(job.noise.shape[1]), str(error) or type(error).__name__


def _sizes_at_place(job: _PlaceJob) -> tuple[list[_Spot], Array]:
    """The best sizes of the candidates at one insertion point, and (B,) the largest score of any in each record of noise."""
    nominal = job.view.nominal
    latent = Inversion.of(nominal, job.view.paths, job.found[0].candidate.at[0])
    noise = latent.against(job.noise)
    chosen: list[tuple[CandidateEffect, float, float, Array]] = []
    largest = np.zeros(noise.shape[1])
    for dense in job.found:
        for signals in (latent.own, latent.told) if job.own else (latent.told,):
            parts = [_at_knots(latent, part, signals) for part in dense.parts()]
            tables = [latent.falls(part, noise) for part in parts]
            falls, scores = (np.concatenate([t[k] for t in tables]) for k in range(2))
            largest = np.max([largest, *(t[2] for t in tables)], axis=0)
            at_knots = np.hstack(parts)
            chosen += [
                (dense.alone(k), float(scores[k]), float(falls[k]), at_knots[:, k]) for k in _minima(falls, scores)
            ]
    if not chosen:
        return [], largest
    thetas = latent.answers(nominal, np.column_stack([c[3] for c in chosen]))
    return [_Spot(*c[:3], theta) for c, theta in zip(chosen, thetas, strict=True)], largest


def _at_knots(latent: Inversion, dense: Dense, signals: Sequence[Array]) -> Array:
    """(k n, C) at the knots: what each size of a candidate makes of a signal, less the signal."""
    kind, count = kind_of(dense.candidate, 0), dense.sizes.size
    changes: list[NDArray[np.floating]] = []
    whole, values = block(kind.effect, kind.present, kind.brings), dense.candidate.probes[0].values
    # Thousands are compared, and the best run again: half the digits take a third of the time.
    digits = np.float32 if whole.quick else np.float64
    own = {parameter(n): np.full(count, values[n]) for n in kind.present} | {
        parameter(sized(dense.candidate)): dense.sizes
    }
    for time, u in zip(latent.time, signals, strict=True):
        wide = np.broadcast_to(u.astype(digits)[:, None], (u.size, count))
        y = whole.run({n: v.astype(digits) for n, v in own.items()}, time, wide, None, COARSE)
        changes.append((y - wide).astype(np.float32, copy=False))
    return np.nan_to_num(latent.knots(changes))


def _minima(falls: Array, scores: Array) -> list[int]:
    """The best sizes, by the fall as they are and where none brings any by their score; neighbours of better ones left out."""
    worth = falls if falls.max(initial=0.0) > 0 else scores
    kept: list[int] = []
    for k in np.argsort(-worth, kind="stable"):
        if len(kept) == SIZES or not worth[k] > 0:
            break
        if all(abs(int(k) - j) > 1 for j in kept):
            kept.append(int(k))
    return kept
