"""The supervisor of this process's workers: a process that starts them, watches them and tells how they ended.

See `hvdc_ident.processes.server` for its other side. It contains crashes, hangs and leaks, not malice.
"""

from __future__ import annotations

import contextlib
import math
import os
import pickle
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import reduction
from multiprocessing.connection import Connection
from pathlib import Path
from typing import IO

from hvdc_ident.processes.messages import (
    BEGAN,
    ITEM,
    NOW,
    PROCESS,
    RESIDENT,
    SPACE,
    START,
    STOP,
    progress_file,
    progress_in,
    unpacked,
)

MIB = 2**20
EXHAUSTED = 0.5
"""Share of its memory from which a process may have run out of it: one that grows by doubling is refused from half on."""
FRAME = re.compile(r'^\s*File "(?P<file>.*)", line (?P<line>\d+) in (?P<name>\w*)')
PATIENCE = 5.0  # s for the supervisor to tell how a worker ended, of which it needs a few milliseconds
LOOKS = 20  # looks at the progress within a deadline: what has not moved over the last two of them stands still
STALL = 0.5  # s that a run at least stands still for: a busy computer lets a process wait for less
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


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


@dataclass(eq=False)
class ChildProcess:
    """A worker, seen from the process that gives it work. printed: what it prints, where that is kept."""

    number: int
    connection: Connection
    progress: memoryview[float]
    memory: int | None
    printed: IO[bytes] | None

    @property
    def pid(self) -> int:
        """Its process, 0 before it began."""
        return int(self.progress[PROCESS])

    @property
    def budget(self) -> Budget:
        """The memory that it may take."""
        return Budget(self.memory, int(self.progress[RESIDENT]), int(self.progress[SPACE]))

    @property
    def last_line(self) -> str:
        """The last line that it printed."""
        return last_line(self.printed)

    @property
    def item(self) -> int:
        """The number of the present piece of work."""
        return int(self.progress[ITEM])

    @property
    def elapsed(self) -> float:
        """Seconds since the present piece of work began."""
        return time.monotonic() - self.progress[BEGAN]

    def begin(self) -> None:
        """Note that a piece of work begins: deadlines count from now on."""
        self.progress[BEGAN] = time.monotonic()

    def close(self) -> None:
        """Close what joins it to this process."""
        for end in (self.connection, self.printed):
            with contextlib.suppress(OSError):
                if end is not None:
                    end.close()


class Supervisor:
    """A process that starts workers by forking, in a hundredth of the time that a new interpreter takes.

    entry: name of the module that the workers run, see `hvdc_ident.processes.server`. setup: for its functions, pickled.
    memory: bytes that a worker may take more than it begins with; None: no limit. keeps: descriptors that it inherits.
    prints: whether workers print where this process does; else the last line of each is kept.
    """

    def __init__(
        self,
        entry: str,
        setup: object = None,
        *,
        memory: int | None = None,
        keeps: Sequence[int] = (),
        prints: bool = False,
    ) -> None:
        self.owner, self.memory, self.prints = os.getpid(), memory, prints
        near_end, far_end = socket.socketpair()
        root = str(Path(__file__).resolve().parents[2])
        path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
        # There is a worker for every core: further threads of linear algebra would wait for each other.
        one_thread = {} if any(n in os.environ for n in THREADS) else dict.fromkeys(THREADS, "1")
        self.printed: IO[bytes] | None = None if prints else tempfile.TemporaryFile()  # noqa: SIM115
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-m", "hvdc_ident.processes.server", str(far_end.fileno())],
            stdin=subprocess.DEVNULL,
            stdout=None if prints else subprocess.DEVNULL,
            stderr=self.printed,
            pass_fds=(far_end.fileno(), *keeps),
            env={**os.environ, **one_thread, "PYTHONPATH": path},
            start_new_session=True,  # what a terminal sends to all its processes is for this one
        )
        far_end.close()
        self.connection = Connection(near_end.detach())
        self.last = ""  # line that it wrote
        self._lock = threading.Lock()
        self._ended: dict[int, Ending] = {}
        self._started = 0
        self.connection.send((os.getpid(), memory, prints, entry))
        self.connection.send(setup)

    def start(self, begun: object = None) -> ChildProcess:
        """Return a worker that begins now. begun: what it begins with. Raises OSError where the supervisor is gone."""
        near_end, far_end = socket.socketpair()
        progress = progress_file()
        printed = None if self.prints else tempfile.TemporaryFile()  # noqa: SIM115 - it lives as long as the worker
        with far_end, progress, self._lock, socket.socket(fileno=os.dup(self.connection.fileno())) as passing:
            self._started += 1
            view = progress_in(progress.fileno())
            child = ChildProcess(self._started, Connection(near_end.detach()), view, self.memory, printed)
            child.begin()
            view[NOW] = math.nan
            self.connection.send_bytes(pickle.dumps(("start", child.number, begun)))
            reduction.sendfds(passing, [f.fileno() for f in (far_end, progress, printed) if f is not None])
        return child

    def end(self, child: ChildProcess, *, trace: bool = True) -> Ending | None:
        """Return how a worker ended, which it is made to do where it has not; None where the supervisor is gone.

        trace: whether it tells its frames before; that takes a fifth of a second.
        """
        with self._lock:
            with contextlib.suppress(OSError, EOFError):
                self.connection.send_bytes(pickle.dumps(("end", child.number, trace)))
                while child.number not in self._ended and self.connection.poll(PATIENCE):
                    heading, _ = unpacked(self.connection.recv_bytes())
                    number = heading.pop("ended")
                    self._ended[number] = Ending(**heading)
            found = self._ended.pop(child.number, None)
        child.close()
        if found is None:
            self.close()  # the system ends its workers with it
        return found

    def close(self) -> None:
        """End it and every worker; in a process that was forked from its owner, only let go of it."""
        self.connection.close()
        if self.printed is not None:
            self.last = last_line(self.printed)
            self.printed.close()
        if self.owner == os.getpid() and self.process.poll() is None:
            self.process.kill()
            self.process.wait()

    @property
    def gone(self) -> bool:
        """True once it has ended, or belongs to the process that this one was forked from."""
        return self.owner != os.getpid() or self.process.poll() is not None


class Watch:
    """The deadline of one piece of work, s, and whether a run moves. progress: shared with the worker."""

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


def last_line(printed: IO[bytes] | None) -> str:
    """Return the last line that a process wrote."""
    with contextlib.suppress(ValueError, OSError):
        if printed is not None:
            printed.seek(0, os.SEEK_END)
            printed.seek(max(0, printed.tell() - 2000))
            lines = printed.read().decode("utf-8", "replace").strip().splitlines()
            return " ".join(lines[-1].split())[:300] if lines else ""
    return ""
