"""Executors and progress: the two protocols that every verb takes, the outcome of an item, and the progress bar."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

from hvdc_ident.errors import ComputationError, one_line
from hvdc_ident.text import duration

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


@runtime_checkable
class Identified(Protocol):
    """Work that names what decides its results beside the item: where that is the same, so are they."""

    @property
    def identity(self) -> Any:
        """Return the value that decides the results, of numbers, text, arrays, collections and dataclasses of the package."""


@dataclass(frozen=True)
class Made(Generic[T]):
    """Items that are made one after the other as they are asked for, where all of them together would be large."""

    make: Callable[[Any], T]
    of: Sequence[Any]

    def __len__(self) -> int:
        return len(self.of)

    def __iter__(self) -> Iterator[T]:
        return map(self.make, self.of)


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
        return Outcome(index, None, one_line(error))


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


SCALE = 1000
"""Parts that a stage's progress is counted in."""
EVERY = 60.0
"""Seconds between two lines of progress where there is no terminal for a bar."""


class StageProgress:
    """Progress of a stage as people see it, in thousandths of its time: it never runs backwards, whatever is counted inside.

    A stage counts one thing after the other: starts of a search, sides of profiles. Each is a phase; it begins where the
    total is another one, or the count falls. The time left is that of the phase at its pace so far, and for each phase that
    is still to come the mean time of those so far. A line with nothing counted (0 of 1) changes the text alone.

    phases: how many there will be. label: before each text. clock: returns s. limit: returns the s that are left of a budget, within
    which any work ends.
    """

    def __init__(
        self,
        progress: Progress,
        label: str,
        phases: int = 1,
        clock: Callable[[], float] = time.monotonic,
        limit: Callable[[], float] = lambda: math.inf,
    ) -> None:
        self._progress, self._label, self._phases, self._clock, self._limit = progress, label, phases, clock, limit
        self._begun = self._last = clock()
        self._finished: list[float] = []
        self._phase: tuple[float, int, int] | None = None
        self._reached = 0

    def __call__(self, done: int, total: int, text: str) -> None:
        """Report that so much of a phase is done."""
        now = self._clock()
        if total > 1:
            self._count(done, total, now)
        self._last = now
        self._progress(self._reached, SCALE, f"{self._label}: {text}")

    def _count(self, done: int, total: int, now: float) -> None:
        if self._phase is None or total != self._phase[2] or done < self._phase[1]:
            if self._phase is not None:
                self._finished.append(now - self._phase[0])
            self._phase = (self._last if done else now, done, total)
        begun = self._phase[0]
        self._phase = (begun, done, total)
        share = done / total
        if not share:
            return
        whole = (now - begun) / share
        to_come = max(0, self._phases - len(self._finished) - 1)
        left = (1.0 - share) * whole + to_come * (sum(self._finished) + whole) / (len(self._finished) + 1)
        left = min(left, max(self._limit(), 0.0))
        elapsed = now - self._begun
        if elapsed + left > 0.0:
            self._reached = max(self._reached, min(SCALE, round(SCALE * elapsed / (elapsed + left))))


@contextmanager
def progress_bar(quiet: bool) -> Iterator[Progress]:
    """Yield the function to report progress to: a bar on stderr once the work has taken a second; with quiet, `silent`.

    Where stderr is no terminal there is a line a minute.
    """
    if quiet:
        yield silent
        return
    bar = _Bar() if sys.stderr.isatty() else _Lines()
    try:
        yield bar
    finally:
        bar.close()


class _Lines:
    """Progress as lines, one a minute at most."""

    def __init__(self) -> None:
        self._last = time.monotonic()

    def __call__(self, done: int, total: int, text: str) -> None:
        if time.monotonic() - self._last >= EVERY:
            self._last = time.monotonic()
            print(f"{100 * done // max(total, 1)} %, {text}", file=sys.stderr, flush=True)

    def close(self) -> None:
        """End the lines."""


class _Bar:
    """Progress as a bar that appears once the work has taken a second; another stage begins it anew."""

    def __init__(self) -> None:
        self._begun = time.monotonic()
        self._shown: Any = None
        self._label, self._stage_begun = "", self._begun

    def __call__(self, done: int, total: int, text: str) -> None:
        now, label = time.monotonic(), text.partition(":")[0] if ":" in text else ""
        if label != self._label:
            self._label, self._stage_begun = label, now
        if self._shown is None:
            if now - self._begun < PATIENCE:
                return
            self._shown = _opened_bar()
        share = done / total if total else 0.0
        finish = now + (now - self._stage_begun) * (1.0 - share) / share if share else None
        self._shown.update(
            self._shown.task_ids[0],
            completed=done,
            total=total,
            description=text,
            begun=self._stage_begun,
            finish=finish,
        )

    def close(self) -> None:
        """Take the bar off the terminal."""
        if self._shown is not None:
            self._shown.stop()


def times_of(begun: float, finish: float | None, now: float) -> str:
    """Return how long a stage has taken and how much longer it takes, as "1:05, about 20 s left". Instants in s."""
    elapsed = int(now - begun)
    hours, minutes = divmod(elapsed // 60, 60)
    shown = f"{hours}:{minutes:02d}:{elapsed % 60:02d}" if hours else f"{minutes}:{elapsed % 60:02d}"
    if finish is None:
        return shown
    left = finish - now
    return f"{shown}, {'about ' + duration(math.ceil(left)) if left > 1.0 else 'a moment'} left"


def _opened_bar() -> Any:
    from rich import progress as rich_progress
    from rich.console import Console
    from rich.table import Column
    from rich.text import Text

    class Times(rich_progress.ProgressColumn):
        """The times of a task, told anew at every refresh."""

        def render(self, task: rich_progress.Task) -> Text:
            """Return the times of the task."""
            return Text(times_of(task.fields["begun"], task.fields["finish"], time.monotonic()))

    columns = (
        rich_progress.BarColumn(bar_width=20),
        rich_progress.TaskProgressColumn(),
        Times(table_column=Column(no_wrap=True)),
        rich_progress.TextColumn(
            "{task.description}", markup=False, table_column=Column(ratio=1, no_wrap=True, overflow="ellipsis")
        ),
    )
    # Lines printed meanwhile go above the bar on a terminal; elsewhere stdout is left alone.
    console = Console(file=sys.stderr)
    bar = rich_progress.Progress(
        *columns, console=console, transient=True, expand=True, redirect_stdout=sys.stdout.isatty()
    )
    bar.add_task("", total=None, begun=time.monotonic(), finish=None)
    bar.start()
    return bar
