"""Values of the model's own parameters that a hypothesis implies, compared with the given ones and between hypotheses.

A lag behind an output and a lag inside a loop may be one transfer function, with other values of the parameters. What the
records do not distinguish then implies several values of a parameter, and none of them by itself is an estimate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

from hvdc_ident.discrepancy.hypothesis import Refit
from hvdc_ident.discrepancy.result import EffectSize
from hvdc_ident.fit.noise import SURE
from hvdc_ident.immutable import FrozenMap

TIED = 2.0
"""In BIC: evidence up to which one hypothesis is not to be preferred to another (Kass and Raftery, Bayes Factors, JASA 90, 1995)."""

T = TypeVar("T")


def implied(refit: Refit) -> FrozenMap[EffectSize]:
    """Return the values of the model's own free parameters in a refit, by name, with their 95 % intervals where these are known."""
    values = {}
    for k in refit.gains:
        free, value = refit.problem.free[k], float(refit.theta[k])
        std = None if free.on_bound(value) else refit.std.get(free.name)
        interval = None if std is None else (value - 1.96 * std, value + 1.96 * std)
        values[free.name] = EffectSize(value, interval, refit.model.parameters[free.name].unit)
    return FrozenMap(values)


def off_given(refit: Refit) -> float:
    """Return how far a refit's own free parameters are from their given values: root of the summed squares of relative differences.

    Each is a difference over the larger of both magnitudes, so that half a value and twice a value are as far.
    """
    total = 0.0
    for k in refit.gains:
        given, value = refit.problem.free[k].given, float(refit.theta[k])
        largest = max(abs(given), abs(value))
        total += ((value - given) / largest) ** 2 if largest else 0.0
    return math.sqrt(total)


def apart(one: Mapping[str, EffectSize], other: Mapping[str, EffectSize]) -> tuple[str, ...]:
    """Return the parameters whose values in two hypotheses differ by more than chance; none whose deviation is not known."""
    found = []
    for name in (n for n in one if n in other):
        stds = [_std(values[name]) for values in (one, other)]
        if None not in stds:
            deviation = math.hypot(*(s for s in stds if s is not None))
            if abs(one[name].value - other[name].value) > SURE * deviation:
                found.append(name)
    return tuple(found)


def _std(size: EffectSize) -> float | None:
    low, high = size.ci95 or (None, None)
    return None if low is None or high is None else (high - low) / (2.0 * 1.96)


def nearest(
    best: T, tied: Sequence[T], values: Callable[[T], Mapping[str, EffectSize]], off: Callable[[T], float]
) -> T:
    """Return of a hypothesis and those that explain as much the one whose values, where they are others, are nearest to the given.

    values: of the parameters by hypothesis; off: how far these are from the given ones.
    """
    own = values(best)
    others = [t for t in tied if off(t) < off(best) and apart(own, values(t))]
    return min([best, *others], key=off)
