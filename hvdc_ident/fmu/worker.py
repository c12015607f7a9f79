"""The process that has an FMU's machine code in it: `python -m hvdc_ident.fmu.worker IN OUT`, numbers of two pipes.

It is started and watched by `hvdc_ident.fmu.host`. Whatever the FMU prints goes to stderr, whose end the host quotes
where the process dies.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from multiprocessing.connection import Connection
from typing import Any


def main() -> None:
    """Nothing; requests are answered until the pipe closes."""
    inward, outward = int(sys.argv[1]), int(sys.argv[2])
    requests = Connection(inward, writable=False)
    answers = Connection(outward, readable=False)
    os.dup2(2, 1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(EOFError, OSError):
        _serve(requests, answers)
    os._exit(0)  # an FMU's library may hang in its own clean-up


def _serve(requests: Connection, answers: Connection) -> None:
    import pickle

    from hvdc_ident.fmu.messages import packed, unpacked

    heading, _ = unpacked(requests.recv_bytes())
    description = pickle.loads(requests.recv_bytes())  # from the parent, which is trusted
    _limit(heading["parent"], heading["memory"])
    jobs = _guarded(
        answers, lambda: _loaded(description, heading["folder"], lambda: answers.send_bytes(packed({"more": 1})))
    )
    if jobs is None:
        return
    answers.send_bytes(packed({"done": 1}))
    while True:
        heading, arrays = unpacked(requests.recv_bytes())
        answer = _guarded(answers, lambda h=heading, a=arrays: jobs.do(h, a), jobs)
        if answer is not None:
            found, out = answer
            answers.send_bytes(packed({**found, "done": 1, "memory": _resident()}, out))


def _loaded(description: Any, folder: str, tell: Any) -> Any:
    from hvdc_ident.fmu.jobs import Jobs
    from hvdc_ident.fmu.plant import Plant

    plant = Plant(description, folder)
    plant.instantiate()
    return Jobs(plant, tell)


def _guarded(answers: Connection, work: Any, jobs: Any = None) -> Any:
    """What the work returns; None where it failed, which was told. A fatal failure ends the process."""
    from fmpy.fmi1 import FMICallException

    from hvdc_ident.fmu.messages import packed
    from hvdc_ident.fmu.plant import RunFailed

    fatal = False
    try:
        return work()
    except RunFailed as e:
        told: dict[str, Any] = {"failed": e.what, "hint": e.hint, "time": e.t}
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
    answers.send_bytes(packed({"fatal": fatal, **told}))
    if fatal:
        os._exit(0)
    return None


def _limit(parent: int, memory: int | None) -> None:
    """Nothing; the process ends with its parent and may take so many bytes more than it has now."""
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()
    if memory is not None:
        with contextlib.suppress(ImportError, OSError, ValueError):
            import resource

            import scipy.integrate  # noqa: F401 - what is loaded later would count as the FMU's

            with open("/proc/self/statm", encoding="ascii") as sizes:
                now = int(sizes.read().split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (now + memory, now + memory))
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _watch(parent: int) -> None:
    """Nothing; the process ends soon after its parent, even where the FMU hangs."""
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(0)


def _resident() -> int:
    """Bytes of memory in use; 0 where the system does not tell."""
    with contextlib.suppress(OSError, ValueError, ImportError):
        import resource

        with open("/proc/self/statm", encoding="ascii") as sizes:
            return int(sizes.read().split()[1]) * resource.getpagesize()
    return 0


if __name__ == "__main__":
    main()
