"""Inside a child: the process that guards it, which has one thread and does no work, and the one that works.

Where the owner of a child ends, however it does, the guard ends the child, does what the owner left to be done, and ends too;
where the guard is itself killed, the system ends the child.

A child that crashes, leaves or is told to dumps its Python frames to the guard before it goes. It cannot go on before the
dump is read, so the memory it has at that moment is known as well. The system says of each part from which process it is: a
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
from multiprocessing.connection import Connection, wait
from multiprocessing.reduction import recv_handle
from typing import Any, NoReturn

from hvdc_ident.parallel.progress import NOW, PROCESS, RESIDENT, SPACE, progress_in

PATIENCE = 1.0  # s between looks after the owner where the system does not tell of its end
DUMP = 0.5  # s that a child has to begin the dump it is asked for; it takes about a millisecond
PAUSE = 0.2
"""s of silence after which a dump that was asked for is over, and a look is taken at a process: it may have to wait for its turn."""
SENDER = struct.Struct("3i")  # process, user and group that the system puts to a message
PR_SET_PDEATHSIG = 1  # Linux: the signal that a process gets when its parent ends


def main() -> None:
    """Start the child that the owner asks for, guard it until it or its owner ends, and start another where one is asked for."""
    try:
        control = Connection(int(sys.argv[1]))
        owner, noted, needs = control.recv()  # pickled by the owner, which is trusted
        finish, progress = control.recv_bytes(), progress_in(noted)
        for module in needs:
            importlib.import_module(module)
        owners_end: list[int] = []
        with contextlib.suppress(OSError, AttributeError):
            owners_end = [os.pidfd_open(owner)]
        asks = [control]
        while os.getppid() == owner:
            if control not in wait([*asks, *owners_end], None if owners_end else PATIENCE):
                continue
            try:
                talk, work = recv_handle(control), control.recv_bytes()
            except (EOFError, OSError):
                asks = []  # an owner that lives on ends this process
                continue
            pid, dumps = _forked(control, talk, progress, work)
            _Guard(control, owner, owners_end, pid, dumps, progress).guard()
            dumps.close()
        if left := pickle.loads(finish):
            left()
    except (EOFError, OSError):
        pass  # the owner is gone
    os._exit(0)


def _forked(control: Connection, talk: int, progress: memoryview[float], work: bytes) -> tuple[int, socket.socket]:
    """Return the new process that does the work, and what takes its frames."""
    dumps, dumping = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    dumps.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
    dumping.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)  # the least: a few lines, then it waits to be read
    guard = os.getpid()
    pid = os.fork()
    if pid == 0:
        control.close()
        dumps.close()
        _work(guard, Connection(talk), progress, dumping, work)
    dumping.close()
    os.close(talk)
    return pid, dumps


class _Guard:
    """What guards a child. control: to the owner. dumps: takes the child's frames, and ends with it.

    owners_end: what the system makes ready when the owner ends; empty where it does not tell.
    """

    def __init__(
        self,
        control: Connection,
        owner: int,
        owners_end: list[int],
        pid: int,
        dumps: socket.socket,
        progress: memoryview[float],
    ) -> None:
        self.control, self.owner, self.owners_end = control, owner, owners_end
        self.pid, self.dumps, self.progress = pid, dumps, progress
        self.space = self.resident = 0  # most bytes of address space and of memory that it was seen with
        self.dumped: dict[int, list[bytes]] = {}  # by process

    def guard(self) -> None:
        """Return once the child has ended and its owner knows how, or is gone."""
        asked = False
        while os.getppid() == self.owner:
            ready = wait([self.control, self.dumps, *self.owners_end], None if self.owners_end else PATIENCE)
            if self.dumps in ready and not self._read():
                break
            if self.control in ready:
                asked = True
                with contextlib.suppress(EOFError, OSError):
                    if self.control.recv():
                        self._ask_where_it_is()
                break
            if ready and self.dumps not in ready:
                break
        self._look()
        _kill_group(self.pid)
        _, status, usage = os.wait4(self.pid, 0)
        _kill_group(self.pid)  # what its work has started
        resident = max(self.resident, usage.ru_maxrss * 1024)
        with contextlib.suppress(OSError, EOFError):
            self.control.send((os.waitstatus_to_exitcode(status), resident, self.space, self._traces()))
            while not asked and os.getppid() == self.owner:  # the owner asks for its end when it notices
                asked = self.control in wait([self.control, *self.owners_end], None if self.owners_end else PATIENCE)
                if asked:
                    self.control.recv()

    def _processes(self) -> list[int]:
        """The child and, where its work is in a process of its own, that."""
        inner = int(self.progress[PROCESS])
        return [self.pid, inner] if inner != self.pid and _parent_of(inner) == self.pid else [self.pid]

    def _look(self) -> None:
        """Note the memory it has."""
        for pid in self._processes():
            space, resident = _peaks(pid)
            self.space, self.resident = max(self.space, space), max(self.resident, resident)

    def _read(self) -> bool:
        """Return whether there was a part of a dump to read."""
        part, control, _, _ = self.dumps.recvmsg(65536, socket.CMSG_SPACE(SENDER.size))
        if not part:
            return False
        sender = next((SENDER.unpack(data)[0] for _, kind, data in control if kind == socket.SCM_CREDENTIALS), self.pid)
        if sender not in self.dumped:  # it waits in the middle of its dump
            self._look()
        self.dumped.setdefault(sender, []).append(part)
        return True

    def _ask_where_it_is(self) -> None:
        """Let the child dump its frames."""
        self._look()
        for pid in self._processes():
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGUSR1)
        until = time.monotonic() + DUMP
        while (left := until - time.monotonic()) > 0 and wait([self.dumps], left) and self._read():
            until = min(until, time.monotonic() + PAUSE)

    def _traces(self) -> str:
        """The dumps of the processes that it last had, the innermost first; an earlier one's told of its own end only."""
        last = dict.fromkeys((int(self.progress[PROCESS]), self.pid))
        return b"".join(part for pid in last for part in self.dumped.get(pid, ())).decode("utf-8", "replace")


