"""Sizes that have to be met: levels of a quantiser and periods of a sampler, to which no slope leads, and those that bend a signal.

The first are run in all their sizes from the gains as they are, and the best refitted. Beside what the best refits came to sizes are
run ever closer: between two plays of a backlash chi2 has hills, and a refit stands in the next valley.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.discrepancy.candidates import CandidateEffect
from hvdc_ident.discrepancy.expansion import Expansion, ExpansionModel, Race, Trial, by_cost, gains_of
from hvdc_ident.discrepancy.hypothesis import Refit, with_given_gains
from hvdc_ident.discrepancy.misfit import misfit_of
from hvdc_ident.discrepancy.movable import in_proportion
from hvdc_ident.discrepancy.options import BEAM, SHORTLIST
from hvdc_ident.discrepancy.screen import Score
from hvdc_ident.effects import SignalScales, effects, size_grid

QUANTISER_PLACES = 4
"""Places at which a quantiser is tried in all its sizes, some thousand."""
COARSE_STRIDE = 3
"""Of levels, which stand a tenth of one apart in the grid, the first look takes every third; then those between the best."""
REFINEMENT = 4
"""Times closer that the sizes stand at each further look."""
BESIDE = 0.5
"""Share of a size beside which others are looked for: half way to the next in a grid of three a decade."""
N_REFINEMENTS = 4
"""Further looks: after the last the sizes stand REFINEMENT ** N_REFINEMENTS times closer than in the grid, 1e-5 of the size."""
SIMILAR_DELAY = 0.3
"""Difference of the logarithms of two delays within which one may stand for the other."""


def with_periods(model: ExpansionModel, opened: Expansion, text: str) -> Expansion:
    """Return the expansion with samplers in every period that delays as long as what was refitted at their places: to first order a
    sampler is a delay."""
    return _met(model, opened, _periods(opened), text)


def with_levels(model: ExpansionModel, opened: Expansion, text: str) -> Expansion:
    """Return the expansion with quantisers of every step at the places that promise most, and with samplers in every period where no
    other delay is tried."""
    return _met(model, opened, _levels(opened), text)


def _met(model: ExpansionModel, opened: Expansion, grids: Mapping[int, Array], text: str) -> Expansion:
    if not grids:
        return opened
    opened = _with_best_of_all_sizes(model, opened, grids, text)
    return _refined(model, opened, text, lambda ranked: [t for t in ranked if t.score.candidate in grids], grids)


def with_closer_sizes(model: ExpansionModel, opened: Expansion, text: str) -> Expansion:
    """Return the expansion with those of the best effects that have one size and bend their signal refined, while the best of all leaves
    more than noise."""

    def bent(ranked: Sequence[Trial]) -> list[Trial]:
        rough = ranked[:BEAM] if ranked and misfit_of(ranked[0].refit).is_loud else ()
        return [t for t in rough if _bends(t.refit.placed[-1].candidate)]

    return _refined(model, opened, text, bent)


def _refined(
    model: ExpansionModel,
    opened: Expansion,
    text: str,
    which: Callable[[Sequence[Trial]], list[Trial]],
    grids: Mapping[int, Array] | None = None,
) -> Expansion:
    """Return the expansion with refits from ever closer beside the sizes that some refits came to, by their rank."""
    known = grids or {}
    for turn in range(1, N_REFINEMENTS + 1):
        for t in which(by_cost(opened.trials))[:BEAM]:
            if model.search.spent:
                break
            k, size = t.score.candidate, _size(t.refit)
            away = np.delete(np.arange(-REFINEMENT, REFINEMENT + 1), REFINEMENT) / REFINEMENT**turn
            sizes = size + away * (_spacing(known[k], size) if k in known else BESIDE * size)
            near = _best_sizes(model, opened, {k: sizes}, text, [gains_of(opened.before, t.refit)])
            opened = _refitted(model, opened, near, text)
    return opened


def _bends(candidate: CandidateEffect) -> bool:
    return len(candidate.probes[0].free) == 1 and not in_proportion(candidate, 0)


def _with_best_of_all_sizes(
    model: ExpansionModel, opened: Expansion, grids: Mapping[int, Array], text: str
) -> Expansion:
    """Return the expansion with the best of all sizes refitted."""
    # Beside the gains of what explains most of the misfit; where nothing does, beside those without an effect.
    best_of_all = [t.refit for t in by_cost(opened.trials)[:1] if t.refit.chi2 < 0.5 * opened.before.chi2]
    points: list[Array | None] = [*(gains_of(opened.before, r) for r in best_of_all)] or [None]
    given = with_given_gains(opened.before)
    late = {k: g for k, g in grids.items() if effects()[opened.candidates[k].effect].equivalent_delay is not None}
    levels = {k: g for k, g in grids.items() if k not in late}
    # A sampler that is missing biases the gains as a delay does; levels hardly do.
    best = _best_sizes(model, opened, late, text, [*points, *([] if given is None else [given])], most=SHORTLIST)
    coarse = {k: g[::COARSE_STRIDE] for k, g in levels.items()}
    rough = _best_sizes(model, opened, coarse, text, points, most=SHORTLIST)
    beside = {k: _beside(grids[k], [size for size, _ in own]) for k, own in rough.items()}
    best |= _best_sizes(model, opened, beside, text, points)
    return _refitted(model, opened, best, text)


def _periods(opened: Expansion) -> dict[int, Array]:
    """Return by sampler the periods to be looked at, (m,), rising."""
    if not _has_delays(opened):
        return {}
    entries = effects()
    better = [t for t in by_cost(opened.trials) if t.refit.chi2 < opened.before.chi2]
    late = {t.refit.placed[-1].candidate.at: d for t in reversed(better) if (d := _late(t.refit)) is not None}
    grids = {}
    for k, values, sizes in _to_be_met(opened):
        c = opened.candidates[k]
        if entries[c.effect].equivalent_delay is None:
            continue
        own = [entries[c.effect].delay_with({**values, _named(c): s}) or 0.0 for s in sizes.tolist()]
        grids[k] = sizes[[_alike(d, late.get(c.at, 0.0)) for d in own]]
    return {k: sizes for k, sizes in grids.items() if sizes.size}


def _levels(opened: Expansion) -> dict[int, Array]:
    """Return by quantiser the steps to be looked at, (m,), rising, and by sampler the periods where no other delay is tried."""
    delays, least, count = _has_delays(opened), _least_answer(opened), Counter[str]()
    grids = {}
    for k, _, sizes in _to_be_met(opened):
        effect = opened.candidates[k].effect
        count[effect] += 1
        if count[effect] <= QUANTISER_PLACES and not (delays and effects()[effect].equivalent_delay is not None):
            grids[k] = sizes[sizes * _answer_per_size(opened, k) >= least]
    return {k: sizes for k, sizes in grids.items() if sizes.size}


def _to_be_met(opened: Expansion) -> Iterator[tuple[int, Mapping[str, float], Array]]:
    """Yield the candidates whose size has to be met, the most promising first, each with its other sizes and the grid of that one."""
    times = [e.time for e in opened.before.problem.fitted_experiments]
    for k in opened.screen.best():
        c = opened.candidates[k]
        if effects()[c.effect].needs_grid and len(c.at) == 1:
            probe, sizes = size_grid(effects()[c.effect], SignalScales.of(times, opened.signals[c.at[0]]))
            yield k, probe.values, np.unique(sizes)


def _has_delays(opened: Expansion) -> bool:
    """Return True where delays are tried whose size a slope leads to."""
    entries = (effects()[c.effect] for c in opened.candidates)
    return any(e.equivalent_delay is not None and not e.needs_grid for e in entries)


def _answer_per_size(opened: Expansion, candidate: int) -> float:
    """Return the largest answer that the screen saw of a candidate, in noise units, per unit of its size."""
    found, screen = opened.candidates[candidate], opened.screen
    name = _named(found)
    return max(
        (math.sqrt(screen.size[k, n]) / found.probes[n].values[name] for k, n in screen.size if k == candidate),
        default=0.0,
    )


def _least_answer(opened: Expansion) -> float:
    """Return the least answer, in noise units, with which an effect may come within reach of the best fall of chi2.

    With an answer a beside a residual r, chi2 = |r + a|^2 falls by no more than 2 |r| |a|.
    """
    chi2 = opened.before.chi2
    best = min((t.refit.chi2 for t in opened.trials if not t.refit.failure), default=chi2)
    return Race().reach * (chi2 - best) / (2.0 * math.sqrt(chi2))


def _late(refit: Refit) -> float | None:
    """Return how long the effect that was added last delays a slow signal, s; None for one that has to be met itself, or no delay."""
    placed = refit.placed[-1]
    entry = effects()[placed.candidate.effect]
    return None if entry.needs_grid else entry.delay_with(refit.sizes(placed))


def _alike(one: float, other: float) -> bool:
    return one > 0.0 and other > 0.0 and abs(math.log(one / other)) < SIMILAR_DELAY


def _named(candidate: CandidateEffect) -> str:
    """Return the name of the size that has to be met."""
    grids = [n for n, q in effects()[candidate.effect].parameters.items() if q.grid is not None]
    return grids[0] if grids else next(iter(candidate.probes[0].free))


def _size(refit: Refit) -> float:
    placed = refit.placed[-1]
    return refit.sizes(placed)[_named(placed.candidate)]


def _spacing(grid: Array, size: float) -> float:
    """Return how far apart the sizes of a grid stand where one lies."""
    if grid.size < 2:
        return size / REFINEMENT
    at = min(max(int(np.searchsorted(grid, size)), 1), grid.size - 1)
    return float(grid[at] - grid[at - 1])


def _beside(grid: Array, sizes: Sequence[float]) -> Array:
    """Return the sizes of a grid next to some of them."""
    at = [
        np.arange(max(k - COARSE_STRIDE + 1, 0), min(k + COARSE_STRIDE, grid.size))
        for k in np.searchsorted(grid, sizes)
    ]
    return grid[np.unique(np.concatenate(at))]


def _at(candidate: CandidateEffect, sizes: Sequence[float]) -> CandidateEffect:
    """Return the candidate at these sizes alone."""
    own = candidate.probes[0].values
    return replace(candidate, probes=()).with_sizes(
        [{**own, _named(candidate): float(s)} for s in sizes], like=candidate.probes
    )


def _best_sizes(
    model: ExpansionModel,
    opened: Expansion,
    sizes: Mapping[int, Array],
    text: str,
    points: Sequence[Array | None],
    most: int = BEAM,
) -> dict[int, list[tuple[float, Score]]]:
    """Return by candidate the best of some sizes, none of them neighbours, with what the screen says of them."""
    if not sizes:
        return {}
    found = [_at(c, sizes[k].tolist()) if k in sizes else c for k, c in enumerate(opened.candidates)]
    scores = [s for point in points for s in model.screen(found, text, list(sizes), point, held=True).scores]
    best: dict[int, list[Score]] = {}
    for s in sorted(scores, key=lambda s: -s.fall):
        own = best.setdefault(s.candidate, [])
        if len(own) < most and all(abs(s.probe - other.probe) > 1 for other in own):
            own.append(s)
    return {k: [(float(sizes[k][s.probe]), s) for s in own] for k, own in best.items()}


def _refitted(
    model: ExpansionModel, opened: Expansion, best: Mapping[int, Sequence[tuple[float, Score]]], text: str
) -> Expansion:
    """Return the expansion, whose candidates have these sizes too, with the refits begun there."""
    found, scores = list(opened.candidates), []
    for k, own in best.items():
        more = _at(found[k], [size for size, _ in own]).probes
        scores += [replace(s, probe=len(found[k].probes) + n, factor=1.0) for n, (_, s) in enumerate(own)]
        found[k] = replace(found[k], probes=(*found[k].probes, *more))
    opened = replace(opened, candidates=tuple(found))
    return opened.with_trials(model.refitted(found, scores, text, opened.trials))
