"""The one process that starts an FMU's workers, watches them and tells how they ended; the FMU is never loaded in it.

`python -m hvdc_ident.fmu.supervisor SOCKET LOCK`, numbers of descriptors, started by `hvdc_ident.fmu.host`. It loads what
a worker needs and forks one whenever the host asks, in a hundredth of the time that a new interpreter takes. It tells
with which memory and in which call a worker ended. Where the host ends, however it does, it ends the workers, removes
the unpacked FMU and ends too; where it is itself killed, the system ends the workers.

A worker that crashes, leaves or is told to dumps its Python frames here before it goes (see `worker.main`). It cannot
go on before the dump is read, so the memory it has at that moment is known as well. The system says of each part from
which process it is: a trial that crashed in a process of its own tells nothing about the run after it.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import socket
import struct
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from multiprocessing import reduction
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from hvdc_ident.fmu import worker
from hvdc_ident.fmu.folder import Folder
from hvdc_ident.fmu.messages import PROCESS, packed, progress_in, unpacked

PATIENCE = 1.0  # s between looks after the host where the system does not tell of its end
DUMP = 0.5  # s that a worker has to begin the dump it is asked for; it takes about a millisecond
PAUSE = 0.2  # s of silence after which a dump that was asked for is over: a process may have to wait for its turn
SENDER = struct.Struct("3i")  # process, user and group that the system puts to a message


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
        """The worker and, where it keeps the FMU in a process of its own, that."""
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


class Supervisor:
    """The workers of one host. host: the connection to it. parent: its process. lock: of the unpacked FMU's folder."""

    def __init__(self, host: Connection, lock: int) -> None:
        self.host = host
        heading, _ = unpacked(host.recv_bytes())
        self.parent: int = heading["parent"]
        self.folder = Folder(Path(heading["folder"]), lock)
        self.memory: int | None = heading["memory"]
        self.description = pickle.loads(host.recv_bytes())  # from the host, which is trusted
        self.children: dict[int, _Child] = {}
        self.parents_end: list[int] = []
        with contextlib.suppress(OSError, AttributeError):
            self.parents_end = [os.pidfd_open(self.parent)]
        worker.prepare(self.description)

    def run(self) -> None:
        """Serve the host until it ends."""
        try:
            while os.getppid() == self.parent:
                dumps = {child.dumps: child for child in self.children.values()}
                ready = wait([self.host, *self.parents_end, *dumps], None if self.parents_end else PATIENCE)
                if any(end in ready for end in self.parents_end):
                    break
                for child in [child for end, child in dumps.items() if end in ready]:
                    if not child.read():
                        self._ended(child)
                if self.host in ready:
                    self._serve(*unpacked(self.host.recv_bytes()))
        except (EOFError, OSError):
            pass  # the host is gone
        for child in self.children.values():
            _kill(child)
        for child in self.children.values():
            os.waitpid(child.pid, 0)
        while (
            os.getppid() == self.parent
        ):  # its connection ends before it; if it only closed that, it ends this process
            wait(self.parents_end, None if self.parents_end else PATIENCE)
        self.folder.release()

    def _serve(self, heading: Mapping[str, Any], _: Mapping[str, Any]) -> None:
        if "start" in heading:
            with socket.socket(fileno=os.dup(self.host.fileno())) as passing:
                descriptors = reduction.recvfds(passing, 3)
            self._start(int(heading["start"]), heading, descriptors)
        elif heading["end"] in self.children:
            self._end(self.children[heading["end"]])

    def _start(self, number: int, heading: Mapping[str, Any], descriptors: list[int]) -> None:
        """Fork a worker. descriptors: its connection to the host, its progress, and what its messages go to."""
        here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        here.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        there.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)  # the least: a few lines, then it waits to be read
        own = os.getpid()
        pid = os.fork()
        if pid == 0:
            self.host.close()
            for other in (here, *(c.dumps for c in self.children.values())):
                other.close()
            worker.main(own, self.description, str(self.folder.binaries), self.memory, heading, descriptors, there)
        there.close()
        progress = progress_in(descriptors[1])
        for descriptor in descriptors:
            os.close(descriptor)
        self.children[number] = _Child(number, pid, here, progress)

    def _end(self, child: _Child) -> None:
        """End a worker, once it has told where it is."""
        child.look()
        for pid in child.processes():
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGUSR1)
        until = time.monotonic() + DUMP
        while (left := until - time.monotonic()) > 0 and wait([child.dumps], left):
            if not child.read():
                break
            until = min(until, time.monotonic() + PAUSE)
        _kill(child)
        self._ended(child)

    def _ended(self, child: _Child) -> None:
        """Tell the host of a worker's end."""
        _, status, usage = os.wait4(child.pid, 0)
        with contextlib.suppress(OSError):
            os.killpg(child.pid, signal.SIGKILL)  # what the FMU has started
        child.dumps.close()
        del self.children[child.number]
        ended = {
            "ended": child.number,
            "code": os.waitstatus_to_exitcode(status),
            "resident": max(child.resident, usage.ru_maxrss * 1024),
            "space": child.space,
            "traces": child.traces,
        }
        self.host.send_bytes(packed(ended))


def _kill(child: _Child) -> None:
    for send in (os.killpg, os.kill):  # its group, or itself where it had no time to make one
        with contextlib.suppress(OSError):
            send(child.pid, signal.SIGKILL)


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


def main() -> None:
    """Serve the host that started this process."""
    host, lock = int(sys.argv[1]), int(sys.argv[2])
    with contextlib.suppress(EOFError, OSError):
        Supervisor(Connection(host), lock).run()
    os._exit(0)


if __name__ == "__main__":
    main()
