"""The many sizes that a candidate is looked at with, and which candidates are.

Levels of a quantiser and periods of a sampler have to be met (`has_to_be_met`); what bends its signal has to be
near. Thousands of sizes are kept as numbers: a probe of each would take longer to send than its trace to work out.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.context import SearchContext
from hvdc_ident.discrepancy.evidence import unseen_rows
from hvdc_ident.discrepancy.options import BEAM, SURE
from hvdc_ident.discrepancy.race import done
from hvdc_ident.discrepancy.refit import FAILURES, Refit, RefitJob, RefitResult, found_by, judged, run, signal
from hvdc_ident.discrepancy.refit_jobs import as_given
from hvdc_ident.discrepancy.signatures.candidates import CandidateEffect
from hvdc_ident.discrepancy.size_line import BENT, PATIENT, SizeLine
from hvdc_ident.effects import Probe, SignalScales, effects, size_grid
from hvdc_ident.executor import mapped
from hvdc_ident.fit.optimisers.nelder_mead import NelderMead
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.simulate import ModelSimulator

WIDE = 20.0
"""Below the least and above the largest probe of such an effect: how far its sizes reach."""
BETWEEN = 7
"""Sizes between one of the scan and its neighbour, then."""
TOGETHER = 400
"""Sizes whose traces are worked out at a time."""


@dataclass(frozen=True, eq=False)
class Dense:
    """A candidate with one size, and (C,) all those that it is looked at with, the least first."""

    candidate: CandidateEffect
    sizes: Array

    def alone(self, k: int) -> CandidateEffect:
        """The candidate with one of the sizes."""
        return replace(
            self.candidate, probes=(resized(self.candidate.probes[0], sized(self.candidate), float(self.sizes[k])),)
        )

    def parts(self) -> list[Dense]:
        """A part of the sizes each: of all at once the traces would fill the memory."""
        return [replace(self, sizes=self.sizes[k : k + TOGETHER]) for k in range(0, self.sizes.size, TOGETHER)]


def has_to_be_met(candidate: CandidateEffect) -> bool:
    """Return True where the size has to be met exactly (levels of a quantiser, periods of a sampler)."""
    return effects()[candidate.effect].needs_grid


def by_level(candidate: CandidateEffect) -> bool:
    """Return True where the size has to be met exactly and is a level of the signal, not a time."""
    return has_to_be_met(candidate) and effects()[candidate.effect].equivalent_delay is None


def widened(candidate: CandidateEffect) -> Dense:
    """Many sizes of a candidate that bends its signal, evenly in the logarithm."""
    name = sized(candidate)
    low, high = candidate.probes[0].free[name]
    tried = [p.values[name] for p in candidate.probes]
    return Dense(candidate, np.geomspace(max(low, min(tried) / WIDE), min(high, max(tried) * WIDE), BENT))


def every_size(candidate: CandidateEffect, signal: SignalScales) -> Dense:
    """Every size worth a look of a candidate whose size has to be met. signal: that of its slot."""
    probe, sizes = size_grid(effects()[candidate.effect], signal)
    return Dense(replace(candidate, probes=(probe,)), np.sort(sizes))


def sized(candidate: CandidateEffect) -> str:
    """The parameter whose size is looked for: the one that has to be met, or the only one."""
    parameters = effects()[candidate.effect].parameters
    return next((n for n, q in parameters.items() if q.grid is not None), next(iter(parameters)))


def resized(probe: Probe, name: str, size: float) -> Probe:
    """The probe with another size of a parameter, and room about it, within what the effect may have."""
    q, (low, high) = effects()[probe.effect].parameters[name], probe.free[name]
    size, room = min(max(size, q.min), q.max), 0.1 * abs(size)
    wide = max(min(low, size - room), q.min), min(max(high, size + room), q.max)
    return replace(probe, values=FrozenMap({**probe.values, name: size}), free=FrozenMap({**probe.free, name: wide}))


K = TypeVar("K", bound=Hashable)
Data = Literal["fitted", "held out", "all"]

HOPS = 3
"""Times that a better size is looked for."""
WIDTH = 3.0
"""Sizes are looked at from this share below to this multiple above."""
SIZES = 120
TEETH = 4
"""Sizes, each the best among its neighbours, from which is refitted: the cost over a period is a saw."""
LEVELS = 15.0
"""Over the signal's range: fewer are looked for all over, for any number of them may come near."""
OF_LEVELS = 12
"""Sizes from which is refitted then."""
AMONG = 3
"""Times as many, the best on the fitted data, among which the held-out ones choose."""
CLOSE = 1.3
"""Multiple above the size, and share below it, that the closest search spans."""
PHASE = 0.2
"""Of a step or period: by how much the last one of a record moves from one size of the closest look to the next."""
MOST = 1500
BETTER = 0.02
"""Share by which chi2 has to fall for another hop."""
COUNTS = 12
"""Numbers of steps, on either side of the one there is, that a level may be from 0."""
ROUGH = 20.0
"""Times its rows: chi2 up to which one is."""
RUNS = 500
SIMPLEX = 0.003
"""Of the range of each unknown: the first simplex."""
PIECE = 30
"""Sizes that are looked at in one go, wherever that is done."""


