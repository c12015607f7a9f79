"""What the processes below this one take: a pool's workers are forked from a server, and no children of this process."""

from __future__ import annotations

from pathlib import Path

import psutil


def cpu() -> float:
    """Processor time so far of those that run and of those that they have waited for, s."""
    return sum(sum(p.cpu_times()[:4]) for p in psutil.Process().children(recursive=True))


def peak() -> float:
    """The most memory that one of those that run has had, MiB. Linux."""
    lines = [
        line
        for p in psutil.Process().children(recursive=True)
        for line in Path(f"/proc/{p.pid}/status").read_text().splitlines()
        if line.startswith("VmHWM:")
    ]
    return max((int(line.split()[1]) for line in lines), default=0) / 1024
