"""What travels between a process and its worker: a JSON heading and arrays of doubles. Nothing in it can run code."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from hvdc_ident.trajectory import Array


def packed(heading: Mapping[str, Any], arrays: Mapping[str, Array] | None = None) -> bytes:
    """The bytes of a message."""
    parts = {n: np.ascontiguousarray(a, dtype="<f8") for n, a in (arrays or {}).items()}
    text = json.dumps({"heading": dict(heading), "arrays": {n: list(a.shape) for n, a in parts.items()}}).encode()
    return b"".join([len(text).to_bytes(8, "little"), text, *(a.tobytes() for a in parts.values())])


def unpacked(message: bytes) -> tuple[dict[str, Any], dict[str, Array]]:
    """The heading and the arrays of a message. Raises ValueError where it is none."""
    size = int.from_bytes(message[:8], "little")
    outer = json.loads(message[8 : 8 + size])
    arrays, at = {}, 8 + size
    for name, shape in outer["arrays"].items():
        count = int(np.prod(shape, dtype=int))
        if at + 8 * count > len(message):
            raise ValueError("the message is shorter than it says")
        arrays[name] = np.frombuffer(message, dtype="<f8", count=count, offset=at).reshape(shape).astype(float)
        at += 8 * count
    return outer["heading"], arrays
