"""The end of a process in words, and the memory that it may take."""

from __future__ import annotations

import math
import re
import signal
from collections.abc import Iterator
from dataclasses import dataclass

MIB = 2**20
EXHAUSTED = 0.5
"""Share of its memory from which a process may have run out of it: one that grows by doubling is refused from half on."""
FRAME = re.compile(r'^\s*File "(?P<file>.*)", line (?P<line>\d+) in (?P<name>\w*)')


@dataclass(frozen=True)
class Ending:
    """A process that ended.

    code: its exit code, negative where a signal ended it. resident, space: the most bytes of memory and of address space
    that it had; 0 where the system did not tell. traces: Python's frames when it crashed or was ended, innermost first.
    """

    code: int
    resident: int = 0
    space: int = 0
    traces: str = ""

    def __str__(self) -> str:
        if self.code >= 0:
            return f"ended with exit code {self.code}"
        try:
            return f"was ended by {signal.Signals(-self.code).name}"
        except ValueError:
            return f"was ended by signal {-self.code}"

    def frames(self) -> Iterator[tuple[str, int, str]]:
        """Yield file, line and function of each frame, innermost first."""
        for line in self.traces.splitlines():
            if found := FRAME.match(line):
                yield found["file"], int(found["line"]), found["name"]


@dataclass(frozen=True)
class Budget:
    """The memory that a worker may take, in bytes: `most` more than it began with. None: no limit."""

    most: int | None
    resident: int = 0
    space: int = 0

    def taken(self, resident: int, space: int) -> int:
        """Return the bytes taken since the worker began: of the address space, which the limit is on, where it is known."""
        return max(resident - self.resident if resident else 0, space - self.space if space else 0, 0)

    def exhausted(self, taken: int) -> bool:
        """Return whether the worker may have run out of it."""
        return self.most is not None and taken >= EXHAUSTED * self.most

    def told(self, taken: int) -> str:
        """Return the memory taken, in words."""
        assert self.most is not None
        return f"it had used {taken / MIB:.0f} of its {self.most / MIB:.0f} MiB of memory"

    @property
    def larger(self) -> int:
        """A limit of twice as much, in MiB."""
        assert self.most is not None
        return math.ceil(2 * self.most / MIB)
