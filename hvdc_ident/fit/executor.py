"""Where work is done: in this process, or wherever an executor takes it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any, Protocol, TypeVar

T = TypeVar("T")
R = TypeVar("R")

Progress = Callable[[int, int, str], None]
"""Called with runs done, runs in all, and a line of text."""


class Executor(Protocol):
    """Anything with the `map` of concurrent.futures."""

    def map(self, function: Callable[[Any], Any], items: Iterable[Any], /) -> Iterator[Any]:
        """The function's results in the items' order."""


def mapped(executor: Executor | None, function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """The function's results in the items' order, as they come; without an executor each is worked out when it is asked for."""
    return map(function, items) if executor is None else iter(executor.map(function, items))
