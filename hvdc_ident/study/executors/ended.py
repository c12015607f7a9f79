"""The fate of an item that was given to a pool."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from hvdc_ident.errors import ComputationError


@dataclass(frozen=True)
class Ended:
    """What became of one item: its place among the items, its value, and why it has none (empty where it has)."""

    index: int
    value: Any = None
    failure: str = ""


def in_order(ends: Iterable[Ended]) -> Iterator[Any]:
    """The values in the items' order. Raises ComputationError at the first item that has none."""
    waiting: dict[int, Any] = {}
    place = 0
    for end in ends:
        if end.failure:
            raise ComputationError(f"item {end.index + 1} failed", where="the pool of workers", got=end.failure)
        waiting[end.index] = end.value
        while place in waiting:
            yield waiting.pop(place)
            place += 1
