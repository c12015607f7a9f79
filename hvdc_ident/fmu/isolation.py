"""Work done in a process of its own, forked from one that has not loaded the FMU yet. Runs in the worker alone."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from hvdc_ident.data import Array
from hvdc_ident.fmu.messages import packed, unpacked
from hvdc_ident.fmu.plant import RunFailed, failure

Part = tuple[dict[str, Any], dict[str, Array]]
"""A heading and arrays."""
PR_SET_PDEATHSIG = 1  # Linux: the signal that a process gets when its parent ends


def in_new_process(work: Callable[[Callable[[Part], None]], None]) -> tuple[list[Part], RunFailed | int | None]:
    """Return the parts that the work handed over, and how it ended: None, its failure, or the code of its process.

    work: called in the new process with what hands a part over. A negative code is the signal that ended the process,
    a code of 0 an end without a word.
    """
    inward, outward = os.pipe()
    parent = os.getpid()
    child = os.fork()
    if child == 0:
        os.close(inward)
        end_with(parent)
        _work(work, Connection(outward, readable=False))
    os.close(outward)
    parts: list[Part] = []
    end: RunFailed | int | None = 0
    with Connection(inward, writable=False) as heard, contextlib.suppress(EOFError):
        while True:
            heading, arrays = unpacked(heard.recv_bytes())
            if "ended" in heading:
                end = RunFailed.heard(heading["failed"]) if heading["ended"] else None
                break
            parts.append((heading["part"], arrays))
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return parts, code if end == 0 else end


def result(work: Callable[[], Part]) -> Part:
    """Return what the work returns, done in a new process. Raises its failure; ends this process as that one ended."""
    parts, end = in_new_process(lambda hand: hand(work()))
    if isinstance(end, RunFailed):
        raise end
    if isinstance(end, int):
        die_like(end)
    return parts[0]


def die_like(code: int) -> None:
    """End this process as another ended, by the same signal or exit code: whoever watches it tells what happened."""
    if code < 0:
        signal.signal(-code, signal.SIG_DFL) if -code not in (signal.SIGKILL, signal.SIGSTOP) else None
        os.kill(os.getpid(), -code)
    os._exit(code)


def _work(work: Callable[[Callable[[Part], None]], None], told: Connection) -> None:
    """Do the work, say how it ended, and end the process."""
    end: dict[str, Any] = {"ended": 0}
    try:
        work(lambda part: told.send_bytes(packed({"part": part[0]}, part[1])))
    except Exception as e:
        failed = failure(e)
        failed.resident, failed.space = resident(), space()
        end = {"ended": 1, "failed": failed.told()}
    told.send_bytes(packed(end))
    os._exit(0)


def end_with(parent: int) -> None:
    """Let the system end this process when its parent ends."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(0)


def resident() -> int:
    """Bytes of memory in use; 0 where the system does not tell."""
    return _statm(1)


def space() -> int:
    """Bytes of address space in use, on which the limit is; 0 where the system does not tell."""
    return _statm(0)


def _statm(place: int) -> int:
    with contextlib.suppress(OSError), open("/proc/self/statm", encoding="ascii") as sizes:
        return int(sizes.read().split()[place]) * os.sysconf("SC_PAGESIZE")
    return 0