@dataclass(frozen=True)
class _Sweep:
    """Sizes to look at. teeth: how many of the best are refitted from. between: whether the best may lie between them, so
    that of neighbours one is enough and it is looked at closer; else each is the best of its kind."""

    sizes: Callable[[Refit], Array]
    teeth: int = TEETH
    between: bool = True

    def of(self, refit: Refit) -> Array:
        """Sizes to look at; none where the slot's signal cannot be simulated by itself: what is counted is not known then."""
        try:
            return self.sizes(refit)
        except FAILURES:
            return np.empty(0)


def hopped(search: SearchContext, jobs: Sequence[RefitJob], texts: Sequence[str]) -> list[Refit]:
    """Return the refits after a nonsmooth search of their last effect's size: repeated while it helps, then once very closely.

    All of them go from step to step together, for a step of one is many runs. texts: progress text of each.
    """
    here = dict(enumerate(done(search, jobs, texts)))
    stuck = {k: r for k, r in here.items() if r.failure}
    here = {k: r for k, r in here.items() if not r.failure}

    def further(refits: Mapping[int, Refit], sweep: _Sweep) -> dict[int, Refit]:
        return _further(search, jobs, texts, refits, _begins(search, refits, sweep))

    counted = [k for k, r in here.items() if by_level(r.placed[-1].candidate)]
    here |= further({k: here[k] for k in counted}, _Sweep(_levels, OF_LEVELS))
    moving = here
    for _ in range(HOPS):
        there = further(moving, _Sweep(_around))
        moving = {k: r for k, r in there.items() if _left(r) < (1.0 - BETTER) * _left(here[k])}
        here = here | moving
    here = further(here, _Sweep(_closely))
    here |= further({k: here[k] for k in counted}, _Sweep(_other_counts, between=False))
    best = [k for k in sorted(counted, key=lambda k: _left(here[k]))[:BEAM] if here[k].chi2 < ROUGH * here[k].rows]
    polished = mapped(search.executor, _polished, [here[k] for k in best])
    here |= {k: outcome.refit(jobs[k]) for k, outcome in zip(best, polished, strict=True)}
    found = stuck | _agreed(search, here)
    return [found[k] for k in range(len(jobs))]


def _polished(here: Refit) -> RefitResult:
    """Refit from the end of a simplex search, where that is better: rows that cross an edge turn the cost into stairs."""
    simplex = NelderMead(max_evaluations=RUNS, size=SIMPLEX, cost=0.05, step=1e-8, restarts=2)
    try:
        end = simplex.run(replace(here.problem, simulator=ModelSimulator(here.model, PATIENT)), here.theta)
        there = run(RefitJob(here.model, here.placed, here.problem, (end.theta,), here.noise))
    except FAILURES:  # it stays where it is
        return found_by(here)
    return found_by(min(here, here if there.failure else there, key=_left))


