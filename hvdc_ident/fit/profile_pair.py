"""The profile of two parameters together, on a grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit.objective import DescentResult, Objective, descend

JOINT = 2.996
"""Rise of the cost on the border of a joint 95 % region of two parameters: half the chi-square quantile, 2 degrees."""


@dataclass(frozen=True, eq=False)
class PairProfile:
    """The rise of the cost over a grid. first: (m,), second: (n,) values in their units; rises: (m, n), nan: failed."""

    names: tuple[str, str]
    first: Array
    second: Array
    rises: Array


def profile_pair(
    objective: Objective, theta: Array, names: tuple[str, str], first: Array, second: Array, *, enough: float = 1e-3
) -> PairProfile:
    """The cost above the optimum theta at each pair of values, the other unknowns re-fitted from the nearest point.

    A value outside the bounds of the search is evaluated all the same; a point that cannot be simulated is nan.
    """
    known = [u.name for u in objective.unknowns]
    rows = [known.index(n) for n in names]
    fixed = np.isin(np.arange(len(known)), rows)
    best = descend(objective, theta, np.zeros(len(known), dtype=bool), enough=enough)
    rises = np.full((first.size, second.size), np.nan)
    done: dict[tuple[int, int], DescentResult] = {}
    centre = (int(np.abs(first - best.theta[rows[0]]).argmin()), int(np.abs(second - best.theta[rows[1]]).argmin()))
    order = sorted(np.ndindex(rises.shape), key=lambda k: (max(abs(k[0] - centre[0]), abs(k[1] - centre[1])), k))
    for k in order:
        near = min(done, key=lambda d: (d[0] - k[0]) ** 2 + (d[1] - k[1]) ** 2, default=None)
        begin = (done[near].theta if near is not None else best.theta).copy()
        begin[rows] = first[k[0]], second[k[1]]
        try:
            done[k] = descend(objective, begin, fixed, enough=enough)
        except SimulationError:
            continue
        rises[k] = done[k].at.cost - best.at.cost
    return PairProfile(names, first, second, rises)
