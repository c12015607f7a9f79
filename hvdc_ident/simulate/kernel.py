"""How the integrators' inner functions are compiled: cached, and without an entry from Python, which nobody uses."""

from __future__ import annotations

from functools import partial

from numba import njit

kernel = partial(njit, cache=True, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)
