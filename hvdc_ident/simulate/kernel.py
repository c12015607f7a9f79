"""Compilation of the integrators: once for an installation, and again where a file they are made from has changed."""

from __future__ import annotations

import hashlib
from functools import partial
from pathlib import Path

from numba import njit

# An inner function: kept without an entry from Python, which nobody uses. What is called from Python is cached as a whole.
kernel = partial(njit, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)

_FILES = (
    "call", "driver", "entries", "exogenous", "kernel", "lanes", "linear", "memory", "outputs", "patient", "rest",
    "segments", "state", "status", "steps", "switches", "tableaus", "unknowns",
)  # fmt: skip


def stamp(*facts: object) -> int:
    """A number that changes with the files the kernels are made from, and with the facts.

    The cache of machine code looks at the file of the outermost function alone, and at the values its closure holds:
    holding this number makes it look at all of them.
    """
    digest = hashlib.sha256(repr(facts).encode())
    for name in _FILES:
        digest.update((Path(__file__).parent / f"{name}.py").read_bytes())
    return int.from_bytes(digest.digest()[:7], "big")
