"""Results of a study as the page shows them: tables of text, and columns of curves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from hvdc_ident.axes import joined
from hvdc_ident.data import Array
from hvdc_ident.report.overlay import Overlay


def profile_columns(profile: Mapping[str, Any]) -> list[Array]:
    """Return the columns of a profile's picture, (n,) each: the values, the rise of the cost between what was computed, the
    rise computed, the 95 % level, and the ends of the interval; the rise in units of that level, nan where there is none.
    """
    x = np.array(profile["values"], dtype=float)
    rise = np.array(profile["rises"], dtype=float) / profile["threshold"]
    ends = [end for side in ("lower", "upper") if (end := profile[side]["limit"]) is not None]
    dense, between = joined(x, rise)
    at = np.unique(np.concatenate([dense, x, ends]))

    def only(places: Any, values: Any) -> Array:
        column = np.full(at.size, np.nan)
        column[np.searchsorted(at, places)] = values
        return column

    level = np.ones(at.size)
    return [at, np.interp(at, dense, between), only(x, rise), level, only(ends, 1.0)]


def overlay_columns(overlay: Overlay, sets: tuple[str, ...], *, errors: bool = False) -> list[Array]:
    """Return the columns of an output's picture, (n,) each: time, recorded, and the runs by set of values; nan where one is not.

    errors: recorded less simulated in place of the runs, and none in place of the recorded signal.
    """
    record = overlay.record
    missing = np.full(record.time.size, np.nan)
    columns = [record.time, missing if errors else record[f"{overlay.output}.measured"]]
    for name in sets:
        run = overlay.runs.get(name)
        if run is None or run.time.size != record.time.size:
            columns.append(missing)
        else:
            columns.append(overlay.error(name) if errors else run[overlay.output])
    return columns
