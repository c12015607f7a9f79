"""Where the runs of a multistart begin, and which of their ends are one optimum."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit.problem import Problem
from hvdc_ident.fit.unknown import FitParameter

DISTINCT = 1.92
"""Half the 95 % quantile of chi-square with one degree of freedom: costs that differ by less are as good."""


@dataclass(frozen=True, eq=False)
class LocalMinimum:
    """An optimum: (p,) theta and its cost."""

    theta: Array
    cost: float


TIE = 1e-6
"""Costs that differ by this share differ by what no number of rows makes a likelihood notice (half of it a row)."""


def best_first(ends: Sequence[LocalMinimum]) -> list[LocalMinimum]:
    """The ends by their cost; the first one stays first where no other is lower by more than rounding.

    So of optima that are one but for the names of their unknowns, as two time constants that may change places, the one
    next to the given start is told.
    """
    ordered = sorted(ends, key=lambda o: o.cost)
    if ends and ends[0].cost <= (1.0 + TIE) * ordered[0].cost:
        return [ends[0], *(o for o in ordered if o is not ends[0])]
    return ordered


def latin_hypercube(spread: Sequence[FitParameter], rest: Sequence[FitParameter], count: int, seed: int) -> list[Array]:
    """`count` starts, (p,) each: `spread` over the bounds (even in the logarithm where scaled so), `rest` at their own.

    Nuisances are the rest: they are small by nature, and far off they only lead a run astray.
    """
    if count < 1:
        return []
    from scipy.stats import qmc

    own = [u.start for u in rest]
    shares = qmc.LatinHypercube(d=len(spread), seed=np.random.default_rng(seed)).random(count)
    return [np.array([*(u.draw(float(s)) for u, s in zip(spread, row, strict=True)), *own]) for row in shares]


def distinct(problem: Problem, ends: Sequence[LocalMinimum], worth: float = 1.0) -> list[LocalMinimum]:
    """The ends that are optima of their own, best first; of the others the best of each basin.

    Two are one where no coordinate differs by a thousandth of its range, or where the cost between them on the straight
    line (in scaled coordinates) never rises by DISTINCT above the worse one. worth: independent samples per sample.
    """
    kept: list[LocalMinimum] = []
    for end in sorted(ends, key=lambda o: o.cost):
        if not any(_same(problem, end, other, worth) for other in kept):
            kept.append(end)
    return kept


def _same(problem: Problem, a: LocalMinimum, b: LocalMinimum, worth: float) -> bool:
    space = problem.coordinates
    x, y = space.scaled(a.theta), space.scaled(b.theta)
    if (np.abs(x - y) <= 1e-3 * space.ranges).all():
        return True
    if (max(a.cost, b.cost) - min(a.cost, b.cost)) * worth >= DISTINCT:
        return False
    barrier = max(a.cost, b.cost) + DISTINCT / worth
    try:
        return all(problem.cost(space.unscaled(x + s * (y - x))) < barrier for s in np.linspace(0.0, 1.0, 9)[1:-1])
    except SimulationError:
        return False
