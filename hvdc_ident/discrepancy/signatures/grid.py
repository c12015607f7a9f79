"""The instants at which a signature is computed: the recorded rows, both sides of every jump, and more after it and after corners."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, Experiment

FEWEST = 600
"""Fewer instants over a record are filled up."""
AFTER = np.geomspace(2e-5, 2e-2, 22)
"""Where instants are put after a jump, s: what a missing lag or delay does happens there."""
AROUND = AFTER[10:17:6]
"""The same after a corner, where less happens at once: an input that was recorded has one at every row."""


def instants(experiment: Experiment) -> tuple[Array, NDArray[np.int64]]:
    """(K,) instants, s, a jump's twice; and (K,) the row of the record that each is, -1 where it is none."""
    time = experiment.time
    begin, end = float(time[0]), float(time[-1])
    rows = np.unique(time)
    pieces = max(1, int(np.ceil(FEWEST / max(rows.size - 1, 1))))
    inner = [rows[:-1] + k / pieces * np.diff(rows) for k in range(1, pieces)]
    inputs = experiment.inputs.values()
    breaks = np.unique([b for s in inputs for b in s.breaks.tolist() if begin < b < end])
    jumps = np.intersect1d(breaks, [t for s in inputs for t in s.jumps.tolist()])
    after = [b + (AFTER if b in jumps else AROUND) for b in breaks]
    inside = np.concatenate([np.empty(0), *after])
    every = np.unique(np.concatenate([rows, *inner, inside[inside < end], breaks]))
    close = np.append(False, np.diff(every) < 1e-9 * max(end - begin, 1e-12)) & ~np.isin(every, rows)
    every = every[~close]
    grid = np.sort(np.concatenate([every, np.intersect1d(every, jumps)]))
    row = np.full(grid.size, -1, dtype=np.int64)
    # Of an instant that stands twice on the grid and once in the record the later one is compared: after the jump.
    left, right = np.searchsorted(grid, time, "left"), np.searchsorted(grid, time, "right") - 1
    first = np.append(np.diff(time) == 0, False)
    row[np.where(first, left, right)] = np.arange(time.size)
    return grid, row