def _further(
    search: SearchContext,
    jobs: Sequence[RefitJob],
    texts: Sequence[str],
    here: Mapping[int, Refit],
    begins: Mapping[int, Sequence[Array]],
) -> dict[int, Refit]:
    """By job the best refit from where it begins, or the one there is."""
    each = [(k, replace(jobs[k], begins=(b,), spare=())) for k, own in begins.items() for b in own]
    ends = done(search, [job for _, job in each], [texts[k] for k, _ in each])
    found = dict(here)
    for (k, _), end in zip(each, ends, strict=True):
        if not end.failure and _left(end) < _left(found[k]):
            found[k] = end
    return found


def _left(refit: Refit) -> float:
    """Chi2 of a refit on all data: of sizes that come near the fitted records one is near the others too."""
    held = refit.holdout
    return refit.chi2 + (held**2 * unseen_rows(refit) if held is not None else 0.0)


def _levels(here: Refit) -> Array:
    """Sizes of a few levels over the slot's signal, the largest last: those of a closer look."""
    _, _, low, high = _size(here)
    placed = here.placed[-1]
    seen = signal(here, placed.use.at[0])
    about = SignalScales.of([e.time for e in here.problem.fitted_experiments], list(seen.values()))
    _, sizes = size_grid(effects()[placed.candidate.effect], about)
    return np.sort(sizes[(sizes > low) & (sizes < high) & (sizes > about.range / LEVELS)])


def _around(here: Refit) -> Array:
    _, own, low, high = _size(here)
    return np.geomspace(max(low, own / WIDTH), min(high, own * WIDTH), SIZES)


def _closely(here: Refit) -> Array:
    """Sizes around the one there is, so close that no tooth lies between: a record holds many steps or periods."""
    _, own, low, high = _size(here)
    count = int(np.clip((CLOSE - 1.0 / CLOSE) * _held(here) / own / PHASE, SIZES, MOST))
    return 1.0 / np.linspace(1.0 / min(high, own * CLOSE), 1.0 / max(low, own / CLOSE), count)


def _other_counts(here: Refit) -> Array:
    """Steps with which the level that the signal rests at stands where it does, as another number of steps from 0."""
    _, own, low, high = _size(here)
    rest = next(iter(signal(here, here.placed[-1].use.at[0]).values()))[0]
    count = round(abs(float(rest)) / own)
    if count <= 1:
        return np.empty(0)
    counts = np.arange(max(count - COUNTS, 1), count + COUNTS + 1)
    sizes = own * count / counts
    return np.sort(sizes[(sizes > low) & (sizes < high)])


def _agreed(search: SearchContext, refits: Mapping[int, Refit]) -> dict[int, Refit]:
    """The refits, each at the size that suits all data best of those that the fitted ones do not tell apart.

    Where a level or a sample falls on the other side of an edge a row jumps, whatever the standard deviation.
    """
    grids = {k: _within(r) for k, r in refits.items()}
    left = _looked(search, refits, grids, "all")
    found = dict(refits)
    for k, r in refits.items():
        if grids[k].size:
            theta = r.theta.copy()
            theta[_size(r)[0]] = grids[k][np.argmin(left[k])]
            with suppress(*FAILURES):  # it stays where it runs
                there = judged(replace(r, theta=theta))
                found[k] = min(r, there, key=_left)
    return found


def _within(here: Refit) -> Array:
    """Sizes within the uncertainty of the one there is; none where that is not known."""
    _, own, low, high = _size(here)
    std = here.std.get(here.placed[-1].names[sized(here.placed[-1].candidate)])
    return np.empty(0) if not std else np.clip(own + std * np.linspace(-SURE, SURE, PIECE), low, high)


def _size(here: Refit) -> tuple[int, float, float, float]:
    """Of the size that has to be met: its place among the unknowns, its value, its bounds."""
    placed = here.placed[-1]
    name = sized(placed.candidate)
    at = here.problem.names.index(placed.names[name])
    return at, float(here.theta[at]), *placed.bounds[name]


