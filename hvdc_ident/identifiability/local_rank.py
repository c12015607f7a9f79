"""What of the parameters the experiments tell at random points, from the sensitivities' rank: for any simulator.

It asks the simulator for nothing but runs with sensitivities (exact ones, or differences whose error it states), so it
serves models with delays and sampled parts, recordings played in, and models that have no equations here at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit import Problem
from hvdc_ident.fit.multistart import starting_points
from hvdc_ident.fit.simulator import sensitivity_error
from hvdc_ident.identifiability.combinations import Combination, combinations_of, held_of
from hvdc_ident.sensitivity import SENSITIVITY_ERROR, null_directions

METHOD = "numerical, local"
POINTS = 5
WIDE = 8
"""Of so many points one lies in each eighth of every parameter's range."""
INSIDE = (0.2, 0.8)
"""Share of the bounds that the points are drawn from: at a bound a parameter may do nothing that does else."""


@dataclass(frozen=True)
class LocalRank:
    """What is lost at every point tried.

    points: how many could be simulated. independent: the most parameters that are told together once the others are
    held, the earlier listed where there is a choice. combinations: what is seen of the others. note: what the numbers
    cannot see. A parameter of which nothing at all is seen stands among the independent ones: the data's verdict on it
    says more. moving: the parameters that move the outputs, at any of the points, by more than the sensitivities' error.
    """

    points: int
    independent: tuple[str, ...]
    combinations: tuple[Combination, ...] = ()
    note: str = ""
    moving: tuple[str, ...] = ()


def local_rank(problem: Problem, seed: int = 0, *, wide: bool = False) -> LocalRank:
    """The rank of the whitened sensitivities of the problem's experiments, at the start and five random points in the bounds.

    wide: whether to look for other regimes too, at a Latin hypercube of points up to the bounds. Points that cannot be
    simulated are passed over; those of the five are counted in the note.
    """
    names = tuple(f.name for f in problem.free)
    error = sensitivity_error(problem.simulator)
    stacked, failures = [], []
    others = starting_points(problem.unknowns, (), WIDE, seed) if wide else []
    for k, theta in enumerate([*_points(problem, seed), problem.start, *others]):
        try:
            _, jacobian = problem.residual(theta)
        except SimulationError as e:
            failures += [e.what] if k < POINTS else []
            continue
        stacked.append(jacobian * _slope(problem, theta))
    note = _note(failures, error)
    moving = _moving(stacked, names, error)
    null = _lost(stacked, len(names), error) if stacked else np.zeros((0, len(names)))
    if not null.size:
        return LocalRank(len(stacked), names, note=note, moving=moving)
    logs = [f.min > 0 for f in problem.free]
    combos = combinations_of(null, names, logs, [f.start for f in problem.free], "structural")
    held = held_of(null)
    told = tuple(n for i, n in enumerate(names) if i not in held)
    return LocalRank(len(stacked), told, combos, note, moving)


def _moving(stacked: Sequence[Array], names: Sequence[str], error: float) -> tuple[str, ...]:
    """The parameters whose column is at some point longer than the sensitivities' error, of the longest there."""
    norms = [np.linalg.norm(j, axis=0) for j in stacked]
    seen = [n[: len(names)] > error * n.max(initial=0.0) for n in norms]
    return tuple(n for i, n in enumerate(names) if any(s[i] for s in seen))


def _note(failures: Sequence[str], error: float) -> str:
    parts = []
    if failures:
        parts.append(f"{len(failures)} of {POINTS} random points could not be simulated ({failures[0]})")
    if error > SENSITIVITY_ERROR:
        parts.append(
            f"the sensitivities are differences, good to {error:.1g}: what is seen more weakly counts as not seen"
        )
    return "; ".join(parts)


def _lost(stacked: Sequence[Array], count: int, error: float) -> Array:
    """(k, count): the directions that are lost at every point, without the nuisances."""
    ranks = [null_directions(j, error).shape[0] for j in stacked]
    if min(ranks) == 0:
        return np.zeros((0, count))
    null = _moved(null_directions(_together(stacked), error)[:, :count])
    if null.size:
        return null
    # the direction turns from place to place: take it where the least is lost
    return _moved(null_directions(stacked[int(np.argmin(ranks))], error)[:, :count])


def _together(stacked: Sequence[Array]) -> Array:
    return np.vstack([j / np.maximum(np.linalg.norm(j), 1e-300) for j in stacked])


def _moved(null: Array) -> Array:
    """The directions that move a parameter at all."""
    return null[(np.abs(null) > 0).any(axis=1)]


def _points(problem: Problem, seed: int) -> Sequence[Array]:
    random = np.random.default_rng(seed)
    shares = random.uniform(*INSIDE, (POINTS, len(problem.unknowns)))
    return [np.array([u.draw(s) for u, s in zip(problem.unknowns, row, strict=True)]) for row in shares.tolist()]


def _slope(problem: Problem, theta: Array) -> Array:
    return np.array([v if u.min > 0 else u.span for u, v in zip(problem.unknowns, theta, strict=True)])
