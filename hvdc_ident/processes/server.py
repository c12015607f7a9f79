"""The process that starts workers, watches them and tells how they ended; none of their work is done in it.

`python -m hvdc_ident.processes.server SOCKET`, the number of a descriptor, started by a `Supervisor`. It imports the
workers' module, whose functions it calls:

    prepare(setup)                           here, at the beginning: load what workers need
    serve(connection, progress, setup, begun)   in each worker, until its owner closes the connection
    finish(setup)                            here, at the end

Workers share what is loaded before, and it does not count as their memory. Where the owner of the workers ends, however it
does, this process ends them, finishes and ends too; where it is itself killed, the system ends the workers.

A worker that crashes, leaves or is told to dumps its Python frames here before it goes. It cannot go on before the dump
is read, so the memory it has at that moment is known as well. The system says of each part from which process it is: a
trial that crashed in a process of its own tells nothing about the run after it.
"""

from __future__ import annotations

import contextlib
import ctypes
import faulthandler
import importlib
import math
import os
import pickle
import signal
import socket
import struct
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from multiprocessing import reduction
from multiprocessing.connection import Connection, wait
from typing import Any, NoReturn

from hvdc_ident.processes.messages import NOW, PROCESS, RESIDENT, SPACE, Message, packed, progress_in, unpacked

PATIENCE = 1.0  # s between looks after the owner where the system does not tell of its end
DUMP = 0.5  # s that a worker has to begin the dump it is asked for; it takes about a millisecond
PAUSE = 0.2
"""s of silence after which a dump that was asked for is over, and a look is taken at a process: it may have to wait for its turn."""
SENDER = struct.Struct("3i")  # process, user and group that the system puts to a message
PR_SET_PDEATHSIG = 1  # Linux: the signal that a process gets when its parent ends

_worker = False


def is_worker() -> bool:
    """Return whether this process is a worker, one of several that share the cores."""
    return _worker


@dataclass(eq=False)
class _Child:
    """A worker. space, resident: most bytes of address space and of memory that it was seen with."""

    number: int
    pid: int
    dumps: socket.socket
    progress: memoryview[float]
    space: int = 0
    resident: int = 0
    dumped: dict[int, list[bytes]] = field(default_factory=dict)  # by process

    def processes(self) -> list[int]:
        """The worker and, where its work is in a process of its own, that."""
        inner = int(self.progress[PROCESS])
        return [self.pid, inner] if inner != self.pid and _parent_of(inner) == self.pid else [self.pid]

    def look(self) -> None:
        """Note the memory it has."""
        for pid in self.processes():
            space, resident = _peaks(pid)
            self.space, self.resident = max(self.space, space), max(self.resident, resident)

    def read(self) -> bool:
        """Return whether there was a part of a dump to read."""
        part, control, _, _ = self.dumps.recvmsg(65536, socket.CMSG_SPACE(SENDER.size))
        if not part:
            return False
        sender = next((SENDER.unpack(data)[0] for _, kind, data in control if kind == socket.SCM_CREDENTIALS), self.pid)
        if sender not in self.dumped:  # it waits in the middle of its dump
            self.look()
        self.dumped.setdefault(sender, []).append(part)
        return True

    @property
    def traces(self) -> str:
        """The dumps of the processes that it last had, the innermost first; an earlier one's told of its own end only."""
        last = dict.fromkeys((int(self.progress[PROCESS]), self.pid))
        return b"".join(part for pid in last for part in self.dumped.get(pid, ())).decode("utf-8", "replace")

    def kill(self) -> None:
        """Kill it with what it has started."""
        for send in (os.killpg, os.kill):  # its group, or itself where it had no time to make one
            with contextlib.suppress(OSError):
                send(self.pid, signal.SIGKILL)


