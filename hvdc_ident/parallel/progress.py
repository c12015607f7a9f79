"""Progress of a child's work in memory that its owner shares, and the watch over it."""

from __future__ import annotations

import math
import mmap
import tempfile
import time
from typing import IO

PROCESS, RESIDENT, SPACE, BEGAN, START, STOP, NOW = range(7)
"""Places in the progress: the process at work; its bytes of memory and of address space before its work; when the present
piece of work began (s of the monotonic clock); of a run its first, last and present instant, s."""
LOOKS = 20  # looks at the progress within a deadline: what has not moved over the last two of them stands still
STALL = 0.5  # s that a run at least stands still for: a busy computer lets a process wait for less


def progress_file() -> IO[bytes]:
    """Return a file without a name that holds a child's progress."""
    file = tempfile.TemporaryFile()  # noqa: SIM115 - it lives as long as the child
    file.truncate(mmap.PAGESIZE)
    return file


def progress_in(file: int) -> memoryview[float]:
    """Return the progress in a file, shared with every process that has it."""
    return memoryview(mmap.mmap(file, mmap.PAGESIZE)).cast("d")


def no_progress() -> memoryview[float]:
    """Return a progress that nobody watches."""
    view = memoryview(bytearray(8 * 8)).cast("d")
    view[NOW] = math.nan
    return view


def begin(progress: memoryview[float]) -> None:
    """Note that a piece of work begins: its deadline counts from now on, and no run has reached an instant yet."""
    progress[BEGAN] = time.monotonic()
    progress[START] = progress[STOP] = progress[NOW] = math.nan


class Watch:
    """The deadline of one piece of work, s, and whether a run moves. progress: shared with the child."""

    def __init__(self, progress: memoryview[float], deadline: float) -> None:
        self.progress, self.deadline = progress, deadline
        self.moved = time.monotonic()
        self.at = (math.nan, math.nan)

    def pause(self) -> float:
        """For how long to wait before the next look, s."""
        self._look()
        return max(0.0, min(self.progress[BEGAN] + self.deadline - time.monotonic(), self.deadline / LOOKS))

    def over(self) -> bool:
        """Return whether the work is past its deadline."""
        self._look()
        return self.elapsed() >= self.deadline

    def elapsed(self) -> float:
        """Return the seconds since the work began."""
        return time.monotonic() - self.progress[BEGAN]

    def instants(self) -> tuple[float, float, float]:
        """First, last and present instant of the run, s, nan where not known."""
        return self.progress[START], self.progress[STOP], self.progress[NOW]

    def still(self) -> float | None:
        """For how long the run has stood still, s; None where it moves, or was not watched for long enough."""
        stood = time.monotonic() - self.moved
        return stood if stood > max(2 * self.deadline / LOOKS, STALL) else None

    def _look(self) -> None:
        at = (self.progress[BEGAN], self.progress[NOW])
        if at != self.at and not (math.isnan(at[1]) and at[0] == self.at[0]):
            self.at, self.moved = at, time.monotonic()
