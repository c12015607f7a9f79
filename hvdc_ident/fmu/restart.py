"""The way an FMU is brought back to the start of a run: by a reset, by a new instance, or by a new process. In the worker alone.

The cheapest way is taken whose second run repeats the first run of a fresh process, over a whole run and in every
output. It is found once for an FMU, for values at the start alone do not tell: FMUs were seen whose reset brings the
start back and nothing else. Outputs that two fresh processes do not repeat either, as the time that the computation
took, do not judge.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array
from hvdc_ident.fmu.plant import Plant, RunFailed, failure
from hvdc_ident.processes.server import die_like, in_new_process

Way = Literal["reset", "instance", "process"]
Make = Callable[[dict[str, Any]], Plant]
"""Loads the FMU into this process, with what is learned of it; what the plant finds out joins that."""

SAME = 1e-9
"""Share of an output's largest value by which a repeated run may differ. The same program from the same state repeats
itself to the last digit; sums in another order, as of threads, change that by rounding: 1e-16 in each of a million."""
SPREAD = 10.0
"""Differences between two fresh processes that a repeated run may have where no output repeats: one difference of a
normal spread is below a tenth of the next in 6 of 100 pairs, and of several outputs hardly ever in all."""


def find_restart(make: Make, run: Callable[[Plant], Array]) -> tuple[Way, Array]:
    """Return the way and the first run, (n, signals). Raises RunFailed where the first run fails.

    run: a run from the start, the same each time.
    """
    first, reset = _twice(make, run, "reset")
    if _repeats(reset, first, np.zeros(first.shape[1])):
        return "reset", first
    fresh, instance = _twice(make, run, "instance")
    noise = np.nan_to_num(np.abs(fresh - first)).max(axis=0, initial=0.0)
    if _repeats(reset, first, noise):
        return "reset", first
    return ("instance" if _repeats(instance, fresh, noise) else "process"), first


def _twice(make: Make, run: Callable[[Plant], Array], way: Way) -> tuple[Array, Array | None]:
    """Return the first run in a new process, and the second by a way to restart; None where that one failed."""

    def work(hand: Callable[[tuple[dict[str, Any], dict[str, Array]]], None]) -> None:
        plant = make({"restart": way})
        for _ in range(2):
            rows = run(plant)
            if plant.learned["restart"] == way:
                hand(({}, {"rows": rows}))

    parts, end = in_new_process(work, lambda e: failure(e).told())
    runs = [arrays["rows"] for _, arrays in parts]
    if not runs:
        if isinstance(end, dict):
            raise RunFailed.heard(end)
        die_like(end or 0)
    return runs[0], (runs[1] if len(runs) > 1 else None)


def apart(run: Array, other: Array) -> Array:
    """Return the largest difference over rows, (signals,); infinite where only one of them is not a number."""
    off = np.abs(run - other)
    off[np.isnan(run) & np.isnan(other)] = 0.0
    return np.asarray(np.nan_to_num(off, nan=np.inf).max(axis=0, initial=0.0))


def moving(run: Array) -> NDArray[np.bool_]:
    """Return which signals of a run move, (signals,): one at rest throughout cannot tell a start from an end."""
    known = np.nan_to_num(run)
    return np.asarray(np.ptp(known, axis=0) > SAME * np.abs(known).max(axis=0, initial=0.0))


def _repeats(run: Array | None, first: Array, noise: Array) -> bool:
    """Return whether a run repeats the first. noise: (signals,) by how much two fresh processes differ."""
    if run is None:
        return False
    size = np.nan_to_num(np.abs(first)).max(axis=0, initial=0.0)
    off = apart(run, first)
    steady = noise <= SAME * size
    if steady.any() or not noise.size:
        return bool((off <= SAME * size)[steady].all())
    return bool((off <= SPREAD * noise).all())
