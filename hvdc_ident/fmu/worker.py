"""The process with an FMU's machine code in it, forked by `hvdc_ident.fmu.supervisor`: it answers the host's requests.

Whatever the FMU prints goes to a file, whose end the host quotes where it dies.
"""

from __future__ import annotations

import contextlib
import ctypes
import faulthandler
import math
import os
import signal
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from multiprocessing.connection import Connection
from typing import Any, NoReturn

from hvdc_ident.fmu.messages import BEGAN, NOW, PROCESS, START, STOP, packed, progress_in, unpacked

PR_SET_PDEATHSIG = 1  # Linux: the signal that a process gets when its parent ends


def prepare(description: Any) -> None:
    """Load what workers need: what one of them loads later would count as the FMU's memory."""
    import hvdc_ident.fmu.jobs  # noqa: F401

    if description.interface == "model-exchange":
        import scipy.integrate  # noqa: F401


def main(
    parent: int,
    description: Any,
    folder: str,
    memory: int | None,
    begun: Mapping[str, Any],
    descriptors: Sequence[int],
    dumps: socket.socket,
) -> NoReturn:
    """Answer requests until the host closes the connection or the FMU ends the process.

    begun: the host's heading. descriptors: of the connection, of the progress file and of what is printed to.
    dumps: takes the frames when it crashes.
    """
    try:
        os.setpgid(0, 0)  # with what the FMU may start
        _end_with(parent)
        connection, progress, printed = descriptors
        os.dup2(printed, 1)
        os.dup2(printed, 2)
        view = progress_in(progress)
        view[PROCESS], view[NOW] = os.getpid(), math.nan
        told = _dump_into(dumps)  # noqa: F841 - the system calls it at the end
        _limit(memory)
        host = Connection(connection)
        host.send_bytes(packed({"more": 1, "resident": resident(), "space": space()}))
        _serve(host, description, folder, begun, view)
    except (EOFError, OSError):
        pass  # the host is gone
    finally:
        os._exit(0)  # an FMU's library may hang in its own clean-up


def _serve(host: Connection, description: Any, folder: str, begun: Mapping[str, Any], view: memoryview[float]) -> None:
    """Load the FMU and answer requests. begun: what the host began with. view: where the progress is noted."""
    tell = _teller(view)
    jobs = _guarded(host, lambda: _loaded(description, folder, tell, view))
    if jobs is None:
        return
    host.send_bytes(packed({"done": 1}))
    while True:
        heading, arrays = unpacked(host.recv_bytes())
        tell()
        answer = _guarded(host, lambda h=heading, a=arrays: jobs.do(h, a), jobs)
        if answer is not None:
            found, out = answer
            host.send_bytes(packed({**found, "done": 1, "memory": resident(), "space": space()}, out))


def _teller(view: memoryview[float]) -> Callable[[], None]:
    """Return what notes that a run begins: the deadline is that of one run."""

    def tell() -> None:
        view[BEGAN] = time.monotonic()
        view[START] = view[STOP] = view[NOW] = math.nan

    return tell


def _loaded(description: Any, folder: str, tell: Any, view: memoryview[float]) -> Any:
    from hvdc_ident.fmu.jobs import Jobs
    from hvdc_ident.fmu.plant import Plant

    plant = Plant(description, folder)
    plant.binding.progress = view
    plant.instantiate()
    return Jobs(plant, tell)


def _guarded(host: Connection, work: Any, jobs: Any = None) -> Any:
    """What the work returns; None where it failed, which was told. A fatal failure ends the process.

    A failure with "again" may have come from what the process did before: the host asks once more in a new one.
    """
    from fmpy.fmi1 import FMICallException

    from hvdc_ident.fmu.plant import NoInstance, RunFailed

    fatal = False
    try:
        return work()
    except RunFailed as e:
        told: dict[str, Any] = {"failed": e.what, "hint": e.hint, "time": e.t}
        if isinstance(e, NoInstance) and jobs is not None:  # there was an instance: a process may give only one
            told["again"] = 1
    except FMICallException as e:
        words = {2: "discard", 3: "error", 4: "fatal"}.get(e.status, f"status {e.status}")
        told, fatal = {"failed": f"{e.function} returned {words}"}, e.status not in (2, 3)
    except MemoryError:
        told, fatal = {"failed": "not enough memory"}, True
    except Exception as e:  # a library that cannot be loaded or lacks a function; or a bug here
        told = {"failed": " ".join(f"{type(e).__name__}: {e}".split())[:500]}
    if jobs is not None:
        messages = jobs.plant.binding.messages
        told["said"] = messages[-1] if messages else ""
        messages.clear()
        jobs.plant.abandon()
    host.send_bytes(packed({"fatal": fatal, **told, "memory": resident(), "space": space()}))
    if fatal:
        os._exit(0)
    return None


def _end_with(parent: int) -> None:
    """Let the system end this process when its parent ends."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(0)


def _dump_into(dumps: socket.socket) -> object:
    """Dump the frames when this process crashes, gets SIGUSR1, or is ended by the FMU's exit. Return what to keep."""
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