def _work(guard: int, talk: Connection, progress: memoryview[float], dumps: socket.socket, work: bytes) -> NoReturn:
    """Do the owner's work in this new process. dumps: takes the frames when it crashes."""
    code = 0
    try:
        os.setpgid(0, 0)  # with what its work may start
        end_with(guard)
        progress[PROCESS], progress[NOW] = os.getpid(), math.nan
        at_exit = _dump_into(dumps)  # noqa: F841 - the system calls it at the end
        limit_memory(progress, None)
        function, arguments = pickle.loads(work)
        function(talk, progress, *arguments)
    except (EOFError, ConnectionError):
        pass  # the owner is gone
    except BaseException:
        traceback.print_exc()
        code = 1
    with contextlib.suppress(OSError, ValueError):
        sys.stdout.flush()
    os._exit(code)  # a library may hang in its own clean-up


def answer(
    connection: Connection,
    progress: memoryview[float],
    function: Callable[..., Any],
    arguments: Sequence[Any],
    memory: int | None,
) -> None:
    """Send the function's value and None, or None and what it raised. memory: bytes that it may take."""
    limit_memory(progress, memory)
    try:
        value, error = function(*arguments), None
    except Exception as raised:
        value, error = None, raised
    connection.send((value, error))


def limit_memory(progress: memoryview[float], memory: int | None) -> None:
    """Let this process take so many bytes more than it has now, which is noted; None: no limit. It leaves no core file."""
    import resource

    progress[RESIDENT], progress[SPACE] = resident(), space()
    with contextlib.suppress(OSError, ValueError):
        if memory is not None:
            most = space() + memory
            resource.setrlimit(resource.RLIMIT_AS, (most, most))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


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


def in_new_process(
    work: Callable[[Callable[[Any], None]], None],
    failure: Callable[[Exception], Any],
    hangs: Callable[[Sequence[Any]], bool] | None = None,
) -> tuple[list[Any], Any]:
    """Return the parts that the work handed over, and how it ended: None, its failure, or the code of its process.

    Runs in a child that has one thread, whose process is forked. work: called with what hands a part over. failure: returns
    what an error amounts to. A negative code is the signal that ended the process, a code of 0 an end without a word.
    hangs: called with the parts so far while the work is silent, whether to end its process.
    """
    inward, outward = os.pipe()
    parent = os.getpid()
    child = os.fork()
    if child == 0:
        os.close(inward)
        end_with(parent)
        sender = Connection(outward, readable=False)
        failed = None
        try:
            work(lambda part: sender.send(("part", part)))
        except Exception as e:
            failed = failure(e)
        sender.send(("end", failed))
        os._exit(0)
    os.close(outward)
    parts: list[Any] = []
    end: Any = 0
    with Connection(inward, writable=False) as heard, contextlib.suppress(EOFError):
        while True:
            while hangs is not None and not heard.poll(PAUSE):
                if hangs(parts):
                    os.kill(child, signal.SIGKILL)
                    break
            kind, content = heard.recv()
            if kind == "end":
                end = content
                break
            parts.append(content)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return parts, code if end == 0 else end


def die_like(code: int) -> NoReturn:
    """End this process as another ended, by the same signal or exit code: whoever watches it tells what happened."""
    if code < 0:
        signal.signal(-code, signal.SIG_DFL) if -code not in (signal.SIGKILL, signal.SIGSTOP) else None
        os.kill(os.getpid(), -code)
    os._exit(code)


def _kill_group(pid: int) -> None:
    """Kill a child with what it has started."""
    for send in (os.killpg, os.kill):  # its group, or itself where it had no time to make one
        with contextlib.suppress(OSError):
            send(pid, signal.SIGKILL)


def _peaks(pid: int) -> tuple[int, int]:
    """The most bytes of address space and of memory that a process has had; 0 where the system does not tell."""
    peaks = {"VmPeak": 0, "VmHWM": 0}
    with contextlib.suppress(OSError), open(f"/proc/{pid}/status", encoding="ascii", errors="replace") as lines:
        for line in lines:
            name, _, rest = line.partition(":")
            if name in peaks:
                peaks[name] = int(rest.split()[0]) * 1024
    return peaks["VmPeak"], peaks["VmHWM"]


def _parent_of(pid: int) -> int:
    """The parent of a process; 0 where it is not there."""
    try:
        with open(f"/proc/{pid}/stat", encoding="ascii", errors="replace") as text:
            return int(text.read().rpartition(")")[2].split()[1])
    except OSError:
        return 0
