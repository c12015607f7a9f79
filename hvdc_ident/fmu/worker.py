"""The process with an FMU's machine code in it: it answers the pool's requests. See `hvdc_ident.processes`.

Whatever the FMU prints goes to a file, whose end the pool quotes where it dies.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Mapping
from functools import partial
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

from hvdc_ident.fmu.archive import Folder
from hvdc_ident.fmu.description import Description
from hvdc_ident.processes.messages import BEGAN, NOW, PROCESS, START, STOP, packed, unpacked
from hvdc_ident.processes.server import resident, space


class Setup(NamedTuple):
    """An FMU's description, and the folder that it is unpacked into, whose lock is inherited."""

    description: Description
    folder: Folder


def prepare(setup: Setup) -> None:
    """Load what workers need: what one of them loads later would count as the FMU's memory."""
    import hvdc_ident.fmu.sensitivity_run  # noqa: F401

    if setup.description.interface == "model-exchange":
        import scipy.integrate  # noqa: F401


def finish(setup: Setup) -> None:
    """Remove the unpacked FMU where nobody else uses it."""
    setup.folder.release()


def serve(connection: Connection, progress: memoryview[float], setup: Setup, begun: Mapping[str, Any]) -> None:
    """Answer requests until the connection closes or the FMU ends the process. begun: what the pool has learned."""
    from hvdc_ident.fmu.fmi import why_not_loaded
    from hvdc_ident.fmu.instance import Instance, RunFailed
    from hvdc_ident.fmu.sensitivity_run import RequestHandler

    folder = str(setup.folder.binaries)

    def make(learned: dict[str, Any]) -> Instance:
        try:
            instance = Instance(setup.description, folder, learned)
        except MemoryError:
            raise
        except Exception as e:  # FMPy raises bare ones, beside those of ctypes
            what, hint = why_not_loaded(e, folder, setup.description)
            raise RunFailed(what, hint=hint) from None
        instance.library.progress = progress
        progress[PROCESS] = os.getpid()
        return instance

    def tell() -> None:
        progress[BEGAN] = time.monotonic()  # the deadline is that of one run
        progress[START] = progress[STOP] = progress[NOW] = math.nan

    def guarded(work: Callable[[], Any]) -> bool:
        """Answer with what the work returns or with its failure; return whether it did not fail.

        A fatal failure ends the process. One with "again" may have come from what the process did before: the pool asks
        once more in a new one.
        """
        try:
            found, out = work()
            told, fatal = {**found, "done": 1}, False
        except Exception as e:
            failed = jobs.failed(e)
            told, out, fatal = failed.told(), {}, failed.fatal
        progress[PROCESS] = os.getpid()  # of those that the work was done in
        taken = max(resident(), told.get("resident", 0)), max(space(), told.get("space", 0))
        connection.send_bytes(packed({**told, "memory": taken[0], "space": taken[1]}, out))
        if fatal:
            os._exit(0)
        return "done" in told

    jobs = RequestHandler(setup.description, make, tell, dict(begun))
    if not guarded(jobs.load):
        return
    while True:
        heading, arrays = unpacked(connection.recv_bytes())
        tell()
        guarded(partial(jobs.do, heading, arrays))
