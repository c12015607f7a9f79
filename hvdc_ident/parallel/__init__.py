"""Work in other processes: limited in time, contained where it crashes or hangs, and ended with its owner, even where
that is killed.

Many items go to a `LocalPool`, on the library pebble. One piece of work goes to a `Child`, whose progress can be watched
(`Watch`) and whose end is told (`Ending`); `call` is one function there. Neither inherits threads or locks of this process:
pools fork from a server that has one thread, children begin as a new interpreter.
"""

import os
from typing import TYPE_CHECKING

from hvdc_ident.lazy import offered

if TYPE_CHECKING:
    from hvdc_ident.parallel.child import Child, ChildEndedError, Ending, call
    from hvdc_ident.parallel.patient import PatientPool
    from hvdc_ident.parallel.pool import LocalPool, OpenPool, can_start
    from hvdc_ident.parallel.progress import Watch
else:
    __getattr__ = offered(
        __name__,
        {
            "child": "Child ChildEndedError Ending call",
            "patient": "PatientPool",
            "pool": "LocalPool OpenPool can_start",
            "progress": "Watch",
        },
    )

__all__ = [
    "Child",
    "ChildEndedError",
    "Ending",
    "LocalPool",
    "OpenPool",
    "PatientPool",
    "Watch",
    "available_cores",
    "call",
    "can_start",
    "one_thread",
]

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def available_cores() -> int:
    """Return the number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def one_thread() -> dict[str, str]:
    """Return the environment that keeps linear algebra to one thread a process; empty where the present one says otherwise.

    There is a worker for every core: further threads would wait for each other.
    """
    return {} if any(n in os.environ for n in THREADS) else dict.fromkeys(THREADS, "1")
