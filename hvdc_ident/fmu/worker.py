"""The processes that have to do with an FMU's machine code: `python -m hvdc_ident.fmu.worker IN OUT`, numbers of pipes.

The one that `hvdc_ident.fmu.host` starts forks: the child loads the FMU and answers, the parent waits for its end and
tells it with the memory it had used, which the system says of a forked process alone. Whatever the FMU prints goes to
stderr, whose end the host quotes where it dies.
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
    """Nothing; requests are answered until the pipe closes or the FMU ends its process."""
    inward, outward = int(sys.argv[1]), int(sys.argv[2])
    requests = Connection(inward, writable=False)
    answers = Connection(outward, readable=False)
    os.dup2(2, 1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(EOFError, OSError):
        _begin(requests, answers)
    os._exit(0)  # an FMU's library may hang in its own clean-up


def _begin(requests: Connection, answers: Connection) -> None:
    import pickle

    from hvdc_ident.fmu.messages import packed, unpacked

    heading, _ = unpacked(requests.recv_bytes())
    description = pickle.loads(requests.recv_bytes())  # from the host, which is trusted
    import hvdc_ident.fmu.jobs  # noqa: F401 - what is loaded later would count as the FMU's memory

    if description.interface == "model-exchange":
        import scipy.integrate  # noqa: F401
    child = os.fork()
    if child == 0:
        _limit(heading["memory"])
        answers.send_bytes(packed({"more": 1, "resident": _resident()}))
        _serve(requests, answers, description, heading["folder"])
        return
    requests.close()
    threading.Thread(target=_watch, args=(heading["parent"], child), daemon=True).start()
    answers.send_bytes(packed({"more": 1, "child": child}))
    _, status, usage = os.wait4(child, 0)
    answers.send_bytes(packed({"ended": os.waitstatus_to_exitcode(status), "peak": usage.ru_maxrss * 1024}))


def _serve(requests: Connection, answers: Connection, description: Any, folder: str) -> None:
    from hvdc_ident.fmu.messages import packed, unpacked

    jobs = _guarded(answers, lambda: _loaded(description, folder, lambda: answers.send_bytes(packed({"more": 1}))))
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
    """What the work returns; None where it failed, which was told. A fatal failure ends the process.

    A failure with "again" may have come from what the process did before: the host asks once more in a new one.
    """
    from fmpy.fmi1 import FMICallException

    from hvdc_ident.fmu.messages import packed
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
    answers.send_bytes(packed({"fatal": fatal, **told}))
    if fatal:
        os._exit(0)
    return None


def _limit(memory: int | None) -> None:
    """Nothing; the process may take so many bytes more than it has now, and leaves no core file."""
    if memory is not None:
        with contextlib.suppress(ImportError, OSError, ValueError):
            import resource

            with open("/proc/self/statm", encoding="ascii") as sizes:
                now = int(sizes.read().split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (now + memory, now + memory))
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _watch(parent: int, child: int) -> None:
    """Nothing; both processes end soon after the host, even where the FMU hangs."""
    while os.getppid() == parent:
        time.sleep(1.0)
    with contextlib.suppress(OSError):
        os.kill(child, signal.SIGKILL)
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
