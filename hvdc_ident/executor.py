"""Where work is done and who is told of its progress: the two protocols that every verb takes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any, Protocol, TypeVar, cast, runtime_checkable

T = TypeVar("T")
R = TypeVar("R")

Progress = Callable[[int, int, str], None]
"""Called with the number of items done, the number in all, and a line of text."""


class Executor(Protocol):
    """Anything with the `map` of concurrent.futures."""

    def map(self, function: Callable[[Any], Any], items: Iterable[Any], /) -> Iterator[Any]:
        """Return the function's results in the items' order."""


class Ended(Protocol):
    """The end of one item: its place among the items, and its value, or why it has none."""

    @property
    def index(self) -> int: ...
    @property
    def value(self) -> Any: ...
    @property
    def failure(self) -> str: ...


@runtime_checkable
class Runner(Protocol):
    """An executor that tells the end of each item, in any order: an item that is lost costs no other."""

    def run(self, function: Callable[[Any], Any], items: Iterable[Any], /) -> Iterator[Ended]:
        """Return the ends of the items."""


def mapped(executor: Executor | None, function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """Return the function's results in the items' order, as they come; without an executor each when it is asked for."""
    return map(function, items) if executor is None else iter(executor.map(function, items))


def ends(executor: Executor, function: Callable[[T], R], items: Iterable[T]) -> Iterator[tuple[int, R, str]]:
    """Yield place, value and failure of each item, as they come; the failure is empty where there is a value.

    A plain `map` raises where an item fails. An executor that tells the end of each item goes on.
    """
    if isinstance(executor, Runner):
        for end in executor.run(function, items):
            yield end.index, cast("R", end.value), end.failure
    else:
        for index, value in enumerate(executor.map(function, items)):
            yield index, value, ""
