"""The processor cores that a process may use, and linear algebra on one of them."""

from __future__ import annotations

import os

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def available_cores() -> int:
    """Return the number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def one_thread() -> dict[str, str]:
    """Return the environment that keeps linear algebra to one thread a process; empty where the present one says otherwise.

    There is a worker for every core: further threads would wait for each other.
    """
    return {} if any(n in os.environ for n in THREADS) else dict.fromkeys(THREADS, "1")
