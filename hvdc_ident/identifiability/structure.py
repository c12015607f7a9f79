"""What can be told from any data at all: the structural part of the report, symbolic where there are equations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hvdc_ident.errors import SimulationError
from hvdc_ident.fit import Problem
from hvdc_ident.identifiability.combinations import Combination, combinations_of
from hvdc_ident.sensitivity.fisher import independent, null_directions
from hvdc_ident.trajectory import Array

POINTS = 5


@dataclass(frozen=True)
class Structure:
    """The structural verdict on the candidates.

    status: decided, or not decided. method: "symbolic" or "numerical, local". admissible: the most that can be told
    together once the others are held; the earlier listed where there is a choice. combinations: what is seen of others.
    note: why it is not decided, or what the method cannot see.
    """

    status: str
    method: str
    admissible: tuple[str, ...]
    combinations: tuple[Combination, ...] = ()
    note: str = ""

    @property
    def unidentifiable(self) -> tuple[str, ...]:
        """Members of any combination."""
        return tuple(dict.fromkeys(n for c in self.combinations for n in c.members))


def numerical_structure(problem: Problem, seed: int = 0) -> Structure:
    """The structure from the rank of the sensitivities at five random points: what is lost at all of them.

    Local, and for the inputs of these experiments. A parameter that is not seen at all is left to the data's verdict.
    Points that cannot be simulated are passed over; with none left the structure is not decided.
    """
    names = tuple(f.name for f in problem.free)
    k, stacked, space = len(names), [], None
    for theta in _points(problem, seed):
        try:
            _, jacobian = problem.residual(theta)
        except SimulationError:
            continue
        space = _slope(problem, theta) if space is None else space
        stacked.append(jacobian * _slope(problem, theta))
    if not stacked or space is None:
        return Structure("not decided", "numerical, local", names, note="no random point could be simulated")
    ranks = [null_directions(j).shape[0] for j in stacked]
    if min(ranks) == 0:
        return Structure("decided", "numerical, local", names)
    scaled = np.vstack([j / np.maximum(np.linalg.norm(j), 1e-300) for j in stacked])
    null = null_directions(scaled)
    null = null[:, :k][(np.abs(null[:, :k]) > 0).any(axis=1)]
    if not null.size:  # the direction turns from place to place: take it where the least is lost
        null = null_directions(stacked[int(np.argmin(ranks))])[:, :k]
        null = null[(np.abs(null) > 0).any(axis=1)]
    if not null.size:
        return Structure("decided", "numerical, local", names)
    logs = [f.min > 0 for f in problem.free]
    combos = combinations_of(null, names, logs, [f.start for f in problem.free], "structural")
    involved = [i for i, n in enumerate(names) if any(n in c.members for c in combos)]
    matrix = scaled[:, :k].T @ scaled[:, :k]
    free = [i for i in range(k) if i not in involved]
    kept = {*free, *(involved[i] for i in independent(matrix[np.ix_(involved, involved)]))}
    return Structure("decided", "numerical, local", tuple(names[i] for i in sorted(kept)), combos)


def _points(problem: Problem, seed: int) -> Sequence[Array]:
    random = np.random.default_rng(seed)
    rows = []
    for _ in range(POINTS):
        rows.append(
            np.array(
                [
                    u.draw(float(s))
                    for u, s in zip(problem.unknowns, random.uniform(0.2, 0.8, len(problem.unknowns)), strict=True)
                ]
            )
        )
    return rows


def _slope(problem: Problem, theta: Array) -> Array:
    return np.array([v if u.min > 0 else u.span for u, v in zip(problem.unknowns, theta, strict=True)])
