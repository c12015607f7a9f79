"""A size that has to be met, looked for again beside the gains that a refit came to.

No slope leads from one period of a sampler to another, and gains that are biased by what is missing point a scan at the
wrong one. Once they have been refitted they are nearer to the truth: with their answers taken out to first order the
sizes around are run again, and the refit goes on from the best.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hvdc_ident.discrepancy.jobs import as_given
from hvdc_ident.discrepancy.nominal import orthonormal
from hvdc_ident.discrepancy.objections import unseen_rows
from hvdc_ident.discrepancy.refit import Found, Job, Refit, found_by, of_held_out, run, signal
from hvdc_ident.discrepancy.scan import BETWEEN, QUICK, by_level, sized
from hvdc_ident.effects import SlotSignal, effects, probes
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit import Problem
from hvdc_ident.simulate.model_simulator import ModelSimulator
from hvdc_ident.trajectory import Array

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
"""The same as WIDTH for the closest look."""
PHASE = 0.2
"""Of a step or period: by how much the last one of a record moves from one size of the closest look to the next."""
MOST = 1500
PATIENT = replace(QUICK, max_steps=5000, search=True)
"""A record that never rests crosses hundreds of levels."""
BETTER = 0.02
"""Share by which chi2 has to fall for another hop."""


def hop(job: Job) -> Found:
    """What a refit comes to that looks for its last effect's size again, as long as that helps, and once very closely."""
    here = run(job)
    if here.failure:
        return found_by(here)
    try:
        if by_level(here.placed[-1].candidate):
            here = _from(job, here, _levels(here), OF_LEVELS)
        for _ in range(HOPS):
            there = _from(job, here, _around(here))
            if not _left(there) < (1.0 - BETTER) * _left(here):
                break
            here = there
        return found_by(_from(job, here, _closely(here)))
    except SimulationError:  # the refit runs, the slot's signal by itself does not: what is to be counted is not known
        return found_by(here)


def _from(job: Job, here: Refit, grid: Array, teeth: int = TEETH) -> Refit:
    """The best refit from the best sizes of a grid, or the one there is."""
    ends = [run(replace(job, begins=(begin,), spare=())) for begin in _begins(here, grid, teeth)]
    return min((r for r in [here, *ends] if not r.failure), key=_left)


def _left(refit: Refit) -> float:
    """What a refit leaves of all data: of sizes that come near the fitted records one is near the others too."""
    held = refit.holdout
    return refit.chi2 + (held**2 * unseen_rows(refit) if held is not None else 0.0)


def _levels(here: Refit) -> Array:
    """Sizes of a few levels over the slot's signal, the largest last: those of a closer look."""
    _, _, low, high = _size(here)
    placed = here.placed[-1]
    seen = signal(here, placed.use.at[0])
    about = SlotSignal.of([e.time for e in here.problem.fitted_experiments], list(seen.values()))
    name, effect = sized(placed.candidate), effects()[placed.candidate.effect]
    sizes = np.array([p.values[name] for p in probes(effect, about, closer=True)])
    return np.sort(sizes[(sizes > low) & (sizes < high) & (sizes > about.range / LEVELS)])


def _around(here: Refit) -> Array:
    _, own, low, high = _size(here)
    return np.geomspace(max(low, own / WIDTH), min(high, own * WIDTH), SIZES)


def _closely(here: Refit) -> Array:
    """Sizes around the one there is, so close that no tooth lies between: a record holds many steps or periods."""
    _, own, low, high = _size(here)
    count = int(np.clip((CLOSE - 1.0 / CLOSE) * _held(here) / own / PHASE, SIZES, MOST))
    return 1.0 / np.linspace(1.0 / min(high, own * CLOSE), 1.0 / max(low, own / CLOSE), count)


def _size(here: Refit) -> tuple[int, float, float, float]:
    """Of the size that has to be met: its place among the unknowns, its value, its bounds."""
    placed = here.placed[-1]
    name = sized(placed.candidate)
    at = here.problem.names.index(placed.names[name])
    return at, float(here.theta[at]), *placed.bounds[name]


def _held(here: Refit) -> float:
    """What is counted in sizes: the time a record takes where they are periods, else how far the slot's signal reaches.

    Raises SimulationError where that signal cannot be had.
    """
    placed = here.placed[-1]
    if by_level(placed.candidate):
        return max(float(np.abs(u).max()) for u in signal(here, placed.use.at[0]).values())
    return max(float(e.time[-1] - e.time[0]) for e in here.problem.fitted_experiments)


def _begins(here: Refit, grid: Array, teeth: int) -> list[Array]:
    """Unknowns with the best sizes of a grid, those the refit has and those that were given."""
    if grid.size < 2:
        return []
    at = _size(here)[0]
    left = _Left.of(here, at)
    rough = np.array([left.fitted(float(s)) for s in grid])
    padded = np.concatenate([[np.inf], rough, [np.inf]])
    least = [k for k in np.argsort(rough) if np.isfinite(rough[k]) and rough[k] <= min(padded[k], padded[k + 2])]
    best = sorted(least[: AMONG * teeth], key=lambda k: rough[k] + left.unseen(float(grid[k])))
    begins, given = [], as_given(here)
    for k in best[:teeth]:
        beside = np.geomspace(grid[max(k - 1, 0)], grid[min(k + 1, grid.size - 1)], 2 * BETWEEN + 1)
        size = min(beside, key=left)
        for theta in (here.theta, given):
            if theta is not None:
                begins.append(theta.copy())
                begins[-1][at] = size
    return begins


@dataclass(frozen=True, eq=False)
class _Left:
    """chi2 of all data by the size of the last effect, with what the other unknowns can make good of the fitted ones taken
    out to first order.

    held: the problem of the held-out ones, where there are any. others: (N, k) orthonormal, what the unknowns can.
    """

    refit: Refit
    at: int
    problem: Problem
    held: Problem | None
    others: Array

    @classmethod
    def of(cls, refit: Refit, at: int) -> _Left:
        quick = replace(refit.problem, simulator=ModelSimulator(refit.model, PATIENT))
        jacobian = np.vstack([b.jacobian for b in refit.problem.blocks(refit.theta)])
        return cls(refit, at, quick, of_held_out(quick), orthonormal(np.delete(jacobian, at, axis=1)))

    def __call__(self, size: float) -> float:
        """Infinite for a size that could not be run."""
        return self.fitted(size) + self.unseen(size)

    def fitted(self, size: float) -> float:
        """What is left of the fitted data; infinite for a size that could not be run."""
        try:
            r = np.concatenate([b.residual for b in self.problem.blocks(self._at(size), derivatives=False)])
        except SimulationError:
            return np.inf
        return float(r @ r - np.sum((self.others.T @ r) ** 2))

    def unseen(self, size: float) -> float:
        """What is left of the held-out data; 0 where there are none, infinite for a size that could not be run."""
        if self.held is None:
            return 0.0
        try:
            further = self.held.blocks(self._at(size)[: len(self.held.free)], derivatives=False)
        except SimulationError:
            return np.inf
        return sum(float(b.residual @ b.residual) for b in further if b.output in self.problem.outputs)

    def _at(self, size: float) -> Array:
        """The unknowns with another size of the last effect."""
        theta = self.refit.theta.copy()
        theta[self.at] = size
        return theta
