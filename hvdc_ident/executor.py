"""Where work runs and where its progress is shown: the two protocols that every verb takes, and the progress bar."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol, TypeVar, cast, runtime_checkable

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
