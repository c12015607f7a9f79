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


def time_left(times: Sequence[float], pieces: int) -> float | None:
    """Return the time in s that so many more pieces of work take, from the times of those done; None where these do not tell.

    They tell where such a sum lies within a factor of 2 of what is returned. That is decided by the means of blocks of pieces, for a
    pool hands over several at once: k blocks with the relative standard deviation v foretell m more to within t v sqrt(1/k + 1/m),
    which may be half at most: the sum then lies between half and one and a half times the mean. t is Student's, at 95 %.
    """
    if pieces == 0:
        return 0.0
    size = max(1, math.isqrt(len(times)))
    count = len(times) // size
    if count < 2:
        return None
    from scipy.special import stdtrit  # the stages that count pieces have loaded it

    last = times[len(times) - count * size :]
    blocks = [sum(last[k : k + size]) / size for k in range(0, len(last), size)]
    mean = sum(blocks) / count
    spread = math.sqrt(sum((b - mean) ** 2 for b in blocks) / (count - 1))
    off = float(stdtrit(count - 1, 0.975)) * spread * math.sqrt(1.0 / count + size / pieces)
    return pieces * mean if off <= 0.5 * mean else None


class StageProgress:
    """Progress of a stage as people see it: the share of its time that is over, in thousandths; 0 of 1 where it cannot be known.

    A stage counts one thing after the other: starts of a search, sides of profiles, experiments. What one of them takes does not tell
    what the next will: starts of one search took 7 to 119 evaluations each, and how many rounds of candidates there are depends on
    what they find. So a share is told only while the last thing is counted, and only where its pieces tell the time that is left
    (`time_left`). It never runs backwards. A line with nothing counted changes the text alone. Time is counted from the first line, as
    people see it.

    label: before each text. last: how the texts begin while the last thing is counted; "": it counts one thing; None: after none of
    them the end is near. clock: returns s.
    limit: returns the s that are left of a budget, within which any work ends.
    """

    def __init__(
        self,
        progress: Progress,
        label: str,
        last: str | None = "",
        clock: Callable[[], float] = time.monotonic,
        limit: Callable[[], float] = lambda: math.inf,
    ) -> None:
        self._progress, self._label, self._last, self._clock, self._limit = progress, label, last, clock, limit
        self._begun: float | None = None
        self._before = 0.0
        self._counted: tuple[int, int] = (0, 0)
        self._times: list[float] = []
        self._reached = 0
        self._known = False

    def __call__(self, done: int, total: int, text: str) -> None:
        """Report that so much of a thing is done."""
        now = self._clock()
        if self._begun is None:
            self._begun = now
        if self._last is None or not text.startswith(self._last):
            self._counted, self._known = (0, 0), False
        elif total > 1:
            self._count(done, total, now, now - self._begun)
            self._before = now
        reached, scale = (self._reached, SCALE) if self._known else (0, 1)
        self._progress(reached, scale, f"{self._label}: {text}")

    def _count(self, done: int, total: int, now: float, elapsed: float) -> None:
        before, of = self._counted
        if total != of or done < before:  # another thing: when its first pieces began is not known
            before, self._times = done, []
        if done > before:
            self._times += [(now - self._before) / (done - before)] * (done - before)
        self._counted = (done, total)
        left = time_left(self._times, total - done)
        self._known = left is not None and elapsed > 0.0
        if left is None or not self._known:
            return
        left = min(left, max(self._limit(), 0.0))
        self._reached = max(self._reached, min(SCALE, round(SCALE * elapsed / (elapsed + left))))
        # What was told before may not be taken back: a share that has come to mean half the time that is left is not told.
        self._known = 2.0 * elapsed * (SCALE - self._reached) >= self._reached * left


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
            share = f"{100 * done // total} %, " if total > 1 else ""
            print(f"{share}{text}", file=sys.stderr, flush=True)

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
        self._shown.update(
            self._shown.task_ids[0],
            completed=done,
            total=total if total > 1 else None,
            description=text,
            begun=self._stage_begun,
            finish=finish_of(self._stage_begun, now, done, total),
        )

    def close(self) -> None:
        """Take the bar off the terminal."""
        if self._shown is not None:
            self._shown.stop()


def finish_of(begun: float, told: float, done: int, total: int) -> float | None:
    """Return the instant at which a stage ends whose share `done` of `total` of its time was over when it was told; None where no
    share is known. Instants in s."""
    return told + (told - begun) * (total - done) / done if total > 1 and done else None


def times_of(begun: float, finish: float | None, now: float) -> str:
    """Return how long a stage has taken and how much longer it takes, as "1:05, about 20 s left". Instants in s.

    Of a stage that should have ended more than a second ago it is not known how much longer it takes.
    """
    elapsed = int(now - begun)
    hours, minutes = divmod(elapsed // 60, 60)
    shown = f"{hours}:{minutes:02d}:{elapsed % 60:02d}" if hours else f"{minutes}:{elapsed % 60:02d}"
    if finish is None or now - finish > 1.0:
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

    class Share(rich_progress.ProgressColumn):
        """The share that is over, in per cent; nothing where it is not known."""

        def render(self, task: rich_progress.Task) -> Text:
            """Return the share of the task."""
            return Text("" if task.total is None else f"{task.percentage:>3.0f}%")

    columns = (
        rich_progress.BarColumn(bar_width=20),
        Share(),
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
