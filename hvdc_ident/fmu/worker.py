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
from functools import partial
from multiprocessing.connection import Connection
from typing import Any, NoReturn

from hvdc_ident.fmu.isolation import end_with, resident, space
from hvdc_ident.fmu.messages import BEGAN, NOW, PROCESS, START, STOP, packed, progress_in, unpacked


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
        end_with(parent)
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
    """Answer requests until the connection closes. begun: what the host began with. view: where the progress is noted."""
    from hvdc_ident.fmu.binding import why_not_loaded
    from hvdc_ident.fmu.jobs import Jobs
    from hvdc_ident.fmu.plant import Plant, RunFailed

    def make(learned: dict[str, Any]) -> Plant:
        try:
            plant = Plant(description, folder, learned)
        except MemoryError:
            raise
        except Exception as e:  # FMPy raises bare ones, beside those of ctypes
            what, hint = why_not_loaded(e, folder, description)
            raise RunFailed(what, hint=hint) from None
        plant.binding.progress = view
        view[PROCESS] = os.getpid()
        return plant

    tell = _teller(view)
    jobs = Jobs(description, make, tell, begun["learned"])
    if not _guarded(host, jobs, jobs.load, view):
        return
    while True:
        heading, arrays = unpacked(host.recv_bytes())
        tell()
        _guarded(host, jobs, partial(jobs.do, heading, arrays), view)


def _teller(view: memoryview[float]) -> Callable[[], None]:
    """Return what notes that a run begins: the deadline is that of one run."""

    def tell() -> None:
        view[BEGAN] = time.monotonic()
        view[START] = view[STOP] = view[NOW] = math.nan

    return tell


def _guarded(host: Connection, jobs: Any, work: Callable[[], Any], view: memoryview[float]) -> bool:
    """Answer with what the work returns or with its failure; return whether it did not fail.

    A fatal failure ends the process. One with "again" may have come from what the process did before: the host asks once
    more in a new one.
    """
    try:
        found, out = work()
        told, fatal = {**found, "done": 1}, False
    except Exception as e:
        failed = jobs.failed(e)
        told, out, fatal = failed.told(), {}, failed.fatal
    view[PROCESS] = os.getpid()  # of those that the work was done in
    taken = max(resident(), told.get("resident", 0)), max(space(), told.get("space", 0))
    host.send_bytes(packed({**told, "memory": taken[0], "space": taken[1]}, out))
    if fatal:
        os._exit(0)
    return "done" in told


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
