"""Pool that is started only where the work is long enough for it, and that changes no answer."""

from __future__ import annotations

import operator
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from functools import cache
from typing import Any

from hvdc_ident.executor import Outcome, in_order
from hvdc_ident.parallel.pool import LocalPool, OpenPool


class PatientPool:
    """A pool that works in this process until that has taken as long as a worker takes to begin, then in workers.

    The time in all is at most twice the least possible, beside the item during which the patience ends: the rule for renting
    until the rent paid is the price. An item that fails in a worker is done again here, so that it ends as without workers,
    with its value or with the error that it raises.

    settings: the pool that is started. patience: processor time in s before it is. clock: returns the processor time.
    """

    def __init__(self, settings: LocalPool, patience: float, clock: Callable[[], float] = time.process_time) -> None:
        self._settings, self._patience, self._clock = settings, patience, clock
        self._spent = 0.0
        self._pool: OpenPool | None = None
        self._stack = ExitStack()

    def map(self, function: Callable[[Any], Any], items: Iterable[Any], /) -> Iterator[Any]:
        """Return the function's results in the items' order. Raises what the function raises."""
        return in_order(self.run(function, items))

    def run(self, function: Callable[[Any], Any], items: Iterable[Any], /) -> Iterator[Outcome]:
        """Yield the outcome of each item, as they come. Raises what the function raises."""
        source = _Items(items)
        if self._pool is None:
            yield from self._here(function, source)
        if source.left:
            yield from self._in_workers(function, source)

    def close(self) -> None:
        """End the workers, where there are any."""
        self._pool = None
        self._stack.close()

    def _here(self, function: Callable[[Any], Any], source: _Items) -> Iterator[Outcome]:
        """Yield outcomes of this process until the patience is at its end; a single item is no work for several."""
        while self._spent < self._patience or operator.length_hint(source) == 1:
            index, item = source.take()
            if index < 0:
                return
            begin = self._clock()
            value = function(item)
            self._spent += self._clock() - begin
            yield Outcome(index, value)

    def _in_workers(self, function: Callable[[Any], Any], source: _Items) -> Iterator[Outcome]:
        """Yield outcomes of the pool, which is opened for the first; `source` keeps the items that are there."""
        if self._pool is None:
            self._pool = self._stack.enter_context(self._settings.open())
        following, done, failed = source.following, set[int](), dict[int, Any]()
        for outcome in self._pool.run(function, source):
            index, item = source.given.pop(outcome.index)
            done.add(index)
            if outcome.failure:
                failed[index] = item
            else:
                yield Outcome(index, outcome.value)
            while following in done:  # an error is raised after the values of the items before, as without workers
                if following in failed:
                    yield Outcome(following, function(failed.pop(following)))
                done.discard(following)
                following += 1


class _Items:
    """Items taken one by one with their index. given: what an iteration has given, by its place in it, until it is removed."""

    def __init__(self, items: Iterable[Any]) -> None:
        self._count = operator.length_hint(items)
        self._source = enumerate(items)
        self._next: tuple[int, Any] | None = None
        self.given: dict[int, tuple[int, Any]] = {}

    @property
    def left(self) -> bool:
        """Return whether there is another item."""
        if self._next is None:
            self._next = next(self._source, None)
        return self._next is not None

    @property
    def following(self) -> int:
        """Return the index of the next item; -1 where there is none."""
        return self._next[0] if self.left and self._next is not None else -1

    def take(self) -> tuple[int, Any]:
        """Return the next index and item; -1 where there is none."""
        if not self.left:
            return -1, None
        assert self._next is not None
        item, self._next = self._next, None
        self._count -= 1
        return item

    def __length_hint__(self) -> int:
        return max(0, self._count)

    def __iter__(self) -> Iterator[Any]:
        place = 0
        while self.left:
            self.given[place] = self.take()
            yield self.given[place][1]
            place += 1


@cache
def beginning() -> float:
    """Return the processor time in s that this process had taken when it was first asked.

    It has loaded the package and the study by then, which a worker has to do as well before it is of use.
    """
    return time.process_time()