class _Server:
    """The workers of one owner, to which `owner` is connected."""

    def __init__(self, owner: Connection) -> None:
        self.owner = owner
        parent, memory, prints, entry = owner.recv()  # pickled by the owner, which is trusted
        self.parent: int = parent
        self.memory: int | None = memory
        self.descriptors = 2 if prints else 3
        self.setup: Any = owner.recv()
        self.module = importlib.import_module(entry)
        self.children: dict[int, _Child] = {}
        self.parents_end: list[int] = []
        with contextlib.suppress(OSError, AttributeError):
            self.parents_end = [os.pidfd_open(self.parent)]
        self.module.prepare(self.setup)

    def run(self) -> None:
        """Serve the owner until it ends."""
        try:
            while os.getppid() == self.parent:
                dumps = {child.dumps: child for child in self.children.values()}
                ready = wait([self.owner, *self.parents_end, *dumps], None if self.parents_end else PATIENCE)
                if any(end in ready for end in self.parents_end):
                    break
                for child in [child for end, child in dumps.items() if end in ready]:
                    if not child.read():
                        self._ended(child)
                if self.owner in ready:
                    self._serve(*pickle.loads(self.owner.recv_bytes()))
        except (EOFError, OSError):
            pass  # the owner is gone
        for child in self.children.values():
            child.kill()
        for child in self.children.values():
            os.waitpid(child.pid, 0)
        while (
            os.getppid() == self.parent
        ):  # its connection ends before it; where it closed that only, it kills this one
            wait(self.parents_end, None if self.parents_end else PATIENCE)
        self.module.finish(self.setup)

    def _serve(self, what: str, number: int, given: object) -> None:
        if what == "start":
            with socket.socket(fileno=os.dup(self.owner.fileno())) as passing:
                descriptors = reduction.recvfds(passing, self.descriptors)
            self._start(number, given, descriptors)
        elif number in self.children:
            self._end(self.children[number], trace=bool(given))

    def _start(self, number: int, begun: object, descriptors: Sequence[int]) -> None:
        """Fork a worker. descriptors: its connection to the owner, its progress, and what its messages go to."""
        dumped, dumping = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        dumped.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        dumping.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)  # the least: a few lines, then it waits to be read
        server = os.getpid()
        pid = os.fork()
        if pid == 0:
            self.owner.close()
            for other in (dumped, *(c.dumps for c in self.children.values())):
                other.close()
            self._become_worker(server, begun, descriptors, dumping)
        dumping.close()
        progress = progress_in(descriptors[1])
        for descriptor in descriptors:
            os.close(descriptor)
        self.children[number] = _Child(number, pid, dumped, progress)

    def _become_worker(self, parent: int, begun: object, descriptors: Sequence[int], dumps: socket.socket) -> NoReturn:
        """Do the owner's work in this new process. dumps: takes the frames when it crashes."""
        global _worker
        _worker = True
        try:
            os.setpgid(0, 0)  # with what its work may start
            end_with(parent)
            connection, progress, *printed = descriptors
            for descriptor in printed:
                os.dup2(descriptor, 1)
                os.dup2(descriptor, 2)
            view = progress_in(progress)
            view[PROCESS], view[NOW] = os.getpid(), math.nan
            told = _dump_into(dumps)  # noqa: F841 - the system calls it at the end
            _limit(self.memory)
            view[RESIDENT], view[SPACE] = resident(), space()
            self.module.serve(Connection(connection), view, self.setup, begun)
        except (EOFError, OSError):
            pass  # the owner is gone
        except BaseException:
            traceback.print_exc()
            os._exit(1)
        os._exit(0)  # a library may hang in its own clean-up

    def _end(self, child: _Child, *, trace: bool) -> None:
        """End a worker. trace: once it has told where it is."""
        child.look()
        if trace:
            for pid in child.processes():
                with contextlib.suppress(OSError):
                    os.kill(pid, signal.SIGUSR1)
            until = time.monotonic() + DUMP
            while (left := until - time.monotonic()) > 0 and wait([child.dumps], left):
                if not child.read():
                    break
                until = min(until, time.monotonic() + PAUSE)
        child.kill()
        self._ended(child)

    def _ended(self, child: _Child) -> None:
        """Tell the owner of a worker's end."""
        _, status, usage = os.wait4(child.pid, 0)
        with contextlib.suppress(OSError):
            os.killpg(child.pid, signal.SIGKILL)  # what its work has started
        child.dumps.close()
        del self.children[child.number]
        ended = {
            "ended": child.number,
            "code": os.waitstatus_to_exitcode(status),
            "resident": max(child.resident, usage.ru_maxrss * 1024),
            "space": child.space,
            "traces": child.traces,
        }
        self.owner.send_bytes(packed(ended))


