"""What this process takes, and those below it: a pool's workers are forked from a server, and no children of this one."""

from __future__ import annotations

import resource
from pathlib import Path

import psutil


def peak() -> float:
    """The most memory that this process has had, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def cpu_below() -> float:
    """Processor time so far of the processes below that run and of those that they have waited for, s."""
    return sum(sum(p.cpu_times()[:4]) for p in psutil.Process().children(recursive=True))


def peak_below() -> float:
    """The most memory that one of the processes below that run has had, MiB. Linux."""
    lines = [
        line
        for p in psutil.Process().children(recursive=True)
        for line in Path(f"/proc/{p.pid}/status").read_text().splitlines()
        if line.startswith("VmHWM:")
    ]
    return max((int(line.split()[1]) for line in lines), default=0) / 1024
