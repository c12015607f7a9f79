"""The process with an FMU's machine code in it: it answers the pool's requests. See `hvdc_ident.processes`.

Whatever the FMU prints goes to a file, whose last line the pool quotes where the process ends.
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


def serve(connection: Connection, progress: memoryview[float], setup: Setup, learned: Mapping[str, Any]) -> None:
    """Answer requests until the connection closes or the FMU ends the process. learned: by earlier workers."""
    from hvdc_ident.fmu.fmi import why_not_loaded
    from hvdc_ident.fmu.instance import Instance, RunFailed
    from hvdc_ident.fmu.sensitivity_run import RequestHandler

    folder = str(setup.folder.binaries)

    def load(learned: dict[str, Any]) -> Instance:
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

    def restart_deadline() -> None:
        progress[BEGAN] = time.monotonic()  # the deadline is that of one run
        progress[START] = progress[STOP] = progress[NOW] = math.nan

    def answer(work: Callable[[], tuple[Mapping[str, Any], Mapping[str, Any]]]) -> bool:
        """Send the work's result or its failure; return whether it succeeded.

        A fatal failure ends the process. One with "again" may have come from what the process did before: the pool asks
        once more in a new one.
        """
        try:
            result, arrays = work()
            heading, fatal = {**result, "done": 1}, False
        except Exception as e:
            failed = handler.failed(e)
            heading, arrays, fatal = failed.heading(), {}, failed.fatal
        progress[PROCESS] = os.getpid()  # the work may have used others
        memory = {"memory": max(resident(), heading.get("resident", 0)), "space": max(space(), heading.get("space", 0))}
        connection.send_bytes(packed({**heading, **memory}, arrays))
        if fatal:
            os._exit(0)
        return "done" in heading

    handler = RequestHandler(setup.description, load, restart_deadline, dict(learned))
    if not answer(handler.load):
        return
    while True:
        heading, arrays = unpacked(connection.recv_bytes())
        restart_deadline()
        answer(partial(handler.do, heading, arrays))
