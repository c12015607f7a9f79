"""A command run in a process of its own that is ended at will, and a list of the work it did.

The process is a fork: it has everything imported and compiled, so that nearly all its time is work. Each piece of work
is noted, with the time, before it is given to the store; in a pool, by its worker, as soon as it is done.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from typer.testing import CliRunner

from hvdc_ident.cli import app
from hvdc_ident.parallel import OpenPool
from hvdc_ident.study.store import Job


@dataclass(frozen=True)
class Note:
    """A piece of work that was done: when (monotonic, s), and what."""

    time: float
    work: str


@dataclass(frozen=True)
class Noted:
    """A function of a pool that notes in the log what it has done."""

    function: Callable[[Any], Any]
    log: Path

    def __call__(self, item: Any) -> Any:
        value = self.function(item)
        with self.log.open("ab", buffering=0) as log:
            log.write(f"{time.monotonic()!r} pool {hashlib.sha256(pickle.dumps(item)).hexdigest()}\n".encode())
        return value


def run(*arguments: object) -> str:
    """What the command printed, run in this process. Raises AssertionError where it did not come to its end."""
    result = CliRunner().invoke(app, [*map(str, arguments), "--quiet"])
    assert result.exit_code == 0, result.output
    return result.output


def forked(
    arguments: tuple[object, ...],
    log: Path,
    *,
    after: float | None = None,
    at: int | None = None,
    first: Callable[[], None] | None = None,
    in_pool: bool = False,
) -> tuple[int, str]:
    """Exit code (-9 where it was killed) and output of the command, run in a fork that notes its work in `log`.

    after: the fork is killed after so many s; at: just before it keeps its at-th piece of work. first: called in it.
    in_pool: the workers of its pool note what they have done, not the store what it is given.
    """
    said = log.with_suffix(".said")
    child = os.fork()
    if child == 0:
        _child(arguments, log, said, at, first, in_pool)
    timer = threading.Timer(after, os.kill, (child, signal.SIGKILL)) if after is not None else None
    if timer is not None:
        timer.start()
    status = _waited(child, timer)
    return os.waitstatus_to_exitcode(status), said.read_text() if said.exists() else ""


def _waited(child: int, timer: threading.Timer | None) -> int:
    """The status of the process; it is not reaped while the timer may still fire at its number."""
    os.waitid(os.P_PID, child, os.WEXITED | os.WNOWAIT)
    if timer is not None:
        timer.cancel()
        timer.join()
    return os.waitpid(child, 0)[1]


def _child(
    arguments: tuple[object, ...],
    log: Path,
    said: Path,
    at: int | None,
    first: Callable[[], None] | None,
    in_pool: bool,
) -> None:
    code = 70
    try:
        handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        keep, count = Job.put, 0

        def put(job: Job, key: bytes, value: bytes) -> None:
            nonlocal count
            count += 1
            os.write(handle, f"{time.monotonic()!r} {job.name[:12]} {key.hex()}\n".encode())
            if count == at:
                os.kill(os.getpid(), signal.SIGKILL)
            keep(job, key, value)

        if in_pool:
            pooled = OpenPool.run
            OpenPool.run = lambda pool, work, items: pooled(pool, Noted(work, log), items)  # type: ignore[method-assign]
        else:
            Job.put = put  # type: ignore[method-assign]
        said.unlink(missing_ok=True)
        if first is not None:
            first()
        result = CliRunner().invoke(app, [*map(str, arguments), "--quiet"])
        said.write_text(result.output)
        code = result.exit_code
    finally:
        os._exit(code)


def notes(log: Path) -> list[Note]:
    """The work done, in order."""
    lines = log.read_text().splitlines() if log.exists() else []
    return [Note(float(t), f"{job} {key}") for t, job, key in (line.split() for line in lines)]