def _peaks(pid: int) -> tuple[int, int]:
    """The most bytes of address space and of memory that a process has had; 0 where the system does not tell."""
    found = {"VmPeak": 0, "VmHWM": 0}
    with contextlib.suppress(OSError), open(f"/proc/{pid}/status", encoding="ascii", errors="replace") as lines:
        for line in lines:
            name, _, rest = line.partition(":")
            if name in found:
                found[name] = int(rest.split()[0]) * 1024
    return found["VmPeak"], found["VmHWM"]


def _parent_of(pid: int) -> int:
    """The parent of a process; 0 where it is not there."""
    try:
        with open(f"/proc/{pid}/stat", encoding="ascii", errors="replace") as text:
            return int(text.read().rpartition(")")[2].split()[1])
    except OSError:
        return 0


# --- in a worker ---


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


def _dump_into(dumps: socket.socket) -> object:
    """Dump the frames when this process crashes, gets SIGUSR1, or is ended by an exit in C. Return what to keep."""
    where = dumps.detach()
    faulthandler.enable(where)
    faulthandler.register(signal.SIGUSR1, where, all_threads=True)
    at_exit = ctypes.CFUNCTYPE(None, ctypes.c_void_p)(lambda _: faulthandler.dump_traceback(where))
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).__cxa_atexit(at_exit, None, None)
    return at_exit


def _limit(memory: int | None) -> None:
    """Let the process take so many bytes more than it has now, and leave no core file."""
    import resource

    with contextlib.suppress(OSError, ValueError):
        if memory is not None:
            most = space() + memory
            resource.setrlimit(resource.RLIMIT_AS, (most, most))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def in_new_process(
    work: Callable[[Callable[[Message], None]], None],
    failure: Callable[[Exception], dict[str, Any]],
    hangs: Callable[[Sequence[Message]], bool] | None = None,
) -> tuple[list[Message], dict[str, Any] | int | None]:
    """Return the parts that the work handed over, and how it ended: None, its failure, or the code of its process.

    Runs in a worker, whose process is forked. work: called with what hands a part over. failure: what an error amounts
    to, as a heading. A negative code is the signal that ended the process, a code of 0 an end without a word.
    hangs: called with the parts so far while the work is silent, whether to end its process.
    """
    inward, outward = os.pipe()
    parent = os.getpid()
    child = os.fork()
    if child == 0:
        os.close(inward)
        end_with(parent)
        told = Connection(outward, readable=False)
        last: dict[str, Any] = {"ended": 0}
        try:
            work(lambda part: told.send_bytes(packed({"part": part[0]}, part[1])))
        except Exception as e:
            last = {"ended": 1, "failed": {**failure(e), "resident": resident(), "space": space()}}
        told.send_bytes(packed(last))
        os._exit(0)
    os.close(outward)
    parts: list[Message] = []
    end: dict[str, Any] | int | None = 0
    with Connection(inward, writable=False) as heard, contextlib.suppress(EOFError):
        while True:
            while hangs is not None and not heard.poll(PAUSE):
                if hangs(parts):
                    os.kill(child, signal.SIGKILL)
                    break
            heading, arrays = unpacked(heard.recv_bytes())
            if "ended" in heading:
                end = heading["failed"] if heading["ended"] else None
                break
            parts.append((heading["part"], arrays))
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return parts, code if end == 0 else end


def die_like(code: int) -> NoReturn:
    """End this process as another ended, by the same signal or exit code: whoever watches it tells what happened."""
    if code < 0:
        signal.signal(-code, signal.SIG_DFL) if -code not in (signal.SIGKILL, signal.SIGSTOP) else None
        os.kill(os.getpid(), -code)
    os._exit(code)


def main() -> None:
    """Serve the owner that started this process."""
    with contextlib.suppress(EOFError, OSError):
        _Server(Connection(int(sys.argv[1]))).run()
    os._exit(0)


if __name__ == "__main__":
    # Under its own name too: workers' modules import it, and there is one `_worker`.
    from hvdc_ident.processes import server

    server.main()
