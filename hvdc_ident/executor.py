"""Executors and progress: the two protocols that every verb takes, the outcome of an item, and the progress bar."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar, runtime_checkable

from hvdc_ident.errors import ComputationError

T = TypeVar("T")
R = TypeVar("R")

Progress = Callable[[int, int, str], None]
"""Called with the number of items done, the number in all, and a line of text."""

PATIENCE = 1.0
"""Seconds after which a progress bar appears."""


class Executor(Protocol):
    """Anything with the `map` of concurrent.futures."""

    def map(self, function: Callable[[Any], Any], items: Iterable[Any], /) -> Iterator[Any]:
        """Return the function's results in the items' order."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of one item: its index among the items, its value, and why it has none, empty where it has."""

    index: int
    value: Any = None
    failure: str = ""


@runtime_checkable
class TolerantExecutor(Protocol):
    """An executor that reports the outcome of each item, in any order: an item that is lost costs no other."""

    def run(self, function: Callable[[Any], Any], items: Iterable[Any], /) -> Iterator[Outcome]:
        """Yield the outcome of each item."""


def mapped(executor: Executor | None, function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """Return the function's results in the items' order, as they come; without an executor each when it is asked for."""
    return map(function, items) if executor is None else iter(executor.map(function, items))


def outcomes(executor: Executor, function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Outcome]:
    """Yield the outcome of each item, as they come. A plain `map` raises where an item fails."""
    if isinstance(executor, TolerantExecutor):
        yield from executor.run(function, items)
    else:
        for index, value in enumerate(executor.map(function, items)):
            yield Outcome(index, value)


def attempted(function: Callable[[Any], Any], index: int, item: Any) -> Outcome:
    """Return the outcome of a function of one item; what it raises is the failure."""
    try:
        return Outcome(index, function(item))
    except MemoryError:
        return Outcome(index, None, "not enough memory")
    except Exception as error:
        return Outcome(index, None, " ".join(f"{type(error).__name__}: {error}".split())[:500])


def in_order(outcomes: Iterable[Outcome]) -> Iterator[Any]:
    """Yield the values in the items' order. Raises ComputationError at the first outcome without a value."""
    waiting: dict[int, Any] = {}
    following = 0
    for outcome in outcomes:
        if outcome.failure:
            raise ComputationError(f"item {outcome.index + 1} failed", where="the pool of workers", got=outcome.failure)
        waiting[outcome.index] = outcome.value
        while following in waiting:
            yield waiting.pop(following)
            following += 1


def silent(done: int, total: int, text: str) -> None:
    """Report no progress."""


@contextmanager
def progress_bar(quiet: bool) -> Iterator[Progress]:
    """Yield the function to report progress to: a bar on stderr once the work has taken a second; with quiet, `silent`."""
    if quiet:
        yield silent
        return
    begun, bar = time.monotonic(), None

    def show(done: int, total: int, text: str) -> None:
        nonlocal bar
        if bar is None:
            if time.monotonic() - begun < PATIENCE:
                return
            bar = _opened_bar()
        bar.update(bar.task_ids[0], completed=done, total=total, description=text)

    try:
        yield show
    finally:
        if bar is not None:
            bar.stop()


def _opened_bar() -> Any:
    from rich import progress as rich_progress
    from rich.console import Console

    columns = (
        rich_progress.BarColumn(),
        rich_progress.MofNCompleteColumn(),
        rich_progress.TimeElapsedColumn(),
        rich_progress.TextColumn("left"),
        rich_progress.TimeRemainingColumn(),
        rich_progress.TextColumn("{task.description}", markup=False),
    )
    # Lines printed meanwhile go above the bar on a terminal; elsewhere stdout is left alone.
    console = Console(file=sys.stderr)
    bar = rich_progress.Progress(*columns, console=console, transient=True, redirect_stdout=sys.stdout.isatty())
    bar.add_task("", total=None)
    bar.start()
    return bar
