"""Directions in parameter space along which nothing is seen, and their names: "only b*kp and b*ki are seen"."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.immutable import FrozenMap

SMALL = 1e-2
"""Parts of a direction below this share of its largest are not members."""


@dataclass(frozen=True)
class Combination:
    """Parameters of which only combinations are seen.

    members: in the order listed. seen: the combinations, in words. kind: "structural" (no data could tell) or
    "practical" (these data do not). direction: the change of the members that leaves the outputs alone, in scaled
    coordinates (relative, or share of the range). held: those put at their given value so that the others can be told.
    text: the finding in words where `seen` has none.
    """

    members: tuple[str, ...]
    seen: tuple[str, ...]
    kind: Literal["structural", "practical"]
    direction: FrozenMap[float] = field(default_factory=FrozenMap)
    held: tuple[str, ...] = ()
    text: str = ""

    @property
    def words(self) -> str:
        """The finding as a sentence."""
        names = _list(self.members)
        if self.text:
            return self.text
        if not self.seen:
            return f"{names} cannot be told apart" if len(self.members) > 1 else f"{names} is not seen"
        verb = "is" if len(self.seen) == 1 else "are"
        return f"only {_list(self.seen)} {verb} seen, not {names} apart"


def in_words(direction: Array, names: Sequence[str], logs: Sequence[bool], values: Sequence[float]) -> tuple[str, ...]:
    """The combinations that a null direction leaves unchanged: products of powers where all members are positive.

    direction: (p,) in scaled coordinates. logs: which coordinates are relative. values: of the parameters.
    """
    members = [i for i in range(len(names)) if abs(direction[i]) > SMALL * np.abs(direction).max()]
    pivot = members[0]
    found = []
    for i in members[1:]:
        ratio = float(direction[i] / direction[pivot])
        if logs[i] and logs[pivot]:
            found.append(_product(names[pivot], names[i], -ratio))
        else:
            slope = _per_unit(ratio, logs[i], values[i], logs[pivot], values[pivot])
            sign = "-" if slope > 0 else "+"
            found.append(f"{names[i]} {sign} {abs(slope):.3g}*{names[pivot]} (near these values)")
    return tuple(found)


def _product(pivot: str, name: str, power: float) -> str:
    """name * pivot^power as people write it."""
    near = round(2.0 * power) / 2.0
    power = near if abs(power - near) < 0.02 and near else power
    if abs(power) == 1.0:
        return f"{pivot}*{name}" if power > 0 else f"{name}/{pivot}"
    return f"{name}*{pivot}^{power:.3g}"


def _per_unit(ratio: float, log_i: bool, value_i: float, log_p: bool, value_p: float) -> float:
    return ratio * (value_i if log_i else 1.0) / ((value_p if log_p else 1.0) or 1.0)


def combinations_of(
    null: Array,
    names: Sequence[str],
    logs: Sequence[bool],
    values: Sequence[float],
    kind: Literal["structural", "practical"],
) -> tuple[Combination, ...]:
    """One combination for each null direction, (k, p) in scaled coordinates, with its members and words."""
    found = []
    for row in null:
        members = tuple(n for n, v in zip(names, row, strict=True) if abs(v) > SMALL * np.abs(row).max())
        direction = FrozenMap({n: float(v) for n, v in zip(names, row, strict=True) if n in members})
        found.append(Combination(members, in_words(row, names, logs, values), kind, direction))
    return tuple(found)


def held_of(null: Array) -> frozenset[int]:
    """The parameters to hold so that the others can be told: one for each direction, the last listed that will do.

    null: (k, p) independent directions. Any set of columns in which they stay independent would do; the equations' route
    keeps the earlier listed, and how strongly each is seen must not make the two routes differ.
    """
    left, held = null.copy(), set()
    for i in reversed(range(null.shape[1])):
        if not left.shape[0]:
            break
        left = left / np.abs(left[:, : i + 1]).max(axis=1, keepdims=True)
        row = int(np.argmax(np.abs(left[:, i])))
        if abs(left[row, i]) > SMALL:
            held.add(i)
            left = np.delete(left - np.outer(left[:, i] / left[row, i], left[row]), row, axis=0)
    return frozenset(held)


def partners(combinations: Sequence[Combination], held: Mapping[str, str]) -> dict[str, tuple[str, ...]]:
    """For each member that is not held, the held ones of its combinations."""
    found: dict[str, tuple[str, ...]] = {}
    for c in combinations:
        stuck = tuple(n for n in c.members if n in held)
        for n in c.members:
            if n not in held and stuck:
                found[n] = tuple(dict.fromkeys((*found.get(n, ()), *stuck)))
    return found


def _list(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
