"""Integrators of other packages behind one interface: solve(f, start, times) returns the states at the times, (n, states)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib.util import find_spec
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from .plant import RTOL


def installed(module: str, package: str = "") -> bool:
    """Return True if a package is installed; name one that is not."""
    if find_spec(module) is not None:
        return True
    print(f"{package or module} is not installed: left out")
    return False


def scipy_way(method: str, rtol: float = RTOL) -> Callable[..., np.ndarray]:
    """Return scipy's integrator of that name."""

    def solve(f: Any, y: np.ndarray, times: np.ndarray) -> np.ndarray:
        done = solve_ivp(f, (times[0], times[-1]), y, method=method, t_eval=times, rtol=rtol, atol=rtol / 100)
        assert done.success, done.message
        return done.y.T

    return solve


def sundae_way(rtol: float = RTOL) -> Callable[..., np.ndarray]:
    """Return CVODE of scikit-sundae."""
    from sksundae.cvode import CVODE

    def solve(f: Any, y: np.ndarray, times: np.ndarray) -> np.ndarray:
        def rhs(t: float, x: np.ndarray, out: np.ndarray) -> None:
            out[:] = f(t, x)

        done = CVODE(rhs, rtol=rtol, atol=rtol / 100, max_num_steps=100_000).solve(times, y)
        assert done.success, done.message
        return done.y

    return solve


def ways(rtol: float = RTOL) -> Iterator[tuple[str, Callable[..., np.ndarray]]]:
    """Return the installed integrators by name."""
    for method in ("LSODA", "BDF", "Radau", "DOP853"):
        yield f"scipy {method}", scipy_way(method, rtol)
    if installed("sksundae", "scikit-sundae"):
        yield "scikit-sundae CVODE", sundae_way(rtol)
