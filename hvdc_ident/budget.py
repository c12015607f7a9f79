"""Budget of a piece of work: the wall clock that it may take, and the end of the work where that is over.

Work is ended from within, where it tells its progress, and from without, by a timer of the operating system, where it tells none for
long. What it has found by then is told; see `study/pipeline.py`.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from hvdc_ident.executor import Progress
from hvdc_ident.text import quantity

TO_TELL = 0.05
"""Share of a budget in which what was found is written and told. With the tenth by which a budget may be missed, a budget of 20 s
leaves 3 s for it; the report of a unit with two records takes 1.3 s."""
TO_CONCLUDE = 0.15
"""Share of the time left in which a search that can answer at any time concludes: it runs the model with what it found."""


@dataclass(frozen=True)
class Known:
    """Part of some work as it stood when its budget ended it.

    done: what has ended, in lines. not_tried: what of the part has not been begun or not ended, in words; later: of what follows it.
    """

    done: tuple[str, ...] = ()
    not_tried: tuple[str, ...] = ()
    later: tuple[str, ...] = ()


class BudgetSpent(KeyboardInterrupt):
    """The time that the work may take is over: it ends as by an interrupt, which no part of it takes for a failure of its own.

    known: what each part that it passes had come to, the innermost first; a part puts its own in place of what it takes up in it.
    """

    def __init__(self, message: str) -> None:
        super().__init__(message)
        self.known: list[Known] = []


@dataclass(frozen=True)
class Budget:
    """Wall clock that work may take. seconds: as asked for. begun: the instant at which it began, by the clock, s."""

    seconds: float
    begun: float
    clock: Callable[[], float] = time.monotonic

    @classmethod
    def of(cls, seconds: float, clock: Callable[[], float] = time.monotonic) -> Budget:
        """Return a budget that begins now."""
        return cls(seconds, clock(), clock)

    @classmethod
    def of_process(cls, seconds: float) -> Budget:
        """Return a budget that began with this process, whose start counts for who waits for it; without a way to know, now."""
        return cls(seconds, time.monotonic() - _age())

    @property
    def left(self) -> float:
        """Seconds left for work; what is found has to be told afterwards."""
        return self.begun + (1.0 - TO_TELL) * self.seconds - self.clock()

    @property
    def spent(self) -> bool:
        """True once no time is left for work."""
        return self.left <= 0.0

    @property
    def to_search(self) -> float:
        """Seconds left for a search that then needs some more to conclude."""
        return (1.0 - TO_CONCLUDE) * self.left

    @property
    def text(self) -> str:
        """The budget in words."""
        return f"the budget of {quantity(self.seconds, 's')}"

    def watched(self, progress: Progress) -> Progress:
        """Return progress that ends the work that tells it once the budget is spent."""

        def told(done: int, total: int, text: str) -> None:
            progress(done, total, text)
            if self.spent:
                raise BudgetSpent(f"{self.text} is over")

        return told

    @contextmanager
    def timed(self) -> Iterator[None]:
        """Interrupt the work inside once the budget is spent, by a timer where there is one: on POSIX, in the main thread."""
        if not hasattr(signal, "setitimer") or threading.current_thread() is not threading.main_thread():
            yield
            return

        def stop(*_: object) -> NoReturn:
            raise BudgetSpent(f"{self.text} is over")

        before = signal.signal(signal.SIGALRM, stop)
        signal.setitimer(signal.ITIMER_REAL, max(self.left, 1e-6))
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, before)


def _age() -> float:
    """Return the s since this process began, by the operating system; 0 where it does not say."""
    stat = Path("/proc/self/stat")
    if not stat.is_file():
        return 0.0
    # The 22nd field, in ticks since the system began; the second, the command in brackets, may hold blanks.
    ticks = int(stat.read_text().rpartition(")")[2].split()[19])
    return max(0.0, time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK"))
