"""Errors in the language of model validation: maximum, mean and mean absolute error before, during and after an event.

The error is model - reference. Kinds of error and windows after IEC 61400-27-2; a tolerance profile has the numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, Experiment
from hvdc_ident.fit.assessment import Curve
from hvdc_ident.fit.tolerance import WINDOWS, ToleranceProfile

Span = tuple[float, float]


def windowed_errors(
    found: Mapping[str, Mapping[str, Curve]],
    experiments: tuple[Experiment, ...],
    profile: ToleranceProfile,
    units: Mapping[str, str],
) -> dict[str, Any]:
    """The errors by output and experiment, with the profile they are held against.

    Each: event, end (s; the instant the event is over), end_from ("inputs" or "settling"), and for each window `from`,
    `to` (s), n, max, mean, mean_absolute (in the output's unit), limits and within (None where there is no limit for
    the unit, or no row in the window). found: curves by experiment and output. units: of the outputs.
    """
    table: dict[str, dict[str, Any]] = {}
    by_name = {e.name: e for e in experiments}
    for name, line in found.items():
        for output, curve in line.items():
            table.setdefault(output, {})[name] = _errors(by_name[name], output, curve, profile, units.get(output, ""))
    head = {"name": profile.name, "version": profile.version, "title": profile.title, "source": profile.source}
    return {"profile": {**head, "notes": profile.notes, "unit": profile.unit}, "errors": table}


def _errors(e: Experiment, output: str, curve: Curve, profile: ToleranceProfile, unit: str) -> dict[str, Any]:
    if e.event is None:
        return {"event": None, "reason": "no event: no input moves and none is given"}
    end, source = event_end(e, curve.measured, profile.windows["settling"])
    spans = windows(e, end, profile)
    rows = np.zeros(e.time.size, dtype=bool)
    rows[curve.rows] = True
    limited = unit == profile.unit
    return {
        "event": e.event,
        "end": end,
        "end_from": source,
        **{w: _window(e.time, spans[w], rows, curve, profile.limits[w] if limited else None) for w in WINDOWS},
    }


def _window(
    time: Array, span: Span, rows: NDArray[np.bool_], curve: Curve, limits: Mapping[str, float] | None
) -> dict[str, Any]:
    inside = rows & (time >= span[0]) & (time <= span[1])
    n = int(inside.sum())
    line: dict[str, Any] = {"from": span[0], "to": span[1], "n": n, "limits": dict(limits) if limits else None}
    if n == 0:
        return {**line, "max": None, "mean": None, "mean_absolute": None, "within": None}
    error = curve.model[inside] - curve.measured[inside]
    found = {
        "max": float(np.abs(error).max()),
        "mean": float(error.mean()),
        "mean_absolute": float(np.abs(error).mean()),
    }
    within = all(abs(found[k]) <= v for k, v in limits.items()) if limits else None
    return {**line, **found, "within": within}


def windows(e: Experiment, end: float, profile: ToleranceProfile) -> dict[str, Span]:
    """From and to, in s, of each window around an event that is over at `end`; one that is empty ends before it begins."""
    assert e.event is not None
    w = profile.windows
    first, last = float(e.time[0]), float(e.time[-1])
    until = e.event - w["gap_before"]
    cleared = end + w["gap_cleared"]
    return {
        "before": (max(first, until - w["before"]), until),
        "during": (e.event + w["gap_start"], end - w["gap_end"]),
        "after": (cleared, min(last - w["gap_end"], cleared + w["after"])),
    }


def event_end(e: Experiment, reference: Array, settling: float) -> tuple[float, str]:
    """The instant the event is over, s, and what says so.

    "inputs": the last change of an input, where that is later than the event (the end of a ramp, the clearing of a
    dip). "settling": for a step, the last instant the reference is farther from its last value than the given share of
    its whole change.
    """
    assert e.event is not None
    ends = [e.event]
    for signal in e.inputs.values():
        moving = np.flatnonzero(np.diff(signal.values) != 0)
        if moving.size:
            ends.append(float(signal.times[moving[-1] + 1]))
    over = max(t for t in ends if t <= e.time[-1]) if any(t <= e.time[-1] for t in ends) else float(e.time[-1])
    if over > e.event:
        return over, "inputs"
    later = (e.time >= e.event) & np.isfinite(reference)
    y, t = reference[later], e.time[later]
    if y.size < 2 or np.ptp(y) == 0:
        return e.event, "settling"
    last = float(np.mean(y[-max(1, y.size // 50) :]))
    out = np.flatnonzero(np.abs(y - last) > settling * float(np.ptp(y)))
    return (float(t[min(out[-1] + 1, t.size - 1)]) if out.size else e.event), "settling"