def _held(here: Refit) -> float:
    """Length that sizes are counted in: the time a record takes where they are periods, else how far the slot's signal reaches.

    Raises SimulationError where that signal cannot be had.
    """
    placed = here.placed[-1]
    if by_level(placed.candidate):
        return max(float(np.abs(u).max()) for u in signal(here, placed.use.at[0]).values())
    return max(float(e.time[-1] - e.time[0]) for e in here.problem.fitted_experiments)


def _begins(search: SearchContext, here: Mapping[int, Refit], sweep: _Sweep) -> dict[int, list[Array]]:
    """By job unknowns with the best sizes of a sweep, those the refit has and those that were given."""
    asked = {k: g for k, r in here.items() if (g := sweep.of(r)).size > 1}
    rough = _looked(search, here, asked, "fitted")
    tops = {}
    for k, left in rough.items():
        padded = np.concatenate([[np.inf], left, [np.inf]])
        least = [
            n
            for n in np.argsort(left)
            if np.isfinite(left[n]) and (not sweep.between or left[n] <= min(padded[n], padded[n + 2]))
        ]
        tops[k] = np.array(least[: AMONG * sweep.teeth], dtype=int)
    unseen = _looked(search, here, {k: asked[k][n] for k, n in tops.items()}, "held out")
    best = {k: n[np.argsort(rough[k][n] + unseen[k], kind="stable")][: sweep.teeth] for k, n in tops.items()}
    sizes = _between(search, here, asked, best) if sweep.between else {k: asked[k][n] for k, n in best.items()}
    begins: dict[int, list[Array]] = {k: [] for k in asked}
    for k, own in sizes.items():
        for size in own:
            for theta in (here[k].theta, as_given(here[k])):
                if theta is not None:
                    begins[k].append(theta.copy())
                    begins[k][-1][_size(here[k])[0]] = size
    return begins


def _between(
    search: SearchContext, here: Mapping[int, Refit], grids: Mapping[int, Array], best: Mapping[int, NDArray[np.intp]]
) -> dict[int, list[float]]:
    """By job the best size between the neighbours of each of the best of its grid."""
    beside = {(k, n): _beside(grids[k], n) for k, own in best.items() for n in own}
    left = _looked(search, {key: here[key[0]] for key in beside}, beside, "all")
    return {k: [float(beside[k, n][np.argmin(left[k, n])]) for n in own] for k, own in best.items()}


def _beside(grid: Array, n: int) -> Array:
    """Sizes from one neighbour of a grid's to the other."""
    return np.geomspace(grid[max(n - 1, 0)], grid[min(n + 1, grid.size - 1)], 2 * BETWEEN + 1)


def _looked(search: SearchContext, here: Mapping[K, Refit], grids: Mapping[K, Array], what: Data) -> dict[K, Array]:
    """By key what is left at each size of a grid, wherever that is worked out."""
    cuts = {k: [g[n : n + PIECE] for n in range(0, g.size, PIECE)] for k, g in grids.items()}
    pieces = [_Piece(here[k], c, what) for k, own in cuts.items() for c in own]
    found = mapped(search.executor, _left_at, pieces)
    return {k: np.concatenate([np.empty(0), *(next(found) for _ in own)]) for k, own in cuts.items()}


@dataclass(frozen=True, eq=False)
class _Piece:
    """Some sizes beside the unknowns of a refit, and the data of which is asked what they leave."""

    refit: Refit
    sizes: Array
    what: Data


def _left_at(piece: _Piece) -> Array:
    """Chi2 at each size; infinite for one that could not be run."""
    try:
        line = SizeLine.of(piece.refit.model, piece.refit.problem, piece.refit.theta, _size(piece.refit)[0])
    except FAILURES:
        return np.full(piece.sizes.size, np.inf)
    asked: dict[Data, Callable[[float], float]] = {"fitted": line.fitted, "held out": line.unseen, "all": line.left}
    of = asked[piece.what]
    return np.array([of(float(s)) for s in piece.sizes])
