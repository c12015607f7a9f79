"""Other optima that explain the records as well: from the ends of the multistart, from exchanged values and signs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.errors import SimulationError
from hvdc_ident.fit.objective import DescentResult, LeastSquares, descend
from hvdc_ident.identifiability.pilot import Optimum
from hvdc_ident.immutable import FrozenMap

TRIED = 6
"""At most so many exchanged points are begun from: about a third of what the profiles of as many parameters cost."""
EVALUATIONS = 25
"""A descent that has not come near by then is given up."""
NEAR = 10.0
"""Ends of the multistart whose cost is more than so many thresholds above the best are optima of their own, but no rivals."""
SAME = 1e-3
"""Points that differ by less in every scaled coordinate are one."""


@dataclass(frozen=True)
class OtherOptimum:
    """An optimum as good as the best within the noise. values: by unknown, in its unit; rise: of the cost above the best."""

    values: FrozenMap[float]
    rise: float


def other_optima(
    best: Optimum, limits: Mapping[str, float], ends: Sequence[tuple[Mapping[str, float], float]]
) -> tuple[OtherOptimum, ...]:
    """The optima whose cost is less than the largest of the limits above the best one's, or below it, the lowest first.

    limits: the rise of the cost at the ends of each parameter's interval. ends: where the starts of the multistart ended,
    with their costs. The search begins from those, and from the best with two parameters of one unit exchanged, the most
    alike in their effect first, or with a sign turned: that is where the usual second solutions lie.
    """
    objective, space = LeastSquares.of(best.problem), best.problem.coordinates
    limit = max(limits.values())

    def teeth(theta: Array) -> bool:
        """Return whether a point is the best one but for the roughness of the cost."""
        return best.trend is not None and best.trend.holds(theta, limit)

    known = [space.scaled(best.theta)]
    begins: list[Array] = []
    for theta in (*_ended(best, ends, limit), *_exchanged(best)):
        if _new(space.scaled(theta), known) and not teeth(theta):
            known.append(space.scaled(theta))
            begins.append(theta)
    found: list[DescentResult] = []
    reached = [space.scaled(best.theta)]
    for theta in begins:
        try:
            end = descend(
                objective, theta, np.zeros(theta.size, dtype=bool), enough=1e-4 * limit, max_evaluations=EVALUATIONS
            )
        except SimulationError:
            continue
        if end.at.cost - best.cost < limit and _new(space.scaled(end.theta), reached) and not teeth(end.theta):
            reached.append(space.scaled(end.theta))
            found.append(end)
    found.sort(key=lambda r: r.at.cost)
    names = best.problem.names
    return tuple(
        OtherOptimum(FrozenMap(zip(names, map(float, r.theta), strict=True)), r.at.cost - best.cost) for r in found
    )


def _new(x: Array, known: Sequence[Array]) -> bool:
    return not any((np.abs(x - k) <= SAME).all() for k in known)


def _ended(best: Optimum, ends: Sequence[tuple[Mapping[str, float], float]], limit: float) -> Iterator[Array]:
    for values, cost in ends:
        if cost - best.cost < NEAR * limit:
            theta = [values.get(n, best.value(n)) for n in best.problem.names]
            yield np.array(theta, dtype=float)


def _exchanged(best: Optimum) -> Iterator[Array]:
    """The best point with two values exchanged, or a sign turned, where the bounds admit it."""
    free, parameters = best.problem.free, best.problem.simulator.parameters
    matrix = best.information.matrix
    d = np.sqrt(np.clip(np.diag(matrix), 1e-300, None))
    alike = np.abs(matrix / np.outer(d, d))
    places: list[tuple[float, Array]] = []
    for i, j in combinations(range(len(free)), 2):
        a, b = best.theta[i], best.theta[j]
        fits = free[i].min <= b <= free[i].max and free[j].min <= a <= free[j].max
        if fits and parameters[free[i].name].unit == parameters[free[j].name].unit:
            theta = best.theta.copy()
            theta[i], theta[j] = b, a
            places.append((float(alike[i, j]), theta))
    for i, u in enumerate(free):
        if u.min <= -best.theta[i] <= u.max:
            theta = best.theta.copy()
            theta[i] = -theta[i]
            places.append((1.0, theta))
    places.sort(key=lambda p: -p[0])
    yield from (theta for _, theta in places[:TRIED])
