"""Jobs for the pool's workers, in a module they can import."""

from __future__ import annotations

import os
import signal
import threading
from pathlib import Path


class Job:
    """Squares numbers; some of them end the worker, hang, fail, or end the worker the first time only."""

    def __init__(self, dies=(), hangs=(), fails=(), once=None):
        self.dies, self.hangs, self.fails, self.once = dies, hangs, fails, once

    def __call__(self, x):
        if x in self.dies:
            os.kill(os.getpid(), signal.SIGSEGV)
        if x in self.hangs:
            threading.Event().wait()
        if x in self.fails:
            raise ValueError("a bad number")
        if self.once is not None and x == 5 and not Path(self.once).exists():
            Path(self.once).touch()
            os._exit(3)
        return x * x


class OnlyIn:
    """Squares numbers in one process, and fails in every other one."""

    def __init__(self, process):
        self.process = process

    def __call__(self, x):
        if os.getpid() != self.process:
            raise RuntimeError("only one process may hold the licence")
        return x * x


class Unloadable:
    """Cannot be made in a worker."""

    def __reduce__(self):
        return os._exit, (7,)

    def __call__(self, x):
        return x


def environment(name):
    """A variable of the worker's environment."""
    return os.environ.get(name)


def process(_):
    """Which process the item is worked out in."""
    return os.getpid()


def end_and_hang(process):
    """Never: another process is killed first."""
    os.kill(process, signal.SIGKILL)
    threading.Event().wait()
