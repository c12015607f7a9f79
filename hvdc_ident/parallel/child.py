"""A process for one piece of work that may crash, hang or take too much memory, seen from its owner.

A new interpreter, so that nothing of this process is imported or inherited, forks the process that works, and guards it:
see `hvdc_ident.parallel.inside`. This contains crashes, hangs and leaks, not malice.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import re
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.reduction import send_handle
from pathlib import Path
from typing import Any

from hvdc_ident.parallel import inside, one_thread
from hvdc_ident.parallel.progress import PROCESS, begin, progress_file, progress_in

FRAME = re.compile(r'^\s*File "(?P<file>.*)", line (?P<line>\d+) in (?P<name>\w*)')
PATIENCE = 5.0  # s for the guard to tell how its child ended, of which it needs a few milliseconds
LAST_WORDS = 2000  # bytes of what a child printed last


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
            if match := FRAME.match(line):
                yield match["file"], int(match["line"]), match["name"]


class ChildEndedError(Exception):
    """A child ended before it gave its result; str() says how, and `printed` what it printed last."""

    def __init__(self, ending: Ending | None, printed: str) -> None:
        super().__init__(str(ending or "is gone, and so is what watched it"))
        self.printed = printed


class Child:
    """A process that runs work(connection, progress, *arguments) and ends with this one. What it prints is kept.

    connection: to the work, of picklable objects. progress: memory that the work shares, see `hvdc_ident.parallel.progress`.
    keeps: descriptors that it inherits under their numbers. needs: modules that what guards it loads, so that a work begun
    again is spared that. finish: called, once this process has ended without closing the child, by what guards it. Raises
    OSError where the system starts no process.
    """

    def __init__(
        self,
        work: Callable[..., None],
        *arguments: object,
        keeps: Sequence[int] = (),
        needs: Sequence[str] = (),
        finish: Callable[[], object] | None = None,
    ) -> None:
        self._owner = os.getpid()
        self._printed = tempfile.TemporaryFile()  # noqa: SIM115 - it lives as long as the child
        control, far = socket.socketpair()
        root = str(Path(__file__).resolve().parents[2])
        path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
        with far, progress_file() as noted:
            self.progress = progress_in(noted.fileno())
            at = noted.fileno()
            self.guard = subprocess.Popen(
                [sys.executable, "-P", "-c", f"from {inside.__name__} import main; main()", str(far.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=self._printed,
                stderr=self._printed,
                pass_fds=(far.fileno(), at, *keeps),
                env={**os.environ, **one_thread(), "PYTHONPATH": path},
                start_new_session=True,  # what a terminal sends to all its processes is for this one
            )
        self._control = Connection(control.detach())
        with contextlib.suppress(OSError):  # it has ended already: noticed when it is heard
            self._control.send((os.getpid(), at, tuple(needs)))
            self._control.send_bytes(pickle.dumps(finish))
        self._begin(work, arguments)

    def _begin(self, work: Callable[..., None], arguments: Sequence[object]) -> None:
        here, there = socket.socketpair()
        self.connection = Connection(here.detach())
        begin(self.progress)
        self.progress[PROCESS] = 0
        with there, contextlib.suppress(OSError):  # what guards it has ended already: noticed when it is heard
            send_handle(self._control, there.fileno(), self.guard.pid)
            self._control.send_bytes(pickle.dumps((work, arguments)))

    def again(self, work: Callable[..., None], *arguments: object) -> None:
        """Begin work in a new process, after `rest`; what the one before printed is forgotten."""
        self._printed.seek(0)  # the processes that print share the place
        self._printed.truncate()
        self._begin(work, arguments)

    @property
    def pid(self) -> int:
        """The process that works, 0 before it began."""
        return int(self.progress[PROCESS])

    @property
    def printed(self) -> str:
        """The last lines that it printed."""
        with contextlib.suppress(ValueError, OSError):
            size = os.fstat(self._printed.fileno()).st_size
            return (
                os.pread(self._printed.fileno(), LAST_WORDS, max(0, size - LAST_WORDS))
                .decode("utf-8", "replace")
                .strip()
            )
        return ""

    def end(self, *, trace: bool = False) -> Ending | None:
        """Return how it ended, which it is made to do where it has not; None where what guards it is gone.

        trace: whether it tells its frames before; that takes a fifth of a second.
        """
        ending = self.rest(trace=trace)
        self.close()
        return ending

    def rest(self, *, trace: bool = False) -> Ending | None:
        """End it as `end` does, but keep what guards it, so that work can begin `again`; None where that is gone."""
        with contextlib.suppress(OSError, EOFError):
            self._control.send(trace)
        with contextlib.suppress(OSError, EOFError):
            if self._control.poll(PATIENCE):
                ending = Ending(*self._control.recv())
                self.connection.close()
                return ending
        self.close()
        return None

    def close(self) -> None:
        """End it without asking how; in a process that was forked from its owner, only let go of it."""
        for end in (self.connection, self._control, self._printed):
            with contextlib.suppress(OSError):
                end.close()
        if self._owner == os.getpid() and self.guard.returncode is None:
            self.guard.kill()  # and the system ends the child with it
            self.guard.wait()


def call(function: Callable[..., Any], *arguments: object, seconds: float, memory: int | None = None) -> Any:
    """Return function(*arguments) from a process of its own. Both, and what is returned, must be picklable.

    memory: bytes that it may take; None: no limit. Raises what the function raises, TimeoutError where it takes longer, and
    ChildEndedError where its process ends. Windows hands no descriptors on: there it is called in this process.
    """
    if os.name != "posix":
        return function(*arguments)
    child = Child(inside.answer, function, arguments, memory)
    try:
        if not child.connection.poll(seconds):
            raise TimeoutError(f"no result after {seconds:g} s")
        value, error = child.connection.recv()
    except (EOFError, OSError) as gone:
        if isinstance(gone, TimeoutError):
            raise
        printed = child.printed
        raise ChildEndedError(child.end(), printed) from None
    finally:
        child.close()
    if error is not None:
        raise error
    return value
