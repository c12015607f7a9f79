"""Messages between a process and its worker: a JSON heading and arrays of doubles, which cannot run code; and
shared memory in which the worker notes its progress."""

from __future__ import annotations

import json
import math
import mmap
import tempfile
from collections.abc import Mapping
from math import prod
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Message = tuple[dict[str, Any], dict[str, Array]]
"""A heading and arrays."""
PROCESS, RESIDENT, SPACE, BEGAN, ITEM, START, STOP, NOW = range(8)
"""Places in the progress: the process at work; its bytes of memory and of address space before its work; when the present
piece of work began (s of the monotonic clock) and its number; of a run its first, last and present instant, s."""


def packed(heading: Mapping[str, Any], arrays: Mapping[str, Array] | None = None) -> bytes:
    """Return the bytes of a message."""
    parts = {n: np.ascontiguousarray(a, dtype="<f8") for n, a in (arrays or {}).items()}
    text = json.dumps({"heading": dict(heading), "arrays": {n: list(a.shape) for n, a in parts.items()}}).encode()
    return b"".join([len(text).to_bytes(8, "little"), text, *(a.tobytes() for a in parts.values())])


def unpacked(message: bytes) -> Message:
    """Return the heading and the arrays of a message. Raises ValueError where it is none."""
    size = int.from_bytes(message[:8], "little")
    outer = json.loads(message[8 : 8 + size])
    arrays, at = {}, 8 + size
    for name, shape in outer["arrays"].items():
        count = prod(shape)
        if at + 8 * count > len(message):
            raise ValueError("the message is shorter than it says")
        arrays[name] = np.frombuffer(message, dtype="<f8", count=count, offset=at).reshape(shape).astype(float)
        at += 8 * count
    return outer["heading"], arrays


def progress_file() -> IO[bytes]:
    """Return a file without a name that holds a worker's progress."""
    file = tempfile.TemporaryFile()  # noqa: SIM115 - it lives as long as the worker
    file.truncate(mmap.PAGESIZE)
    return file


def progress_in(file: int) -> memoryview[float]:
    """Return the doubles of a progress file, shared with every process that has it."""
    return memoryview(mmap.mmap(file, mmap.PAGESIZE)).cast("d")


def no_progress() -> memoryview[float]:
    """Return a progress that nobody watches."""
    view = memoryview(bytearray(8 * 8)).cast("d")
    view[NOW] = math.nan
    return view
