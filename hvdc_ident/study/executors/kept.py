"""An executor that remembers: what a stage has finished is not done again when the stage is run a second time.

A stage does the same work in the same order whenever it is given the same study, seed and software, whatever executor
it has. So the place of a piece of work in that order, with a digest of the piece itself where it has one, is its key.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Protocol

from hvdc_ident.errors import ComputationError
from hvdc_ident.files import digest
from hvdc_ident.study.executors.ended import Ended, in_order
from hvdc_ident.study.store import packed, unpacked


class Shelf(Protocol):
    """Where results are kept, by key."""

    def get(self, keys: Sequence[bytes]) -> Any:
        """What is kept under the keys, as a mapping; a key without a result is missing."""

    def put(self, key: bytes, value: bytes) -> None:
        """Keep the value."""


class Runner(Protocol):
    """What runs the work that is missing."""

    def run(self, function: Callable[[Any], Any], items: Iterable[Any], /) -> Iterator[Ended]:
        """What became of each item, as it ends."""


class KeptExecutor:
    """The `map` of a pool, or of this process where there is none, with a shelf beside it."""

    def __init__(self, shelf: Shelf, pool: Runner | None = None) -> None:
        self._shelf, self._pool, self._calls = shelf, pool, 0

    def map(self, function: Callable[[Any], Any], items: Iterable[Any], /) -> Iterator[Any]:
        """The function's results in the items' order, those kept from an earlier run not computed again.

        Raises ComputationError where an item has no result in the pool; in this process, what the function raises.
        """
        self._calls += 1
        return self._results(self._calls, function, list(items))

    def _results(self, call: int, function: Callable[[Any], Any], items: list[Any]) -> Iterator[Any]:
        keys = [f"{call}/{place}/{_mark(item)}".encode() for place, item in enumerate(items)]
        kept = self._shelf.get(keys)
        known = {place: unpacked(kept[key]) for place, key in enumerate(keys) if key in kept}
        missing = [place for place in range(len(items)) if place not in known]
        if self._pool is None or len(missing) < 2:
            for place, item in enumerate(items):
                if place not in known:
                    known[place] = function(item)
                    self._put(keys[place], known[place])
                yield known.pop(place)
            return
        yield from in_order(self._ends(function, items, keys, known, missing))

    def _ends(
        self,
        function: Callable[[Any], Any],
        items: list[Any],
        keys: list[bytes],
        known: dict[int, Any],
        missing: list[int],
    ) -> Iterator[Ended]:
        assert self._pool is not None
        for place, value in known.items():
            yield Ended(place, value)
        for end in self._pool.run(function, [items[place] for place in missing]):
            place = missing[end.index]
            if not end.failure:
                self._put(keys[place], end.value)
            yield Ended(place, end.value, end.failure)

    def _put(self, key: bytes, value: Any) -> None:
        try:
            content = packed(value)
        except TypeError as error:
            raise ComputationError("a result cannot be kept", got=str(error)) from None
        self._shelf.put(key, content)


def _mark(item: Any) -> str:
    """A digest of a piece of work, so that a result is never taken for another's; empty where it has no text form."""
    try:
        return digest(packed(item))[:16]
    except TypeError:
        return ""
